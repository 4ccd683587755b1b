"""Make EXR files that are damaged, hostile or unusual: the corpus of `attack`.

Each damaged file is one good file with one change. What OpenEXR's Python binding cannot
write comes from `assembled`.
"""

import io
import math
import pathlib
import struct
from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import numpy as np
import OpenEXR

from jscomb import exr
from jscomb.exr import native
from jscomb.exr._files import Part, read_parts, write_parts
from jscomb.frame import Frame, make_frame
from tests.exr_corpus import assembled

SIZE = 24, 20  # height and width in pixels
OURS, THEIRS = "jscomb's own file", "another program's file"


Arrays = dict[str, np.ndarray]  # of a frame, by their paths in it


class Case(NamedTuple):
    """One file.

    Attributes:
        kind: what is special about it.
        data: its bytes.
        right: arrays of the frame in it; None if only an error is right.
        has_checksum: a checksum in the file covers the change.
        tolerance: of a lossy codec, absolute.
    """

    kind: str
    data: bytes
    right: Arrays | None
    has_checksum: bool = True
    tolerance: float = 0.0


def image(seed: int, *shape: int) -> np.ndarray:
    """Return uniform noise in [0, 1), float32."""
    return np.random.default_rng(seed).random(shape, np.float32)


def own_frame(seed: int) -> Frame:
    """Return a noisy frame with most kinds of buffers, for a file of several parts."""
    return make_frame(
        image(seed, 2, *SIZE, 3),
        variance=image(seed + 1, 2, *SIZE, 3),
        albedo=np.ones((*SIZE, 3), np.float32),
        depth=image(seed + 2, *SIZE, 1),
        samples=64,
        estimates={"oidn": np.zeros((*SIZE, 3), np.float32)},
    )


def arrays(frame: Frame) -> Arrays:
    """Return the arrays of a frame, to compare."""
    leaves = jax.tree_util.tree_leaves_with_path(frame)
    return {jax.tree_util.keystr(path): np.asarray(leaf) for path, leaf in leaves}


def own_bytes(frame: Frame, folder: pathlib.Path) -> bytes:
    """Return the bytes of a frame's file, written in `folder`."""
    exr.write_frame(folder / "own.exr", frame, provenance={"seed": 2**40})
    return (folder / "own.exr").read_bytes()


def corpus(folder: pathlib.Path, *, seed: int, step: int) -> Iterator[Case]:
    """Yield all files, kind by kind.

    Args:
        folder: for temporary files.
        seed: of the noise.
        step: bytes from one damage to the next.

    Yields:
        the cases.
    """
    frame = own_frame(seed)
    ours = Case("as jscomb writes it", own_bytes(frame, folder), arrays(frame))
    yield ours
    yield from _damaged(OURS, ours, step)
    yield from _changed_parts(ours, folder)
    smooth = np.linspace(0, 1, math.prod(SIZE) * 3, dtype=np.float32)
    color = np.round(smooth, 2).reshape(*SIZE, 3)  # every chunk compresses
    for case in _whole(color, image(seed, *SIZE, 3)):
        yield case._replace(kind=f"{THEIRS}, every compression")
        if case.kind in DAMAGED:
            yield from _damaged(THEIRS, case, step)
    yield from _unusual(color)
    black = _of(np.zeros((8, 8, 3), np.float32))
    for claim, data in assembled.claims():
        yield Case(f"claims of {claim}", data, black)


# The largest error of each codec for numbers in [0, 1].
CODECS = {
    "NO": 0.0,
    "RLE": 0.0,
    "ZIPS": 0.0,
    "ZIP": 0.0,
    "PIZ": 0.0,
    "PXR24": 1e-4,
    "B44": 0.0,  # compresses 16 bits only
    "B44A": 0.0,
    "DWAA": 0.05,
    "DWAB": 0.05,
    "HTJ2K32": 0.0,
    "HTJ2K256": 0.0,
    "ZSTD": 0.0,
}
HALF_CODECS = {"B44": 0.02, "B44A": 0.02, "PIZ": 0.0, "HTJ2K32": 0.0, "ZSTD": 0.0}
DAMAGED = (
    *("NO", "RLE", "ZIP", "ZIP of noise", "ZIP in tiles", "PIZ", "PXR24", "DWAA"),
    *("16-bit B44", "16-bit PIZ", "HTJ2K32", "ZSTD"),
)


def _whole(color: np.ndarray, noise: np.ndarray) -> Iterator[Case]:
    """Yield intact files; ZIP has a checksum, but not for noise, which is stored."""
    codec = lambda name: getattr(OpenEXR, f"{name}_COMPRESSION")
    plain, half = _of(color), color.astype(np.float16)
    for name, tolerance in CODECS.items():
        data = _foreign(color, compression=codec(name))
        yield Case(name, data, plain, name.startswith("ZIP"), tolerance)
    for name, tolerance in HALF_CODECS.items():
        data, right = _foreign(half, compression=codec(name)), _of(np.float32(half))
        yield Case(f"16-bit {name}", data, right, False, tolerance)
    yield Case("ZIP of noise", _foreign(noise), _of(noise), False)
    tiles = OpenEXR.TileDescription()
    tiles.xSize = tiles.ySize = 16
    tiled = _foreign(color, type=OpenEXR.tiledimage, tiles=tiles)
    yield Case("ZIP in tiles", tiled, plain)


def _of(color: np.ndarray) -> Arrays:
    """Return what a file of colour alone is read as."""
    return arrays(make_frame(color))


def _foreign(color: np.ndarray, **header: Any) -> bytes:
    """Return an RGB file as the binding writes it."""
    channels = {n: np.ascontiguousarray(color[..., c]) for c, n in enumerate("RGB")}
    return _written(channels, header)


def _written(channels: dict[str, np.ndarray], header: dict[str, Any]) -> bytes:
    """Return a file of any channels as the binding writes it."""
    usual = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION}
    stream = io.BytesIO()
    OpenEXR.File(usual | header, channels).write(stream)
    return stream.getvalue()


def _damaged(whose: str, case: Case, step: int) -> Iterator[Case]:
    """Yield a file truncated, with a bit flipped, with four bytes overwritten."""
    data = case.data
    for end in range(0, len(data), max(step // 2, 1)):
        truncated = f"{whose}, truncated"
        yield case._replace(kind=truncated, data=data[:end], has_checksum=True)
    codec = "" if whose == OURS else f", {case.kind}"
    random = np.random.default_rng(len(data))
    start = header_size(data)
    for number, place in enumerate(range(8, len(data) - 4, step)):
        damaged = bytearray(data)
        if number % 2:
            damaged[place : place + 4] = random.bytes(4)
        else:
            damaged[place] ^= 1 << number // 2 % 8
        if place < start:
            kind, checked = f"{whose}, header damaged", whose == OURS
        else:
            kind, checked = f"{whose}{codec}, pixels damaged", case.has_checksum
        yield case._replace(kind=kind, data=bytes(damaged), has_checksum=checked)


def header_size(data: bytes) -> int:
    """Return the bytes of all headers and tables of offsets of a file."""
    multi_part, place, chunks = data[5] & 0x10, 8, 0
    while data[place]:
        while data[place]:
            name = data[place : data.index(0, place)]
            place = data.index(0, place) + 1
            place = data.index(0, place) + 1
            (size,) = struct.unpack_from("<i", data, place)
            if name == b"chunkCount":
                chunks += struct.unpack_from("<i", data, place + 4)[0]
            place += 4 + size
        place += 1
        if not multi_part:
            break
    if not multi_part:
        return struct.unpack_from("<q", data, place)[0]
    return place + 1 + 8 * chunks


def _changed_parts(ours: Case, folder: pathlib.Path) -> Iterator[Case]:
    """Yield our own files with parts removed, added or exchanged."""
    path = folder / "parts.exr"
    path.write_bytes(ours.data)
    parts = read_parts(str(path))
    a, b, denoised = parts
    reordered = [denoised, b, a]
    for some in (
        reordered,
        [a],
        [a, b],
        [a, denoised],
        [*parts, b._replace(name="c")],
        [*parts, b._replace(name="extra")],
        [a, b._replace(channels=a.channels), denoised],
        [a, denoised._replace(name="b"), b._replace(name="oidn")],
        [a, b._replace(channels={n: b.channels[n] for n in "RGB"}), denoised],
    ):
        bare = [Part(p.name, p.channels, _ours(p.attributes)) for p in some]
        write_parts(str(path), bare)
        right = ours.right if some is reordered else None
        yield Case("parts removed, added, exchanged", path.read_bytes(), right)


def _ours(attributes: dict[str, Any]) -> dict[str, Any]:
    """Return the attributes that identify our own files."""
    return {
        k: v
        for k, v in attributes.items()
        if k in (native.ATTRIBUTE, native.PROVENANCE)
    }


def _unusual(color: np.ndarray) -> Iterator[Case]:
    """Yield valid files of kinds that few programs write."""
    types = {"R": np.float16, "G": np.float32, "B": np.uint32}
    whole = np.round(100 * color)
    mixed = {n: whole[..., c].astype(t) for c, (n, t) in enumerate(types.items())}
    yield Case("mixed types", _written(mixed, {}), _of(whole))
    bad = color.copy()
    bad[::3] = np.nan
    bad[1::5, ::2] = np.inf
    yield Case("NaN and infinite pixels", _foreign(bad), _of(bad))
    for left, top, right, bottom in WINDOWS:
        display = np.int32([left, top]), np.int32([right, bottom])
        data = _foreign(color, displayWindow=display)
        yield Case("crop and overscan windows", data, _of(color))
    deep = np.empty((4, 4), object)
    for place in np.ndindex(4, 4):
        deep[place] = np.ones(sum(place), np.float32)
    lines = {
        "type": OpenEXR.deepscanline,
        "compression": OpenEXR.ZIPS_COMPRESSION,
    }
    yield Case("deep", _written(dict.fromkeys("RGB", deep), lines), None)
    grey = image(0, 8, 8)
    made = _of(np.repeat(grey[..., None], 3, -1))
    yield Case("put together by hand", assembled.rows(grey), made)
    yield Case("put together by hand", assembled.levels(grey, 0), made)
    for mode in (1, 2):
        yield Case("mip-mapped and rip-mapped", assembled.levels(grey, mode), made)
    for sampling in (2, 3, 8, 0, -1):
        yield Case("subsampled", assembled.subsampled(sampling), None)


# Display windows around the data window (0, 0, 19, 23).
WINDOWS = (
    (0, 0, 19, 23),
    (-3, -5, 30, 40),
    (4, 6, 9, 11),
    (10, -2, 40, 8),
    (50, 50, 59, 54),
)
