"""Who wrote this EXR file, and what its channels mean.

One function a dialect maps a path to the arguments of `make_frame`. What each writes:

    jscomb     everything; see `own`
    mitsuba    R G B, or <nested>.R with A; <name>.R albedo, <name>.X normal,
               <name>.T depth; m2_<name>.* second moments of single samples
    pbrt       R G B, Albedo.R, Ns.X (shading) or N.X, Variance.R of one sample
    tungsten   a directory: color.exr, colorA.exr, colorB.exr, likewise albedo, normal,
               depth, visibility; colorVariance.exr of the mean; <m>/<m>.exr,
               <m>A.exr, <m>B.exr biased images (the layout of Ensemble Denoising)
    njs        default.R, subColorA.R, albedo.R, albedoA.R, ..., colorVariance.R of the
               mean (the file of the Neural James-Stein Combiner); half B = 2 full - A.
               Its denoised images are files of their own: read them with `read_image`
    rgb        R G B, or Y, and nothing else that is known
"""

import os
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np

from jscomb.exr import own
from jscomb.exr.files import Part, layers, read_parts, stack
from jscomb.frame import CHANNELS, Biased, Frame

Arguments = dict[str, Any]  # of make_frame


def recognise(path: str) -> str:
    """The dialect of a file or directory, from its contents.

    Args:
        path: an EXR file or a directory.

    Returns:
        a key of `DIALECTS`.

    Raises:
        ValueError: if the file cannot be read or has no colour that is known; names
            its channels.
    """
    if os.path.isdir(path):
        return "tungsten"
    parts = read_parts(path, header_only=True)
    if own.is_own(parts):
        return "jscomb"
    header = parts[0].attributes
    names = {channel.name for channel in header["channels"]}
    if any(name.startswith("default.") for name in names):
        return "njs"
    if str(header.get("generatedBy", "")).startswith("Mitsuba") or any(
        name.startswith("m2_") or name.endswith(".T") for name in names
    ):
        return "mitsuba"
    if {"Variance.R", "Ns.X", "Nsx", "P.X", "Albedo.R"} & names:
        return "pbrt"
    if {"R", "G", "B"} <= names or "Y" in names:
        return "rgb"
    listed = ", ".join(sorted(names)[:12]) + (", ..." if len(names) > 12 else "")
    raise ValueError(f"{path}: no colour channels R, G, B (or Y) among {listed}")


def _own(path: str, samples: int | None, statistics: bool) -> Frame:
    """Jscomb's own multi-part file."""
    return own.from_parts(read_parts(path), samples, statistics)


def _rgb(path: str, samples: int | None, statistics: bool) -> Arguments:
    """Colour alone."""
    return {"color": _color(_single(path)), "samples": samples}


def _mitsuba(path: str, samples: int | None, statistics: bool) -> Arguments:
    """Mitsuba 3: path, aov around path, and moment around aov.

    Second moments of a path right inside a moment integrator are in CIE XYZ, which have
    no variance in RGB; the file then has colour alone.
    """
    part = _single(path)
    names = layers(part)
    images = {n: s for n, s in names.items() if n and not n.startswith("m2_")}
    # Only nested integrators have alpha; an RGB layer without it is an albedo.
    radiance = [n for n, s in images.items() if s == "ABGR"]
    moments = [n for n in radiance if f"m2_{n}" in names]
    layer = (moments or radiance or [""])[0]
    found: Arguments = {"color": _color(part, layer), "samples": samples}
    if statistics and moments:
        if samples is None:
            raise ValueError(
                "it holds second moments of single samples but not their number: give "
                "the samples a pixel"
            )
        if samples < 2:
            raise ValueError(f"a variance needs at least two samples, got {samples}")
        second = _color(part, f"m2_{layer}")
        spread = np.maximum(second - np.square(found["color"]), 0)
        found["variance"] = spread / (samples - 1)
    albedo = sorted(
        (n for n, s in images.items() if s == "BGR"), key=lambda n: "alb" not in n
    )
    depth = [n for n, s in images.items() if s == "T"]
    normal = [n for n, s in images.items() if s == "XYZ" and _unit(part, n)]
    if albedo:
        found["albedo"] = np.clip(_color(part, albedo[0]), 0, 1)
    if normal:
        found["normal"] = stack(part, normal[0], "XYZ")
    if depth:
        found["depth"] = _finite_depth(_any_image(part, depth[0]))[..., :1]
    return found


def _pbrt(path: str, samples: int | None, statistics: bool) -> Arguments:
    """pbrt-v4's GBufferFilm, and its older names."""
    part = _single(path)
    if samples is None:
        samples = part.attributes.get("samplesPerPixel")
        if samples is not None and not isinstance(samples, int):
            raise ValueError(f"attribute samplesPerPixel is {samples!r}, not a number")
    found: Arguments = {"color": _color(part), "samples": samples}
    albedo = stack(part, "Albedo", "RGB")
    if albedo is not None:
        found["albedo"] = np.clip(albedo, 0, 1)
    for layer in ("Ns", "N"):
        old = [part.channels.get(layer + axis) for axis in "xyz"]
        normal = stack(part, layer, "XYZ")
        if normal is None and all(o is not None for o in old):
            normal = np.stack(old, axis=-1).astype(np.float32)  # type: ignore[arg-type]
        if normal is not None:
            found["normal"] = normal
            break
    variance = stack(part, "Variance", "RGB")
    if statistics and variance is not None:
        if samples is None:
            raise ValueError(
                "its variance is of one sample and the attribute samplesPerPixel is "
                "missing: give the samples a pixel"
            )
        # The film writes 0 where no surface was hit: missing, not exact.
        hit = np.any([f != 0 for f in (variance, *_features(found))], axis=(0, -1))
        found["variance"] = np.where(hit[..., None], variance / samples, np.nan)
    return found


def _tungsten(path: str, samples: int | None, statistics: bool) -> Arguments:
    """A directory of images by name, with A and B beside them for the halves."""

    def image(*names: str) -> np.ndarray | None:
        file = os.path.join(path, *names) + ".exr"
        return _any_image(_single(file)) if os.path.isfile(file) else None

    def halves(*names: str) -> np.ndarray | None:
        *folder, name = names
        a, b = (image(*folder, name + half) for half in "AB")
        if a is None or b is None:
            return None
        if a.shape != b.shape:
            raise ValueError(f"{name}A is {a.shape[:2]}, {name}B is {b.shape[:2]}")
        return np.stack([a, b])

    color = halves("color")
    color = image("color") if color is None else color
    if color is None:
        raise ValueError(
            f"{path}: the directory holds neither color.exr nor colorA.exr"
        )
    found: Arguments = {"color": color, "samples": samples}
    for name, count in CHANNELS.items():
        both = halves(name) if color.ndim == 4 else None
        feature = image(name) if both is None else both
        if feature is not None:
            feature = feature[..., :count]
            found[name] = _finite_depth(feature) if name == "depth" else feature
    if statistics:
        found["variance"] = image("colorVariance")
    found["biased"] = {
        name: _biased(full, halves(name, name))
        for name in sorted(os.listdir(path))
        if os.path.isdir(os.path.join(path, name))
        and (full := image(name, name)) is not None
    }
    return found


def _njs(path: str, samples: int | None, statistics: bool) -> Arguments:
    """The NJS authors' single file: full buffers, and half A of each."""
    part = _single(path)
    names = layers(part)

    def image(layer: str) -> np.ndarray:
        pixels = _any_image(part, layer)
        return _finite_depth(pixels) if layer.startswith("depth") else pixels

    def halves(full: str, half: str) -> np.ndarray | None:
        if full not in names:
            return None
        if half not in names:
            return image(full)[None]
        return np.stack([image(half), 2 * image(full) - image(half)])

    found: Arguments = {"color": halves("default", "subColorA"), "samples": samples}
    for name, count in CHANNELS.items():
        feature = halves(name, name + "A")
        if feature is not None:
            feature = feature[..., :count]
            found[name] = np.clip(feature, 0, 1) if name == "albedo" else feature
    if statistics and "colorVariance" in names:
        found["variance"] = _any_image(part, "colorVariance")
    return found


DIALECTS: dict[str, Callable[[str, int | None, bool], Arguments | Frame]] = {
    "jscomb": _own,
    "mitsuba": _mitsuba,
    "pbrt": _pbrt,
    "tungsten": _tungsten,
    "njs": _njs,
    "rgb": _rgb,
}


def _single(path: str) -> Part:
    """The first part of a file; the dialects of others have one."""
    return read_parts(path)[0]


def _color(part: Part, layer: str = "") -> np.ndarray:
    """R, G, B of a layer; grey from Y."""
    image = stack(part, layer, "RGB")
    if image is None:
        grey = stack(part, layer, "Y")
        if grey is None:
            prefix = f"{layer}." if layer else ""
            listed = ", ".join(sorted(part.channels)[:12])
            raise ValueError(f"channels {prefix}R, G, B are missing; it has {listed}")
        image = np.repeat(grey, 3, axis=-1)
    return image


def _any_image(part: Part, layer: str = "") -> np.ndarray:
    """A layer as three channels, whatever its letters."""
    for suffixes in ("RGB", "XYZ"):
        image = stack(part, layer, suffixes)
        if image is not None:
            return image
    for suffix in "YZVTR":
        image = stack(part, layer, suffix)
        if image is not None:
            return np.repeat(image, 3, axis=-1)
    return _color(part, layer)  # raises: says what is there


def _biased(full: np.ndarray, halves: np.ndarray | None) -> Biased:
    """A biased image as arrays of JAX."""
    return Biased(jnp.asarray(full), None if halves is None else jnp.asarray(halves))


def _features(found: Arguments) -> list[np.ndarray]:
    """The features found so far."""
    return [found[name] for name in CHANNELS if name in found]


def _unit(part: Part, layer: str) -> bool:
    """Whether X, Y, Z look like averaged normals: no longer than 1, mostly 1."""
    vectors = stack(part, layer, "XYZ")
    assert vectors is not None
    length = np.linalg.norm(vectors, axis=-1)
    length = length[np.isfinite(length) & (length > 0)]
    return length.size > 0 and bool(length.max() < 1.01 and np.median(length) > 0.9)


def _finite_depth(depth: np.ndarray) -> np.ndarray:
    """Depth with 0 for the infinite background."""
    return np.where(np.isinf(depth), 0, depth)
