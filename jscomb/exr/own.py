"""jscomb's own file: one multi-part EXR that holds a whole frame.

    part            channels
    a, b, c, ...    one sub-buffer: R G B, variance.R ..., albedo.R ..., normal.X ...,
                    depth.Z, visibility.Y; shared features only in part a
    NAME            a biased image: R G B
    NAME.a NAME.b   the same denoiser on each half
    reference       R G B, half_difference.R ...

Two attributes of the first part are JSON (EXR's own numeric ones would mangle large
integers and lists): `jscomb`, format version, sample count, a checksum of each part
(ZIP has one too, but EXR stores chunks that do not shrink, such as noise, without it)
and one of the two attributes; `provenance`, where the file came from. Version 1 had no
checksum of attributes and channel names.
"""

import json
import string
import zlib
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from jscomb.exr.files import Part, stack
from jscomb.frame import Estimate, Frame, Reference, make_frame

ATTRIBUTE = "jscomb"
PROVENANCE = "provenance"
VERSION = 2
LETTERS = string.ascii_lowercase
SUFFIXES = {"albedo": "RGB", "normal": "XYZ", "depth": "Z", "visibility": "Y"}
HALF_MAX = float(np.finfo(np.float16).max)


def to_parts(
    frame: Frame, provenance: dict[str, Any], half: tuple[str, ...]
) -> list[Part]:
    """The parts of a frame's file.

    Args:
        frame: to write.
        provenance: anything that JSON can hold.
        half: buffers to store in 16 bits, see `exr.write_frame`.

    Returns:
        the parts.

    Raises:
        ValueError: if a name is reserved, colour is not RGB, there are too many
            sub-buffers, or a value does not fit into 16 bits.
    """
    k = frame.sub_buffers
    if k > len(LETTERS):
        raise ValueError(f"a file holds at most {len(LETTERS)} sub-buffers, got {k}")
    if frame.buffers.color.shape[-1] != 3:
        raise ValueError(f"color must be RGB, got {frame.buffers.color.shape}")
    known = {*frame.buffers._fields, "biased", "biased_halves", "half_difference"}
    if unknown := set(half) - known:
        raise ValueError(
            f"half names {sorted(unknown)}, expected among {sorted(known)}"
        )

    def pixels(name: str, image: Any, layer: str, suffixes: str) -> dict:
        array = np.asarray(image)
        dtype = np.float32
        if name in half:
            dtype = np.float16
            if np.abs(array[np.isfinite(array)]).max(initial=0) > HALF_MAX:
                raise ValueError(f"{name} has values that do not fit into 16 bits")
        names = [f"{layer}.{s}" if layer else s for s in suffixes]
        return {n: array[..., c].astype(dtype) for c, n in enumerate(names)}

    def sub_buffer(number: int) -> dict[str, np.ndarray]:
        channels = {}
        for name, buffer in frame.buffers._asdict().items():
            if buffer is not None and number < len(buffer):
                layer = "" if name == "color" else name
                suffixes = SUFFIXES.get(name, "RGB")
                channels |= pixels(name, buffer[number], layer, suffixes)
        return channels

    parts = {LETTERS[number]: sub_buffer(number) for number in range(k)}
    for name, image in frame.estimates.items():
        if name in parts or name == "reference" or "." in name or not name:
            raise ValueError(
                f"a biased image cannot be called {name!r} in a file: sub-buffers are "
                f"called {', '.join(LETTERS[:k])}, the reference `reference`, halves "
                "have a dot"
            )
        parts[name] = pixels("biased", image.image, "", "RGB")
        for number, part in enumerate([] if image.halves is None else image.halves):
            parts[f"{name}.{LETTERS[number]}"] = pixels(
                "biased_halves", part, "", "RGB"
            )
    if frame.reference is not None:
        image, difference = frame.reference
        parts["reference"] = pixels("reference", image, "", "RGB")
        if difference is not None:
            name = "half_difference"
            parts["reference"] |= pixels(name, difference, name, "RGB")
    samples = None if frame.samples is None else float(frame.samples)
    checksums = {name: _checksum(channels) for name, channels in parts.items()}
    about = {
        "version": VERSION,
        "samples": samples,
        "sub_buffers": k,
        "crc32": checksums,
    }
    origin = json.dumps(provenance, default=str)
    seal = {"header crc32": _seal(about, origin)}
    attributes = {ATTRIBUTE: json.dumps(about | seal), PROVENANCE: origin}
    return [
        Part(name, channels, attributes if name == "a" else {})
        for name, channels in parts.items()
    ]


def from_parts(parts: list[Part], samples: int | None, statistics: bool) -> Frame:
    """The frame in a file that `to_parts` laid out.

    Args:
        parts: of the file.
        samples: overrides the file's sample count.
        statistics: read the variance.

    Returns:
        the frame.

    Raises:
        ValueError: if the format is newer than this code, a checksum does not fit, or
            a part or channel is missing.
    """
    about = _about(parts)
    checksums, letters = about["crc32"], LETTERS[: about["sub_buffers"]]
    by_name = {part.name: part for part in parts}
    if by_name.keys() != checksums.keys():
        wanted, got = ", ".join(checksums), ", ".join(by_name)
        raise ValueError(f"it must have the parts {wanted}, but has {got}")
    for name, part in by_name.items():
        found = _checksum(part.channels, names=about["version"] > 1)
        if found != checksums[name]:
            raise ValueError(f"part {name} is corrupt: its checksum does not fit")

    def rgb(name: str) -> Array:
        image = stack(by_name[name], "", "RGB")
        if image is None:
            raise ValueError(f"part {name} lacks channels R, G, B")
        return jnp.asarray(image)

    buffers: dict[str, Any] = {}
    for name in ("variance", *SUFFIXES) if statistics else tuple(SUFFIXES):
        suffixes = SUFFIXES.get(name, "RGB")
        images = [stack(by_name[letter], name, suffixes) for letter in letters]
        present = [image for image in images if image is not None]
        if present:
            buffers[name] = np.stack(present)
    names = [n for n in by_name if "." not in n and n not in (*letters, "reference")]
    biased = {
        name: Estimate(
            rgb(name),
            jnp.stack([rgb(f"{name}.a"), rgb(f"{name}.b")])
            if {f"{name}.a", f"{name}.b"} <= by_name.keys()
            else None,
        )
        for name in names
    }
    reference = None
    if "reference" in by_name:
        difference = stack(by_name["reference"], "half_difference", "RGB")
        if difference is not None:
            difference = jnp.asarray(difference)
        reference = Reference(rgb("reference"), difference)
    return make_frame(
        jnp.stack([rgb(letter) for letter in letters]),
        samples=about.get("samples") if samples is None else samples,
        estimates=biased,
        reference=reference,
        **buffers,
    )


def provenance(parts: list[Part]) -> dict[str, Any]:
    """What a file says of its origin, in any program's words.

    Args:
        parts: of any file; headers suffice.

    Returns:
        the provenance, empty if there is none.
    """
    text = _first(parts).attributes.get(PROVENANCE, "{}")
    try:
        found = json.loads(text)
    except (TypeError, ValueError):
        found = text  # another program's
    return found if isinstance(found, dict) else {PROVENANCE: str(found)}


def is_own(parts: list[Part]) -> bool:
    """Whether jscomb wrote a file.

    Args:
        parts: of any file; headers suffice.

    Returns:
        True if it carries the attribute, or all else that tells.
    """
    name, _, attributes = _first(parts)
    return ATTRIBUTE in attributes or (name == LETTERS[0] and PROVENANCE in attributes)


def _first(parts: list[Part]) -> Part:
    """The part with the attributes, wherever other programs have put it."""
    return next((part for part in parts if ATTRIBUTE in part.attributes), parts[0])


def _about(parts: list[Part]) -> dict[str, Any]:
    """What the attribute holds, if it is as it was written."""
    attributes = _first(parts).attributes
    try:
        about = json.loads(attributes[ATTRIBUTE])
        version, seal = about["version"], about.pop("header crc32", None)
        about = about | {"crc32": dict(about["crc32"])}
        _ = about["sub_buffers"]
    except (TypeError, ValueError, KeyError, AttributeError):
        raise ValueError(f"attribute {ATTRIBUTE} is malformed") from None
    if version not in (1, VERSION):
        raise ValueError(f"format version {version} is not known, only up to {VERSION}")
    if version > 1 and seal != _seal(about, attributes.get(PROVENANCE)):
        raise ValueError(f"attribute {ATTRIBUTE} or {PROVENANCE} is corrupt")
    return about


def _seal(about: dict[str, Any], provenance: Any) -> int:
    """CRC-32 of both attributes."""
    return zlib.crc32(json.dumps([about, provenance]).encode())


def _checksum(channels: dict[str, np.ndarray], *, names: bool = True) -> int:
    """CRC-32 over the pixels of all channels, by name, and over the names."""
    total = zlib.crc32(" ".join(sorted(channels)).encode()) if names else 0
    for name in sorted(channels):
        total = zlib.crc32(channels[name].tobytes(), total)
    return total
