"""Does James-Stein harm dark pixels beside a light, which get the light's variance?

The robust variance of a pixel is at least that of its surroundings, so that dark pixels
beside a light are taken to be as noisy as it, and shrink towards the denoised image. On
every frame of a split of `experiments.data.dataset`, of pixels within three pixels of
one that is twenty times as bright by the reference, and of all others: the variance
(sample and robust) over path tracing's squared error, and the squared error of
James-Stein, whitened and by the network, over that of Open Image Denoise. Squared
errors are relative to the reference's square (plus 0.01).
"""

import dataclasses
import pathlib

import jax
import numpy as np
import scipy.ndimage
import tyro

from experiments.common import errors
from experiments.common.command import Options, main
from experiments.common.report import Report
from experiments.common.tables import table
from experiments.data import dataset
from jscomb import combine, exr
from jscomb.frame import Frame
from jscomb.numerics.variances import robust_variance

BESIDE, OTHERS = "beside a light", "others"
WINDOW, BRIGHTER = 7, 20
RATIOS = {
    "sample variance / error": ("sample variance", "path tracing"),
    "robust variance / error": ("robust variance", "path tracing"),
    "whitened / oidn": ("whitened", "oidn"),
    "njs / oidn": ("njs", "oidn"),
}
Row = dict[str, dict[str, float]]


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


def beside_lights(frame: Frame) -> np.ndarray:
    """Find the dark pixels beside a light.

    Args:
        frame: with a reference.

    Returns:
        true for those, [H,W].
    """
    assert frame.reference is not None
    level = np.asarray(frame.reference.image).mean(axis=-1)
    return scipy.ndimage.maximum_filter(level, WINDOW) > BRIGHTER * level


def measure(path: pathlib.Path) -> Row:
    """Measure a frame.

    Args:
        path: of the frame.

    Returns:
        means of relative squares by name, and the number of pixels, beside a light and
        of others; nothing if there is no such pixel.
    """
    frame = exr.read_frame(path).normalised()
    assert frame.reference is not None
    r = frame.reference.image
    weight = 1 / (np.square(np.asarray(r).mean(axis=-1, keepdims=True)) + 0.01)
    key = jax.random.key(0)
    images = {"path tracing": frame.color, "oidn": frame.estimates["oidn"].image}
    for name in ("whitened", "njs"):
        images[name] = combine(key, frame, method=name, biased="oidn").image
    squares = {name: np.square(image - r) for name, image in images.items()}
    squares["sample variance"] = np.asarray(frame.variance)
    squares["robust variance"] = np.asarray(robust_variance(frame.variance))
    beside = beside_lights(frame)
    if not beside.any():
        return {}
    return {
        name: {"pixels": int(where.sum())}
        | {each: float((weight * s)[where].mean()) for each, s in squares.items()}
        for name, where in ((BESIDE, beside), (OTHERS, ~beside))
    }


def run(config: Config) -> dict[str, Row]:
    """Measure every frame.

    Args:
        config: what to measure.

    Returns:
        as `measure`, by "view samples", of frames that have such pixels.

    Raises:
        ValueError: if there are no frames.
    """
    first = 1 if config.quick else None
    where = config.folder, config.split
    found = dataset.measured(*where, measure, config.results, first=first)
    return {key: row for key, row in found.items() if row}


def report(rows: dict[str, Row]) -> Report:
    """Say what was found.

    Args:
        rows: by `run`.

    Returns:
        ratios of both kinds of pixels, means and every frame.
    """
    if not rows:
        return Report("No frame has dark pixels beside a light.", "")
    ratio = lambda row, kind, pair: row[kind][pair[0]] / row[kind][pair[1]]
    cells, every = [], []
    for kind in (BESIDE, OTHERS):
        each = {
            n: [ratio(r, kind, p) for r in rows.values()] for n, p in RATIOS.items()
        }
        cells += [[kind, *map(errors.geometric_mean, each.values())]]
        cells += [[f"{kind}, worst frame", *map(max, each.values())]]
    for key, row in rows.items():
        beside = [ratio(row, BESIDE, pair) for pair in RATIOS.values()]
        every.append([key, row[BESIDE]["pixels"], *beside])
    mean = dict(zip(RATIOS, cells[0][1:], strict=True))
    others = dict(zip(RATIOS, cells[2][1:], strict=True))
    answer = (
        f"In {len(rows)} frames, of dark pixels beside a light (others): the robust "
        f"variance is {mean['robust variance / error']:.3g} "
        f"({others['robust variance / error']:.3g}) times path tracing's squared "
        f"error; whitened has {mean['whitened / oidn']:.3f} "
        f"({others['whitened / oidn']:.3f}), njs {mean['njs / oidn']:.3f} "
        f"({others['njs / oidn']:.3f}) of Open Image Denoise's."
    )
    body = [
        table(["pixels", *RATIOS], cells),
        table(["frame", "pixels beside a light", *RATIOS], every),
    ]
    return Report(answer, "\n\n".join(body))


if __name__ == "__main__":
    main(Config, run, report)
