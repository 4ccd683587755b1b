"""Scenes drawn at random: geometry, materials, textures, lights, camera from a seed.

For training, so that the scenes of reported errors stay unseen. Each is a room (closed,
open in front, or with a window to the sky) or a place under the sky, furnished with
solids, meshes, foliage and rods. Many are hard for path tracing: small or hidden
lights, glass, mirrors, depth of field. Rooms are about two units wide, and radiance is
about one.
"""

import numpy as np

TEXTURE = 128  # width of a drawn texture in texels


def random_scene(mi, seed: int) -> dict:
    """Return a scene without film, sampler and integrator.

    Args:
        mi: Mitsuba.
        seed: of the scene.

    Returns:
        a dictionary for `mitsuba.load_dict`, with a `sensor`.
    """
    rng = np.random.default_rng([seed, 0x5CE7E])
    half = np.array([rng.uniform(0.8, 1.6), rng.uniform(0.7, 1.1), rng.uniform(1, 2)])
    kind = rng.choice(
        ["open", "closed", "window", "outdoors"], p=[0.3, 0.25, 0.2, 0.25]
    )
    scene: dict = {"type": "scene"}
    scene |= _walls(mi, rng, half, kind)
    scene |= _furniture(mi, rng, half)
    scene |= _lights(mi, rng, half, kind)
    scene["sensor"] = _camera(mi, rng, half, outside=kind == "open")
    return scene


def _walls(mi, rng, half, kind: str) -> dict:
    """Return the floor, walls and ceiling of a kind of place in [-half, half]."""
    at = mi.ScalarTransform4f()
    x, y, z = (float(h) for h in half)
    if kind == "outdoors":
        turned = at.translate([0, -y, 0]).rotate([1, 0, 0], -90).scale([12, 12, 1])
        return {"floor": _shape("rectangle", turned, _surface(mi, rng, tiles=12))}
    faces = {
        "floor": at.translate([0, -y, 0]).rotate([1, 0, 0], -90).scale([x, z, 1]),
        "ceiling": at.translate([0, y, 0]).rotate([1, 0, 0], 90).scale([x, z, 1]),
        "back": at.translate([0, 0, -z]).scale([x, y, 1]),
        "left": at.translate([-x, 0, 0]).rotate([0, 1, 0], 90).scale([z, y, 1]),
        "right": at.translate([x, 0, 0]).rotate([0, 1, 0], -90).scale([z, y, 1]),
        "front": at.translate([0, 0, z]).rotate([0, 1, 0], 180).scale([x, y, 1]),
    }
    missing = {"open": ["front"], "window": [rng.choice(["left", "right", "ceiling"])]}
    for face in missing.get(kind, []):
        del faces[face]
    return {
        name: _shape("rectangle", where, _surface(mi, rng))
        for name, where in faces.items()
    }


def _furniture(mi, rng, half) -> dict:
    """Return things in the back two thirds of the place."""
    makers = [_solid, _solid, _solid, _blob, _torus, _foliage, _rods]
    return {
        f"thing{number}": makers[rng.integers(len(makers))](mi, rng, half)
        for number in range(rng.integers(3, 11))
    }


def _place(mi, rng, half, size: float):
    """Draw the position and rotation of something of radius `size`."""
    x, y, z = half
    where = [
        rng.uniform(-0.75, 0.75) * x,
        size - y if rng.random() < 0.75 else rng.uniform(-0.6, 0.6) * y,
        rng.uniform(-0.8, 0.3) * z,
    ]
    tilt = 0 if rng.random() < 0.6 else rng.uniform(0, 60)
    at = mi.ScalarTransform4f()
    at = at.translate([float(w) for w in where])
    return at.rotate([0, 1, 0], rng.uniform(0, 360)).rotate([1, 0, 0], tilt)


def _solid(mi, rng, half) -> dict:
    """Return a sphere, a box or a cylinder."""
    size = rng.uniform(0.1, 0.42)
    at, name = _place(mi, rng, half, size), rng.choice(["sphere", "cube", "cylinder"])
    if name == "cylinder":
        thick = float(size * rng.uniform(0.2, 0.7))
        at = at.rotate([1, 0, 0], -90).translate([0, 0, -size])
        at = at.scale([thick, thick, 2 * size])
    else:
        stretch = rng.uniform(0.35, 1, 3) if name == "cube" else np.ones(3)
        at = at.scale([float(size * s) for s in stretch])
    return _shape(str(name), at, _material(mi, rng))


def _blob(mi, rng, half) -> object:
    """Return a sphere with bumps."""
    size = rng.uniform(0.15, 0.4)
    turns = rng.normal(size=(6, 3)) * rng.uniform(2, 7)
    phases = rng.uniform(0, 2 * np.pi, 6)

    def shape(u, v):
        up = np.pi * v
        way = [np.cos(u) * np.sin(up), np.cos(up), np.sin(u) * np.sin(up)]
        way = np.stack(way, -1)
        bumps = np.sin(way @ turns.T + phases).mean(-1, keepdims=True)
        return size * way * (1 + 0.6 * bumps)

    return _sheet(mi, rng, shape, _place(mi, rng, half, size), 64)


def _torus(mi, rng, half) -> object:
    """Return a ring, perhaps with waves."""
    size, thickness = rng.uniform(0.15, 0.35), rng.uniform(0.15, 0.4)
    waves = int(rng.choice([0, 0, 2, 3, 5]))

    def shape(u, v):
        around = 2 * np.pi * v
        radius = size * (1 + thickness * np.cos(around) + 0.2 * np.sin(waves * u))
        height = size * (
            thickness * np.sin(around) + 0.3 * np.cos(waves * u) * (waves > 0)
        )
        return np.stack([radius * np.cos(u), height, radius * np.sin(u)], -1)

    return _sheet(mi, rng, shape, _place(mi, rng, half, size * 0.8), 64)


def _sheet(mi, rng, shape, at, steps: int) -> object:
    """Triangulate a surface over u in [0, 2 pi] and v in [0, 1]."""
    u, v = np.meshgrid(
        np.linspace(0, 2 * np.pi, steps + 1),
        np.linspace(0, 1, steps + 1),
        indexing="ij",
    )
    corner = np.arange((steps + 1) ** 2).reshape(steps + 1, steps + 1)
    a, b, c, d = (
        corner[i : i + steps, j : j + steps].ravel()
        for i, j in ((0, 0), (1, 0), (0, 1), (1, 1))
    )
    faces = np.concatenate([np.stack([a, c, b], -1), np.stack([b, c, d], -1)])
    texture = np.stack([u / (2 * np.pi), v], -1).reshape(-1, 2)
    return _mesh(mi, shape(u, v).reshape(-1, 3), faces, texture, at, _material(mi, rng))


def _foliage(mi, rng, half) -> object:
    """Return some hundred leaves, rotated at random."""
    number, size = int(rng.integers(100, 500)), rng.uniform(0.2, 0.45)
    centre = rng.normal(size=(number, 3)) * size / 2
    frame, _ = np.linalg.qr(rng.normal(size=(number, 3, 3)))
    long, wide = frame[:, 0] * size * 0.2, frame[:, 1] * size * 0.06
    corners = np.stack(
        [centre - long, centre - wide, centre + wide, centre + long], 1
    ).reshape(-1, 3)
    first = 4 * np.arange(number)[:, None]
    faces = np.concatenate([first + np.array(t) for t in ([0, 1, 2], [1, 3, 2])])
    texture = np.tile([[0.0, 0], [0, 1], [1, 0], [1, 1]], (number, 1))
    leaf = _diffuse(_texture(mi, rng) if rng.random() < 0.3 else _colour(rng))
    return _mesh(mi, corners, faces, texture, _place(mi, rng, half, size), leaf)


def _rods(mi, rng, half) -> object:
    """Return a row of thin upright bars, such as a railing."""
    number, height = int(rng.integers(6, 30)), rng.uniform(0.3, 0.9)
    width = rng.uniform(0.4, 1.2)
    thin = width / number * rng.uniform(0.1, 0.35)
    left = np.linspace(-width / 2, width / 2, number)
    box = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)], float)
    box = (box - [0.5, 0.5, 0.5]) * [thin, height, thin]
    corners = (box + np.stack([left, 0 * left, 0 * left], -1)[:, None]).reshape(-1, 3)
    quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4]]
    quads = np.array([*quads, [1, 5, 7, 3]])
    one = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    faces = (one + 8 * np.arange(number)[:, None, None]).reshape(-1, 3)
    texture = np.zeros((len(corners), 2))
    at = _place(mi, rng, half, height / 2)
    # Corners of boxes must not share normals.
    corners, faces = corners[faces].reshape(-1, 3), np.arange(faces.size).reshape(-1, 3)
    texture = np.zeros((len(corners), 2))
    return _mesh(mi, corners, faces, texture, at, _material(mi, rng, clear=False))


def _mesh(mi, corners, faces, texture, at, bsdf: dict) -> object:
    """Return a triangle mesh as Mitsuba's object."""
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(bsdf)
    mesh = mi.Mesh(
        "mesh", len(corners), len(faces), has_vertex_texcoords=True, props=properties
    )
    there = np.asarray(at.matrix)
    corners = corners @ there[:3, :3].T + there[:3, 3]
    values = mi.traverse(mesh)
    values["vertex_positions"] = corners.astype(np.float32).ravel()
    values["vertex_texcoords"] = texture.astype(np.float32).ravel()
    values["faces"] = faces.astype(np.uint32).ravel()
    values.update()
    return mesh


def _lights(mi, rng, half, kind: str) -> dict:
    """Return the sky where it is visible, and lamps."""
    lights = {}
    if kind in ("window", "outdoors"):
        sky = {"type": "envmap", "bitmap": mi.Bitmap(_sky(rng))}
        lights["sky"] = sky | {"scale": float(rng.uniform(0.5, 2))}
    lamps = rng.integers(0, 2) if lights else rng.integers(1, 4)
    for number in range(lamps):
        lights |= _lamp(mi, rng, half, f"lamp{number}", 1 / lamps)
    return lights


def _lamp(mi, rng, half, name: str, power: float) -> dict:
    """Return a rectangle below the ceiling or a bulb, perhaps with a shade."""
    at = mi.ScalarTransform4f()
    x, y, z = (float(h) for h in half)
    width = float(np.exp(rng.uniform(np.log(0.04), np.log(0.5))))
    tint = 1 + rng.uniform(-0.35, 0.35, 3)
    radiance = power * 1.5 * x * z * tint / width**2
    where = [rng.uniform(-0.7, 0.7) * x, 0.97 * y, rng.uniform(-0.7, 0.5) * z]
    parts = {}
    if rng.random() < 0.6:
        turned = at.translate(where).rotate([1, 0, 0], 90).scale([width, width, 1])
        parts[name] = _shape("rectangle", turned, _diffuse(_rgb([0, 0, 0])))
    else:
        where[1] = rng.uniform(-0.2, 0.8) * y
        turned = at.translate(where).scale(0.5 * width)
        parts[name] = _shape("sphere", turned, _diffuse(_rgb([0, 0, 0])))
        if rng.random() < 0.4:  # light only by way of the ceiling
            below = at.translate([where[0], where[1] - 0.6 * width, where[2]])
            below = below.rotate([1, 0, 0], 90).scale([1.5 * width, 1.5 * width, 1])
            shade = _shape("rectangle", below, _diffuse(_colour(rng)))
            parts[f"{name}-shade"] = shade
    parts[name]["emitter"] = {"type": "area", "radiance": _rgb(radiance)}
    return parts


def _camera(mi, rng, half, *, outside: bool) -> dict:
    """Return a camera at or before the front of the place that looks to its back."""
    x, y, z = half
    far = rng.uniform(1.3, 2.2) if outside else rng.uniform(0.75, 0.95)
    origin = [rng.uniform(-0.6, 0.6) * x, rng.uniform(-0.3, 0.7) * y, far * z]
    target = [
        rng.uniform(-0.5, 0.5) * x,
        rng.uniform(-0.8, 0.1) * y,
        rng.uniform(-0.7, 0.0) * z,
    ]
    look = mi.ScalarTransform4f().look_at(
        origin=[float(o) for o in origin],
        target=[float(t) for t in target],
        up=[float(rng.normal() * 0.05), 1, 0],
    )
    # Narrow views show a few things in detail, as a crop of a large film does.
    camera = {"type": "perspective", "to_world": look, "fov": rng.uniform(16, 60)}
    if rng.random() < 0.25:  # depth of field
        far = float(np.linalg.norm(np.subtract(target, origin)))
        camera |= {"type": "thinlens", "aperture_radius": rng.uniform(0.01, 0.05)}
        camera |= {"focus_distance": far * rng.uniform(0.6, 1.1)}
    return camera


def _surface(mi, rng, tiles: int = 1) -> dict:
    """Return an opaque material for walls and floors."""
    reflectance = _reflectance(mi, rng, tiles)
    if rng.random() < 0.7:
        return _diffuse(reflectance)
    alpha = float(np.exp(rng.uniform(np.log(0.04), np.log(0.3))))
    plastic = {"type": "roughplastic", "alpha": alpha}
    return _twosided(plastic | {"diffuse_reflectance": reflectance})


def _material(mi, rng, *, clear: bool = True) -> dict:
    """Return a material for things."""
    kinds = ["diffuse", "roughplastic", "plastic", "roughconductor", "conductor"]
    kinds += ["dielectric", "roughdielectric"] if clear else ["diffuse"] * 2
    kind = rng.choice(kinds, p=[0.42, 0.18, 0.08, 0.12, 0.06, 0.1, 0.04])
    alpha = float(np.exp(rng.uniform(np.log(0.05), np.log(0.4))))
    if kind == "diffuse":
        return _diffuse(_reflectance(mi, rng))
    if kind in ("dielectric", "roughdielectric"):
        glass = {"type": str(kind), "int_ior": float(rng.uniform(1.3, 1.7))}
        return glass | ({"alpha": alpha} if kind == "roughdielectric" else {})
    if kind in ("conductor", "roughconductor"):
        metal = {
            "type": str(kind),
            "material": str(rng.choice(["Al", "Cu", "Au", "Cr"])),
        }
        return _twosided(metal | ({"alpha": alpha} if kind == "roughconductor" else {}))
    lacquer = {"type": str(kind), "diffuse_reflectance": _reflectance(mi, rng)}
    return _twosided(lacquer | ({"alpha": alpha} if kind == "roughplastic" else {}))


def _reflectance(mi, rng, tiles: int = 1) -> dict:
    """Return one colour, a checkerboard or a texture."""
    kind = rng.random()
    if kind < 0.35:
        return _colour(rng)
    if kind < 0.55:
        scale = tiles * float(np.exp(rng.uniform(np.log(1), np.log(12))))
        colours = {f"color{i}": _colour(rng) for i in range(2)}
        fine = mi.ScalarTransform4f().scale([scale, scale, 1])
        return {"type": "checkerboard", "to_uv": fine, **colours}
    return _texture(mi, rng, tiles)


def _texture(mi, rng, tiles: int = 1) -> dict:
    """Return two colours mixed by fractals, stripes, spots or bricks."""
    v, u = np.mgrid[:TEXTURE, :TEXTURE] / TEXTURE
    kind = rng.choice(["fractal", "stripes", "spots", "bricks"])
    if kind == "fractal":
        share = _fractal(rng)
    elif kind == "stripes":
        way = rng.integers([1, 0], [5, 4])
        turns = 2 * np.pi * rng.integers(1, 6) * (way[0] * u + way[1] * v)
        share = 0.5 + 0.5 * np.sin(turns + 3 * _fractal(rng))
    elif kind == "spots":
        share = (_fractal(rng, first=4) > rng.uniform(0.4, 0.65)).astype(float)
    else:
        rows = int(rng.integers(4, 12))
        shifted = (u * rows / 2 + 0.5 * (np.floor(v * rows) % 2)) % 1
        mortar = (shifted < 0.08) | ((v * rows) % 1 < 0.14)
        share = np.where(mortar, 1.0, 0.35 * _fractal(rng, first=4))
    first, second = (np.array(_colour(rng)["value"]) for _ in range(2))
    image = first + (second - first) * share[..., None]
    scale = tiles * float(rng.uniform(0.7, 3))
    return {
        "type": "bitmap",
        "bitmap": mi.Bitmap(image.astype(np.float32)),
        "raw": True,
        "to_uv": mi.ScalarTransform4f().scale([scale, scale, 1]),
    }


def _fractal(rng, first: int = 1) -> np.ndarray:
    """Return noise in [0, 1] at every scale from 2^first cells."""
    total = np.zeros((TEXTURE, TEXTURE))
    for octave in range(first, 7):
        cells = 2**octave
        block = np.ones((TEXTURE // cells, TEXTURE // cells))
        total += np.kron(rng.standard_normal((cells, cells)), block) / cells**0.8
    low, high = total.min(), total.max()
    return (total - low) / (high - low)


def _sky(rng, height: int = 64) -> np.ndarray:
    """Return a sky, often with a small sun, shape [h,2h,3]."""
    up = np.cos(np.linspace(0, np.pi, height))[:, None, None]
    zenith, horizon = (
        rng.uniform([0.2, 0.4, 0.7], [0.6, 0.8, 1.2]),
        rng.uniform(0.6, 1, 3),
    )
    sky = np.where(up > 0, horizon + (zenith - horizon) * up.clip(0), 0.15)
    sky = np.broadcast_to(sky, (height, 2 * height, 3)).copy()
    if rng.random() < 0.6:
        row, column = rng.integers(4, height // 2 - 3), rng.integers(0, 2 * height - 3)
        size = int(rng.integers(1, 4))
        sun = rng.uniform(30, 400) / size**2 * np.array([1.0, 0.9, 0.7])
        sky[row : row + size, column : column + size] = sun
    return sky.astype(np.float32)


def _shape(kind: str, to_world, bsdf: dict) -> dict:
    return {"type": kind, "to_world": to_world, "bsdf": bsdf}


def _diffuse(reflectance: dict) -> dict:
    return _twosided({"type": "diffuse", "reflectance": reflectance})


def _twosided(bsdf: dict) -> dict:
    return {"type": "twosided", "bsdf": bsdf}


def _rgb(value) -> dict:
    return {"type": "rgb", "value": [float(v) for v in value]}


def _colour(rng) -> dict:
    """Return a reflectance: grey or coloured, dark or bright."""
    grey, spread = rng.uniform(0.1, 0.8), rng.choice([0.05, 0.3])
    return _rgb((grey + rng.uniform(-spread, spread, 3)).clip(0.03, 0.9))
