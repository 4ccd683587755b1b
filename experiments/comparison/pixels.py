"""Which pixels does a combiner make worse?

On frames with a reference, against the denoised image: how many pixels' squared errors,
relative to radiance, fell and rose by more than a thousandth, and by how much of the
denoised image's error all of them together; and maps of the change (NJS figure 19).
"""

import dataclasses
import pathlib
from typing import NamedTuple

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import tyro
from matplotlib.colors import SymLogNorm
from matplotlib.figure import Figure

from experiments.common.command import Options, main
from experiments.common.report import Report
from experiments.common.tables import table
from experiments.comparison.combiners import combiners
from jscomb import exr
from jscomb.frame import Frame
from jscomb.typing import Image

THRESHOLD = 1e-3  # relative squared error


@dataclasses.dataclass(frozen=True)
class Config(Options):
    """What to compare.

    Attributes:
        frames: EXR files with a reference and the denoised image `oidn`; by default the
            bundled one of 1024 samples.
        combiners: names of `experiments.comparison.combiners`.
    """

    frames: tyro.conf.Positional[tuple[pathlib.Path, ...]] = ()
    combiners: tuple[str, ...] = ("whitened", "njs", "pd", "dsc")


class Changed(NamedTuple):
    """What became of the denoised image's pixels.

    Attributes:
        change: of the relative squared error, [H,W].
        better: share of pixels whose error fell by more than `THRESHOLD`.
        worse: share whose error rose by more.
        removed: what those that fell lost, of the whole error.
        added: what those that rose gained.
    """

    change: np.ndarray
    better: float
    worse: float
    removed: float
    added: float


def changed(image: Image, frame: Frame) -> Changed:
    """Compare an image with the denoised one.

    Args:
        image: normalised radiance, [H,W,3].
        frame: normalised, with reference and `oidn`.

    Returns:
        the change of every pixel's error, and its parts.

    Raises:
        ValueError: if the frame lacks either.
    """
    if frame.reference is None or "oidn" not in frame.estimates:
        raise ValueError("a frame has no reference or no biased image 'oidn'")
    r = frame.reference.image
    weight = jnp.square(jnp.mean(r, axis=-1)) + 0.01
    error = lambda i: np.asarray(jnp.mean(jnp.square(i - r), axis=-1) / weight)
    before = error(frame.estimates["oidn"].image)
    change = error(image) - before
    fell, rose = change < 0, change > 0
    return Changed(
        change,
        float(np.mean(change < -THRESHOLD)),
        float(np.mean(change > THRESHOLD)),
        float(-change[fell].sum() / before.sum()),
        float(change[rose].sum() / before.sum()),
    )


def run(config: Config) -> dict[tuple[str, str], Changed]:
    """Compare all.

    Args:
        config: frames and combiners.

    Returns:
        by frame and combiner.
    """
    found = {}
    for path in config.frames or (exr.bundled()["cornell-glass-1024"],):
        frame = exr.read_frame(path).normalised()
        for name in config.combiners[: 1 if config.quick else None]:
            chosen = combiners()[name]
            given = [frame, jnp.float32(1)] if chosen.traced else [frame]
            found[path.stem, name] = changed(chosen.combine(*given), frame)
    return found


def draw(found: dict[tuple[str, str], Changed]) -> Figure:
    """Maps: blue where the error fell, red where it rose, logarithmic beyond a limit.

    Args:
        found: by `run`.

    Returns:
        the maps.
    """
    names = list(dict.fromkeys(frame for frame, _ in found))
    combiners = list(dict.fromkeys(name for _, name in found))
    figure, axes = plt.subplots(
        len(names),
        len(combiners),
        figsize=(3 * len(combiners), 3.2 * len(names)),
        squeeze=False,
        layout="constrained",
    )
    scale = SymLogNorm(THRESHOLD, vmin=-1, vmax=1)
    for (frame, name), each in found.items():
        ax = axes[names.index(frame), combiners.index(name)]
        shown = ax.imshow(each.change, norm=scale, cmap="RdBu_r")
        ax.set_title(f"{frame}\n{name}", fontsize=8)
        ax.axis("off")
    figure.colorbar(
        shown, ax=axes, shrink=0.6, label="change of relative squared error"
    )
    return figure


def report(found: dict[tuple[str, str], Changed]) -> Report:
    """Say how much was removed and added.

    Args:
        found: by `run`.

    Returns:
        a line a frame and combiner, and maps.
    """
    rows = [
        [frame, name, *(f"{100 * value:.1f} %" for value in each[1:])]
        for (frame, name), each in found.items()
    ]
    said = [
        f"{name} removes {100 * each.removed:.0f} % of the denoised image's error and "
        f"adds {100 * each.added:.0f} %, in {100 * each.worse:.1f} % of the pixels"
        for (_, name), each in found.items()
    ]
    header = ["frame", "combiner", "better", "worse", "error removed", "error added"]
    maps = {"Change of the relative squared error": draw(found)}
    return Report(f"{'; '.join(said)}.", table(header, rows), maps)


if __name__ == "__main__":
    main(Config, run, report)
