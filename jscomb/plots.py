"""Pictures of images with their error maps."""

import os
from collections.abc import Mapping, Sequence
from itertools import accumulate

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from jaxtyping import ArrayLike
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize
from matplotlib.patches import Rectangle

from jscomb.frame import Frame
from jscomb.metrics import rel_l2, rel_l2_map, tone_map
from jscomb.numerics.guards import finite
from jscomb.typing import Image

__all__ = ["comparison", "error_map"]

_ERRORS = (1e-4, 1e0)  # relative squared error from black to white
_GAP = 24  # pixels for a line of text
_INSETS = "orange", "deepskyblue"


def comparison(
    path: str | os.PathLike, frame: Frame, images: Mapping[str, Image]
) -> None:
    """Write a picture of images beside the reference: whole, insets, and error maps.

    A pixel of an image is a square of 2x2 in the picture, of 4x4 in the insets. These
    are where the errors of the last two images differ most.

    Args:
        path: PNG file to write.
        frame: with a reference.
        images: by name, linear radiance, [H,W,3].

    Returns:
        nothing.

    Raises:
        ValueError: if the frame has no reference.

    Example:
        >>> import tempfile
        >>> import jax.numpy as jnp
        >>> from jscomb.frame import make_frame
        >>> grey = jnp.full((4, 4, 3), 0.2)
        >>> frame = make_frame(grey, reference=grey)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     comparison(f"{folder}/errors.png", frame, {"path tracing": grey})
        ...     print(os.listdir(folder))
        ['errors.png']
    """
    if frame.reference is None:
        raise ValueError("a comparison needs a frame with a reference")
    reference, noise = frame.reference
    height, width = reference.shape[:2]
    side = max(1, min(height, width) // 4)
    maps = {n: np.asarray(rel_l2_map(i, reference))[..., 0] for n, i in images.items()}
    corners = _differences(list(maps.values()), side)
    rows = [*accumulate((_GAP, 2 * height + 6, 4 * side + _GAP, 2 * height + 6))]
    size = np.array([(1 + len(images)) * (2 * width + 6), rows[-1]])
    figure = plt.figure(figsize=tuple(size / 100), dpi=100)

    def panel(image: np.ndarray, x: int, y: int, scale: int) -> Axes:
        """An image whose upper left corner is at x, y in the picture."""
        w, h = scale * image.shape[1], scale * image.shape[0]
        box = np.array([x, size[1] - y - h, w, h]) / [*size, *size]
        axis = figure.add_axes(tuple(box), xticks=[], yticks=[])
        axis.imshow(image, interpolation="nearest")
        return axis

    for column, (name, image) in enumerate({**images, "reference": reference}.items()):
        shown, x = np.asarray(tone_map(image)), column * (2 * width + 6)
        whole = panel(shown, x, rows[0], 2)
        whole.set_title(name, fontsize=11)
        for number, (top, left) in enumerate(corners):
            color = _INSETS[number]
            corner = (left - 0.5, top - 0.5)
            whole.add_patch(Rectangle(corner, side, side, fill=False, edgecolor=color))
            part = shown[top : top + side, left : left + side]
            inset = panel(part, x + number * 2 * width // len(corners), rows[1], 4)
            inset.spines[:].set_color(color)
        if name not in maps:
            continue
        r, mask = reference, finite(image, reference)
        error = float(rel_l2(image, r, half_difference=noise, mask=mask))
        values = np.clip(np.nan_to_num(maps[name], nan=_ERRORS[1]), *_ERRORS)
        colors = mpl.colormaps["magma"](LogNorm(*_ERRORS)(values))
        panel(colors, x, rows[2], 2).set_title(f"relative L2 {error:.5f}", fontsize=11)
    note = "on the left: relative squared\nerror of each pixel, from\n"
    note += "{:g} (black) to {:g} (white)".format(*_ERRORS)
    x, y = (len(images) * (2 * width + 6) + 10) / size[0], 1 - (rows[2] + 10) / size[1]
    figure.text(x, y, note, fontsize=11, va="top")
    figure.savefig(path)
    plt.close(figure)


def _differences(maps: Sequence[np.ndarray], side: int) -> list[tuple[int, int]]:
    """Upper left corners of two squares in which the last two errors differ most."""
    last = np.clip(np.nan_to_num(maps[-2:]), 0, _ERRORS[1])
    change = np.abs(np.diff(last, axis=0)).sum(axis=0)
    total = np.pad(change, ((1, 0), (1, 0))).cumsum(0).cumsum(1)
    upper, lower = total[:-side], total[side:]
    sums = (lower[:, side:] - lower[:, :-side]) - (upper[:, side:] - upper[:, :-side])
    corners = []
    for _ in range(2):
        top, left = np.unravel_index(np.argmax(sums), sums.shape)
        corners.append((int(top), int(left)))
        near = [slice(max(0, c - side + 1), c + side) for c in corners[-1]]
        sums[tuple(near)] = -1
    return corners


def error_map(
    path: str | os.PathLike,
    error: ArrayLike,
    *,
    title: str,
    limits: tuple[float, float] = _ERRORS,
    logarithmic: bool = True,
) -> None:
    """Write a picture of a map of errors at its full size, with a colour bar.

    Args:
        path: PNG file to write.
        error: [H,W,1]; pixels that are not finite are white.
        title: above the map.
        limits: errors from black to white.
        logarithmic: the scale of the colours.

    Returns:
        nothing.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     error_map(f"{folder}/e.png", np.full((4, 4, 1), 0.1), title="error")
        ...     print(os.listdir(folder))
        ['e.png']
    """
    values = np.asarray(error)[..., 0]
    height, width = values.shape
    low, high = limits
    norm = (LogNorm if logarithmic else Normalize)(low, high)
    right, above = 90, 40  # pixels for the colour bar and the title
    size = np.array([width + right, max(height, 120) + above])
    figure = plt.figure(figsize=tuple(size / 100), dpi=100)
    box = lambda x, y, w, h: figure.add_axes(
        tuple(np.array([x, y, w, h]) / [*size, *size])
    )
    axis = box(0, size[1] - above - height, width, height)
    axis.axis("off")
    shown = np.where(values < low, low, values)
    drawn = axis.imshow(shown, cmap="magma", norm=norm, interpolation="nearest")
    figure.colorbar(drawn, cax=box(width + 10, 10, 14, size[1] - above - 20))
    figure.text(0.01, 1 - 8 / size[1], title, fontsize=9, va="top")
    figure.savefig(path)
    plt.close(figure)
