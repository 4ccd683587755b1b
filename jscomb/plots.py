"""Pictures of images with their error maps."""

import os
from collections.abc import Sequence

import matplotlib.pyplot as plt
import numpy as np
from jaxtyping import Array, ArrayLike
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize

from jscomb.frame import Frame
from jscomb.metrics import rel_l2, rel_l2_map, tone_map
from jscomb.numerics.guards import finite
from jscomb.typing import Image

__all__ = ["comparison", "error_map"]

_ERRORS = (1e-4, 1e0)  # relative squared error from black to white


def comparison(
    path: str | os.PathLike, frames: Sequence[tuple[Frame, dict[str, Image]]]
) -> None:
    """Write a picture: for each frame a row of images above a row of error maps.

    Args:
        path: PNG file to write.
        frames: each a frame with a reference, and further images of it by name, linear
            radiance, [H,W,3]. The frame's colour and estimates are shown before them.

    Returns:
        nothing.

    Raises:
        ValueError: if a frame has no reference.

    Example:
        >>> import tempfile
        >>> import jax.numpy as jnp
        >>> from jscomb.frame import make_frame
        >>> grey = jnp.full((4, 4, 3), 0.2)
        >>> frame = make_frame(grey, estimates={"denoised": grey}, reference=grey)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     comparison(f"{folder}/errors.png", [(frame, {"combined": grey})])
        ...     print(os.listdir(folder))
        ['errors.png']
    """
    rows = []
    for frame, combined in frames:
        if frame.reference is None:
            raise ValueError("a comparison needs a frame with a reference")
        spp = "" if frame.samples is None else f", {float(frame.samples):.0f} spp"
        inputs = {f"path tracing{spp}": frame.color}
        inputs |= {name: image.image for name, image in frame.estimates.items()}
        rows.append((frame.reference, inputs | combined))
    columns = 1 + max(len(images) for _, images in rows)
    figure, axes = plt.subplots(
        2 * len(rows),
        columns,
        figsize=(3 * columns, 6.6 * len(rows)),
        squeeze=False,
        layout="compressed",
    )
    for axis in axes.flat:
        axis.axis("off")
    for number, (reference, images) in enumerate(rows):
        above, below = axes[2 * number], axes[2 * number + 1]
        for axis, under, (name, image) in zip(
            above, below, images.items(), strict=False
        ):
            _show(axis, image, name)
            r, noise = reference
            mask = finite(image, r)
            error = float(rel_l2(image, r, half_difference=noise, mask=mask))
            _show_error(under, image, r, f"relative L2 {error:.5f}")
        _show(above[len(images)], reference.image, "reference")
    low, high = _ERRORS
    note = f"below: relative squared error, black {low:g} to white {high:g}"
    figure.supxlabel(note, fontsize=9)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _show(axis: Axes, image: Array, title: str) -> None:
    """Show a tone-mapped image."""
    axis.imshow(np.asarray(tone_map(image)), interpolation="nearest")
    axis.set_title(title, fontsize=9)


def _show_error(axis: Axes, image: Array, reference: Array, title: str) -> None:
    """Show the relative squared error of each pixel on a logarithmic scale."""
    error = rel_l2_map(image, reference)[..., 0]
    shown = np.maximum(error, _ERRORS[0])  # 0 would be transparent
    norm = LogNorm(*_ERRORS)
    axis.imshow(shown, cmap="magma", norm=norm, interpolation="nearest")
    axis.set_title(title, fontsize=9)


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
