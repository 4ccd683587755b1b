"""What all dialects share: options of reading, what was read, images from channels."""

import os
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jscomb.exr._choice import Choice, Wanted
from jscomb.exr._files import (
    MAX_BYTES,
    Headers,
    Part,
    check_usable,
    read_headers,
    read_pixels,
    stack,
    window,
)
from jscomb.exr._layers import Layer, layers_of
from jscomb.frame import Estimate

Arguments = dict[str, Any]  # of make_frame
FAR = 1e10  # depth of the background: Cycles writes this, others more or infinity
Window = tuple[int, int, int, int]  # left, top, width, height


class Options(NamedTuple):
    """Options of reading a file.

    Attributes:
        samples: samples a pixel, overrides the file's; None if not given.
        statistics: read variances.
        max_bytes: memory that the pixels of one file may take.
        wanted: layers that a user names.
        everything: read all channels of the file with the colour, to write them again.
    """

    samples: int | None = None
    statistics: bool = True
    max_bytes: int = MAX_BYTES
    wanted: Wanted = Wanted()
    everything: bool = False


class Reading(NamedTuple):
    """What a dialect has read.

    Attributes:
        arguments: of `make_frame`; no colour where there is only a denoised image.
        file: the file with the colour.
        color: the layer of the colour, or of the denoised image where there is no
            other; None where it has no layer of its own.
        parts: of that file; all channels if everything was asked for.
        taken: what was taken for what, by role.
        notes: lines for the user.
        choice: how the layers were chosen; None where the dialect needs no choice.
        missing: why a variance that is there was not read; else empty.
        alpha: the number of its part and its channel; None if there is none.
    """

    arguments: Arguments
    file: str
    color: Layer | None
    parts: list[Part]
    taken: dict[str, list[str]]
    notes: list[str]
    choice: Choice | None = None
    missing: str = ""
    alpha: tuple[int, str] | None = None


class Source:
    """The files of one frame: their headers are read once, and their pixels once."""

    def __init__(self, path: str, *, digests: bool = False):
        """Start with nothing read.

        Args:
            path: EXR file or directory.
            digests: of every file whose header is read.
        """
        self.path, self._digests = path, digests
        self._headers: dict[str, Headers] = {}

    def headers(self, file: str) -> Headers:
        """Return the headers of a file.

        Args:
            file: its path.

        Returns:
            them; read when asked for first.
        """
        if file not in self._headers:
            self._headers[file] = read_headers(file, digest=self._digests)
        return self._headers[file]

    @property
    def files(self) -> list[str]:
        """The files that were looked at."""
        return list(self._headers)

    def digests(self) -> dict[str, str]:
        """Return the digests of all files that were looked at.

        Returns:
            digests by path, from the directory of the frame.
        """
        inside = self.path if os.path.isdir(self.path) else os.path.dirname(self.path)
        return {
            os.path.relpath(file, inside or "."): headers.digest
            for file, headers in sorted(self._headers.items())
        }


def single(source: Source, path: str, options: Options) -> Part:
    """Return the first part of a file with all its channels."""
    return whole(source, path, options)[0]


def whole(source: Source, path: str, options: Options) -> list[Part]:
    """Return all parts of a file with all their channels."""
    headers = source.headers(path)
    check_usable(headers, [0])
    return read_pixels(headers, max_bytes=options.max_bytes)


def layer_named(source: Source, path: str, name: str) -> Layer | None:
    """Return the layer of that name in the first part of a file."""
    first = [layer for layer in layers_of(source.headers(path)) if layer.part == 0]
    return next((layer for layer in first if layer.name == name), None)


def placed(image: np.ndarray, at: Window, onto: Window) -> np.ndarray:
    """Return an image [H,W,...] on another window, NaN where it has no pixels."""
    if at == onto:
        return image
    left, top, width, height = at
    x0, y0, full_width, full_height = onto
    shape = (full_height, full_width, *image.shape[2:])
    found = np.full(shape, np.nan, np.result_type(image.dtype, np.float16))
    rows, to_rows = _overlap(top, height, y0, full_height)
    columns, to_columns = _overlap(left, width, x0, full_width)
    found[to_rows, to_columns] = image[rows, columns]
    return found


def _overlap(start: int, size: int, to: int, to_size: int) -> tuple[slice, slice]:
    """Return the common range of two intervals, from the start of each."""
    first = max(start, to)
    last = max(first, min(start + size, to + to_size))
    return slice(first - start, last - start), slice(first - to, last - to)


def data_window(part: Part) -> Window:
    """Return the data window of a part."""
    return window(part.attributes, "dataWindow")


def rgb(part: Part, layer: str) -> np.ndarray:
    """Return R, G, B of a layer, or Y three times, [H,W,3]; raise if missing."""
    image = stack(part, layer, "RGB")
    if image is None:
        grey = stack(part, layer, "Y")
        if grey is None:
            prefix = f"{layer}." if layer else ""
            listed = ", ".join(sorted(part.channels)[:12])
            raise ValueError(f"channels {prefix}R, G, B are missing among {listed}")
        image = np.repeat(grey, 3, axis=-1)
    return image


def any_image(part: Part, layer: str) -> np.ndarray:
    """Return a layer of any suffixes as three channels, [H,W,3]; raise if missing."""
    for suffixes in ("RGB", "XYZ"):
        image = stack(part, layer, suffixes)
        if image is not None:
            return image
    for suffix in "YZVTR":
        image = stack(part, layer, suffix)
        if image is not None:
            return np.repeat(image, 3, axis=-1)
    return rgb(part, layer)  # raises


def estimate(image: np.ndarray, halves: np.ndarray | None) -> Estimate:
    """Return an estimate of JAX arrays, [H,W,3] and [2,H,W,3]."""
    return Estimate(jnp.asarray(image), None if halves is None else jnp.asarray(halves))


def clipped(albedo: np.ndarray | None) -> np.ndarray | None:
    """Return an optional albedo, clipped to [0, 1] in place."""
    return None if albedo is None else np.clip(albedo, 0, 1, out=albedo)


def finite_depth(depth: np.ndarray) -> np.ndarray:
    """Return depths with 0 for a background at infinity, or as far as one."""
    return np.where(np.abs(depth) >= FAR, 0, depth)


def variance_of_mean(
    spread: np.ndarray,
    samples: int | float | None,
    stored: str,
    *,
    unbiased: bool = False,
) -> np.ndarray:
    """Return the variance of the mean from that of samples.

    It is given as the mean squared deviation, or as the unbiased estimate. `stored`
    names in the error what the file stores of single samples.
    """
    if samples is None:
        raise ValueError(
            f"it stores {stored} of single samples but not their number (an attribute "
            "such as samplesPerPixel is missing): give the samples a pixel (--samples)"
        )
    if samples < 2:
        raise ValueError(f"a variance needs at least two samples, got {samples}")
    return np.maximum(spread, 0) / (samples if unbiased else samples - 1)
