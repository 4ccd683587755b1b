"""Read the files of the papers' authors, and training data for denoisers.

Each function reads a path; beside it is one that lists the files which that takes.
`dialects` lists what is in the files.
"""

import glob
import math
import os
import re

import numpy as np

from jscomb.exr.dialects._images import (
    Arguments,
    Options,
    Reading,
    Source,
    any_image,
    clipped,
    finite_depth,
    layer_named,
    rgb,
    single,
    whole,
)
from jscomb.exr.dialects._layered import layered
from jscomb.frame import CHANNELS

HDR = ".hdr.exr"
NUMBERED = "_(?:rand|corr)Img_"


def njs(source: Source, path: str, options: Options) -> Reading:
    """Read the NJS authors' single file: full buffers, and half A of each."""
    parts = whole(source, path, options)
    part = parts[0]
    names = {name.rpartition(".")[0] for name in part.channels}

    def image(layer: str) -> np.ndarray:
        pixels = any_image(part, layer)
        return finite_depth(pixels) if layer.startswith("depth") else pixels

    def halves(full: str, half: str) -> np.ndarray | None:
        if full not in names:
            return None
        if half not in names:
            return image(full)[None]
        return np.stack([image(half), 2 * image(full) - image(half)])

    found: Arguments = {
        "color": halves("default", "subColorA"),
        "samples": options.samples,
    }
    for name, count in CHANNELS.items():
        feature = halves(name, name + "A")
        if feature is not None:
            feature = feature[..., :count]
            found[name] = clipped(feature) if name == "albedo" else feature
    if options.statistics and "colorVariance" in names:
        found["variance"] = any_image(part, "colorVariance")
    color = layer_named(source, path, "default")
    return Reading(found, path, color, parts, {}, [])


def pd(source: Source, path: str, options: Options) -> Reading:
    """Read the PD authors' `<name>.exr`, and the denoised image in a file beside it.

    The variance is of the mean: the authors compute SURE from it unchanged.
    """
    found = layered(source, path, options, unit="mean")
    arguments = {"estimates": {}} | found.arguments
    arguments["samples"] = _samples(path.removesuffix(".exr"), options)
    for beside in pd_files(path)[1:]:
        denoised = any_image(single(source, beside, options), "")
        arguments["estimates"] = {**arguments["estimates"], "denoised": denoised}
    return found._replace(arguments=arguments)


def pd_files(path: str) -> list[str]:
    """Return the frame's file, and the denoised one if it is there."""
    beside = f"{path.removesuffix('.exr')}.den.exr"
    return [path, *([beside] if os.path.isfile(beside) else [])]


def oidn(source: Source, path: str, options: Options) -> Reading:
    """Read `<name>_<samples>spp.hdr.exr` of Open Image Denoise's training data.

    The reference is the file of that name, or the file with the most samples.
    """
    name, present = path.removesuffix(HDR), oidn_files(path)

    def image(kind: str) -> np.ndarray | None:
        file = f"{name}.{kind}.exr"
        return any_image(single(source, file, options), "") if file in present else None

    found = layered(source, path, options)
    arguments = {
        **found.arguments,
        "samples": _samples(name, options),
        "albedo": clipped(image("alb")),
        "normal": image("nrm"),
    }
    reference = _reference_of(name)
    if reference is not None:
        arguments["reference"] = rgb(single(source, reference, options), "")
    return found._replace(arguments=arguments)


def oidn_files(path: str) -> list[str]:
    """Return the file with the colour, those of the features, and the reference."""
    name = path.removesuffix(HDR)
    files = [f"{name}.{kind}.exr" for kind in ("alb", "nrm")]
    reference = _reference_of(name)
    present = [file for file in files if os.path.isfile(file)]
    return [path, *present, *([reference] if reference else [])]


def _reference_of(name: str) -> str | None:
    """Return the best image of the same scene; None if that is this file."""
    scene = name.rpartition("_")[0]
    files = glob.glob(f"{glob.escape(scene)}_*{HDR}")
    names = [file.removesuffix(HDR) for file in files]
    same = [other for other in names if scene and other.rpartition("_")[0] == scene]
    best = max(same, key=_samples_in, default=name)
    return best + HDR if _samples_in(best) > _samples_in(name) else None


def _samples_in(name: str) -> float:
    """Return the samples a pixel in a name: infinite for a reference, 0 if unknown."""
    end = name.rpartition("_")[2].lower()
    if end in ("ref", "reference", "gt", "target"):
        return math.inf
    count = re.fullmatch(r"(\d+)(spp)?", end)
    return float(count[1]) if count else 0.0


def _samples(name: str, options: Options) -> int | float | None:
    """Return the samples a pixel of the options, or else of the file's name."""
    if options.samples is not None:
        return options.samples
    count = _samples_in(name)
    return count if 0 < count < math.inf else None


def idu(source: Source, path: str, options: Options) -> Reading:
    """Read the IDU authors' numbered images as sub-buffers, from the path of any one.

    Independent (`_randImg_0`, ...) and correlated (`_corrImg_0`, ...) images are two
    frames. The samples in the names are ignored: whether they count one image or all
    is unknown.
    """
    files = idu_files(path)
    first = whole(source, path, options)
    others = {f: single(source, f, options) for f in files if f != path}
    images = [any_image(others.get(file, first[0]), "") for file in files]
    arguments = {"color": np.stack(images), "samples": options.samples}
    return Reading(arguments, path, layer_named(source, path, ""), first, {}, [])


def idu_files(path: str) -> list[str]:
    """Return all numbered images of the same kind."""
    stem = re.fullmatch(rf"(.*{NUMBERED})\d+\.exr", path, re.S)
    if stem is None:
        raise ValueError("its name does not end in _randImg_ or _corrImg_ and a number")
    return sorted(glob.glob(f"{glob.escape(stem[1])}[0-9].exr"))
