"""How do all combiners do with path tracing and photon mapping?

On every frame of a split of `experiments.data.dataset`, whose photon-mapped image is of
another integrator, not denoised: relative L2, less the reference's noise, over that of
the better of both images. Ensembles are of both images, and of what follows them.
"""

import dataclasses
import pathlib

import jax
import tyro

from experiments.common import errors
from experiments.common.command import Options, main
from experiments.common.report import Report
from experiments.common.tables import table
from experiments.data import dataset
from jscomb import combine, exr
from jscomb.frame import Frame
from jscomb.rendering import PHOTONS
from jscomb.typing import Image

PATH_TRACING = "path-tracing"
COMBINERS = (
    *("james-stein", "whitened", "multi-scale", "njs"),
    *("double-shrinkage", "dsc"),
)
ENSEMBLES = {
    "ensemble": (),
    "ensemble with James-Stein": ("whitened", "multi-scale"),
}


@dataclasses.dataclass(frozen=True)
class Config(Options):
    """What to measure.

    Attributes:
        folder: of `experiments.data.dataset`.
        split: that is measured.
        results: file that stores results as they come.
    """

    folder: tyro.conf.Positional[pathlib.Path]
    split: str = "test"
    results: pathlib.Path | None = None


def combined(frame: Frame) -> dict[str, Image]:
    """Return what each combiner makes of a frame's two images.

    Args:
        frame: normalised, with a photon-mapped image alone.

    Returns:
        images by name.
    """
    key = jax.random.key(0)
    made = {
        name: combine(key, frame, method=name, biased=PHOTONS) for name in COMBINERS
    }
    images = {name: estimate.image for name, estimate in made.items()}
    for name, estimate in made.items():
        frame = frame.with_estimate(name, estimate)
    for name, more in ENSEMBLES.items():
        bases = [PATH_TRACING, PHOTONS, *more]
        images[name] = combine(key, frame, method="ensemble", biased=bases).image
    return images


def measure(path: pathlib.Path) -> dict[str, float]:
    """Return the errors of a frame's images.

    Args:
        path: of the frame.

    Returns:
        relative L2 by name; nothing if it has no photon-mapped image.
    """
    frame = exr.read_frame(path).normalised()
    if PHOTONS not in frame.estimates:
        return {}
    photons = frame.estimates[PHOTONS]
    images = {PATH_TRACING: frame.color, PHOTONS: photons.image}
    images |= combined(frame._replace(estimates={PHOTONS: photons}))
    return {name: errors.relative_l2(image, frame) for name, image in images.items()}


def run(config: Config) -> dict[str, dict[str, float]]:
    """Measure every frame.

    Args:
        config: what to measure.

    Returns:
        errors by image, by "view samples".

    Raises:
        ValueError: if there are no frames.
    """
    first = 1 if config.quick else None
    where = config.folder, config.split
    found = dataset.measured(*where, measure, config.results, first=first)
    return {key: row for key, row in found.items() if row}


def report(found: dict[str, dict[str, float]]) -> Report:
    """Say what was found.

    Args:
        found: by `run`.

    Returns:
        errors over the better input's by sample count, the worst, and every frame.
    """
    names = list(next(iter(found.values())))
    better = lambda row: min(row[PATH_TRACING], row[PHOTONS])
    ratios = {n: [row[n] / better(row) for row in found.values()] for n in names[2:]}
    said = ", ".join(
        f"{name} {errors.geometric_mean(some):.3f} ({max(some):.2f})"
        for name, some in ratios.items()
    )
    answer = (
        "Relative L2 over the better of path tracing and photon mapping, geometric "
        f"mean (worst) of {len(found)} frames: {said}."
    )
    first = errors.means(found, names, better, title="image")
    every = table(["frame", *names], [[k, *row.values()] for k, row in found.items()])
    return Report(answer, f"{first}\n\n{every}")


if __name__ == "__main__":
    main(Config, run, report)
