"""Read and write EXR files as plain parts; guard OpenEXR's Python binding.

The binding (3.5) opens a truncated file with fewer parts and only a printed warning;
lets a small file claim gigabytes; writes non-contiguous arrays wrongly without an
error; leaves half a file behind a failed write; changes a dict that it is given; raises
exceptions of any type; refuses a file for one text that is not UTF-8.

A file is opened twice: for its headers, then for the pixels of what is needed of it.
"""

import contextlib
import hashlib
import os
import re
import sys
import uuid
from collections.abc import Collection, Iterator, Mapping
from typing import Any, BinaryIO, NamedTuple

import numpy as np
import OpenEXR

from jscomb.exr._header import Patched, Raw, read_raw

MAX_BYTES = 8 * 2**30  # default limit for the pixels that are read, in memory
MAX_TILE_BYTES = 2**28  # limit of a tile, whatever `max_bytes` is
_START = b"\x76\x2f\x31\x01"  # of every EXR file
_DEEP = 8  # how much larger than its file a deep image is taken to be
_FLAT = (OpenEXR.scanlineimage, OpenEXR.tiledimage)
_UNFINISHED: set[str] = set()  # temporary files, for `discard_unfinished`


class Part(NamedTuple):
    """One part of an EXR file.

    Attributes:
        name: empty in single-part files.
        channels: pixels by channel name, [H,W] each, of the data window, as they are
            in the file.
        attributes: header attributes by name.
    """

    name: str
    channels: dict[str, np.ndarray]
    attributes: dict[str, Any]


class Headers(NamedTuple):
    """What a file says before its pixels.

    Attributes:
        path: the file.
        parts: without pixels.
        types: of the pixels of each part, by channel.
        unusable: why a part has no flat image, by its number.
        notes: what was changed on reading, in lines for the user.
        raw: the bytes of the headers; None if the binding alone can read them.
        digest: of the whole file; empty if it was not asked for.
    """

    path: str
    parts: list[Part]
    types: list[dict[str, Any]]
    unusable: dict[int, str]
    notes: list[str]
    raw: Raw | None
    digest: str


def read_headers(path: str, *, digest: bool = False) -> Headers:
    """Return the headers of a file, or raise; opens it once."""
    if not os.path.exists(path):
        raise FileNotFoundError(f"{path}: no such file")
    if not os.path.isfile(path):  # reading a pipe would block
        raise ValueError(f"{path}: is not a file")
    with open(path, "rb") as file:
        raw = read_raw(file)
        file.seek(0)
        parts = _opened(path, _stream(file, raw), header_only=True).parts
        found = [Part(part.name(), {}, dict(part.header)) for part in parts]
        for part in found:
            _check_windows(path, part.attributes)
        hashed = ""
        if digest:
            file.seek(0)
            hashed = hashlib.file_digest(file, "sha256").hexdigest()
    if raw is None or len(raw.types) != len(found):
        raw, types = None, [_widest(part) for part in found]
    else:
        types = raw.types
    notes = [] if raw is None else _restore(found, raw)
    unusable = {n: why for n, part in enumerate(found) if (why := _unusable(part))}
    return Headers(path, found, types, unusable, notes, raw, hashed)


def read_pixels(
    headers: Headers,
    wanted: Mapping[int, Collection[str]] | None = None,
    *,
    max_bytes: int = MAX_BYTES,
) -> list[Part]:
    """Return the parts with the wanted channels, by part; opens the file once.

    None for all channels. `max_bytes` limits what is read, which is more than what is
    wanted where the binding cannot read less.
    """
    path, parts = headers.path, headers.parts
    alone = _first_alone(headers, wanted)
    _check_claims(headers, None if alone is None else {0: alone}, max_bytes)
    if alone is not None:
        return [_selected(headers, alone), *parts[1:]]
    with contextlib.ExitStack() as stack:
        source: Any = path
        if _is_escaped(headers.raw):
            source = _stream(stack.enter_context(open(path, "rb")), headers.raw)
        read = _opened(path, source, header_only=False).parts
    if len(read) != len(parts):
        raise ValueError(
            f"{path}: truncated or corrupt: only {len(read)} of {len(parts)} parts "
            "have readable pixels"
        )
    return [
        part._replace(channels=_pixels(headers, number, read[number], wanted))
        for number, part in enumerate(parts)
    ]


def read_parts(
    path: str, *, header_only: bool = False, max_bytes: int = MAX_BYTES
) -> list[Part]:
    """Return all parts of a complete file of flat images, or raise."""
    headers = read_headers(path)
    check_usable(headers, range(len(headers.parts)))
    return headers.parts if header_only else read_pixels(headers, max_bytes=max_bytes)


def check_usable(headers: Headers, parts: Collection[int]) -> None:
    """Raise if one of the parts has no flat image."""
    for number in parts:
        if number in headers.unusable:
            raise ValueError(f"{headers.path}: {headers.unusable[number]}")


def write_parts(path: str, parts: list[Part]) -> list[str]:
    """Write channels as they are, atomically; ZIP compressed if nothing else is asked.

    A link stays one: what it points to is replaced. Returns the names of attributes
    that cannot be written.
    """
    target = os.path.realpath(path)
    folder = os.path.dirname(target)
    if not os.path.isdir(folder):
        shown = folder if os.path.islink(path) else os.path.dirname(path) or "."
        raise FileNotFoundError(f"{path}: the folder {shown} does not exist")
    if os.path.isdir(target):
        raise IsADirectoryError(f"{path}: is a folder")
    temporary = os.path.join(folder, f".jscomb-{uuid.uuid4().hex}.exr")
    _UNFINISHED.add(temporary)
    try:
        lost = _written(temporary, parts)
        os.replace(temporary, target)
    except (RuntimeError, OSError) as error:
        reason = str(error).replace(temporary, path)
        raise OSError(f"{path}: cannot be written: {reason}") from None
    finally:
        with contextlib.suppress(OSError):
            os.unlink(temporary)
        _UNFINISHED.discard(temporary)
    return lost


def discard_unfinished() -> None:
    """Remove the temporary files of writes that are going on, before an exit."""
    for temporary in list(_UNFINISHED):
        with contextlib.suppress(OSError):
            os.unlink(temporary)


def _written(temporary: str, parts: list[Part]) -> list[str]:
    """Write a file; without attributes whose types the binding cannot write."""
    lost: list[str] = []
    while True:
        kept = [
            p._replace(
                attributes={k: v for k, v in p.attributes.items() if k not in lost}
            )
            for p in parts
        ]
        try:
            with _silence():
                OpenEXR.File([_to_openexr(part) for part in kept]).write(temporary)
        except (RuntimeError, ValueError, TypeError) as error:
            found = re.search(r"type of attribute '([^']+)'", str(error))
            if found is None or found[1] in lost:
                raise
            lost.append(found[1])
        else:
            return lost


def stack(part: Part, layer: str, suffixes: str) -> np.ndarray | None:
    """Return channels of a layer as float32 [H,W,C]; None if one is missing."""
    names = channel_names(layer, suffixes)
    if not all(name in part.channels for name in names):
        return None
    return np.stack([part.channels[n].astype(np.float32) for n in names], axis=-1)


def channel_names(layer: str, suffixes: str) -> list[str]:
    """Return the names of a layer's channels; the layer "" has no prefix."""
    return [f"{layer}.{s}" if layer else s for s in suffixes]


def window(attributes: dict[str, Any], name: str) -> tuple[int, int, int, int]:
    """Return left, top, width and height of the dataWindow or displayWindow."""
    (x0, y0), (x1, y1) = (corner.tolist() for corner in attributes[name])
    return x0, y0, x1 - x0 + 1, y1 - y0 + 1


def _stream(file: BinaryIO, raw: Raw | None) -> Any:
    """The file, with text that the binding can read."""
    return Patched(file, raw.data) if raw and _is_escaped(raw) else file


def _is_escaped(raw: Raw | None) -> bool:
    """Whether some text of the headers is not UTF-8."""
    return raw is not None and (raw.renamed or any(raw.escaped))


def _restore(parts: list[Part], raw: Raw) -> list[str]:
    """Put escaped text into the attributes; returns what to say about it."""
    changed = [name for texts in raw.escaped for name in texts]
    for part, texts in zip(parts, raw.escaped, strict=True):
        part.attributes.update(texts)
    if raw.renamed:
        changed.append("names of channels or attributes")
    if not changed:
        return []
    return [f"text that is not UTF-8 was escaped: {', '.join(dict.fromkeys(changed))}"]


def _opened(path: str, source: Any, *, header_only: bool) -> OpenEXR.File:
    """Open a file silently, with one type of exception for the binding's many."""
    try:
        with _silence():
            return OpenEXR.File(source, separate_channels=True, header_only=header_only)
    except MemoryError:
        raise ValueError(f"{path}: too large to read into memory") from None
    except Exception as error:  # the binding raises nearly every built-in type
        raise _unreadable(path, error) from None


def _unreadable(path: str, error: Exception) -> ValueError:
    """The error for a file that the binding cannot read."""
    with open(path, "rb") as file:
        start = file.read(len(_START))
    reason = str(error).replace("<python_buffer>", path)
    if not start:
        reason = "is empty"
    elif start != _START:
        reason = "has other content, by its first bytes"
    return ValueError(f"{path}: not a readable EXR file: {reason}")


def _first_alone(
    headers: Headers, wanted: Mapping[int, Collection[str]] | None
) -> list[str] | None:
    """The wanted channels, if they are of the first part and can be read alone."""
    some = {number: names for number, names in (wanted or {}).items() if names}
    if wanted is None or set(some) - {0} or _is_escaped(headers.raw):
        return None
    if headers.raw is None or not hasattr(OpenEXR, "InputFile"):
        return None
    names = list(some.get(0, ()))
    more = len(headers.types[0]) + len(headers.parts) - 1
    return names if names and len(names) < more else None


def _selected(headers: Headers, names: list[str]) -> Part:
    """The first part with some of its channels, so that the rest takes no memory."""
    path, part = headers.path, headers.parts[0]
    _, _, width, height = window(part.attributes, "dataWindow")
    types = [headers.types[0][name] for name in names]
    try:
        with _silence():
            file = OpenEXR.InputFile(path)
            try:
                if not file.isComplete():
                    raise ValueError("truncated or corrupt: rows are missing")
                data = file.channels(names)
            finally:
                file.close()
    except MemoryError:
        raise ValueError(f"{path}: too large to read into memory") from None
    except Exception as error:
        raise ValueError(f"{path}: truncated or corrupt: {error}") from None
    planes = zip(names, data, types, strict=True)
    channels = {n: np.frombuffer(d, t).reshape(height, width) for n, d, t in planes}
    return part._replace(channels=channels)


def _pixels(
    headers: Headers,
    number: int,
    read: Any,
    wanted: Mapping[int, Collection[str]] | None,
) -> dict[str, np.ndarray]:
    """The wanted channels of a part that was read."""
    names = read.channels.keys() if wanted is None else wanted.get(number, ())
    pixels = {name: read.channels[name].pixels for name in names}
    if number in headers.unusable:
        return pixels
    _, _, width, height = window(headers.parts[number].attributes, "dataWindow")
    for name, image in pixels.items():
        if image.shape != (height, width):
            raise ValueError(
                f"{headers.path}: channel {name} has {image.shape} pixels, the data "
                f"window {(height, width)}"
            )
    return pixels


def _widest(part: Part) -> dict[str, Any]:
    """Pixel types of a part whose header tells them to the binding alone."""
    return {channel.name: np.float32 for channel in part.attributes["channels"]}


def _check_claims(
    headers: Headers, wanted: Mapping[int, Collection[str]] | None, max_bytes: int
) -> None:
    """Raise if the file would take too much memory, before any pixel is read."""
    path, claimed = headers.path, 0
    for number, (part, types) in enumerate(
        zip(headers.parts, headers.types, strict=True)
    ):
        names = types if wanted is None else wanted.get(number, ())
        _, _, width, height = window(part.attributes, "dataWindow")
        size = sum(np.dtype(types[name]).itemsize for name in names)
        claimed += width * height * size
        if "deep" in headers.unusable.get(number, "") and names:
            claimed += _DEEP * os.path.getsize(path)
    if claimed > max_bytes:
        raise ValueError(
            f"{path}: claims {claimed / 2**20:.1f} MiB of pixels, max_bytes allows "
            f"{max_bytes / 2**20:.1f} MiB (--max-memory)"
        )
    limit = min(max_bytes, MAX_TILE_BYTES)
    for part, types in zip(headers.parts, headers.types, strict=True):
        tiles = part.attributes.get("tiles")
        if tiles is None:
            continue
        size = sum(np.dtype(kind).itemsize for kind in types.values())
        claimed = tiles.xSize * tiles.ySize * size
        if claimed > limit:
            raise ValueError(
                f"{path}: claims tiles of {claimed / 2**20:.1f} MiB, the limit is "
                f"{limit / 2**20:.1f} MiB"
            )


def _check_windows(path: str, attributes: dict[str, Any]) -> None:
    """Raise unless the part has pixels."""
    for name in ("dataWindow", "displayWindow"):
        _, _, width, height = window(attributes, name)
        if width < 1 or height < 1:
            raise ValueError(f"{path}: {name} is {width}x{height}, not an image")


def _unusable(part: Part) -> str:
    """Why a part has no flat image; empty if it has one."""
    kind = part.attributes.get("type", OpenEXR.scanlineimage)
    if kind not in _FLAT:
        return "deep images are not supported, only flat images"
    for channel in part.attributes["channels"]:
        if (channel.xSampling, channel.ySampling) != (1, 1):
            return f"channel {channel.name} is subsampled"
    return ""


def _to_openexr(part: Part) -> OpenEXR.Part:
    """Return the binding's part: contiguous pixels, and a header of its own."""
    header = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        **{k: v for k, v in part.attributes.items() if k not in ("channels", "name")},
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
