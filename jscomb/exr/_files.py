"""Read and write EXR files as plain parts; guard OpenEXR's Python binding.

The binding (3.5) opens a truncated file with fewer parts and only a printed warning;
lets a small file claim gigabytes; writes non-contiguous arrays wrongly without an
error; leaves half a file behind a failed write; changes a dict that it is given; raises
exceptions of any type.
"""

import contextlib
import os
import sys
import uuid
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import OpenEXR

MAX_BYTES = 8 * 2**30  # default limit for all pixels of a file, in memory
MAX_TILE_BYTES = 2**28  # limit of a tile, whatever `max_bytes` is
_BYTES = 4  # a pixel of a channel


class Part(NamedTuple):
    """One part of an EXR file.

    Attributes:
        name: empty in single-part files.
        channels: pixels by channel name, [H,W] each, of the display window; NaN
            outside the data window.
        attributes: header attributes by name.
    """

    name: str
    channels: dict[str, np.ndarray]
    attributes: dict[str, Any]


def read_parts(
    path: str, *, header_only: bool = False, max_bytes: int = MAX_BYTES
) -> list[Part]:
    """Return the parts of a complete file of flat images, or raise.

    `header_only` leaves `channels` empty; `max_bytes` limits the memory that the header
    claims for 32-bit pixels, before any pixel is read.
    """
    if not os.path.exists(path):
        raise FileNotFoundError(f"{path}: no such file")
    if not os.path.isfile(path):  # reading a pipe would block
        raise ValueError(f"{path}: is not a file")
    headers = _open(path, header_only=True).parts
    for part in headers:
        _check_header(path, part.header)
    if header_only:
        return [Part(part.name(), {}, dict(part.header)) for part in headers]
    _check_claims(path, [part.header for part in headers], max_bytes)
    parts = _open(path, header_only=False).parts
    if len(parts) != len(headers):
        raise ValueError(
            f"{path}: truncated or corrupt: only {len(parts)} of {len(headers)} parts "
            "have readable pixels"
        )
    return [_placed(path, part) for part in parts]


def write_parts(path: str, parts: list[Part]) -> None:
    """Write channels [H,W], float16 or float32, atomically and ZIP compressed."""
    folder = os.path.dirname(path) or "."
    if not os.path.isdir(folder):
        raise FileNotFoundError(f"{path}: the folder {folder} does not exist")
    if os.path.isdir(path):
        raise IsADirectoryError(f"{path}: is a folder")
    file = OpenEXR.File([_to_openexr(part) for part in parts])
    temporary = os.path.join(folder, f".jscomb-{uuid.uuid4().hex}.exr")
    try:
        with _silence():
            file.write(temporary)
        os.replace(temporary, path)
    except (RuntimeError, OSError) as error:
        reason = str(error).replace(temporary, path)
        raise OSError(f"{path}: cannot be written: {reason}") from None
    finally:
        with contextlib.suppress(OSError):
            os.unlink(temporary)


def stack(part: Part, layer: str, suffixes: str) -> np.ndarray | None:
    """Return channels of a layer as float32 [H,W,C]; None if one is missing."""
    names = channel_names(layer, suffixes)
    if not all(name in part.channels for name in names):
        return None
    return np.stack([part.channels[n].astype(np.float32) for n in names], axis=-1)


def channel_names(layer: str, suffixes: str) -> list[str]:
    """Return the names of a layer's channels; the layer "" has no prefix."""
    return [f"{layer}.{s}" if layer else s for s in suffixes]


def layers(part: Part) -> dict[str, str]:
    """Return the sorted channel suffixes of each layer, by the layer's name."""
    found: dict[str, str] = {}
    for name in sorted(part.channels):
        prefix, _, suffix = name.rpartition(".")
        found[prefix] = found.get(prefix, "") + suffix
    return found


def _open(path: str, *, header_only: bool) -> OpenEXR.File:
    """Open a file silently, with one type of exception for the binding's many."""
    try:
        with _silence():
            return OpenEXR.File(path, separate_channels=True, header_only=header_only)
    except MemoryError:
        raise ValueError(f"{path}: too large to read into memory") from None
    except Exception as error:  # the binding raises nearly every built-in type
        reason = "is empty" if os.path.getsize(path) == 0 else str(error)
        raise ValueError(f"{path}: not a readable EXR file: {reason}") from None


def _size(header: dict[str, Any], window: str) -> tuple[int, int, int, int]:
    """Return left, top, width and height of the data or display window."""
    (x0, y0), (x1, y1) = (corner.tolist() for corner in header[window])
    return x0, y0, x1 - x0 + 1, y1 - y0 + 1


def _claimed_bytes(header: dict[str, Any]) -> int:
    """Return the memory that a part would take."""
    areas = [w * h for _, _, w, h in (_size(header, n) for n in _WINDOWS)]
    return max(areas) * len(header["channels"]) * _BYTES


def _check_claims(path: str, headers: list[dict[str, Any]], max_bytes: int) -> None:
    """Raise if the file would take too much memory, before any pixel is read."""
    claimed = sum(_claimed_bytes(header) for header in headers)
    if claimed > max_bytes:
        raise ValueError(
            f"{path}: claims {claimed / 2**20:.1f} MiB of pixels, max_bytes allows "
            f"{max_bytes / 2**20:.1f} MiB"
        )
    limit = min(max_bytes, MAX_TILE_BYTES)
    for header in headers:
        tiles = header.get("tiles")
        if tiles is None:
            continue
        claimed = tiles.xSize * tiles.ySize * len(header["channels"]) * _BYTES
        if claimed > limit:
            raise ValueError(
                f"{path}: claims tiles of {claimed / 2**20:.1f} MiB, the limit is "
                f"{limit / 2**20:.1f} MiB"
            )


_WINDOWS = ("dataWindow", "displayWindow")


def _check_header(path: str, header: dict[str, Any]) -> None:
    """Raise unless the part is a flat image, before any pixel is read."""
    for window in _WINDOWS:
        _, _, width, height = _size(header, window)
        if width < 1 or height < 1:
            raise ValueError(f"{path}: {window} is {width}x{height}, not an image")
    kind = header.get("type", OpenEXR.scanlineimage)
    if kind not in (OpenEXR.scanlineimage, OpenEXR.tiledimage):
        raise ValueError(f"{path}: deep images are not supported, only flat images")
    for channel in header["channels"]:
        if (channel.xSampling, channel.ySampling) != (1, 1):
            raise ValueError(f"{path}: channel {channel.name} is subsampled")


def _placed(path: str, part: OpenEXR.Part) -> Part:
    """Return a part on its display window: crops padded with NaN, overscan cut off."""
    left, top, width, height = _size(part.header, "dataWindow")
    x0, y0, full_width, full_height = _size(part.header, "displayWindow")
    channels = {}
    for name, channel in part.channels.items():
        pixels = channel.pixels
        if pixels.shape != (height, width):
            raise ValueError(
                f"{path}: channel {name} has {pixels.shape} pixels, the data window "
                f"{(height, width)}"
            )
        if pixels.dtype == np.uint32:
            pixels = pixels.astype(np.float32)
        if (left, top, width, height) != (x0, y0, full_width, full_height):
            placed = np.full((full_height, full_width), np.nan, pixels.dtype)
            rows, to_rows = _overlap(top, height, y0, full_height)
            columns, to_columns = _overlap(left, width, x0, full_width)
            placed[to_rows, to_columns] = pixels[rows, columns]
            pixels = placed
        channels[name] = pixels
    return Part(part.name(), channels, dict(part.header))


def _overlap(start: int, size: int, to: int, to_size: int) -> tuple[slice, slice]:
    """Return the common range of two intervals, from the start of each."""
    first = max(start, to)
    last = max(first, min(start + size, to + to_size))
    return slice(first - start, last - start), slice(first - to, last - to)


def _to_openexr(part: Part) -> OpenEXR.Part:
    """Return the binding's part: contiguous pixels, and a header of its own."""
    header = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        **part.attributes,
    }
    channels = {n: np.ascontiguousarray(pixels) for n, pixels in part.channels.items()}
    return OpenEXR.Part(header, channels, part.name)


@contextlib.contextmanager
def _silence() -> Iterator[None]:
    """Discard what the binding prints to Python's stdout and to C's stderr."""
    sys.stderr.flush()
    stderr = os.dup(2)
    with open(os.devnull, "w") as nowhere, contextlib.redirect_stdout(nowhere):
        os.dup2(nowhere.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(stderr, 2)
            os.close(stderr)
