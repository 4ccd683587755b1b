"""Files and folders as renderers write them.

Each function maps a path to the arguments of `make_frame`; `dialects` says what is in
the files.
"""

import os

import numpy as np

from jscomb.exr.dialects.images import (
    Arguments,
    Asked,
    any_image,
    biased,
    finite_depth,
    of_the_mean,
    rgb,
    single,
)
from jscomb.exr.files import Part, layers, stack
from jscomb.frame import CHANNELS

FAR = 1e10  # Cycles' depth where nothing is


def mitsuba(path: str, asked: Asked) -> Arguments:
    """Mitsuba 3: path, aov around path, and moment around aov.

    Second moments of a path right inside a moment integrator are in CIE XYZ, which have
    no variance in RGB; the file then has colour alone.

    Args:
        path: an EXR file.
        asked: how to read it.

    Returns:
        arguments of `make_frame`.
    """
    part = single(path, asked)
    names = layers(part)
    images = {n: s for n, s in names.items() if n and not n.startswith("m2_")}
    # Only nested integrators have alpha; an RGB layer without it is an albedo.
    radiance = [n for n, s in images.items() if s == "ABGR"]
    moments = [n for n in radiance if f"m2_{n}" in names]
    layer = (moments or radiance or [""])[0]
    found: Arguments = {"color": rgb(part, layer), "samples": asked.samples}
    if asked.statistics and moments:
        spread = rgb(part, f"m2_{layer}") - np.square(found["color"])
        found["variance"] = of_the_mean(spread, asked.samples, "second moments")
    albedo = sorted(
        (n for n, s in images.items() if s == "BGR"), key=lambda n: "alb" not in n
    )
    depth = [n for n, s in images.items() if s == "T"]
    normal = [n for n, s in images.items() if s == "XYZ" and _unit(part, n)]
    if albedo:
        found["albedo"] = np.clip(rgb(part, albedo[0]), 0, 1)
    if normal:
        found["normal"] = stack(part, normal[0], "XYZ")
    if depth:
        found["depth"] = finite_depth(any_image(part, depth[0]))[..., :1]
    return found


def _unit(part: Part, layer: str) -> bool:
    """Whether X, Y, Z look like averaged normals: no longer than 1, mostly 1."""
    vectors = stack(part, layer, "XYZ")
    assert vectors is not None
    length = np.linalg.norm(vectors, axis=-1)
    length = length[np.isfinite(length) & (length > 0)]
    return length.size > 0 and bool(length.max() < 1.01 and np.median(length) > 0.9)


def pbrt(path: str, asked: Asked) -> Arguments:
    """pbrt-v4's GBufferFilm, and its older names.

    Args:
        path: an EXR file.
        asked: how to read it.

    Returns:
        arguments of `make_frame`.
    """
    part = single(path, asked)
    samples = asked.samples
    if samples is None:
        samples = part.attributes.get("samplesPerPixel")
        if samples is not None and not isinstance(samples, int):
            raise ValueError(f"attribute samplesPerPixel is {samples!r}, not a number")
    found: Arguments = {"color": rgb(part, ""), "samples": samples}
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
    if asked.statistics and variance is not None:
        if samples is None:
            raise ValueError(
                "its variance is of one sample and the attribute samplesPerPixel is "
                "missing: give the samples a pixel"
            )
        # The film writes 0 where no surface was hit: missing, not exact.
        hit = np.any([f != 0 for f in (variance, *_features(found))], axis=(0, -1))
        found["variance"] = np.where(hit[..., None], variance / samples, np.nan)
    return found


def _features(found: Arguments) -> list[np.ndarray]:
    """The features found so far."""
    return [found[name] for name in CHANNELS if name in found]


def tungsten(path: str, asked: Asked) -> Arguments:
    """Tungsten: a directory of images by name, with A and B beside for the halves.

    Args:
        path: the directory.
        asked: how to read it.

    Returns:
        arguments of `make_frame`.
    """

    def image(*names: str) -> np.ndarray | None:
        file = os.path.join(path, *names) + ".exr"
        return any_image(single(file, asked), "") if os.path.isfile(file) else None

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
    found: Arguments = {"color": color, "samples": asked.samples}
    for name, count in CHANNELS.items():
        both = halves(name) if color.ndim == 4 else None
        feature = image(name) if both is None else both
        if feature is not None:
            feature = feature[..., :count]
            found[name] = finite_depth(feature) if name == "depth" else feature
    if asked.statistics:
        found["variance"] = image("colorVariance")
    found["estimates"] = {
        name: biased(full, halves(name, name))
        for name in sorted(os.listdir(path))
        if os.path.isdir(os.path.join(path, name))
        and (full := image(name, name)) is not None
    }
    return found


def blender(path: str, asked: Asked) -> Arguments:
    """Blender Cycles: the first view layer, its denoising data and their older names.

    Where there is a noisy image, `Combined` is what Blender has denoised.

    Args:
        path: an EXR file.
        asked: how to read it.

    Returns:
        arguments of `make_frame`.
    """
    part = single(path, asked)
    names = layers(part)
    views = [n.rpartition(".")[0] for n in names if n.endswith(".Combined")]
    if not views:
        raise ValueError("it has no layer whose name ends in .Combined")
    view = min(views, key=lambda v: v == "Composite")  # the compositor's output
    samples = asked.samples
    if samples is None:
        said = part.attributes.get(f"cycles.{view}.samples")
        samples = int(said) if said is not None else None
    combined = rgb(part, f"{view}.Combined")
    found: Arguments = {"color": combined, "samples": samples}

    def image(*passes: str) -> np.ndarray | None:
        held = [name for name in passes if f"{view}.{name}" in names]
        return any_image(part, f"{view}.{held[0]}") if held else None

    noisy = image("Noisy Image", "Denoising Image")
    if noisy is not None:
        found |= {"color": noisy, "estimates": {"denoised": combined}}
    albedo = image("Denoising Albedo", "DiffCol")
    normal = image("Denoising Normal", "Normal")
    depth = image("Denoising Depth", "Depth")
    if albedo is not None:
        found["albedo"] = np.clip(albedo, 0, 1)
    if normal is not None:
        found["normal"] = normal
    if depth is not None:
        found["depth"] = np.where(depth >= FAR, 0, depth)[..., :1]
    spread = image("Denoising Variance", "Denoising Image Variance")
    if asked.statistics and spread is not None:
        found["variance"] = of_the_mean(spread, samples, "the variance")
    return found
