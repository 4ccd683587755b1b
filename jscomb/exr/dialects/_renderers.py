"""Read the files and directories of renderers.

Each function returns the arguments of `make_frame` for a path; `dialects` lists what is
in the files.
"""

import os

import numpy as np

from jscomb.exr._files import Part, layers, stack
from jscomb.exr.dialects._images import (
    Arguments,
    Options,
    any_image,
    clipped,
    estimate,
    finite_depth,
    rgb,
    single,
    variance_of_mean,
)
from jscomb.frame import CHANNELS

FAR = 1e10  # Cycles' depth of the background


def mitsuba(path: str, options: Options) -> Arguments:
    """Read Mitsuba 3: path, aov around path, and moment around aov.

    Second moments of a path directly inside a moment integrator are in CIE XYZ and have
    no variance in RGB; such a file is read without variance.
    """
    part = single(path, options)
    names = layers(part)
    images = {n: s for n, s in names.items() if n and not n.startswith("m2_")}
    # Only nested integrators have alpha; an RGB layer without it is an albedo.
    radiance = [n for n, s in images.items() if s == "ABGR"]
    moments = [n for n in radiance if f"m2_{n}" in names]
    layer = (moments or radiance or [""])[0]
    found: Arguments = {"color": rgb(part, layer), "samples": options.samples}
    if options.statistics and moments:
        deviation = rgb(part, f"m2_{layer}") - np.square(found["color"])
        found["variance"] = variance_of_mean(
            deviation, options.samples, "second moments"
        )
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
    return found


def _are_normals(part: Part, layer: str) -> bool:
    """Return whether X, Y, Z look like averaged normals: at most 1 long, mostly 1."""
    vectors = stack(part, layer, "XYZ")
    assert vectors is not None
    length = np.linalg.norm(vectors, axis=-1)
    length = length[np.isfinite(length) & (length > 0)]
    return length.size > 0 and bool(length.max() < 1.01 and np.median(length) > 0.9)


def pbrt(path: str, options: Options) -> Arguments:
    """Read pbrt-v4's GBufferFilm, and its older names."""
    part = single(path, options)
    samples = options.samples
    if samples is None:
        samples = part.attributes.get("samplesPerPixel")
        if samples is not None and not isinstance(samples, int):
            raise ValueError(f"attribute samplesPerPixel is {samples!r}, not a number")
    found: Arguments = {
        "color": rgb(part, ""),
        "samples": samples,
        "albedo": clipped(stack(part, "Albedo", "RGB")),
        "normal": _pbrt_normal(part),
    }
    variance = stack(part, "Variance", "RGB")
    if options.statistics and variance is not None:
        if samples is None:
            raise ValueError(
                "its variance is of one sample and the attribute samplesPerPixel is "
                "missing: give the samples a pixel"
            )
        # The film writes 0 where no surface was hit: missing, not exact.
        buffers = [variance, found["albedo"], found["normal"]]
        hit = np.any([b != 0 for b in buffers if b is not None], axis=(0, -1))
        found["variance"] = np.where(hit[..., None], variance / samples, np.nan)
    return found


def _pbrt_normal(part: Part) -> np.ndarray | None:
    """Return the shading normal, or else the geometric normal."""
    for layer in ("Ns", "N"):
        normal = stack(part, layer, "XYZ")
        older = [part.channels.get(layer + axis) for axis in "xyz"]
        present = [channel for channel in older if channel is not None]
        if normal is None and len(present) == 3:
            normal = np.stack(present, axis=-1).astype(np.float32)
        if normal is not None:
            return normal
    return None


def tungsten(path: str, options: Options) -> Arguments:
    """Read Tungsten's directory of images by name, with A and B for the halves."""

    def image(*names: str) -> np.ndarray | None:
        file = os.path.join(path, *names) + ".exr"
        return any_image(single(file, options), "") if os.path.isfile(file) else None

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
    return found


def blender(path: str, options: Options) -> Arguments:
    """Read Blender Cycles: the first view layer, its denoising data and older names.

    Where there is a noisy image, `Combined` is Blender's denoised image.
    """
    part = single(path, options)
    names = layers(part)
    views = [n.rpartition(".")[0] for n in names if n.endswith(".Combined")]
    if not views:
        raise ValueError("it has no layer whose name ends in .Combined")
    view = min(views, key=lambda v: v == "Composite")  # the compositor's output
    samples = options.samples
    if samples is None:
        text = part.attributes.get(f"cycles.{view}.samples")
        samples = int(text) if text is not None else None

    def image(*passes: str) -> np.ndarray | None:
        present = [name for name in passes if f"{view}.{name}" in names]
        return any_image(part, f"{view}.{present[0]}") if present else None

    combined = rgb(part, f"{view}.Combined")
    found: Arguments = {
        "color": combined,
        "samples": samples,
        "albedo": clipped(image("Denoising Albedo", "DiffCol")),
        "normal": image("Denoising Normal", "Normal"),
    }
    noisy = image("Noisy Image", "Denoising Image")
    if noisy is not None:
        found |= {"color": noisy, "estimates": {"denoised": combined}}
    depth = image("Denoising Depth", "Depth")
    if depth is not None:
        found["depth"] = np.where(depth >= FAR, 0, depth)[..., :1]
    deviation = image("Denoising Variance", "Denoising Image Variance")
    if options.statistics and deviation is not None:
        found["variance"] = variance_of_mean(deviation, samples, "the variance")
    return found
