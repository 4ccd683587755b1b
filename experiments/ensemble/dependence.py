"""What does it cost to judge an ensemble by halves that share its weights?

    python -m experiments.ensemble.dependence FRAME.exr [FRAME.exr ...]

With two sub-buffers both halves of an ensemble have the weights of the full frame,
which know the noise of both; with four each half has weights of its own. Both are
judged as `jscomb.choose` judges: by how much each half's relative L2 differs from that
of Open Image Denoise, estimated from the other half. The reference tells what is true.
What the estimate misses is the cost of the dependence; where it is below zero, the
ensemble looks better than it is.
"""

import dataclasses
import pathlib
import sys
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
import tyro
from tqdm import tqdm

from experiments.ensemble.bases import maker
from jscomb import ensemble, exr, metrics
from jscomb.denoisers import oidn
from jscomb.frame import Estimate, Frame

MAKERS = {name: maker(name) for name in ("oidn", "oidn-color", "bilateral", "rdfc")}
_EPSILON = 0.01


@dataclasses.dataclass(frozen=True)
class Config:
    """What to measure.

    Attributes:
        frames: EXR files with four sub-buffers and a reference.
        quick: only the first.
    """

    frames: tyro.conf.Positional[tuple[pathlib.Path, ...]]
    quick: bool = False


def judged(frame: Frame, estimate: Estimate, baseline: Estimate) -> tuple[float, float]:
    """Estimated and true change of the halves' relative L2 against the baseline's.

    Args:
        frame: normalised, with a reference.
        estimate: with halves.
        baseline: with halves.

    Returns:
        both changes, relative to the baseline's true error.
    """
    assert frame.reference is not None
    assert estimate.halves is not None
    assert baseline.halves is not None
    r, _ = frame.reference
    x = jnp.stack([half.color for half in frame.halves()])
    found = metrics.rel_l2_change(estimate.halves, baseline.halves, x, epsilon=_EPSILON)
    error = lambda images: float(
        np.mean([metrics.rel_l2(image, r, epsilon=_EPSILON) for image in images])
    )
    unit = error(baseline.halves)
    return float(found.mean) / unit, error(estimate.halves) / unit - 1


def measure(frame: Frame) -> dict[str, tuple[float, float]]:
    """Both kinds of halves of one frame.

    Args:
        frame: normalised, with four sub-buffers and a reference.

    Returns:
        estimated and true change, of shared weights and of weights of each half's own.
    """
    two = frame.merged(2)
    return {
        "shared": judged(
            two, ensemble.combine_frame(two, MAKERS), oidn.denoise_frame(two)
        ),
        "own": judged(
            frame, ensemble.combine_frame(frame, MAKERS), oidn.denoise_frame(frame)
        ),
    }


def run(config: Config) -> dict[str, dict[str, tuple[float, float]]]:
    """Measure all frames.

    Args:
        config: what to measure.

    Returns:
        results of `measure` by path.

    Raises:
        ValueError: if a frame has no reference, or not four sub-buffers.
    """
    rows = {}
    for path in tqdm(config.frames[: 1 if config.quick else None], unit="frame"):
        frame = exr.read_frame(path)
        if frame.reference is None or frame.sub_buffers % 4:
            raise ValueError(f"{path} needs a reference and four sub-buffers")
        rows[str(path)] = measure(frame.merged(4).normalised())
    return rows


def table(rows: dict[str, dict[str, tuple[float, float]]]) -> Sequence[str]:
    """Markdown, with the mean and the mean of absolute differences in the last rows.

    Args:
        rows: by `run`.

    Returns:
        its lines.
    """
    kinds = ("shared", "own")
    lines = [
        "| frame | shared: estimated | true | own: estimated | true |",
        "| --- | --- | --- | --- | --- |",
    ]
    for name, row in rows.items():
        cells = [f"{value:+.3f}" for kind in kinds for value in row[kind]]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    missed = {
        k: np.array([row[k][0] - row[k][1] for row in rows.values()]) for k in kinds
    }
    for title, of in (
        ("estimated less true, mean", np.mean),
        ("and its size", lambda m: np.mean(np.abs(m))),
    ):
        cells = [f"{of(missed[kind]):+.3f} | " for kind in kinds]
        lines.append(f"| {title} | {' | '.join(cells)}|")
    return lines


def main() -> None:
    """Print the table."""
    try:
        print("\n".join(table(run(tyro.cli(Config, description=__doc__)))))
    except (ValueError, OSError, ImportError, RuntimeError) as error:
        sys.exit(f"dependence: {' '.join(str(error).split())}")


if __name__ == "__main__":
    main()
