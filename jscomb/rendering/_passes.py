"""The passes of a frame, and the moments of what they render."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from jscomb.rendering._photon_mapping import relative_radius
from jscomb.rendering._settings import REFERENCE_CHUNK, Settings

SAMPLES = "samples"  # the path integrator, each sample an image of its own
PHOTONS = "photons"  # the name of the photon-mapped estimate
PHOTON_STREAMS = 10**8  # beyond the path tracer's


class Pass(NamedTuple):
    """One launch of the renderer.

    Attributes:
        target: name of the moments that its image is added to.
        spp: samples a pixel.
        seed: random stream.
        integrator: path, samples (path, each sample an image of its own), aov,
            visibility or photons.
        radius: of a photon pass, relative to the first one's.
    """

    target: str
    spp: int
    seed: int
    integrator: str
    radius: float = 1.0


class Moments(NamedTuple):
    """Running mean and sum of squared deviations of images (Welford).

    Attributes:
        number: of images.
        mean: [H,W,C] in float64; zero without any image.
        squares: sum of squared deviations from the mean, [H,W,C] in float64.
    """

    number: float = 0
    mean: np.ndarray = np.zeros(())
    squares: np.ndarray = np.zeros(())

    def add(self, image: np.ndarray) -> "Moments":
        """Return the moments with one more independent image."""
        number = self.number + 1
        step = image - self.mean
        mean = self.mean + step / number
        return Moments(number, mean, self.squares + step * (image - mean))

    @property
    def variance_of_mean(self) -> np.ndarray:
        """Unbiased estimate of the variance of `mean`."""
        return self.squares / (self.number * (self.number - 1))


def plan_passes(settings: Settings) -> list[Pass]:
    """Return every pass of a frame in order, each with a random stream of its own.

    Sub-buffers take turns, and so do the halves of the reference and of the photons.

    Args:
        settings: what is rendered.

    Returns:
        passes for the targets `color0`, ..., `aov0`, ..., `visibility0`, ...,
        `reference0`, `reference1`, `photons0`, `photons1`.

    Example:
        >>> for each in plan_passes(Settings(spp=4, buffers=2))[:2]:
        ...     print(each.target, each.seed)
        color0 0
        color1 1
    """
    return list(_passes(settings))


def _passes(settings: Settings) -> Iterator[Pass]:
    """Every pass in order."""
    seed, together = settings.seed, settings.samples_together
    integrator = SAMPLES if together > 1 else "path"
    for number in range(settings.spp // together):
        target = f"color{number % settings.buffers}"
        yield Pass(target, together, seed, integrator)
        seed += 1
    for name in ("aov", "visibility"):
        for k in range(settings.buffers):
            yield Pass(f"{name}{k}", settings.feature_spp, seed, name)
            seed += 1
    for number in range(settings.reference_spp // REFERENCE_CHUNK):
        yield Pass(f"reference{number % 2}", REFERENCE_CHUNK, seed, "path")
        seed += 1
    for number in range(settings.passes if settings.photons else 0):
        seed = settings.seed + PHOTON_STREAMS + number
        radius = relative_radius(number)
        yield Pass(f"{PHOTONS}{number % 2}", 1, seed, PHOTONS, radius)
