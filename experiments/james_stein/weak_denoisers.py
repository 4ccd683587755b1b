"""What does James-Stein gain where the denoiser loses to path tracing?

The papers' denoisers fall behind path tracing at many samples; Open Image Denoise
hardly does. For each denoiser, on every frame of a split of `experiments.data.dataset`:
relative L2, less the reference's noise, of combinations of path tracing with its image,
over that of the image alone.
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
from jscomb.methods import with_inputs

DENOISERS = "oidn", "nfor", "bilateral", "rdfc", "nonlocal-means"
COMBINERS = "james-stein", "whitened", "multi-scale", "njs"
PATH_TRACING = "path-tracing"


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


def measure(path: pathlib.Path) -> dict[str, dict[str, float]]:
    """Return the errors of a frame's images.

    Args:
        path: of the frame.

    Returns:
        relative L2 by denoiser, of path tracing, the denoised image ("alone") and each
        combination.
    """
    key = jax.random.key(0)
    frame = exr.read_frame(path).normalised()._replace(estimates={})
    frame = with_inputs(key, frame, DENOISERS)
    found = {}
    for name in DENOISERS:
        estimate = frame.estimates[name]
        own = frame._replace(estimates={name: estimate})
        images = {PATH_TRACING: frame.color, "alone": estimate.image}
        for method in COMBINERS:
            images[method] = combine(key, own, method=method, biased=name).image
        found[name] = {n: errors.relative_l2(i, frame) for n, i in images.items()}
    return found


def run(config: Config) -> dict[str, dict[str, dict[str, float]]]:
    """Measure every frame.

    Args:
        config: what to measure.

    Returns:
        errors by image, by denoiser, by "view samples".

    Raises:
        ValueError: if there are no frames.
        ImportError: if Open Image Denoise is missing.
    """
    first = 1 if config.quick else None
    where = config.folder, config.split
    return dataset.measured(*where, measure, config.results, first=first)


def report(found: dict[str, dict[str, dict[str, float]]]) -> Report:
    """Say what was found.

    Args:
        found: by `run`.

    Returns:
        for each denoiser the errors over its own, by sample count.
    """
    said, body = [], []
    for name in DENOISERS:
        rows = {key: row[name] for key, row in found.items()}
        columns = [PATH_TRACING, *COMBINERS]
        body += [f"Over {name}:", errors.means(rows, columns, _alone, title="image")]
        groups = errors.by_samples(rows)
        ratios = [
            errors.geometric_mean(r["multi-scale"] / _alone(r) for r in group)
            for group in groups.values()
        ]
        each = ", ".join(f"{ratio:.2f}" for ratio in ratios)
        worst = max(r["multi-scale"] / _alone(r) for r in rows.values())
        counts = ", ".join(map(str, groups))
        said.append(f"{name} {each} at {counts} samples (worst {worst:.2f})")
    answer = (
        "Relative L2 of `multi-scale` over that of the denoised image alone, geometric "
        f"mean of frames: {'; '.join(said)}."
    )
    every = [
        [key, *(row[name]["alone"] for name in DENOISERS)] for key, row in found.items()
    ]
    body.append(table(["frame", *DENOISERS], every))
    return Report(answer, "\n\n".join(body))


def _alone(row: errors.Row) -> float:
    """The error of the denoised image."""
    return row["alone"]


if __name__ == "__main__":
    main(Config, run, report)
