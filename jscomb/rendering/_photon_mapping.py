"""Stochastic progressive photon mapping with Mitsuba 3 and Dr.Jit.

Each pass is an image by itself: photons of its own, one path from the eye through each
pixel, and a radius that is known beforehand (Knaus and Zwicker 2011),

    r_{i+1}^2 = r_i^2 (i + alpha) / (i + 1),

the same for two passes in a row, so that passes of even and of odd number are halves
alike in all but their random numbers. The result's bias vanishes with the radius; its
variance is that of the mean of passes.

Hachisuka and Jensen give each pixel a radius of its own, from the M_i photons that it
found in pass i and the N_i = alpha (M_1 + ... + M_{i-1}) that it counts,

    r_{i+1}^2 = r_i^2 (N_i + alpha M_i) / (N_i + M_i).

Photons in proportion to the area, M_i = c r_i^2, leave these radii without c: N_i / M_i
grows by one a pass, and they shrink as above, in every pixel alike. What is left of the
statistics is their noise: pixels that expect 20 photons in the first pass have the same
radius within 3 %, those that expect one in 20 passes one 1.7 times as large, since a
pixel waits for its first photons: more bias, less noise. But radii that follow the
photons tie each pass to all before it. One radius a pass keeps passes independent, and
so the halves and the variance that double shrinkage needs.

A pass: photons leave the lights and are stored where they meet a surface that reflects
diffusely, but for their first meeting, which is direct light. Eye paths go on by
whatever a surface has besides: mirrors, glass, gloss. At each surface they take what
lights shine on it directly (on gloss weighted against what the path itself meets of the
lights, by the balance heuristic), and the photons within the radius, each by the
surface's diffuse reflectance alone: a photon is worth as much as the reflectance at its
direction, and in a sharp highlight a single one would be a firefly. Principled
materials of Mitsuba cannot be taken apart; photons light them as a whole.

Photons count wherever they lie within the radius. A wall that is nearer than the radius
to the inside of a lamp's housing takes its light, until the radius has shrunk.

Source: T. Hachisuka, H. W. Jensen, "Stochastic progressive photon mapping", 2009; C.
Knaus, M. Zwicker, "Progressive photon mapping: a probabilistic approach", 2011.
"""

import math
from typing import NamedTuple

import numpy as np

from jscomb.rendering._scenes import MAX_DEPTH

ALPHA = 2 / 3
ROOM = 8  # meetings that are stored, times the photons; doubled where it is short
FIRST_RADIUS = 0.01  # of the first passes, times the diagonal of the scene


def relative_radius(number: int) -> float:
    """Radius of a pass, relative to the first one's; the same for two in a row."""
    shrunk = [(i + ALPHA) / (i + 1) for i in range(1, number // 2 + 1)]
    return math.prod(shrunk) ** 0.5


class Photons(NamedTuple):
    """Where photons met a surface, sorted by cell; Dr.Jit arrays.

    Attributes:
        position: of the meeting.
        direction: to where it came from.
        power: flux.
        edges: of its path so far.
        start: number of the first photon in each bucket, and after the last.
    """

    position: object
    direction: object
    power: object
    edges: object
    start: object


class PhotonMapper:
    """One scene's photons and eye paths; a class, since both share so much."""

    def __init__(self, mi, scene, count: int) -> None:
        if mi.variant().startswith("scalar"):
            raise ValueError(
                "photon mapping needs a vectorised variant of Mitsuba: install LLVM 17 "
                f"or newer (apt install libllvm19), got {mi.variant()}"
            )
        import drjit as dr  # comes with Mitsuba

        self.mi, self.dr, self.scene = mi, dr, scene
        self.count, self.room = count, max(1, int(ROOM * count))

    def render(self, seed: int, radius: float) -> np.ndarray:
        """One pass, [H,W,3]."""
        stored = None
        while stored is None:
            stored = self._traced(seed)
        # Opaque: a constant in the kernels, each radius would have to be compiled anew.
        opaque = self.dr.opaque(self.mi.Float, radius)
        return self._image(seed, opaque, self._sorted(stored, opaque))

    def _numbers(self, seed: int, count: int):
        """Independent streams of random numbers, one a lane."""
        mi, dr = self.mi, self.dr
        lane = dr.arange(mi.UInt32, count)
        state, sequence = mi.sample_tea_32(dr.opaque(mi.UInt32, seed, count), lane)
        return mi.PCG32(initstate=mi.UInt64(state), initseq=mi.UInt64(sequence))

    def _emitted(self, numbers):
        """Rays from the lights, and their flux."""
        mi = self.mi
        pair = lambda: mi.Point2f(numbers.next_float32(), numbers.next_float32())
        which, where, towards = numbers.next_float32(), pair(), pair()
        ray, power, lamp = self.scene.sample_emitter_ray(
            0.0, which, where, towards, True
        )
        # Mitsuba 3.9 lets the rays of a turned environment map start from a disk that
        # is not turned, and so too many of them meet the scene.
        around = self.scene.bbox().bounding_sphere()
        radius = around.radius * (1 + mi.math.RayEpsilon)
        disk = mi.warp.square_to_uniform_disk_concentric(where)
        across = mi.Frame3f(ray.d).to_world(mi.Vector3f(disk.x, disk.y, 0))
        far = mi.has_flag(lamp.flags(), mi.EmitterFlags.Infinite)
        start = around.center + radius * (across - ray.d)
        ray.o = self.dr.select(far, start, ray.o)
        return ray, power

    def _traced(self, seed: int):
        """All meetings with surfaces, NumPy arrays; None, and more room, if short."""
        mi, dr, room = self.mi, self.dr, self.room
        numbers = self._numbers(2 * seed, self.count)
        ray, power = self._emitted(numbers)
        position, direction = dr.zeros(mi.Point3f, room), dr.zeros(mi.Vector3f, room)
        flux, edges = dr.zeros(mi.Color3f, room), dr.zeros(mi.UInt32, room)
        order, used = dr.zeros(mi.UInt32, room), dr.zeros(mi.UInt32, 1)
        path = dr.arange(mi.UInt32, self.count)
        context = mi.BSDFContext(mi.TransportMode.Importance)

        def step(ray, power, depth, active, numbers):
            si = self.scene.ray_intersect(ray, active)
            active &= si.is_valid()
            bsdf = si.bsdf(ray)
            diffuse = mi.has_flag(bsdf.flags(), mi.BSDFFlags.Diffuse)
            # The first meeting is direct light, which eye paths take care of.
            store = active & diffuse & (depth > 0)
            slot = dr.scatter_inc(used, mi.UInt32(0), store)
            store &= slot < room
            dr.scatter(position, si.p, slot, store)
            dr.scatter(direction, -ray.d, slot, store)
            dr.scatter(flux, power, slot, store)
            dr.scatter(edges, depth + 1, slot, store)
            dr.scatter(order, path * MAX_DEPTH + depth, slot, store)
            first = numbers.next_float32(active)
            second = mi.Point2f(
                numbers.next_float32(active), numbers.next_float32(active)
            )
            sample, weight = bsdf.sample(context, si, first, second, active)
            out = si.to_world(sample.wo)
            # Importance is not symmetric under interpolated normals.
            towards, away = dr.dot(si.n, -ray.d), dr.dot(si.n, out)
            cosines = mi.Frame3f.cos_theta(sample.wo) * towards
            active &= (towards * mi.Frame3f.cos_theta(si.wi) > 0) & (
                away * mi.Frame3f.cos_theta(sample.wo) > 0
            )
            weight *= abs(mi.Frame3f.cos_theta(si.wi) * away / cosines)
            # Photons that go on keep their power, so that all have about the same.
            survive = dr.minimum(dr.max(weight), 0.95)
            active &= numbers.next_float32(active) < survive
            power = dr.select(active, power * weight / survive, power)
            depth += 1
            active &= depth < MAX_DEPTH - 1
            return si.spawn_ray(out), power, depth, active, numbers

        dr.while_loop(
            (ray, power, mi.UInt32(0) + 0 * path, dr.max(power) > 0, numbers),
            lambda ray, power, depth, active, numbers: active,
            step,
        )
        dr.eval(position, direction, flux, edges, order, used)
        number = int(used[0])
        if number > room:
            self.room *= 2
            return None
        arrays = position, direction, flux, edges, order
        return [np.array(array)[..., :number] for array in arrays]

    def _sorted(self, stored: list[np.ndarray], radius) -> Photons:
        """Photons in the order of their cells' buckets, and of their paths in each."""
        mi = self.mi
        position, direction, power, edges, order = stored
        self.buckets = 1 << max(10, int(position.shape[1]).bit_length())
        # By components: of [3,N] the kernels would be compiled anew for every N.
        vector = lambda of, array: of(*(mi.Float(row) for row in array))
        cell = mi.Vector3u(self._cell(vector(mi.Point3f, position), radius))
        bucket = np.array(_hash(*cell) & (self.buckets - 1))
        by = np.lexsort((order, bucket))
        start = np.searchsorted(bucket[by], np.arange(self.buckets + 1))
        return Photons(
            vector(mi.Point3f, position[:, by]),
            vector(mi.Vector3f, direction[:, by]),
            vector(mi.Color3f, power[:, by]),
            mi.UInt32(edges[by]),
            mi.UInt32(start.astype(np.uint32)),
        )

    def _cell(self, position, radius):
        """The cell of a point, two radii wide.

        The only place that rounds: walls often lie where two cells meet.
        """
        return self.mi.Vector3i(self.dr.floor(position * (0.5 / radius)))

    def _image(self, seed: int, radius, photons: Photons) -> np.ndarray:
        """Eye paths, and at their ends direct light and photons."""
        mi, dr = self.mi, self.dr
        sensor = self.scene.sensors()[0]
        width, height = (int(n) for n in sensor.film().size())
        lane = dr.arange(mi.UInt32, width * height)
        numbers = self._numbers(2 * seed + 1, width * height)
        pixel = mi.Point2f(mi.Float(lane % width), mi.Float(lane // width))
        inside = mi.Point2f(numbers.next_float32(), numbers.next_float32())
        ray, weight = sensor.sample_ray(
            0.0, 0.5, (pixel + inside) / mi.Point2f(width, height), mi.Point2f(0.5)
        )

        def step(ray, weight, radiance, edges, active, last, pdf, numbers):
            si = self.scene.ray_intersect(ray, active)
            lamp = si.emitter(self.scene, active)
            before = dr.zeros(mi.Interaction3f)
            before.p = last
            seen = mi.DirectionSample3f(self.scene, si, before)
            by_lamp = active & (pdf > 0)
            chance = self.scene.pdf_emitter_direction(before, seen, by_lamp)
            share = dr.select(pdf > 0, pdf / (pdf + chance), 1)
            radiance += dr.select(active, weight * share * lamp.eval(si, active), 0)
            active &= si.is_valid()
            surface = _Surface(mi, dr, si, ray, active)
            lit = active & (edges < MAX_DEPTH)
            radiance += dr.select(lit, weight * self._direct(surface, numbers, lit), 0)
            flux = self._gathered(surface, edges, lit, radius, photons)
            radiance += weight * flux / (math.pi * radius**2 * self.count)
            active &= lit & surface.goes_on
            out, factor, pdf = surface.sample(numbers, active)
            weight = dr.select(active, weight * factor, weight)
            last = dr.select(active, si.p, last)
            on = si.spawn_ray(out)
            ray.o = dr.select(active, on.o, ray.o)
            ray.d = dr.select(active, on.d, ray.d)
            edges = dr.select(active, edges + 1, edges)
            active &= dr.max(weight) > 0
            return ray, weight, radiance, edges, active, last, pdf, numbers

        zero = dr.zeros(mi.Color3f, width * height)
        ray, weight = mi.Ray3f(ray), mi.Color3f(weight) + zero
        last, pdf = dr.zeros(mi.Point3f, width * height), mi.Float(zero.x)
        _, _, radiance, *_ = dr.while_loop(
            (ray, weight, zero, 1 + 0 * lane, lane >= 0, last, pdf, numbers),
            lambda ray, weight, radiance, edges, active, last, pdf, numbers: active,
            step,
        )
        return np.array(radiance).T.reshape(height, width, 3).astype(np.float64)

    def _direct(self, surface: "_Surface", numbers, active):
        """Reflected light of one point of a lamp."""
        mi, dr = self.mi, self.dr
        pair = mi.Point2f(numbers.next_float32(active), numbers.next_float32(active))
        light, radiant = self.scene.sample_emitter_direction(
            surface.si, pair, True, active
        )
        towards = surface.si.to_local(light.d)
        glossy, pdf = surface.rest(towards, active)
        # Paths may meet the lamp by the rest, too, but for one that is a point.
        alone = light.delta | (pdf <= 0)
        share = dr.select(alone, 1, light.pdf / (light.pdf + pdf))
        return radiant * (surface.diffuse(towards, active) + share * glossy)

    def _gathered(self, surface: "_Surface", edges, found, radius, photons: Photons):
        """Sum over the photons within the radius of reflectance times power."""
        mi, dr, si = self.mi, self.dr, surface.si
        total = dr.zeros(mi.Color3f, dr.width(edges))
        found = found & surface.is_diffuse
        # Of the cells, two radii wide, the eight that the radius reaches.
        least = self._cell(si.p - radius, radius)
        for corner in np.ndindex(2, 2, 2):
            cell = least + mi.Vector3i(*corner)
            bucket = _hash(*mi.Vector3u(cell)) & (self.buckets - 1)
            at = dr.gather(mi.UInt32, photons.start, bucket, found)
            end = dr.gather(mi.UInt32, photons.start, bucket + 1, found)

            def add(at, total, end=end, cell=cell):
                p = dr.gather(mi.Point3f, photons.position, at)
                # Cells of one bucket are told apart, or photons would count twice.
                near = dr.all(self._cell(p, radius) == cell) & (
                    dr.squared_norm(p - si.p) < radius**2
                )
                length = dr.gather(mi.UInt32, photons.edges, at) + edges
                near &= length <= MAX_DEPTH
                wo = si.to_local(dr.gather(mi.Vector3f, photons.direction, at))
                cosine = abs(mi.Frame3f.cos_theta(wo))
                near &= cosine > 0
                power = dr.gather(mi.Color3f, photons.power, at)
                light = surface.diffuse(wo, near) * power / cosine
                return at + 1, total + dr.select(near, light, 0)

            _, total = dr.while_loop(
                (at, total), lambda at, total, end=end: found & (at < end), add
            )
        return total


class _Surface:
    """What a path meets: a diffuse part, which photons light, and all the rest."""

    def __init__(self, mi, dr, si, ray, active) -> None:
        flags, self.mi, self.si, self.bsdf = mi.BSDFFlags, mi, si, si.bsdf(ray)
        of = lambda some: mi.BSDFContext(mi.TransportMode.Radiance, some)
        self._diffuse = of(int(flags.Diffuse))
        self._rest = of(int(flags.Glossy) | int(flags.Delta))
        has = lambda flag: mi.has_flag(self.bsdf.flags(), flag)
        # Principled materials give all of themselves, whatever part is asked for.
        mirrored = mi.Vector3f(-si.wi.x, -si.wi.y, si.wi.z)
        rest = self.bsdf.eval(of(0), si, mirrored, active)
        whole = dr.max(rest) > 0
        self.is_diffuse = has(flags.Diffuse)
        self.goes_on = ~whole & (has(flags.Glossy) | has(flags.Delta))

    def diffuse(self, out, active):
        """Reflectance of the diffuse part, times the cosine."""
        return self.bsdf.eval(self._diffuse, self.si, out, active)

    def rest(self, out, active):
        """Reflectance of the rest, times the cosine, and its density."""
        return self.bsdf.eval_pdf(self._rest, self.si, out, active & self.goes_on)

    def sample(self, numbers, active):
        """Go on by the rest: direction, weight, density; zero for that of a mirror."""
        mi = self.mi
        first = numbers.next_float32(active)
        second = mi.Point2f(numbers.next_float32(active), numbers.next_float32(active))
        sample, weight = self.bsdf.sample(self._rest, self.si, first, second, active)
        smooth = mi.has_flag(sample.sampled_type, mi.BSDFFlags.Smooth)
        _, pdf = self.rest(sample.wo, active & smooth)
        return self.si.to_world(sample.wo), weight, pdf


def _hash(x, y, z):
    """A number of 32 bits, of three; wraps."""
    return (x * 73856093) ^ (y * 19349663) ^ (z * 83492791)
