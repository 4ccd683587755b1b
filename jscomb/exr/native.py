"""jscomb's own format: one multi-part EXR file that stores a whole frame.

    part            channels
    a, b, c, ...    one sub-buffer: R G B, variance.R ..., albedo.R ..., normal.X ...,
                    depth.Z, visibility.Y; shared features only in part a
    NAME            an estimate: R G B
    NAME.a NAME.b   the same estimate made from each half
    reference       R G B, half_difference.R ...

A combined image has its estimated error beside it, as error.Y of part a.

Two attributes of the first part are JSON, because EXR's numeric attributes would mangle
large integers and lists. `jscomb` stores the format version, the sample count, a CRC-32
of each part and one of the two attributes; `provenance` stores where the file came
from. EXR's ZIP has a checksum too, but chunks that do not shrink, such as noise, are
stored without it. Version 1 had no checksum of attributes and channel names.
"""

import json
import string
import zlib
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike

from jscomb.exr._files import Part, channel_names, stack
from jscomb.frame import Buffers, Estimate, Frame, Reference, make_frame

ATTRIBUTE = "jscomb"
PROVENANCE = "provenance"
RESULT = "jscombResult"  # of a file with the layers of another program's
VERSION = 2
LETTERS = string.ascii_lowercase
SUFFIXES = {"albedo": "RGB", "normal": "XYZ", "depth": "Z", "visibility": "Y"}
LAYERS = {"variance", *SUFFIXES, "half_difference"}
LOSSY = {*Buffers._fields, "estimates", "estimate_halves", "half_difference"}
HALF_MAX = float(np.finfo(np.float16).max)
Channels = dict[str, np.ndarray]  # pixels [H,W] by channel name


def to_parts(
    frame: Frame,
    provenance: dict[str, Any],
    half: tuple[str, ...] = (),
    layers: Mapping[str, ArrayLike] = MappingProxyType({}),
) -> list[Part]:
    """Return the parts of a frame's file; `half` as for `exr.write_frame`.

    Layers [H,W,1] are channels NAME.Y of the first part.
    """
    _check(frame, half)
    letters = [*LETTERS[: frame.sub_buffers]]
    parts = {
        letter: _sub_buffer(frame.buffers, number, half)
        for number, letter in enumerate(letters)
    }
    for name, image in layers.items():
        parts["a"][f"{name}.Y"] = np.asarray(image, np.float32)[..., 0]
    for name, estimate in frame.estimates.items():
        _check_name(name, letters)
        parts[name] = _channels("estimates", estimate.image, half)
        halves = () if estimate.halves is None else estimate.halves
        for letter, image in zip("ab", halves, strict=False):
            parts[f"{name}.{letter}"] = _channels("estimate_halves", image, half)
    if frame.reference is not None:
        image, difference = frame.reference
        parts["reference"] = _channels("reference", image, half)
        if difference is not None:
            parts["reference"] |= _channels("half_difference", difference, half)
    attributes = _attributes(frame, parts, provenance)
    return [
        Part(name, channels, attributes if name == "a" else {})
        for name, channels in parts.items()
    ]


def _check(frame: Frame, half: tuple[str, ...]) -> None:
    """Raise unless the format can store the frame."""
    if frame.sub_buffers > len(LETTERS):
        raise ValueError(
            f"a file stores at most {len(LETTERS)} sub-buffers, got {frame.sub_buffers}"
        )
    if frame.buffers.color.shape[-1] != 3:
        raise ValueError(f"color must be RGB, got {frame.buffers.color.shape}")
    if unknown := set(half) - LOSSY:
        raise ValueError(
            f"half has unknown names {sorted(unknown)}, expected among {sorted(LOSSY)}"
        )


def _check_name(name: str, letters: list[str]) -> None:
    """Raise if an estimate has the name of another part."""
    if not name or name in letters or name == "reference" or "." in name:
        raise ValueError(
            f"an estimate cannot be called {name!r} in a file: sub-buffers are called "
            f"{', '.join(letters)}, the reference `reference`, and halves have a dot"
        )


def _sub_buffer(buffers: Buffers, number: int, half: tuple[str, ...]) -> Channels:
    """Return the channels of a sub-buffer; shared features are in the first alone."""
    channels: Channels = {}
    for name, buffer in buffers._asdict().items():
        if buffer is not None and number < len(buffer):
            channels |= _channels(name, buffer[number], half)
    return channels


def _channels(name: str, image: ArrayLike, half: tuple[str, ...]) -> Channels:
    """Return the channels of an image, in 16 bits if `half` lists its name."""
    array, dtype = np.asarray(image), np.float32
    if name in half:
        dtype = np.float16
        if np.abs(array[np.isfinite(array)]).max(initial=0) > HALF_MAX:
            raise ValueError(f"values of {name} do not fit into 16 bits")
    layer = name if name in LAYERS else ""
    names = channel_names(layer, SUFFIXES.get(name, "RGB"))
    return {n: array[..., c].astype(dtype) for c, n in enumerate(names)}


def _attributes(
    frame: Frame, parts: dict[str, Channels], provenance: dict[str, Any]
) -> dict[str, str]:
    """Return both attributes of a file, with checksums."""
    about = {
        "version": VERSION,
        "samples": None if frame.samples is None else float(frame.samples),
        "sub_buffers": frame.sub_buffers,
        "crc32": {name: checksum(channels) for name, channels in parts.items()},
    }
    origin = json.dumps(provenance, default=str)
    about |= {"header crc32": _header_checksum(about, origin)}
    return {ATTRIBUTE: json.dumps(about), PROVENANCE: origin}


def from_parts(parts: list[Part], samples: int | None, statistics: bool) -> Frame:
    """Return the frame in a file of this format; `samples` overrides the file's."""
    about = _about(parts)
    letters = LETTERS[: about["sub_buffers"]]
    by_name = _checked(parts, about)

    def rgb(name: str) -> Array:
        image = stack(by_name[name], "", "RGB")
        if image is None:
            raise ValueError(f"part {name} lacks channels R, G, B")
        return jnp.asarray(image)

    def estimate(name: str) -> Estimate:
        halves = [half for half in (f"{name}.a", f"{name}.b") if half in by_name]
        if len(halves) < 2:
            return Estimate(rgb(name))
        return Estimate(rgb(name), jnp.stack([rgb(half) for half in halves]))

    reference = None
    if "reference" in by_name:
        difference = stack(by_name["reference"], "half_difference", "RGB")
        if difference is not None:
            difference = jnp.asarray(difference)
        reference = Reference(rgb("reference"), difference)
    names = [n for n in by_name if "." not in n and n not in (*letters, "reference")]
    layers = ("variance", *SUFFIXES) if statistics else tuple(SUFFIXES)
    sub_buffers = [by_name[letter] for letter in letters]
    return make_frame(
        jnp.stack([rgb(letter) for letter in letters]),
        samples=about.get("samples") if samples is None else samples,
        estimates={name: estimate(name) for name in names},
        reference=reference,
        **{layer: _buffer(sub_buffers, layer) for layer in layers},
    )


def _buffer(parts: list[Part], layer: str) -> Any:
    """Return one buffer of all sub-buffers, [K,H,W,C], or None."""
    images = [stack(part, layer, SUFFIXES.get(layer, "RGB")) for part in parts]
    present = [image for image in images if image is not None]
    return np.stack(present) if present else None


def _checked(parts: list[Part], about: dict[str, Any]) -> dict[str, Part]:
    """Return the parts by name; raise if one is missing or corrupt."""
    checksums, by_name = about["crc32"], {part.name: part for part in parts}
    if by_name.keys() != checksums.keys():
        expected, found = ", ".join(checksums), ", ".join(by_name)
        raise ValueError(f"expected the parts {expected}, found {found}")
    for name, part in by_name.items():
        found = checksum(part.channels, names=about["version"] > 1)
        if found != checksums[name]:
            raise ValueError(f"part {name} is corrupt: its checksum does not match")
    return by_name


def provenance(parts: list[Part]) -> dict[str, Any]:
    """Return the provenance of a file of any program, empty if there is none."""
    text = _first(parts).attributes.get(PROVENANCE, "{}")
    try:
        found = json.loads(text)
    except (TypeError, ValueError):
        found = text  # written by another program
    return found if isinstance(found, dict) else {PROVENANCE: str(found)}


def result_of(parts: list[Part]) -> dict[str, Any] | None:
    """Return which layer of another program's file was combined; None if none was."""
    for part in parts:
        try:
            found = json.loads(part.attributes[RESULT])
            return {
                "layer": str(found["layer"]),
                "part": int(found["part"]),
                "channels": [str(name) for name in found["channels"]],
                "crc32": found["crc32"],
            }
        except (KeyError, TypeError, ValueError):
            continue
    return None


def is_native(parts: list[Part]) -> bool:
    """Return whether jscomb wrote a file, even if its own attribute is corrupt."""
    name, _, attributes = _first(parts)
    return ATTRIBUTE in attributes or (name == LETTERS[0] and PROVENANCE in attributes)


def _first(parts: list[Part]) -> Part:
    """Return the part with the attributes; other programs may have moved it."""
    return next((part for part in parts if ATTRIBUTE in part.attributes), parts[0])


def _about(parts: list[Part]) -> dict[str, Any]:
    """Return the contents of the attribute; raise if it is malformed or corrupt."""
    attributes = _first(parts).attributes
    try:
        about = json.loads(attributes[ATTRIBUTE])
        version, expected = about["version"], about.pop("header crc32", None)
        about = about | {"crc32": dict(about["crc32"])}
        _ = about["sub_buffers"]
    except (TypeError, ValueError, KeyError, AttributeError):
        raise ValueError(f"attribute {ATTRIBUTE} is malformed") from None
    if version not in (1, VERSION):
        raise ValueError(f"unknown format version {version}, known up to {VERSION}")
    if version > 1 and expected != _header_checksum(about, attributes.get(PROVENANCE)):
        raise ValueError(f"attribute {ATTRIBUTE} or {PROVENANCE} is corrupt")
    return about


def _header_checksum(about: dict[str, Any], provenance: Any) -> int:
    """Return the CRC-32 of both attributes."""
    return zlib.crc32(json.dumps([about, provenance]).encode())


def checksum(channels: Channels, *, names: bool = True) -> int:
    """Return the CRC-32 of the sorted channel names and the channels' pixels."""
    total = zlib.crc32(" ".join(sorted(channels)).encode()) if names else 0
    for name in sorted(channels):
        total = zlib.crc32(channels[name].tobytes(), total)
    return total
