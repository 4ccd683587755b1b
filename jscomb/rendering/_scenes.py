"""Scenes to render: four of our own, random ones, and any Mitsuba 3 XML file.

The own scenes grow from `mitsuba.cornell_box()`:

    cornell-box     plain: large smooth walls, one light
    cornell-glass   glass sphere, rough metal, a small light, a fine checker texture
    cornell-caustic the same with a tiny light, whose caustics path tracing hardly finds
    cornell-glossy  glossy floor, textured walls, environment light, no ceiling

`random-7` is the scene that `_random_scenes` draws from the seed 7.

Every scene is loaded with what unbiased statistics need, whatever its author chose:
a float32 film in linear RGB, a box reconstruction filter (so that pixels are
independent), the independent sampler or a given one, and the path integrator.
"""

import ctypes
import os
import pathlib
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from typing import Any

import numpy as np

from jscomb.frame import Needs, Package
from jscomb.rendering._random_scenes import random_scene

NEEDS = Needs(package=Package("mitsuba", "render"))
MAX_DEPTH = 12
LLVM_VERSIONS = range(25, 16, -1)  # 14 to 16 abort the process inside Dr.Jit


def available() -> bool:
    """Return whether Mitsuba is installed.

    Returns:
        True if scenes can be rendered.

    Example:
        >>> variant = mitsuba().variant() if available() else None
    """
    return not NEEDS.missing_package()


def mitsuba() -> Any:
    """Import Mitsuba 3 with the fastest variant that this machine can run.

    Returns:
        the module, its variant set: `llvm_ad_rgb` where LLVM 17 or newer is found
        (or named by `DRJIT_LIBLLVM_PATH`), else `scalar_rgb`. A variant that the
        caller has already set is kept.

    Raises:
        ImportError: if Mitsuba is not installed; says how to install it.

    Example:
        >>> if available():
        ...     assert mitsuba().variant().endswith("rgb")
    """
    if missing := NEEDS.missing_package():
        raise ImportError(f"rendering needs {missing}")
    llvm = os.environ.get("DRJIT_LIBLLVM_PATH") or _find_llvm()
    if llvm:
        os.environ["DRJIT_LIBLLVM_PATH"] = llvm
    import mitsuba as mi

    if mi.variant() is None:
        mi.set_variant("llvm_ad_rgb" if llvm else "scalar_rgb")
    return mi


def _find_llvm() -> str | None:
    """The newest LLVM library that Dr.Jit can use, None if there is none."""
    for version in LLVM_VERSIONS:
        for name in (f"libLLVM-{version}.so", f"libLLVM.so.{version}.1"):
            try:
                ctypes.CDLL(name)
            except OSError:
                continue
            return name
    return None


def load_scene(
    name: str, *, width: int = 0, height: int = 0, sampler: str = "independent"
) -> Any:
    """Load one of the own scenes by name, or a Mitsuba XML file by path.

    Args:
        name: one of `SCENES`, random-SEED, or the path of an XML file.
        width: of the film in pixels; 0 keeps the file's own (own scenes: 256).
        height: of the film in pixels; 0 as for the width.
        sampler: name of a Mitsuba sampler.

    Returns:
        the `mitsuba.Scene`.

    Raises:
        ImportError: if Mitsuba is not installed; says how to install it.
        ValueError: if it is neither a known name nor a file; names the choices.

    Example:
        >>> if available():
        ...     film = load_scene("cornell-box", width=8, height=6).sensors()[0].film()
        ...     assert list(film.size()) == [8, 6]
    """
    mi = mitsuba()
    seed = name.removeprefix("random-")
    if name in _OWN or (seed != name and seed.isdecimal()):
        own = _OWN.get(name)
        scene = own(mi) if own else random_scene(mi, int(seed))
        scene["sensor"] |= {
            "film": _film(width or 256, height or 256),
            "sampler": {"type": sampler},
        }
        scene["integrator"] = {"type": "path", "max_depth": MAX_DEPTH}
        return mi.load_dict(scene)
    path = pathlib.Path(name)
    if not path.is_file():
        known = ", ".join([*SCENES, "random-SEED"])
        raise ValueError(f"{name!r} is neither a file nor one of the scenes {known}")
    folders = mi.file_resolver()
    # First, and not for longer: scenes call different meshes by the same names.
    folders.prepend(str(path.parent.resolve()))
    try:
        return mi.load_string(_standard_xml(path, width, height, sampler))
    finally:
        del folders[0]


def _film(width: int, height: int) -> dict:
    """A film without hidden steps: linear RGB, float32, box filter."""
    return {
        "type": "hdrfilm",
        "width": width,
        "height": height,
        "rfilter": {"type": "box"},
        "pixel_format": "rgb",
        "component_format": "float32",
    }


def _standard_xml(path: pathlib.Path, width: int, height: int, sampler: str) -> str:
    """The scene file's text with its film, sampler and integrator made standard."""
    try:
        tree = ElementTree.parse(path).getroot()
    except ElementTree.ParseError as error:
        raise ValueError(f"{path}: not XML: {error}") from None
    defaults = {d.get("name"): d.get("value") for d in tree.findall("default")}
    sensor = tree.find("sensor")
    if sensor is None:
        raise ValueError(f"{path}: the scene has no sensor")

    def size(name: str, chosen: int) -> int:
        own = sensor.find(f"film/integer[@name='{name}']")
        value = "256" if own is None else own.get("value", "")
        value = defaults.get(value.removeprefix("$")) or value
        if not chosen and not value.isdecimal():
            raise ValueError(f"{path}: the film's {name} is {value!r}, not a number")
        return chosen or int(value)

    film = _film(size("width", width), size("height", height))
    for old in [*sensor.findall("film"), *sensor.findall("sampler")]:
        sensor.remove(old)
    ElementTree.SubElement(sensor, "sampler", type=sampler)
    node = ElementTree.SubElement(sensor, "film", type=film["type"])
    ElementTree.SubElement(node, "rfilter", type=film["rfilter"]["type"])
    for name in ("pixel_format", "component_format"):
        ElementTree.SubElement(node, "string", name=name, value=film[name])
    for name in ("width", "height"):
        ElementTree.SubElement(node, "integer", name=name, value=str(film[name]))
    for old in tree.findall("integrator"):
        tree.remove(old)
    path_integrator = ElementTree.SubElement(tree, "integrator", type="path")
    ElementTree.SubElement(
        path_integrator, "integer", name="max_depth", value=str(MAX_DEPTH)
    )
    return ElementTree.tostring(tree, encoding="unicode")


def _cornell_glass(mi, light: float = 1.0) -> dict:
    """A glass sphere and a brushed metal box under a quarter of the usual light.

    Args:
        mi: Mitsuba.
        light: width of the light, relative; its power stays the same.
    """
    scene = mi.cornell_box()
    at = mi.ScalarTransform4f()
    for box in ("small-box", "large-box"):
        del scene[box]
    scene["light"]["to_world"] = (
        at.translate([0, 0.99, 0.01])
        .rotate([1, 0, 0], 90)
        .scale([0.115 * light, 0.095 * light, 1])
    )
    scene["light"]["emitter"]["radiance"]["value"] = [
        channel / light**2 for channel in (73.5, 55.9, 27.0)
    ]
    scene["floor"]["bsdf"] = {
        "type": "diffuse",
        "reflectance": {
            "type": "checkerboard",
            "color0": {"type": "rgb", "value": [0.75, 0.7, 0.6]},
            "color1": {"type": "rgb", "value": [0.12, 0.14, 0.2]},
            "to_uv": at.scale([16, 16, 1]),
        },
    }
    scene["glass"] = {
        "type": "sphere",
        "center": [0.38, -0.62, 0.35],
        "radius": 0.38,
        "bsdf": {"type": "dielectric", "int_ior": 1.5},
    }
    scene["metal"] = {
        "type": "cube",
        "to_world": at.translate([-0.4, -0.45, -0.25])
        .rotate([0, 1, 0], 20)
        .scale([0.28, 0.55, 0.28]),
        "bsdf": {"type": "roughconductor", "material": "Al", "alpha": 0.15},
    }
    return scene


def _cornell_glossy(mi) -> dict:
    """Plaster and brick-like walls, a lacquered floor, daylight through the roof."""
    scene = mi.cornell_box()
    at = mi.ScalarTransform4f()
    for part in ("light", "ceiling"):
        del scene[part]
    for number, wall in enumerate(("back", "green-wall", "red-wall")):
        scene[wall]["bsdf"] = {
            "type": "diffuse",
            "reflectance": {
                "type": "bitmap",
                "bitmap": mi.Bitmap(_plaster(number)),
                "raw": True,
            },
        }
    scene["floor"]["bsdf"] = {
        "type": "roughplastic",
        "alpha": 0.08,
        "diffuse_reflectance": {
            "type": "checkerboard",
            "color0": {"type": "rgb", "value": [0.45, 0.25, 0.12]},
            "color1": {"type": "rgb", "value": [0.3, 0.15, 0.07]},
            "to_uv": at.scale([6, 24, 1]),
        },
    }
    scene["large-box"]["bsdf"] = {"type": "roughconductor", "material": "Cu"}
    scene["sky"] = {"type": "envmap", "bitmap": mi.Bitmap(_sky()), "scale": 1.0}
    return scene


def _plaster(seed: int, size: int = 256) -> np.ndarray:
    """Reflectance with structure at every scale, one tint a seed, [size,size,3]."""
    rng = np.random.default_rng(seed)
    rough = np.zeros((size, size))
    for octave in range(2, 8):
        cells = 2**octave
        block = np.ones((size // cells, size // cells))
        rough += np.kron(rng.standard_normal((cells, cells)), block) / 2**octave
    rough /= np.abs(rough).max()
    tint = np.array([[0.7, 0.65, 0.6], [0.3, 0.5, 0.35], [0.6, 0.3, 0.25]])[seed]
    return (tint * (0.8 + 0.35 * rough[..., None])).clip(0.02, 0.95).astype(np.float32)


def _sky(height: int = 64) -> np.ndarray:
    """Latitude-longitude radiance of a clear sky with a broad sun, [h,2h,3]."""
    up = np.cos(np.linspace(0, np.pi, height))[:, None, None]
    zenith, horizon = np.array([0.4, 0.6, 1.1]), np.array([1.0, 0.9, 0.8])
    sky = np.where(up > 0, horizon + (zenith - horizon) * up.clip(0), 0.15)
    sky = np.broadcast_to(sky, (height, 2 * height, 3)).astype(np.float32).copy()
    sky[8:12, 40:46] = [120.0, 105.0, 80.0]
    return sky


_OWN: dict[str, Callable[..., dict]] = {
    "cornell-box": lambda mi: mi.cornell_box(),
    "cornell-glass": _cornell_glass,
    "cornell-caustic": lambda mi: _cornell_glass(mi, light=0.25),
    "cornell-glossy": _cornell_glossy,
}
SCENES = tuple(_OWN)
