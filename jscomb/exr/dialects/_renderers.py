"""Read Mitsuba's files and Tungsten's directories.

Each function reads a path; `dialects` lists what is in the files.
"""

import os

import numpy as np

from jscomb.exr._files import Part, stack
from jscomb.exr.dialects._images import (
    Arguments,
    Options,
    Reading,
    Source,
    any_image,
    clipped,
    estimate,
    finite_depth,
    layer_named,
    rgb,
    single,
    variance_of_mean,
    whole,
)
from jscomb.frame import CHANNELS


def mitsuba(source: Source, path: str, options: Options) -> Reading:
    """Read Mitsuba 3: path, aov around path, and moment around aov.

    Second moments of a path directly inside a moment integrator are in CIE XYZ and have
    no variance in RGB; such a file is read without variance.
    """
    parts = whole(source, path, options)
    part = parts[0]
    names = _suffixes(part)
    images = {n: s for n, s in names.items() if n and not n.startswith("m2_")}
    # Only nested integrators have alpha; an RGB layer without it is an albedo.
    radiance = [n for n, s in images.items() if s == "ABGR"]
    moments = [n for n in radiance if f"m2_{n}" in names]
    layer = (moments or radiance or [""])[0]
    found: Arguments = {"color": rgb(part, layer), "samples": options.samples}
    missing = ""
    if options.statistics and moments:
        deviation = rgb(part, f"m2_{layer}") - np.square(found["color"])
        try:
            found["variance"] = variance_of_mean(
                deviation, options.samples, "second moments"
            )
        except ValueError as error:
            missing = str(error)
    albedo = sorted(
        (n for n, s in images.items() if s == "BGR"), key=lambda n: "alb" not in n
    )
    depth = [n for n, s in images.items() if s == "T"]
    normal = [n for n, s in images.items() if s == "XYZ" and _are_normals(part, n)]
    if albedo:
        found["albedo"] = clipped(rgb(part, albedo[0]))
    if normal:
        found["normal"] = stack(part, normal[0], "XYZ")
    if depth:
        found["depth"] = finite_depth(any_image(part, depth[0]))[..., :1]
    color = layer_named(source, path, layer)
    return Reading(found, path, color, parts, {}, [], missing=missing)


def _suffixes(part: Part) -> dict[str, str]:
    """Return the sorted channel suffixes of each layer, by the layer's name."""
    found: dict[str, str] = {}
    for name in sorted(part.channels):
        prefix, _, suffix = name.rpartition(".")
        found[prefix] = found.get(prefix, "") + suffix
    return found


def _are_normals(part: Part, layer: str) -> bool:
    """Return whether X, Y, Z look like averaged normals: at most 1 long, mostly 1."""
    vectors = stack(part, layer, "XYZ")
    assert vectors is not None
    length = np.linalg.norm(vectors, axis=-1)
    length = length[np.isfinite(length) & (length > 0)]
    return length.size > 0 and bool(length.max() < 1.01 and np.median(length) > 0.9)


def tungsten(source: Source, path: str, options: Options) -> Reading:
    """Read Tungsten's directory of images by name, with A and B for the halves."""

    def image(*names: str) -> np.ndarray | None:
        file = os.path.join(path, *names) + ".exr"
        return (
            any_image(single(source, file, options), "")
            if os.path.isfile(file)
            else None
        )

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
        raise ValueError(f"{path}: the directory has neither color.exr nor colorA.exr")
    found: Arguments = {"color": color, "samples": options.samples}
    for name, count in CHANNELS.items():
        both = halves(name) if color.ndim == 4 else None
        feature = image(name) if both is None else both
        if feature is not None:
            feature = feature[..., :count]
            found[name] = finite_depth(feature) if name == "depth" else feature
    if options.statistics:
        found["variance"] = image("colorVariance")
    found["estimates"] = {
        name: estimate(full, halves(name, name))
        for name in sorted(os.listdir(path))
        if os.path.isdir(os.path.join(path, name))
        and (full := image(name, name)) is not None
    }
    file = tungsten_files(path)[0]
    parts = whole(source, file, options) if options.everything else []
    layer = layer_named(source, file, "")
    return Reading(found, file, layer, parts or source.headers(file).parts, {}, [])


def tungsten_files(path: str) -> list[str]:
    """Return the images of the directory that are read, the colour's first."""
    names = [f"color{half}" for half in ("", "A", "B")] + ["colorVariance"]
    names += [f"{feature}{half}" for feature in CHANNELS for half in ("", "A", "B")]
    for name in sorted(os.listdir(path)):
        if os.path.isdir(os.path.join(path, name)):
            names += [os.path.join(name, f"{name}{half}") for half in ("", "A", "B")]
    files = [os.path.join(path, f"{name}.exr") for name in names]
    found = [file for file in files if os.path.isfile(file)]
    if not found or not os.path.basename(found[0]).startswith("color"):
        raise ValueError(f"{path}: the directory has neither color.exr nor colorA.exr")
    return found
