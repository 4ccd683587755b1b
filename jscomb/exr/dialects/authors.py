"""Files of the papers' authors, and of data for training denoisers.

Each function maps a path to the arguments of `make_frame`; `dialects` says what is in
the files.
"""

import glob
import math
import os
import re

import numpy as np

from jscomb.exr.dialects.images import (
    Arguments,
    Asked,
    any_image,
    finite_depth,
    rgb,
    single,
)
from jscomb.exr.files import layers, stack
from jscomb.frame import CHANNELS


def njs(path: str, asked: Asked) -> Arguments:
    """The NJS authors' single file: full buffers, and half A of each.

    Args:
        path: an EXR file.
        asked: how to read it.

    Returns:
        arguments of `make_frame`.
    """
    part = single(path, asked)
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
        "samples": asked.samples,
    }
    for name, count in CHANNELS.items():
        feature = halves(name, name + "A")
        if feature is not None:
            feature = feature[..., :count]
            found[name] = np.clip(feature, 0, 1) if name == "albedo" else feature
    if asked.statistics and "colorVariance" in names:
        found["variance"] = any_image(part, "colorVariance")
    return found


def pd(path: str, asked: Asked) -> Arguments:
    """The PD authors' file; the denoised image and its SURE in files beside it.

    Their variance is of the mean: they compute SURE from it as it is.

    Args:
        path: the EXR file with colour, `<name>.exr`.
        asked: how to read it.

    Returns:
        arguments of `make_frame`.
    """
    part = single(path, asked)
    name = path.removesuffix(".exr")
    found: Arguments = {"color": rgb(part, ""), "samples": _samples(name, asked)}
    albedo = stack(part, "Albedo", "RGB")
    if albedo is not None:
        found["albedo"] = np.clip(albedo, 0, 1)
    found["normal"] = stack(part, "Normal", "XYZ")
    if asked.statistics:
        found["variance"] = stack(part, "Variance", "RGB")
    beside = f"{name}.den.exr"
    if os.path.isfile(beside):
        found["estimates"] = {"denoised": any_image(single(beside, asked), "")}
    return found


def oidn(path: str, asked: Asked) -> Arguments:
    """Training data of Open Image Denoise: one image a file, samples in the name.

    The reference is the one so named, or that of the most samples.

    Args:
        path: the file with colour, `<name>_<samples>spp.hdr.exr`.
        asked: how to read it.

    Returns:
        arguments of `make_frame`.
    """
    name = path.removesuffix(HDR)

    def image(kind: str) -> np.ndarray | None:
        file = f"{name}.{kind}.exr"
        return any_image(single(file, asked), "") if os.path.isfile(file) else None

    color = rgb(single(path, asked), "")
    found: Arguments = {"color": color, "samples": _samples(name, asked)}
    albedo, normal = image("alb"), image("nrm")
    if albedo is not None:
        found["albedo"] = np.clip(albedo, 0, 1)
    if normal is not None:
        found["normal"] = normal
    reference = _reference_of(name)
    if reference is not None:
        found["reference"] = rgb(single(reference, asked), "")
    return found


HDR = ".hdr.exr"


def _reference_of(name: str) -> str | None:
    """The file of the best image of the same scene, if that is another."""
    scene = name.rpartition("_")[0]
    files = glob.glob(f"{glob.escape(scene)}_*{HDR}")
    names = [file.removesuffix(HDR) for file in files]
    same = [other for other in names if scene and other.rpartition("_")[0] == scene]
    best = max(same, key=_rank, default=name)
    return best + HDR if _rank(best) > _rank(name) else None


def _rank(name: str) -> float:
    """Samples a pixel by the end of a name; infinite for a reference, 0 if unsaid."""
    end = name.rpartition("_")[2].lower()
    if end in ("ref", "reference", "gt", "target"):
        return math.inf
    count = re.fullmatch(r"(\d+)(spp)?", end)
    return float(count[1]) if count else 0.0


def _samples(name: str, asked: Asked) -> int | float | None:
    """What was asked, else what the name says."""
    if asked.samples is not None:
        return asked.samples
    said = _rank(name)
    return said if 0 < said < math.inf else None


def idu(path: str, asked: Asked) -> Arguments:
    """The IDU authors' numbered images, as sub-buffers.

    Independent (`_randImg_0`, ...) and correlated (`_corrImg_0`, ...) ones are frames
    apart. Whether the samples in their names are of each or of all is not known, so
    they are not taken.

    Args:
        path: any one of the images, `<scene>_<samples>spp_randImg_0.exr`.
        asked: how to read it.

    Returns:
        arguments of `make_frame`.
    """
    stem = re.fullmatch(rf"(.*{NUMBERED})\d+\.exr", path, re.S)
    if stem is None:
        raise ValueError("its name does not end in _randImg_ or _corrImg_ and a number")
    files = sorted(glob.glob(f"{glob.escape(stem[1])}[0-9].exr"))
    sub_buffers = [any_image(single(file, asked), "") for file in files]
    return {"color": np.stack(sub_buffers), "samples": asked.samples}


NUMBERED = "_(?:rand|corr)Img_"
