"""Small files of the kinds of OpenEXR's public test images.

Each has the layout, windows, types and attributes of one of those images, or of a group
of them, with a few made-up pixels.
"""

import io
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import OpenEXR

from tests.exr_corpus import assembled
from tests.exr_corpus.hostile import image

SIZE = 8, 8
XYZ = (1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1 / 3, 1 / 3)
WIDE = (0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.077, 0.32168, 0.33767)
Planes = dict[str, np.ndarray]


class Public(NamedTuple):
    """One file.

    Attributes:
        name: of the image that it is like.
        data: its bytes, or parts (name, channels, attributes) to write.
        color: channels of its colour; or the error that is right.
        part: number of that part.
    """

    name: str
    data: bytes | list[tuple[str, Planes, dict[str, Any]]]
    color: list[str] | str
    part: int = 0


def planes(*names: str, dtype: type = np.float16) -> Planes:
    """Return noise for channels."""
    noise = {n: image(seed, *SIZE) for seed, n in enumerate(names)}
    return {name: plane.astype(dtype) for name, plane in noise.items()}


def layer(prefix: str, letters: str = "RGB") -> Planes:
    """Return noise for the channels of a layer."""
    return planes(*(f"{prefix}.{letter}" for letter in letters))


def box(left: int, top: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a window of the usual size."""
    return np.int32([left, top]), np.int32([left + SIZE[1] - 1, top + SIZE[0] - 1])


def corners(*window: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a window by its first and last pixel."""
    return np.int32(window[:2]), np.int32(window[2:])


def single(**attributes: Any) -> list[tuple[str, Planes, dict[str, Any]]]:
    """Return a single part with R, G, B."""
    return [("", planes(*"RGB"), attributes)]


RGB = list("RGB")


def images() -> Iterator[Public]:
    """Yield all of them."""
    yield from _windows()
    yield from _views()
    yield from _levels()
    yield Public("ScanLines/Blobbies", [("", planes(*"ABGRZ"), {})], RGB)
    for codec in ("NO", "RLE", "ZIPS", "ZIP", "PIZ", "PXR24", "B44", "B44A", "DWAA"):
        kind = getattr(OpenEXR, f"{codec}_COMPRESSION")
        yield Public(f"ScanLines, {codec}", single(compression=kind), RGB)
    for name, values in {"Rec709": None, "XYZ": XYZ, "WideColorGamut": WIDE}.items():
        stated = {} if values is None else {"chromaticities": values}
        yield Public(f"Chromaticities/{name}", single(**stated), RGB)
    yield Public("TestImages/GrayRamps", [("", planes("Y"), {})], ["Y"])
    grey = planes("G", dtype=np.float32)
    yield Public("TestImages/WideFloatRange", [("", grey, {})], "no colour channels")
    values = np.arange(64, dtype=np.uint16).view(np.float16).reshape(SIZE)
    values[0, :3] = np.nan, np.inf, -np.inf
    every = dict.fromkeys("RGB", values)
    yield Public("TestImages/AllHalfValues", [("", every, {})], RGB)
    yield Public("grey and alpha", [("", planes(*"YA"), {})], ["Y"])
    yield Public("depth alone", [("", planes("Z"), {})], "no colour channels")
    luminance = assembled.luminance_and_chroma()
    yield Public("LuminanceChroma", luminance, "is subsampled")
    depths = np.empty(SIZE, object)
    for place in np.ndindex(SIZE):
        depths[place] = np.ones(place[0] % 3, np.float32)
    deep = {
        "type": OpenEXR.deepscanline,
        "compression": OpenEXR.ZIPS_COMPRESSION,
    }
    samples = dict.fromkeys("ABGRZ", depths)
    yield Public("v2/Stereo, deep", [("", samples, deep)], "deep images are not")
    parts = [("deep", samples, deep), ("rgba", planes(*"RGBA"), {})]
    yield Public("v2/Stereo, composited", parts, RGB, 1)
    text = _written(single(owner="Mueller")).replace(b"Mueller", b"M\xfcller\xff")
    yield Public("text that is not UTF-8", text, RGB)


def _windows() -> Iterator[Public]:
    """Yield DisplayWindow/t01 to t16 and their like."""
    for number, (data, display) in enumerate(
        [
            (box(0, 0), corners(0, 0, 7, 7)),
            (box(5, 3), corners(0, 0, 19, 19)),
            (box(-3, -2), corners(0, 0, 4, 4)),
            (box(-100, -90), corners(-120, -95, 20, 3)),
            (box(30, 30), corners(0, 0, 9, 9)),
            (box(0, 0), corners(-5, -5, 30, 30)),
        ]
    ):
        attributes = {"dataWindow": data, "displayWindow": display}
        aspect = {"pixelAspectRatio": 1.5} if number == 1 else {}
        yield Public("DisplayWindow", single(**attributes, **aspect), RGB)


def _views() -> Iterator[Public]:
    """Yield Beachball and MultiView: views in channels, in parts, in part names."""
    channels = planes(*"RGBAZ") | layer("left", "RGBAZ") | layer("forward.left", "UV")
    views = {"multiView": ["right", "left"]}
    yield Public("Beachball/singlepart", [("", channels, views)], RGB)
    parts = [
        (f"{name}_{view}", planes(*letters), {"view": view})
        for name, letters in (("depth", "Z"), ("forward", "UV"), ("rgba", "RGBA"))
        for view in ("left", "right")
    ]
    yield Public("Beachball/multipart", parts, RGB, 4)
    parts = [(view, planes(*"RGBA"), {"view": view}) for view in ("left", "right")]
    yield Public("MultiView, one part a view", parts, RGB)


def _levels() -> Iterator[Public]:
    """Yield MultiResolution and Tiles."""
    grey = image(3, 8, 8)
    for mode, name in enumerate(("Tiles", "mip-maps", "rip-maps")):
        data = assembled.levels(grey, mode)
        yield Public(f"MultiResolution, {name}", data, ["Y"])
    yield Public("MultiResolution/Kerner", single(envmap=OpenEXR.ENVMAP_LATLONG), RGB)


def _written(parts: list[tuple[str, Planes, dict[str, Any]]]) -> bytes:
    """Return the bytes of a file."""
    usual = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION}
    stream = io.BytesIO()
    made = [OpenEXR.Part(usual | header, dict(c), name) for name, c, header in parts]
    OpenEXR.File(made).write(stream)
    return stream.getvalue()


def data_of(public: Public) -> bytes:
    """Return the bytes of a file."""
    return public.data if isinstance(public.data, bytes) else _written(public.data)
