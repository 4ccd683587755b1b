"""Read the files of the papers' authors, and training data for denoisers.

Each function returns the arguments of `make_frame` for a path; `dialects` lists what is
in the files.
"""

import glob
import math
import os
import re

import numpy as np

from jscomb.exr._files import layers, stack
from jscomb.exr.dialects._images import (
    Arguments,
    Options,
    any_image,
    clipped,
    finite_depth,
    rgb,
    single,
)
from jscomb.frame import CHANNELS

HDR = ".hdr.exr"
NUMBERED = "_(?:rand|corr)Img_"


def njs(path: str, options: Options) -> Arguments:
    """Read the NJS authors' single file: full buffers, and half A of each."""
    part = single(path, options)
    names = layers(part)

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
    return found


def pd(path: str, options: Options) -> Arguments:
    """Read the PD authors' `<name>.exr`, and the denoised image in a file beside it.

    The variance is of the mean: the authors compute SURE from it unchanged.
    """
    part = single(path, options)
    name = path.removesuffix(".exr")
    found: Arguments = {
        "color": rgb(part, ""),
        "samples": _samples(name, options),
        "albedo": clipped(stack(part, "Albedo", "RGB")),
        "normal": stack(part, "Normal", "XYZ"),
    }
    if options.statistics:
        found["variance"] = stack(part, "Variance", "RGB")
    beside = f"{name}.den.exr"
    if os.path.isfile(beside):
        found["estimates"] = {"denoised": any_image(single(beside, options), "")}
    return found


def oidn(path: str, options: Options) -> Arguments:
    """Read `<name>_<samples>spp.hdr.exr` of Open Image Denoise's training data.

    The reference is the file of that name, or the file with the most samples.
    """
    name = path.removesuffix(HDR)

    def image(kind: str) -> np.ndarray | None:
        file = f"{name}.{kind}.exr"
        return any_image(single(file, options), "") if os.path.isfile(file) else None

    found: Arguments = {
        "color": rgb(single(path, options), ""),
        "samples": _samples(name, options),
        "albedo": clipped(image("alb")),
        "normal": image("nrm"),
    }
    reference = _reference_of(name)
    if reference is not None:
        found["reference"] = rgb(single(reference, options), "")
    return found


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


def idu(path: str, options: Options) -> Arguments:
    """Read the IDU authors' numbered images as sub-buffers, from the path of any one.

    Independent (`_randImg_0`, ...) and correlated (`_corrImg_0`, ...) images are two
    frames. The samples in the names are ignored: whether they count one image or all
    is unknown.
    """
    stem = re.fullmatch(rf"(.*{NUMBERED})\d+\.exr", path, re.S)
    if stem is None:
        raise ValueError("its name does not end in _randImg_ or _corrImg_ and a number")
    files = sorted(glob.glob(f"{glob.escape(stem[1])}[0-9].exr"))
    sub_buffers = [any_image(single(file, options), "") for file in files]
    return {"color": np.stack(sub_buffers), "samples": options.samples}
