"""A loaded scene, and the launches of the renderer on it."""

import numpy as np

from jscomb.rendering import _streams as streams
from jscomb.rendering._passes import PHOTONS, SAMPLES, Pass
from jscomb.rendering._photon_mapping import FIRST_RADIUS, PhotonMapper
from jscomb.rendering._scenes import load_scene, mitsuba
from jscomb.rendering._settings import Settings


class Launcher:
    """A loaded scene; called with a pass, it renders that.

    Attributes:
        shape: of an image, (H, W, 3).
    """

    def __init__(self, scene: str, settings: Settings) -> None:
        """Load a scene.

        Args:
            scene: one of `SCENES`, random-SEED, or the path of a Mitsuba XML file.
            settings: its film, random numbers and photons.

        Raises:
            ImportError: if Mitsuba is not installed; says how to install it.
            ValueError: if the scene is unknown, or needs a vectorised variant of
                Mitsuba.
        """
        mi = mitsuba()
        common = settings.numbers == "common"
        if common:
            streams.register(mi)
        width, height = settings.film
        sampler = streams.NAME if common else "independent"
        loaded = load_scene(scene, width=width, height=height, sampler=sampler)
        sensor = loaded.sensors()[0]
        columns, rows = map(int, sensor.film().size())
        self.shape = rows, columns, 3
        if common:
            sensor.sampler().columns, sensor.sampler().tile = columns, settings.tile
        self._mi, self._scene, self._mapper = mi, loaded, None
        if settings.photons:
            self._mapper = PhotonMapper(mi, loaded, settings.photons)
            box = loaded.bbox()
            diagonal = float(np.linalg.norm(np.array(box.max) - np.array(box.min)))
            self._radius = settings.radius or FIRST_RADIUS * diagonal
        self._integrators = {
            "path": loaded.integrator(),
            "aov": mi.load_dict(
                {"type": "aov", "aovs": "albedo:albedo,normal:sh_normal,depth:depth"}
            ),
            "visibility": _visibility(mi),
        }

    def __call__(self, one: Pass) -> np.ndarray:
        """Render one pass.

        Args:
            one: which.

        Returns:
            its image [H,W,C] in float64: radiance of `path`, albedo, normal and depth
            of `aov`, the unoccluded fraction of `visibility`; of `photons` radiance,
            and radiance times the squared relative radius, C = 6. Of `samples` the
            radiance of each sample, [spp,H,W,3].
        """
        if one.integrator == PHOTONS:
            assert self._mapper is not None, "the settings have no photons"
            image = self._mapper.render(one.seed, one.radius * self._radius)
            return np.concatenate([image, image * one.radius**2], axis=-1)
        if one.integrator == SAMPLES:
            return self._samples(one)
        return self._rendered(one.integrator, one.spp, one.seed)

    def _rendered(self, integrator: str, spp: int, seed: int) -> np.ndarray:
        """The mean of some samples."""
        integrator = self._integrators[integrator]
        image = self._mi.render(self._scene, integrator=integrator, spp=spp, seed=seed)
        return np.asarray(image, np.float64)

    def _samples(self, one: Pass) -> np.ndarray:
        """Each sample's image, by one launch in the vectorised variants."""
        mi, (rows, columns, _) = self._mi, self.shape
        if mi.variant().startswith("scalar"):
            seeds = (mi.sample_tea_32(one.seed, k)[0] for k in range(one.spp))
            return np.stack([self._rendered("path", 1, seed) for seed in seeds])
        import drjit as dr  # comes with Mitsuba

        sensor, number = self._scene.sensors()[0], rows * columns * one.spp
        sampler = sensor.sampler().clone()
        sampler.seed(one.seed, number)
        pixel = dr.arange(mi.UInt32, number) // one.spp
        corner = mi.Point2f(mi.Float(pixel % columns), mi.Float(pixel // columns))
        place = (corner + sampler.next_2d()) / mi.Point2f(columns, rows)
        lens = mi.Point2f(0.5)
        if sensor.needs_aperture_sample():
            lens = sampler.next_2d()
        ray, weight = sensor.sample_ray(0.0, 0.5, place, lens)
        integrator = self._integrators["path"]
        ray = mi.RayDifferential3f(ray)
        radiance, *_ = integrator.sample(self._scene, sampler, ray, None, True)
        values = np.array(weight * radiance, np.float64)  # [3, pixels * samples]
        return np.moveaxis(values.T.reshape(rows, columns, one.spp, 3), 2, 0)


def _visibility(mi):
    """An integrator: the unoccluded fraction of emitter samples at the first hit."""
    import drjit as dr  # comes with Mitsuba

    class Visibility(mi.SamplingIntegrator):
        def sample(self, scene, sampler, ray, medium=None, active=True):
            si = scene.ray_intersect(ray, active)
            lit = active & si.is_valid()
            light, _ = scene.sample_emitter_direction(
                si, sampler.next_2d(lit), False, lit
            )
            lit &= light.pdf > 0
            occluded = scene.ray_test(si.spawn_ray_to(light.p), lit)
            # `select`, since in scalar variants these are Python's own booleans.
            seen = dr.select(lit, dr.select(occluded, 0.0, 1.0), 0.0)
            return mi.Color3f(seen), active, []

    return Visibility(mi.Properties())
