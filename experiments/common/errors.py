"""Errors against a reference with noise of its own, and their means over frames."""

from collections.abc import Callable, Iterable, Mapping, Sequence

import jax
import numpy as np

from experiments.common.tables import table
from jscomb import metrics
from jscomb.frame import Frame
from jscomb.metrics import rel_l2
from jscomb.typing import Image

Row = Mapping[str, float]
GREY = 0.18  # of a display, for the median luminance
_dssim = jax.jit(metrics.dssim)


def relative_l2(image: Image, frame: Frame) -> float:
    """Measure an image's relative L2, less the reference's noise.

    Args:
        image: in the frame's unit, [H,W,C].
        frame: with a reference.

    Returns:
        the error, relative to the reference squared (plus 0.01).
    """
    assert frame.reference is not None
    image_of, noise = frame.reference
    return float(rel_l2(image, image_of, half_difference=noise))


def squared_error(image: Image, frame: Frame) -> float:
    """Measure an image's squared error, less the reference's noise.

    Args:
        image: in the frame's unit, [H,W,C].
        frame: with a reference.

    Returns:
        the mean over pixels and channels, squared radiance.
    """
    assert frame.reference is not None
    image_of, noise = frame.reference
    square = np.square(np.asarray(image - image_of, np.float64))
    return float(np.mean(square - np.square(np.asarray(noise, np.float64)) / 4))


def dssim(image: Image, frame: Frame) -> float:
    """Measure an image's structural dissimilarity, as displayed: ACES, then sRGB.

    Args:
        image: of the normalised frame, whose median luminance is shown as 0.18.
        frame: normalised, with a reference; its noise is not subtracted.

    Returns:
        the dissimilarity, (1 - SSIM) / 2.
    """
    assert frame.reference is not None
    return float(_dssim(GREY * image, GREY * frame.reference.image))


def fireflies(image: Image, frame: Frame) -> float:
    """Measure the share of pixels that are far too bright for where they are.

    Args:
        image: of the normalised frame, [H,W,C].
        frame: normalised, with a reference.

    Returns:
        the share whose mean over channels is more than twice the largest of the
        reference in 5x5 pixels, and more than the median luminance above it.
    """
    assert frame.reference is not None
    grey = np.asarray(image).mean(-1)
    true = np.pad(np.asarray(frame.reference.image).mean(-1), 2, mode="edge")
    near = np.lib.stride_tricks.sliding_window_view(true, (5, 5)).max(axis=(-2, -1))
    return float(np.mean(grey > near + np.maximum(near, 1.0)))


def geometric_mean(values: Iterable[float]) -> float:
    """Return the geometric mean of positive numbers."""
    return float(np.exp(np.mean(np.log([*values]))))


def by_samples(rows: Mapping[str, Row]) -> dict[int, list[Row]]:
    """Group frames by their samples a pixel.

    Args:
        rows: by "frame samples".

    Returns:
        rows by sample count, ascending.
    """
    counts = sorted({int(name.split()[-1]) for name in rows})
    return {c: [r for n, r in rows.items() if n.split()[-1] == f"{c}"] for c in counts}


def means(
    rows: Mapping[str, Row],
    methods: Sequence[str],
    baseline: Callable[[Row], float],
    *,
    title: str,
    beside: Mapping[str, Callable[[str], object]] = {},
) -> str:
    """Tabulate geometric means over frames, and the worst of all.

    Args:
        rows: errors by method, by "frame samples".
        methods: to show.
        baseline: the error that a row's errors are divided by.
        title: of the first column.
        beside: more columns, functions of a method by their titles.

    Returns:
        Markdown: a line a method, a column a sample count, then all frames, the worst
        of them, and more columns.
    """
    groups = by_samples(rows)

    def cells(method: str) -> list[object]:
        ratios = {c: [r[method] / baseline(r) for r in g] for c, g in groups.items()}
        every = [ratio for some in ratios.values() for ratio in some]
        mean = [geometric_mean(some) for some in ratios.values()]
        more = [of(method) for of in beside.values()]
        return [method, *mean, geometric_mean(every), max(every), *more]

    return table([title, *groups, "all", "worst", *beside], map(cells, methods))


def block_means(image: Image, width: int) -> np.ndarray:
    """Average an image over channels and square blocks.

    Args:
        image: [H,W,C]; what does not fill a block at the end is cut off.
        width: of a block in pixels.

    Returns:
        the means as one row, float64.
    """
    rows, columns = (size // width for size in image.shape[:2])
    grey = np.asarray(image, np.float64)[: rows * width, : columns * width].mean(-1)
    return grey.reshape(rows, width, columns, width).mean(axis=(1, 3)).ravel()


def rank_correlation(a: np.ndarray, b: np.ndarray) -> float:
    """Return Spearman's correlation of two rows."""
    ranks = [np.argsort(np.argsort(each)) for each in (a, b)]
    return float(np.corrcoef(*ranks)[0, 1])
