"""EXR files as plain parts, with a guard around OpenEXR's Python binding.

What the guard is for (OpenEXR 3.5): a truncated file opens with fewer parts and only a
printed warning; a small file can claim gigabytes; arrays that are not contiguous are
written wrong without a word; a failed write leaves half a file; a dict handed over is
changed; exceptions are of any type.
"""

import contextlib
import os
import sys
import uuid
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import OpenEXR

MAX_BYTES = 8 * 2**30  # of all pixels of a file, in memory, unless asked otherwise
MAX_TILE_BYTES = 2**28  # however much is asked for
_BYTES = 4


class Part(NamedTuple):
    """One part of an EXR file.

    Attributes:
        name: of the part; empty in single-part files.
        channels: pixels by channel name, [H,W] each, over the display window; NaN
            where the file's data window holds none.
        attributes: header attributes by name.
    """

    name: str
    channels: dict[str, np.ndarray]
    attributes: dict[str, Any]


def read_parts(
    path: str, *, header_only: bool = False, max_bytes: int = MAX_BYTES
) -> list[Part]:
    """Read a file whole, or not at all.

    Args:
        path: an EXR file.
        header_only: leave out the pixels: channels come back empty.
        max_bytes: that the pixels may take in memory, as 32-bit numbers; refused by
            what the header claims, before any pixel is read.

    Returns:
        its parts in order.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is not a whole EXR file of flat images; says why.
    """
    if not os.path.exists(path):
        raise FileNotFoundError(f"{path}: no such file")
    if not os.path.isfile(path):  # a pipe would be waited for
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
    """Write a file atomically, ZIP compressed.

    Args:
        path: the file; replaced only by a whole one.
        parts: at least one; channels [H,W] in float16 or float32.

    Returns:
        nothing.

    Raises:
        OSError: if it cannot be written; what was at `path` is still there.
    """
    folder = os.path.dirname(path) or "."
    if not os.path.isdir(folder):
        raise FileNotFoundError(f"{path}: there is no folder {folder}")
    if os.path.isdir(path):
        raise IsADirectoryError(f"{path}: is a folder")
    file = OpenEXR.File([_native(part) for part in parts])
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
    """Channels of one layer as an image.

    Args:
        part: of a file.
        layer: prefix before the dot; empty for channels without one.
        suffixes: channel letters in order, such as "RGB".

    Returns:
        the image [H,W,C], C = len(suffixes), in float32; None if a channel is missing.
    """
    names = [f"{layer}.{s}" if layer else s for s in suffixes]
    if not all(name in part.channels for name in names):
        return None
    return np.stack([part.channels[n].astype(np.float32) for n in names], axis=-1)


def layers(part: Part) -> dict[str, str]:
    """Layer prefixes of a part.

    Args:
        part: of a file.

    Returns:
        the sorted last letters of each layer's channels, by prefix.
    """
    found: dict[str, str] = {}
    for name in sorted(part.channels):
        prefix, _, suffix = name.rpartition(".")
        found[prefix] = found.get(prefix, "") + suffix
    return found


def _open(path: str, *, header_only: bool) -> OpenEXR.File:
    """The binding's reader, its many exceptions made one and its prints silent."""
    try:
        with _silence():
            return OpenEXR.File(path, separate_channels=True, header_only=header_only)
    except MemoryError:
        raise ValueError(f"{path}: too large to read into memory") from None
    except Exception as error:  # the binding raises nearly every built-in type
        reason = "is empty" if os.path.getsize(path) == 0 else str(error)
        raise ValueError(f"{path}: not a readable EXR file: {reason}") from None


def _size(header: dict[str, Any], window: str) -> tuple[int, int, int, int]:
    """Left, top, width and height of the data or display window."""
    (x0, y0), (x1, y1) = (corner.tolist() for corner in header[window])
    return x0, y0, x1 - x0 + 1, y1 - y0 + 1


def _claimed_bytes(header: dict[str, Any]) -> int:
    """Memory that a part would take."""
    areas = [w * h for _, _, w, h in (_size(header, n) for n in _WINDOWS)]
    return max(areas) * len(header["channels"]) * _BYTES


def _check_claims(path: str, headers: list[dict[str, Any]], max_bytes: int) -> None:
    """Refuse what would take too much memory, before any pixel is read."""
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
    """Refuse what cannot be read as flat images, before any pixel is."""
    for window in _WINDOWS:
        _, _, width, height = _size(header, window)
        if width < 1 or height < 1:
            raise ValueError(
                f"{path}: its {window} is {width}x{height}, so not an image"
            )
    kind = header.get("type", OpenEXR.scanlineimage)
    if kind not in (OpenEXR.scanlineimage, OpenEXR.tiledimage):
        raise ValueError(f"{path}: deep images are not supported, only flat ones")
    for channel in header["channels"]:
        if (channel.xSampling, channel.ySampling) != (1, 1):
            raise ValueError(f"{path}: channel {channel.name} is subsampled")


def _placed(path: str, part: OpenEXR.Part) -> Part:
    """A part's pixels laid onto its display window: crops padded, overscan cut."""
    left, top, width, height = _size(part.header, "dataWindow")
    x0, y0, full_width, full_height = _size(part.header, "displayWindow")
    channels = {}
    for name, channel in part.channels.items():
        pixels = channel.pixels
        if pixels.shape != (height, width):
            raise ValueError(
                f"{path}: channel {name} has {pixels.shape} pixels, its data window "
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
    """The common range of two intervals, counted from each one's start."""
    first = max(start, to)
    last = max(first, min(start + size, to + to_size))
    return slice(first - start, last - start), slice(first - to, last - to)


def _native(part: Part) -> OpenEXR.Part:
    """The binding's part: contiguous pixels, and a header of its own."""
    header = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        **part.attributes,
    }
    channels = {n: np.ascontiguousarray(pixels) for n, pixels in part.channels.items()}
    return OpenEXR.Part(header, channels, part.name)


@contextlib.contextmanager
def _silence() -> Iterator[None]:
    """Send what the binding prints to nowhere; the guard says it in one line instead.

    It prints warnings to Python's standard output and errors to C's standard error.
    """
    sys.stderr.flush()
    kept = os.dup(2)
    with open(os.devnull, "w") as nowhere, contextlib.redirect_stdout(nowhere):
        os.dup2(nowhere.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(kept, 2)
            os.close(kept)
