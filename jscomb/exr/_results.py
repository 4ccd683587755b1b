"""Write a file again with another image in place of the noisy one."""

import json
import os
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
import OpenEXR
from jaxtyping import ArrayLike

from jscomb.exr import native
from jscomb.exr._contents import Contents
from jscomb.exr._files import Part, read_headers, read_pixels, write_parts
from jscomb.exr._layers import Layer
from jscomb.frame import Frame, make_frame

Layers = Literal["all", "color"]
Pixels = Literal["same", "half", "float"]
ERROR = "error.Y"
_LOSSY = {  # which pixel types a codec changes
    "B44": {np.float16},
    "B44A": {np.float16},
    "DWAA": {np.float16, np.float32},
    "DWAB": {np.float16, np.float32},
    "PXR24": {np.float32},
}
_HALF_MAX = float(np.finfo(np.float16).max)
_OF_THE_FILE = ("channels", "name", "chunkCount", "version")  # written by the binding


def write_contents(
    path: str | os.PathLike,
    contents: Contents,
    image: ArrayLike,
    *,
    error: ArrayLike | None = None,
    layers: Layers = "all",
    pixels: Pixels = "same",
    provenance: dict[str, Any] | None = None,
) -> list[str]:
    """Write a file like the one that was read, with an image in place of its colour.

    Channels, parts, data and display windows, compression, pixel types and attributes
    are those that were read, bit by bit. Of a frame in jscomb's own format the features
    are written beside the image.

    Args:
        path: EXR file; replaced atomically if it exists. A link stays a link.
        contents: read with `everything`, unless only the colour is written.
        image: linear radiance, [H,W,3], of the data window.
        error: its estimated relative squared error, [H,W,1]: the layer error.Y.
        layers: all, or color: R, G, B and alpha alone.
        pixels: of the colour: the type that it had, half (16 bits), or float (32).
        provenance: where the image came from; anything that JSON can store.

    Returns:
        what could not be written, in lines for the user.

    Raises:
        OSError: if the file cannot be written; `path` is unchanged.
        ValueError: if the image has not the size of the colour.

    Example:
        >>> import tempfile
        >>> from jscomb import exr
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     exr.write_image(f"{folder}/a.exr", np.ones((2, 2, 3)))
        ...     contents = exr.read_contents(f"{folder}/a.exr", everything=True)
        ...     print(exr.write_contents(f"{folder}/b.exr", contents, contents.image))
        []
    """
    array = np.asarray(image, np.float32)
    if array.shape != (*contents.size, 3):
        raise ValueError(f"image is {array.shape}, the frame {(*contents.size, 3)}")
    if contents.color is None:
        parts, lost = _own(contents, array, error, layers, provenance), []
        if layers == "all" and contents.frame is not None:
            lost = _left_out(contents.frame)
    else:
        parts, lost = _like(contents, contents.color, array, error, layers, pixels)
        parts[0].attributes.update(_about(contents.color, parts, provenance or {}))
    names = write_parts(os.fspath(path), parts)
    return lost + ([f"not written: attribute {', '.join(names)}"] if names else [])


def read_result(path: str | os.PathLike) -> dict[str, Any]:
    """Return the provenance of an image that is complete and as it was written.

    Args:
        path: EXR file, written by `write_contents`, `write_image` or `write_frame`.

    Returns:
        its provenance; empty if another program wrote it, or changed it since, or if
        it cannot be read.

    Example:
        >>> from jscomb import exr
        >>> print(read_result(exr.bundled()["cornell-glass-64"])["spp"])
        64
    """
    try:
        headers = read_headers(os.fspath(path))
        about = native.result_of(headers.parts)
        if about is None:
            native.from_parts(read_pixels(headers), None, False)
        else:
            wanted = {about["part"]: about["channels"]}
            part = read_pixels(headers, wanted)[about["part"]]
            if about["crc32"] not in (None, native.checksum(part.channels)):
                return {}
        return native.provenance(headers.parts)
    except (OSError, ValueError, KeyError, IndexError):
        return {}


def _own(
    contents: Contents,
    image: np.ndarray,
    error: ArrayLike | None,
    layers: Layers,
    provenance: dict[str, Any] | None,
) -> list[Part]:
    """The parts of a frame of our own format: the image and the features."""
    frame = contents.frame
    assert frame is not None
    whole = layers == "all"
    features = {n: getattr(frame, n) for n in native.SUFFIXES} if whole else {}
    extra = {} if error is None or not whole else {"error": np.asarray(error)}
    made = make_frame(image, **features)
    return native.to_parts(made, provenance or {}, layers=extra)


def _left_out(frame: Frame) -> list[str]:
    """A line on what a combined image of our own format does not have."""
    some = {
        f"{frame.sub_buffers} sub-buffers": frame.sub_buffers > 1,
        "variance": frame.buffers.variance is not None,
        f"estimates {', '.join(frame.estimates)}": bool(frame.estimates),
        "reference": frame.reference is not None,
    }
    names = [name for name, has in some.items() if has]
    return [f"not written, but in the frame: {'; '.join(names)}"] if names else []


def _like(
    contents: Contents,
    color: Layer,
    image: np.ndarray,
    error: ArrayLike | None,
    layers: Layers,
    pixels: Pixels,
) -> tuple[list[Part], list[str]]:
    """The parts of another program's file, with the image in place of its colour."""
    source, lost = contents.parts[color.part], []
    names = color.color or []
    planes = image if len(names) == 3 else image.mean(axis=-1, keepdims=True)
    new, line = _typed(names, planes, source, pixels)
    lost += line
    if layers == "color":
        plain = dict(zip("RGB" if len(names) == 3 else "Y", new.values(), strict=True))
        if contents.alpha is not None:
            own = color.channels.get("A")
            plain["A"] = source.channels[own] if own else contents.alpha
        kept = {k: v for k, v in _attributes(source, lost).items() if not _of_layers(k)}
        return [Part("", plain, kept)], lost
    if codec := _lossy(source):
        lost.append(f"compressed with loss, as {contents.file} is: {codec}")
    parts = []
    for number, part in enumerate(contents.parts):
        reason = contents.unusable.get(number, "")
        if "subsampled" in reason:
            lost.append(f"not written: part {part.name or number}: {reason}")
            continue
        channels = dict(part.channels)
        if number == color.part:
            channels |= new
            if error is not None:
                taken = ERROR in channels and contents.dialect != "result"
                name = f"jscomb.{ERROR}" if taken else ERROR
                channels[name] = np.asarray(error, np.float32)[..., 0]
        parts.append(Part(part.name, channels, _attributes(part, lost)))
    return parts, list(dict.fromkeys(lost))


def _typed(
    names: Sequence[str], planes: np.ndarray, source: Part, pixels: Pixels
) -> tuple[dict[str, np.ndarray], list[str]]:
    """The planes of the colour by channel, in their pixel types."""
    types = {name: source.channels[name].dtype for name in names}
    if pixels != "same" or np.dtype(np.uint32) in types.values():
        wanted = np.float16 if pixels == "half" else np.float32
        types = dict.fromkeys(names, np.dtype(wanted))
    bright = np.abs(planes[np.isfinite(planes)]).max(initial=0) > _HALF_MAX
    line = []
    if bright and np.dtype(np.float16) in types.values():
        types = dict.fromkeys(names, np.dtype(np.float32))
        line = ["written in 32 bits: the colour does not fit into 16"]
    return {n: planes[..., c].astype(types[n]) for c, n in enumerate(names)}, line


def _lossy(part: Part) -> str:
    """The name of a compression that changes pixels; empty if it does not."""
    name = part.attributes.get("compression", OpenEXR.NO_COMPRESSION).name
    name = name.removesuffix("_COMPRESSION")
    kinds = {plane.dtype.type for plane in part.channels.values()}
    return name if kinds & _LOSSY.get(name, set()) else ""


def _of_layers(attribute: str) -> bool:
    """Whether an attribute is of channels that are not there."""
    return attribute in ("multiView", "view") or attribute.startswith("cryptomatte/")


def _attributes(part: Part, lost: list[str]) -> dict[str, Any]:
    """The attributes of a part, to be written again."""
    kept = {k: v for k, v in part.attributes.items() if k not in _OF_THE_FILE}
    tiles = kept.get("tiles")
    if tiles is not None and tiles.mode != OpenEXR.ONE_LEVEL:
        lost.append("not written: the smaller levels of a mip-mapped image")
        single = OpenEXR.TileDescription()
        single.xSize, single.ySize = tiles.xSize, tiles.ySize
        kept["tiles"] = single
    return kept


def _about(
    color: Layer, parts: list[Part], provenance: dict[str, Any]
) -> dict[str, str]:
    """The attributes that say what was combined, and how."""
    own, alone = color.color or [], color.part_name == "" or len(parts) == 1
    number = next(
        n for n, part in enumerate(parts) if alone or part.name == color.part_name
    )
    written = parts[number].channels
    whole = all(name in written for name in own)
    names = own if whole else [name for name in ("R", "G", "B", "Y") if name in written]
    view = f"{color.view}." if color.view else ""
    about = {
        "layer": (view + color.name).strip(".") or "rgb" if whole else "rgb",
        "part": number,
        "channels": names,
        "crc32": native.checksum({name: written[name] for name in names}),
    }
    if _lossy(parts[number]):
        about["crc32"] = None  # of pixels that will be others
    return {
        native.RESULT: json.dumps(about),
        native.PROVENANCE: json.dumps(provenance, default=str),
    }
