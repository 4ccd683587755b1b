"""What does it cost to judge an ensemble by halves that share its weights?

With two sub-buffers both halves of an ensemble have the weights of the full frame,
which know the noise of both; with four each half has weights of its own. Both are
judged by how much each half's relative L2 differs from that of Open Image Denoise,
estimated from the other half. The reference tells what is true.
What the estimate misses is the cost of the dependence; where it is below zero, the
ensemble looks better than it is. Frames are files, or scenes that are rendered first.
"""

import dataclasses
import functools
import pathlib
from collections.abc import Callable, Mapping

import jax.numpy as jnp
import numpy as np
import tyro
from tqdm import tqdm

from experiments.common.command import Options, main
from experiments.common.report import Report
from experiments.common.tables import table
from experiments.ensemble.bases import maker, rendered
from jscomb import ensemble, exr, metrics
from jscomb.denoisers import oidn
from jscomb.frame import Estimate, Frame
from jscomb.rendering import Settings

MAKERS = {name: maker(name) for name in ("oidn", "oidn-color", "bilateral", "rdfc")}
KINDS = "shared", "own"
_EPSILON = 0.01


@dataclasses.dataclass(frozen=True)
class Config(Options):
    """What to measure.

    Attributes:
        frames: EXR files with four sub-buffers and a reference, or names of scenes, see
            `jscomb.rendering`.
        work: folder that keeps what is rendered.
        samples: samples a pixel of each rendered frame.
        size: width and height in pixels of a rendered frame.
        reference_spp: samples a pixel of its reference.
    """

    frames: tyro.conf.Positional[tuple[str, ...]]
    work: pathlib.Path = pathlib.Path("build/dependence")
    samples: tuple[int, ...] = (16, 64)
    size: int = 128
    reference_spp: int = 4096


def frames_of(config: Config) -> Mapping[str, Callable[[], Frame]]:
    """Functions that read or render each frame, by its name."""
    read = {name: functools.partial(exr.read_frame, name) for name in config.frames}
    files = {n: f for n, f in read.items() if n.endswith(".exr")}
    return {pathlib.Path(name).stem: f for name, f in files.items()} | {
        f"{scene} {samples}": functools.partial(
            rendered,
            scene,
            config.work / f"{scene}-{samples}.npz",
            Settings(
                spp=samples,
                size=config.size,
                buffers=4,
                reference_spp=config.reference_spp,
            ),
        )
        for scene in config.frames
        if scene not in files
        for samples in config.samples
    }


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
        results of `measure` by frame.

    Raises:
        ValueError: if a frame has no reference, or not four sub-buffers.
    """
    if config.quick:
        config = dataclasses.replace(
            config, frames=config.frames[:1], samples=(16,), size=24, reference_spp=64
        )
    rows = {}
    for name, make in tqdm(frames_of(config).items(), unit="frame"):
        frame = make()
        if frame.reference is None or frame.sub_buffers % 4:
            raise ValueError(f"{name} needs a reference and four sub-buffers")
        rows[name] = measure(frame.merged(4).normalised())
    return rows


def report(rows: dict[str, dict[str, tuple[float, float]]]) -> Report:
    """Say what was found.

    Args:
        rows: by `run`.

    Returns:
        every frame, and what the estimates miss.
    """
    missed = {
        k: np.array([row[k][0] - row[k][1] for row in rows.values()]) for k in KINDS
    }
    cells = [[name, *(f"{v:+.3f}" for k in KINDS for v in row[k])]
             for name, row in rows.items()]  # fmt: skip
    for title, of in (
        ("estimated less true, mean", np.mean),
        ("its size, mean", lambda m: np.mean(np.abs(m))),
        ("least", np.min),
    ):
        cells.append(
            [title, *(c for k in KINDS for c in (f"{of(missed[k]):+.3f}", ""))]
        )
    shared, own = (missed[k] for k in KINDS)
    span = lambda m: f"{m.mean():+.2f} ({m.min():+.2f} to {m.max():+.2f})"
    answer = (
        f"Sharing flatters by {(own - shared).mean():.2f} of the denoiser's error "
        f"(mean of {len(rows)} frames, {(own - shared).max():.2f} at worst): the "
        f"estimated change less the true one is {span(shared)} with shared weights and "
        f"{span(own)} with weights of each half's own. With shared weights the "
        f"ensemble looks better than it is in {(shared < 0).sum()} frames, with own "
        f"ones in {(own < 0).sum()}."
    )
    header = ["frame", "shared: estimated", "true", "own: estimated", "true"]
    return Report(answer, table(header, cells))


if __name__ == "__main__":
    main(Config, run, report)
