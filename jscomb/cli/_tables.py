"""Tables that the commands print."""

import functools
from collections.abc import Mapping

from jscomb import metrics
from jscomb.frame import Frame
from jscomb.numerics.guards import finite
from jscomb.typing import Image


def errors(images: Mapping[str, Image], frame: Frame) -> dict[str, str]:
    """Relative L2, less the reference's noise, over the pixels that all images have."""
    assert frame.reference is not None
    r, noise = frame.reference
    mask = finite(r, *images.values())
    if excluded := int((~mask).sum()):
        print(f"{excluded} of {mask.size} pixels are not finite and were excluded")
    error = functools.partial(metrics.rel_l2, half_difference=noise, mask=mask)
    return {name: f"{float(error(image, r)):.5f}" for name, image in images.items()}


def print_table(columns: Mapping[str, Mapping[str, str]]) -> None:
    """Columns by title, rows by the first column's names."""
    names = list(next(iter(columns.values())))
    cells = [
        ["", *columns],
        *([n, *(c.get(n, "") for c in columns.values())] for n in names),
    ]
    for first, *others in cells:
        print(f"  {first:<22}{''.join(f'{c:>14}' for c in others)}".rstrip())


def samples(frame: Frame) -> str:
    """Samples a pixel."""
    return "unknown" if frame.samples is None else f"{float(frame.samples):g}"


def size(frame: Frame) -> str:
    """Width x height."""
    height, width = frame.color.shape[:2]
    return f"{width}x{height}"
