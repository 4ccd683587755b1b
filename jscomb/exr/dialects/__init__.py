"""Recognise who wrote an EXR file, and read its channels.

Each dialect has one function from a path to the arguments of `make_frame`. What the
programs write:

    jscomb     a whole frame, see `native`
    mitsuba    R G B, or <nested>.R with A; <name>.R albedo, <name>.X normal,
               <name>.T depth; m2_<name>.* second moments of single samples
    pbrt       R G B, Albedo.R, Ns.X (shading) or N.X, Variance.R of one sample
    blender    Cycles: <view>.Combined.R, <view>.Noisy Image.R where that is denoised;
               <view>.Denoising Albedo.R, Denoising Normal.X, Denoising Depth.Z (or
               DiffCol, Normal, Depth); Denoising Variance.R of one sample, from before
               2.93; attribute cycles.<view>.samples
    tungsten   a directory: color.exr, colorA.exr, colorB.exr, the same for albedo,
               normal, depth, visibility; colorVariance.exr of the mean; <m>/<m>.exr,
               <m>A.exr, <m>B.exr estimates (the layout of Ensemble Denoising)
    njs        default.R, subColorA.R, albedo.R, albedoA.R, ..., colorVariance.R of the
               mean (the file of the Neural James-Stein Combiner); half B = 2 full - A.
               Its denoised images are separate files: read them with `read_image`
    pd         R G B, Albedo.R, Normal.X, Variance.R of the mean (Progressive
               Denoising); <name>.den.exr beside <name>.exr is an estimate
    idu        <scene>_<samples>spp_randImg_0.exr, _1, ... sub-buffers; the same for
               _corrImg_0, ... (Input-Dependent Uncorrelated Weighting)
    oidn       <name>_<samples>spp.hdr.exr, with .alb.exr, .nrm.exr beside it;
               <name>_ref.hdr.exr (reference, gt, target), or the file with the most
               samples, is the reference (training data of Open Image Denoise)
    rgb        R G B, or Y, and no other known channel
"""

import os
import re
from collections.abc import Callable

from jscomb.exr import native
from jscomb.exr._files import read_parts
from jscomb.exr.dialects import _authors, _renderers
from jscomb.exr.dialects._images import Arguments, Options, rgb, single
from jscomb.frame import Frame

__all__ = ["DIALECTS", "Options", "recognise"]


def recognise(path: str) -> str:
    """Return the dialect of a file or directory, from its name and contents.

    Args:
        path: EXR file or directory.

    Returns:
        a key of `DIALECTS`.

    Raises:
        ValueError: if the file cannot be read or has no known colour channels; lists
            its channels.

    Example:
        >>> from jscomb import exr
        >>> print(recognise(str(exr.bundled()["cornell-glass-64"])))
        jscomb
    """
    if os.path.isdir(path):
        return "tungsten"
    parts = read_parts(path, header_only=True)
    if native.is_native(parts):
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
    if path.endswith(_authors.HDR):
        return "oidn"
    if re.search(rf"{_authors.NUMBERED}\d+\.exr$", path):
        return "idu"
    if {"R", "G", "B"} <= names or "Y" in names:
        return "rgb"
    listed = ", ".join(sorted(names)[:12]) + (", ..." if len(names) > 12 else "")
    raise ValueError(f"{path}: no colour channels R, G, B (or Y) among {listed}")


def _native(path: str, options: Options) -> Frame:
    """Read jscomb's own format."""
    parts = read_parts(path, max_bytes=options.max_bytes)
    return native.from_parts(parts, options.samples, options.statistics)


def _rgb(path: str, options: Options) -> Arguments:
    """Read colour alone."""
    return {"color": rgb(single(path, options), ""), "samples": options.samples}


DIALECTS: dict[str, Callable[[str, Options], Arguments | Frame]] = {
    "jscomb": _native,
    "mitsuba": _renderers.mitsuba,
    "pbrt": _renderers.pbrt,
    "blender": _renderers.blender,
    "tungsten": _renderers.tungsten,
    "njs": _authors.njs,
    "pd": _authors.pd,
    "idu": _authors.idu,
    "oidn": _authors.oidn,
    "rgb": _rgb,
}
