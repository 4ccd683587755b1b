"""Read of an EXR header what OpenEXR's Python binding does not tell.

That is the pixel types before any pixel is read, and text that is not UTF-8, for which
the binding refuses the whole file. A header is a list of attributes: name, type, size,
value; a name without bytes ends it, and one more ends the headers of several parts.
"""

import io
import struct
from typing import BinaryIO, NamedTuple

import numpy as np

_MULTI_PART = 0x1000
_MAX_NAME = 255  # bytes
_TYPES = {0: np.uint32, 1: np.float16, 2: np.float32}


class Raw(NamedTuple):
    """All headers of a file.

    Attributes:
        data: the bytes from the start of the file, with text that is not UTF-8
            replaced by as many ASCII characters.
        types: pixel types of each part, by the channel's name.
        escaped: of each part the text that was replaced, with escapes, by attribute.
        renamed: whether names were replaced too, of channels or attributes.
    """

    data: bytes
    types: list[dict[str, type]]
    escaped: list[dict[str, str]]
    renamed: bool


def read_raw(file: BinaryIO) -> Raw | None:
    """Return the headers at the start of a file; None if they are malformed."""
    try:
        return _read(file)
    except (struct.error, ValueError, EOFError, LookupError):
        return None


def _read(file: BinaryIO) -> Raw:
    """The headers; raises if they are malformed."""
    data = bytearray(file.read(8))
    _, version = struct.unpack("<ii", data)
    end = file.seek(0, io.SEEK_END)
    file.seek(len(data))
    types, escaped, renamed = [], [], False
    while True:
        channels, texts = {}, {}
        while name := _name(file):
            kind = _name(file)
            size = file.read(4)
            (count,) = struct.unpack("<i", size)
            if not 0 <= count <= end - file.tell():
                raise ValueError("an attribute is longer than the file")
            value = file.read(count)
            safe_name, safe = _ascii(name), value
            if kind == b"string" and not _is_text(value):
                texts[safe_name.decode()] = value.decode("utf-8", "backslashreplace")
                safe = _ascii(value)
            elif kind in (b"stringvector", b"chlist"):
                safe = _safe_list(kind, value)
                renamed |= safe != value
            renamed |= safe_name != name
            if kind == b"chlist":
                channels = dict(_channels(safe))
            data += b"\0".join([safe_name, kind, size]) + safe
        data += b"\0"
        if not channels and not texts and types and version & _MULTI_PART:
            break  # the empty header that ends them
        types.append(channels)
        escaped.append(texts)
        if not version & _MULTI_PART:
            break
    return Raw(bytes(data), types, escaped, renamed)


def _name(file: BinaryIO) -> bytes:
    """The next name."""
    text = b""
    while (byte := file.read(1)) != b"\0":
        if not byte or len(text) > _MAX_NAME:
            raise EOFError
        text += byte
    return text


def _channels(value: bytes) -> list[tuple[str, type]]:
    """The names and types in a list of channels."""
    found, place = [], 0
    while value[place]:
        end = value.index(0, place)
        (kind,) = struct.unpack_from("<i", value, end + 1)
        found.append((value[place:end].decode(), _TYPES[kind]))
        place = end + 17
    return found


def _safe_list(kind: bytes, value: bytes) -> bytes:
    """Channels or texts, with what is not UTF-8 replaced."""
    safe, place = bytearray(value), 0
    while place < len(value) and (kind != b"chlist" or value[place]):
        if kind == b"chlist":
            start, end = place, value.index(0, place)
            place = end + 17
        else:
            (count,) = struct.unpack_from("<i", value, place)
            if count < 0:
                raise ValueError("a text of negative length")
            start, end = place + 4, place + 4 + count
            place = end
        safe[start:end] = _ascii(value[start:end])
    return bytes(safe)


def _is_text(value: bytes) -> bool:
    """Whether bytes are UTF-8."""
    try:
        value.decode()
    except UnicodeDecodeError:
        return False
    return True


def _ascii(value: bytes) -> bytes:
    """The bytes themselves if they are UTF-8, else as many of ASCII."""
    if _is_text(value):
        return value
    plain = (byte & 0x7F if byte > 0x7F else byte for byte in value)
    odd = b"./\x7f"  # would part names, or end them
    return bytes(
        b if v < 0x80 or (b > 0x20 and b not in odd) else ord("_")
        for b, v in zip(plain, value, strict=True)
    )


class Patched(io.RawIOBase):
    """A file whose first bytes are replaced."""

    def __init__(self, file: BinaryIO, start: bytes):
        self._file, self._start = file, start

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def tell(self) -> int:
        return self._file.tell()

    def seek(self, offset: int, whence: int = 0) -> int:
        return self._file.seek(offset, whence)

    def read(self, size: int = -1) -> bytes:
        place = self._file.tell()
        data = self._file.read(size)
        if place >= len(self._start):
            return data
        return self._start[place : place + len(data)] + data[len(self._start) - place :]
