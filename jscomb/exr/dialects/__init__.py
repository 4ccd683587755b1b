"""Who wrote this EXR file, and what its channels mean.

One function a dialect maps a path to the arguments of `make_frame`. What each writes:

    jscomb     everything; see `own`
    mitsuba    R G B, or <nested>.R with A; <name>.R albedo, <name>.X normal,
               <name>.T depth; m2_<name>.* second moments of single samples
    pbrt       R G B, Albedo.R, Ns.X (shading) or N.X, Variance.R of one sample
    blender    Cycles: <view>.Combined.R, <view>.Noisy Image.R where that is denoised;
               <view>.Denoising Albedo.R, Denoising Normal.X, Denoising Depth.Z (or
               DiffCol, Normal, Depth); Denoising Variance.R of one sample, from before
               2.93; attribute cycles.<view>.samples
    tungsten   a directory: color.exr, colorA.exr, colorB.exr, likewise albedo, normal,
               depth, visibility; colorVariance.exr of the mean; <m>/<m>.exr,
               <m>A.exr, <m>B.exr biased images (the layout of Ensemble Denoising)
    njs        default.R, subColorA.R, albedo.R, albedoA.R, ..., colorVariance.R of the
               mean (the file of the Neural James-Stein Combiner); half B = 2 full - A.
               Its denoised images are files of their own: read them with `read_image`
    pd         R G B, Albedo.R, Normal.X, Variance.R of the mean (Progressive
               Denoising); <name>.den.exr beside <name>.exr is biased
    idu        <scene>_<samples>spp_randImg_0.exr, _1, ... sub-buffers; _corrImg_0, ...
               likewise (Input-Dependent Uncorrelated Weighting)
    oidn       <name>_<samples>spp.hdr.exr, with .alb.exr, .nrm.exr beside it;
               <name>_ref.hdr.exr (reference, gt, target), or that of the most samples,
               is the reference (training data of Open Image Denoise)
    rgb        R G B, or Y, and nothing else that is known
"""

import os
import re
from collections.abc import Callable

from jscomb.exr import own
from jscomb.exr.dialects import authors, renderers
from jscomb.exr.dialects.images import Arguments, Asked, rgb, single
from jscomb.exr.files import read_parts
from jscomb.frame import Frame


def recognise(path: str) -> str:
    """The dialect of a file or directory, from its name and contents.

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
    if any(name.endswith(".Combined.R") for name in names):
        return "blender"
    if str(header.get("generatedBy", "")).startswith("Mitsuba") or any(
        name.startswith("m2_") or name.endswith(".T") for name in names
    ):
        return "mitsuba"
    if {"Variance.R", "Normal.X"} <= names:
        return "pd"
    if {"Variance.R", "Ns.X", "Nsx", "P.X", "Albedo.R"} & names:
        return "pbrt"
    if path.endswith(authors.HDR):
        return "oidn"
    if re.search(rf"{authors.NUMBERED}\d+\.exr$", path):
        return "idu"
    if {"R", "G", "B"} <= names or "Y" in names:
        return "rgb"
    listed = ", ".join(sorted(names)[:12]) + (", ..." if len(names) > 12 else "")
    raise ValueError(f"{path}: no colour channels R, G, B (or Y) among {listed}")


def _own(path: str, asked: Asked) -> Frame:
    """Jscomb's own multi-part file."""
    parts = read_parts(path, max_bytes=asked.max_bytes)
    return own.from_parts(parts, asked.samples, asked.statistics)


def _rgb(path: str, asked: Asked) -> Arguments:
    """Colour alone."""
    return {"color": rgb(single(path, asked), ""), "samples": asked.samples}


DIALECTS: dict[str, Callable[[str, Asked], Arguments | Frame]] = {
    "jscomb": _own,
    "mitsuba": renderers.mitsuba,
    "pbrt": renderers.pbrt,
    "blender": renderers.blender,
    "tungsten": renderers.tungsten,
    "njs": authors.njs,
    "pd": authors.pd,
    "idu": authors.idu,
    "oidn": authors.oidn,
    "rgb": _rgb,
}
