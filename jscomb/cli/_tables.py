"""Tables that the commands print."""

import functools
from collections.abc import Mapping

from jscomb import metrics
from jscomb.exr import Contents
from jscomb.frame import Frame
from jscomb.numerics.guards import finite
from jscomb.numerics.tiles import compiled
from jscomb.typing import Image, Mask, Scalar


def errors(images: Mapping[str, Image], frame: Frame) -> tuple[dict[str, float], str]:
    """Relative L2, less the reference's noise, over the pixels that all images have.

    And a line on the pixels that are not finite; empty if all are.
    """
    assert frame.reference is not None
    found, mask = compiled(_errors)(dict(images), *frame.reference)
    excluded = int((~mask).sum())
    line = f"{excluded} of {mask.size} pixels are not finite and were excluded"
    # A program's dictionary comes back sorted; a table keeps the images' order.
    return {n: float(found[n]) for n in images}, line if excluded else ""


def _errors(
    images: dict[str, Image], r: Image, noise: Image | None
) -> tuple[dict[str, Scalar], Mask]:
    """Relative L2 by name, and which pixels all images have."""
    mask = finite(r, *images.values())
    error = functools.partial(metrics.rel_l2, half_difference=noise, mask=mask)
    return {name: error(image, r) for name, image in images.items()}, mask


def rounded(errors: Mapping[str, float]) -> dict[str, str]:
    """A column of errors."""
    return {name: f"{error:.5f}" for name, error in errors.items()}


def table(columns: Mapping[str, Mapping[str, str]]) -> list[str]:
    """Lines of a table: columns by title, rows by the first column's names."""
    names = list(next(iter(columns.values())))
    cells = [
        ["", *columns],
        *([n, *(c.get(n, "") for c in columns.values())] for n in names),
    ]
    return [
        f"  {first:<22}{''.join(f'{c:>14}' for c in others)}".rstrip()
        for first, *others in cells
    ]


def samples(frame: Frame) -> str:
    """Samples a pixel, and in how many sub-buffers they are."""
    spp, count = frame.samples, frame.sub_buffers
    known = "unknown" if spp is None else f"{float(spp):g}"
    return f"{known} samples a pixel in {count} sub-buffer{'s' if count > 1 else ''}"


def size(frame: Frame) -> str:
    """Width x height."""
    height, width = frame.color.shape[:2]
    return f"{width}x{height}"


def frame_of(contents: Contents) -> str:
    """Size, samples and brightness of a file's frame."""
    assert contents.frame is not None
    frame, luminance = contents.frame, contents.median_luminance
    known = f"median luminance {luminance:.4g}"
    return f"{size(frame)}, {samples(frame)}, {known}"
