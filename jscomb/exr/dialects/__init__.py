"""Recognise who wrote an EXR file, and read its channels.

Each dialect has one function from a path to the arguments of `make_frame`, and one that
lists the files which that reads. What the programs write:

    jscomb     a whole frame, see `native`
    result     what `jscomb combine` made of a file of another program
    mitsuba    R G B, or <nested>.R with A; <name>.R albedo, <name>.X normal,
               <name>.T depth; m2_<name>.* second moments of single samples
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

All others are read by the names of their layers, whoever wrote them:

    pbrt       R G B, Albedo.R, Ns.X (shading) or N.X, Variance.R of one sample
    blender    Cycles: <view>.Combined.R, <view>.Noisy Image.R where that is denoised;
               <view>.Denoising Albedo.R, Denoising Normal.X, Denoising Depth.Z (or
               DiffCol, Normal, Depth); Denoising Variance.R of one sample, from before
               2.93; attribute cycles.<view>.samples
    layers     any other: R G B or Y, RGBA.R, beauty.R, C.r, Ci.r, Image.R; albedo,
               diffuse_albedo, N, normal, Z, depth, variance, mse, ... in one part, one
               part a layer, or one part a view
"""

import os
import re
from collections.abc import Callable
from typing import NamedTuple

from jscomb.exr import native
from jscomb.exr._files import Headers, read_headers, read_pixels
from jscomb.exr._layers import layers_of
from jscomb.exr._names import plain
from jscomb.exr.dialects import _authors, _renderers
from jscomb.exr.dialects._images import Options, Reading, Source
from jscomb.exr.dialects._layered import layered

__all__ = ["DIALECTS", "Dialect", "is_frame", "recognise"]


class Dialect(NamedTuple):
    """How one kind of frame is read.

    Attributes:
        read: from a source, a path and options to what was read.
        files: lists what `read` opens, the file with the colour first.
    """

    read: Callable[[Source, str, Options], Reading]
    files: Callable[[str], list[str]] = lambda path: [path]


def recognise(path: str, *, headers: Headers | None = None) -> str:
    """Return the dialect of a file or directory, from its name and contents.

    Args:
        path: EXR file or directory.
        headers: of the file, where they are read already.

    Returns:
        a key of `DIALECTS`.

    Raises:
        ValueError: if the file cannot be read.

    Example:
        >>> from jscomb import exr
        >>> print(recognise(str(exr.bundled()["cornell-glass-64"])))
        jscomb
    """
    if os.path.isdir(path):
        return "tungsten"
    headers = headers or read_headers(path)
    if native.result_of(headers.parts) is not None:
        return "result"
    if native.is_native(headers.parts):
        return "jscomb"
    names = {
        channel.name
        for part in headers.parts
        for channel in part.attributes["channels"]
    }
    if {"default.R", "subColorA.R"} <= names:
        return "njs"
    last = {plain(layer.name.rpartition(".")[2]) for layer in layers_of(headers)}
    if last & {"combined", "noisyimage"}:
        return "blender"
    made_by = str(headers.parts[0].attributes.get("generatedBy", ""))
    if made_by.startswith("Mitsuba") or any(name.startswith("m2_") for name in names):
        return "mitsuba"
    if {"Variance.R", "Normal.X"} <= names:
        return "pd"
    if path.endswith(_authors.HDR):
        return "oidn"
    if re.search(rf"{_authors.NUMBERED}\d+\.exr$", path):
        return "idu"
    if {"Variance.R", "Ns.X", "Nsx", "P.X", "Albedo.R"} & names:
        return "pbrt"
    return "layers"


def is_frame(folder: str) -> bool:
    """Return whether a directory is one frame, not a folder of them.

    Args:
        folder: its path.

    Returns:
        whether it holds Tungsten's images.

    Example:
        >>> print(is_frame("."))
        False
    """
    names = (os.path.join(folder, f"color{half}.exr") for half in ("", "A"))
    return any(os.path.isfile(name) for name in names)


def _native(source: Source, path: str, options: Options) -> Reading:
    """Read jscomb's own format."""
    parts = read_pixels(source.headers(path), max_bytes=options.max_bytes)
    frame = native.from_parts(parts, options.samples, options.statistics)
    return Reading({"frame": frame}, path, None, parts, {}, [])


def _result(source: Source, path: str, options: Options) -> Reading:
    """Read a file that jscomb combined: its colour is not noise any more."""
    about = native.result_of(source.headers(path).parts)
    assert about is not None
    wanted = options.wanted
    if wanted.layer is None:
        wanted = wanted._replace(layer=about["layer"])
    found = layered(source, path, options._replace(wanted=wanted))
    note = "this is a result of jscomb combine: its colour is combined, not noisy"
    return found._replace(notes=[*found.notes, note])


DIALECTS: dict[str, Dialect] = {
    "jscomb": Dialect(_native),
    "result": Dialect(_result),
    "mitsuba": Dialect(_renderers.mitsuba),
    "tungsten": Dialect(_renderers.tungsten, _renderers.tungsten_files),
    "njs": Dialect(_authors.njs),
    "pd": Dialect(_authors.pd, _authors.pd_files),
    "idu": Dialect(_authors.idu, _authors.idu_files),
    "oidn": Dialect(_authors.oidn, _authors.oidn_files),
    "pbrt": Dialect(layered),
    "blender": Dialect(layered),
    "layers": Dialect(layered),
}
