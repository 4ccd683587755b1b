"""What belongs to a frame but is in another file: in its colours, on its window."""

import os
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike

from jscomb.exr import _color
from jscomb.exr._choice import channels_of, unit_of
from jscomb.exr._contents import Contents, open_source
from jscomb.exr._files import MAX_BYTES, read_pixels, window
from jscomb.exr._layers import Layer, layers_of
from jscomb.exr.dialects._images import (
    Source,
    Window,
    placed,
    variance_of_mean,
)
from jscomb.typing import Image


class Feature(NamedTuple):
    """One image of a file.

    Attributes:
        path: of the file.
        image: [H,W,C], of the data window.
        window: the data window: left, top, width, height.
        display: the display window.
    """

    path: str
    image: np.ndarray
    window: Window
    display: Window


def read_feature(
    path: str | os.PathLike | Source,
    name: str,
    *,
    samples: int | float | None = None,
    max_bytes: int = MAX_BYTES,
) -> Feature:
    """Read one feature, or the variance, from a file of its own.

    Args:
        path: EXR file, or a `Source` of it.
        name: albedo, normal, or variance: the layer that is usually called so, else the
            file's only or main image.
        samples: samples a pixel, for a variance of single samples.
        max_bytes: as for `read_contents`.

    Returns:
        the image; the variance is of the mean.

    Raises:
        ValueError: if there is no such image in the file.

    Example:
        >>> import tempfile
        >>> from jscomb import exr
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     exr.write_image(f"{folder}/albedo.exr", np.full((2, 2, 3), 0.5))
        ...     print(exr.read_feature(f"{folder}/albedo.exr", "albedo").image[0, 0])
        [0.5 0.5 0.5]
    """
    source = path if isinstance(path, Source) else open_source(path)
    headers = source.headers(source.path)
    layers = layers_of(headers)
    usable = [layer for layer in layers if _channels(layer, name)]
    called = [layer for layer in usable if layer.rank(name) is not None]
    if not usable:
        raise ValueError(f"{source.path}: has no {name}")
    layer = min(
        called or usable, key=lambda each: (each.rank(name) or 0, not each.bare)
    )
    unit = unit_of(layer) if called else "mean"
    names = channels_of(layer, name)
    part = read_pixels(headers, {layer.part: set(names)}, max_bytes=max_bytes)
    planes = part[layer.part].channels
    image = np.stack([planes[each].astype(np.float32) for each in names], axis=-1)
    if name == "variance":
        image = np.repeat(image, 3, axis=-1) if len(names) == 1 else image
        if unit != "mean":
            unbiased = unit == "sample"
            stored = f"the variance ({source.path})"
            try:
                image = variance_of_mean(image, samples, stored, unbiased=unbiased)
            except ValueError as error:
                raise ValueError(f"{source.path}: {error}") from None
    if name == "albedo":
        image = np.clip(image, 0, 1)
    attributes = part[layer.part].attributes
    windows = (window(attributes, f"{kind}Window") for kind in ("data", "display"))
    return Feature(source.path, image, *windows)


def _channels(layer: Layer, name: str) -> list[str] | None:
    """The channels of a layer that may be a feature; None if there are none."""
    try:
        return channels_of(layer, name)
    except ValueError:
        return None


def align(feature: Feature, target: Contents) -> tuple[Image, list[str]]:
    """Return an image on the window of a frame.

    Args:
        feature: the image.
        target: contents of the frame.

    Returns:
        the image, NaN where it has no pixels; lines for the user on what was done.

    Raises:
        ValueError: if the images have not the same size, nor windows of one display.

    Example:
        >>> from jscomb import exr
        >>> contents = exr.read_contents(exr.bundled()["cornell-glass-64"])
        >>> feature = exr.Feature("a.exr", contents.image, *[contents.window] * 2)
        >>> print(align(feature, contents)[1])
        []
    """
    path, image, at, display = feature
    notes, size = [], target.size
    if at != target.window:
        if display == target.display:
            image = placed(np.asarray(image), at, target.window)
        elif image.shape[:2] == size:
            notes = [
                f"{path}: its window is another than that of {target.path}: both "
                "are taken to be the same pixels"
            ]
        if image.shape[:2] != size or np.isnan(image).all():
            raise ValueError(
                f"{path} is {feature.image.shape}, {target.path} {(*size, 3)}"
            )
    return jnp.asarray(image), notes


def convert(
    image: ArrayLike, contents: Contents, target: Contents
) -> tuple[Image, list[str]]:
    """Return an image of one file in the primaries and on the window of another.

    Args:
        image: of `contents`, linear radiance, [H,W,3].
        contents: what states its primaries and window.
        target: what it is to go with.

    Returns:
        the image, NaN where it has no pixels; lines for the user on what was done.

    Raises:
        ValueError: if the images have not the same size, nor windows of one display.

    Example:
        >>> from jscomb import exr
        >>> contents = exr.read_contents(exr.bundled()["cornell-glass-64"])
        >>> image, notes = convert(contents.image, contents, contents)
        >>> print(image.shape, notes)
        (192, 192, 3) []
    """
    found, notes = np.asarray(image, np.float32), []
    own, wanted = contents.chromaticities, target.chromaticities
    if own is None and not _color.agree(own, wanted):
        notes.append(
            f"{contents.path} states no chromaticities: taken to be those of "
            f"{target.path}"
        )
    elif not _color.agree(own, wanted):
        both = (color or _color.REC_709 for color in (own, wanted))
        found = found @ _color.conversion(*both).astype(np.float32).T
        notes.append(
            f"{contents.path} has other chromaticities than {target.path}: converted"
        )
    feature = Feature(contents.path, found, contents.window, contents.display)
    aligned, more = align(feature, target)
    return aligned, notes + more
