"""Assemble EXR files byte by byte, as no library would write them.

A header is a list of attributes (name, type, size, value); then come the offsets of the
chunks, then the chunks: pixels with their position and size.
"""

import struct
import zlib
from collections.abc import Iterator

import numpy as np


def assembled(
    changed: dict[str, tuple[str, bytes]], chunks: list[bytes], *, flags: int = 0
) -> bytes:
    """Return a file of 8x8 grey pixels, uncompressed.

    Args:
        changed: attributes to change or add, type and value by name.
        chunks: in order.
        flags: of the version field.

    Returns:
        the file.
    """
    attributes = {
        "channels": ("chlist", _channels("Y") + b"\0"),
        "compression": ("compression", b"\0"),
        "dataWindow": _box(0, 0, 7, 7),
        "displayWindow": _box(0, 0, 7, 7),
        "lineOrder": ("lineOrder", b"\0"),
        "pixelAspectRatio": ("float", struct.pack("<f", 1)),
        "screenWindowCenter": ("v2f", struct.pack("<2f", 0, 0)),
        "screenWindowWidth": ("float", struct.pack("<f", 1)),
        **changed,
    }
    head = struct.pack("<ii", 20000630, 2 | flags)
    for name, (kind, value) in attributes.items():
        head += f"{name}\0{kind}\0".encode() + struct.pack("<i", len(value)) + value
    head += b"\0" + b"\0" * (flags & MULTI_PART > 0)
    ends = np.cumsum([0, *map(len, chunks)]) + len(head) + 8 * len(chunks)
    return head + ends[:-1].astype("<i8").tobytes() + b"".join(chunks)


TILED, MULTI_PART = 0x200, 0x1000


def rows(grey: np.ndarray) -> bytes:
    """Return a file of an 8x8 image in rows."""
    return assembled({}, [_chunk(y, row.tobytes()) for y, row in enumerate(grey)])


def subsampled(sampling: int) -> bytes:
    """Return a file of two channels, one of them subsampled along both axes."""
    channels = _channels("R", sampling) + _channels("Y") + b"\0"
    chunks = [_chunk(y, bytes(4 * (8 + 4 * (y % 2 == 0)))) for y in range(8)]
    return assembled({"channels": ("chlist", channels)}, chunks)


def luminance_and_chroma() -> bytes:
    """Return a file of luminance, and chroma at half the resolution along both axes."""
    channels = _channels("BY", 2, letters=False) + _channels("RY", 2, letters=False)
    channels += _channels("Y") + b"\0"
    chunks = [_chunk(y, bytes(4 * (8 + 8 * (y % 2 == 0)))) for y in range(8)]
    return assembled({"channels": ("chlist", channels)}, chunks)


def levels(grey: np.ndarray, mode: int) -> bytes:
    """Return a tiled file of an 8x8 image with its smaller versions.

    Args:
        grey: the image, 8x8.
        mode: 0 for one level, 1 for mip-maps, 2 for rip-maps.

    Returns:
        the file.
    """
    pairs = {
        0: [(0, 0)],
        1: [(n, n) for n in range(4)],
        2: [(x, y) for y in range(4) for x in range(4)],
    }[mode]
    chunks = []
    for x, y in pairs:
        pixels = grey[:: 2**y, :: 2**x]
        for row, column in np.ndindex(*(-(-n // 4) for n in pixels.shape)):
            tile = pixels[4 * row : 4 * row + 4, 4 * column : 4 * column + 4].tobytes()
            chunks.append(struct.pack("<5i", column, row, x, y, len(tile)) + tile)
    return assembled({"tiles": _tiles(4, 4, mode)}, chunks, flags=TILED)


def claims() -> Iterator[tuple[str, bytes]]:
    """Yield small files with huge or impossible claims.

    Yields:
        what is claimed, and the file; its pixels, if any, are black.
    """
    for claim, files in {
        "windows": _window_claims,
        "tiles": _tile_claims,
        "channels and attributes": _header_claims,
        "chunks": _chunk_claims,
    }.items():
        for data in files():
            yield claim, data


INT_MAX = 2**31 - 1


def _window_claims() -> Iterator[bytes]:
    """Yield windows that are huge, overflow 32 bits, or are empty."""
    for window in (
        (0, 0, INT_MAX - 1, INT_MAX - 1),
        (-INT_MAX - 1, -INT_MAX - 1, INT_MAX, INT_MAX),
        (0, 0, 46340, 46340),
        (0, 0, 2**30, 0),
        (0, 0, 0, 2**30),
        (5, 5, 4, 4),
    ):
        for names in (["data"], ["display"], ["data", "display"]):
            windows = {f"{name}Window": _box(*window) for name in names}
            yield assembled(windows, _rows())


def _tile_claims() -> Iterator[bytes]:
    """Yield tiles that are huge or empty, in every mode and an unknown one."""
    for width, height in (
        (2**14, 2**14),
        (2**16, 2**16),
        (INT_MAX, INT_MAX),
        (2**31, 2**31),
        (2**32 - 1, 1),
        (0, 4),
    ):
        for mode in range(4):
            tiles = {"tiles": _tiles(width, height, mode)}
            yield assembled(tiles, _rows(), flags=TILED)


def _header_claims() -> Iterator[bytes]:
    """Yield many channels, none, duplicates; attributes longer than the file."""
    many = "".join(map(chr, range(0x4E00, 0x4E00 + 5000)))
    for channels in (_channels(many), b"", 2 * _channels("Y")):
        listed = {"channels": ("chlist", channels + b"\0")}
        yield assembled(listed, _rows())
        yield assembled(listed | {"dataWindow": _box(0, 0, 999, 999)}, _rows())
    for count in (-4, -(2**31), INT_MAX, 9):
        texts = {"x": ("stringvector", struct.pack("<i", count) + b"a\xffcd")}
        yield assembled(texts, _rows())
    for listed in (b"Y", b"Y\0" + bytes(9), b"\xff\0" + bytes(16), b""):
        yield assembled({"channels": ("chlist", listed)}, _rows())
    whole = assembled({"x": ("string", b"abcd")}, _rows())
    for size in (INT_MAX, 2**28, -1, -INT_MAX - 1):
        yield whole.replace(b"\4\0\0\0abcd", struct.pack("<i", size) + b"abcd")
    for side in (2**16, INT_MAX):
        preview = struct.pack("<II", side, side) + bytes(16)
        yield assembled({"preview": ("preview", preview)}, _rows())


def _chunk_claims() -> Iterator[bytes]:
    """Yield chunks of wrong number, size, row, offset; one unpacks to 256 MiB."""
    for count in (INT_MAX, 2**24, 0, -1):
        part = {
            "name": ("string", b"a"),
            "type": ("string", b"scanlineimage"),
            "chunkCount": ("int", struct.pack("<i", count)),
        }
        yield assembled(part, _rows(), flags=MULTI_PART)
    before, after = _rows()[:4], _rows()[5:]
    for size in (INT_MAX, 2**28, 33, 31, 0, -1, -INT_MAX - 1):
        yield assembled({}, [*before, _chunk(4, bytes(32), size=size), *after])
    for row in (INT_MAX, 8, 3, -1, -INT_MAX - 1):
        yield assembled({}, [*before, _chunk(row, bytes(32)), *after])
    whole = assembled({}, _rows())
    first = struct.pack("<q", whole.index(_rows()[0]))
    for offset in (0, -1, 2**32, 2**62):
        yield whole.replace(first, struct.pack("<q", offset))
    packed = _chunk(0, zlib.compress(bytes(2**28)))
    yield assembled({"compression": ("compression", b"\3")}, [packed])


def _rows() -> list[bytes]:
    """Return the chunks of a black image."""
    return [_chunk(row, bytes(32)) for row in range(8)]


def _box(left: int, top: int, right: int, bottom: int) -> tuple[str, bytes]:
    """Return a window attribute."""
    return "box2i", struct.pack("<4i", left, top, right, bottom)


def _tiles(width: int, height: int, mode: int) -> tuple[str, bytes]:
    """Return a tile description attribute."""
    return "tiledesc", struct.pack("<IIB", width, height, mode)


def _channels(names: str, sampling: int = 1, *, letters: bool = True) -> bytes:
    """Return entries of 32-bit float channels, of one letter each or one in all."""
    end = b"\0" + struct.pack("<4i", 2, 0, sampling, sampling)
    return b"".join(name.encode() + end for name in (names if letters else [names]))


def _chunk(row: int, pixels: bytes, *, size: int | None = None) -> bytes:
    """Return a chunk of one row of pixels."""
    return struct.pack("<ii", row, len(pixels) if size is None else size) + pixels
