"""Read frames, images and their provenance."""

import importlib.resources
import os
import pathlib
from typing import Any

from jscomb.exr import native
from jscomb.exr._contents import read_contents
from jscomb.exr._files import MAX_BYTES, read_headers
from jscomb.frame import Frame
from jscomb.typing import Image


def bundled() -> dict[str, pathlib.Path]:
    """Return the frames that come with the package, to try things on.

    Returns:
        files by name: cornell-glass-64 and cornell-glass-1024, one scene path traced
        with 64 and with 1024 samples a pixel, denoised, with features and a reference;
        and cornell-glass-256, a part of it in four sub-buffers.

    Example:
        >>> from jscomb import exr
        >>> print(sorted(exr.bundled()))
        ['cornell-glass-1024', 'cornell-glass-256', 'cornell-glass-64']
    """
    folder = importlib.resources.files("jscomb") / "data"
    files = [pathlib.Path(str(file)) for file in folder.iterdir()]
    return {file.stem: file for file in files if file.suffix == ".exr"}


def read_frame(
    path: str | os.PathLike,
    *,
    samples: int | None = None,
    dialect: str | None = None,
    statistics: bool = True,
    layer: str | None = None,
    max_bytes: int = MAX_BYTES,
) -> Frame:
    """Read a frame that any known renderer, or jscomb itself, has written.

    Args:
        path: EXR file, or directory of a Tungsten frame; for a frame in several files,
            the file with the colour.
        samples: samples a pixel, where the file does not state them (Mitsuba);
            overrides the file. Variances of single samples are divided by it.
        dialect: key of `dialects.DIALECTS`; None to recognise it from the contents.
        statistics: read variances; without them no sample count is needed.
        layer: the noisy colour, or its stereo view or view layer; None to choose by
            the usual names.
        max_bytes: memory that the pixels that are read of each file may take; a file
            that claims more is refused before its pixels are read.

    Returns:
        the frame, in float32, of the file's data window.

    Raises:
        FileNotFoundError: if `path` does not exist.
        ValueError: if the file is not a complete EXR file, lacks channels, or needs a
            sample count; names the file and what is missing.

    Example:
        >>> from jscomb import exr
        >>> frame = exr.read_frame(exr.bundled()["cornell-glass-64"])
        >>> print(frame.color.shape, frame.samples, list(frame.estimates))
        (192, 192, 3) 64.0 ['oidn']
    """
    contents = read_contents(
        path,
        samples=samples,
        dialect=dialect,
        statistics=statistics,
        layer=layer,
        max_bytes=max_bytes,
    )
    if contents.missing:
        raise ValueError(contents.missing)
    if contents.frame is None:
        raise ValueError(
            f"{contents.path}: has only a denoised image, "
            f"{', '.join(contents.color.color or []) if contents.color else ''}"
        )
    return contents.frame


def read_image(path: str | os.PathLike, *, max_bytes: int = MAX_BYTES) -> Image:
    """Read the best image of an EXR file of any dialect.

    That is what the renderer or a denoiser has denoised, where the file has it beside
    the noisy image, else the colour; of a frame in jscomb's own format the colour.

    Args:
        path: EXR file, or directory of a Tungsten frame.
        max_bytes: as for `read_frame`.

    Returns:
        the image, linear radiance, [H,W,3], of the file's data window.

    Raises:
        FileNotFoundError: if `path` does not exist.
        ValueError: if the file is not a complete EXR file with colour.

    Example:
        >>> from jscomb import exr
        >>> print(exr.read_image(exr.bundled()["cornell-glass-64"]).shape)
        (192, 192, 3)
    """
    return read_contents(path, statistics=False, max_bytes=max_bytes).image


def read_provenance(path: str | os.PathLike) -> dict[str, Any]:
    """Read where a file that jscomb wrote came from.

    Args:
        path: EXR file.

    Returns:
        what `write_frame` or `write_image` was given; empty if another program wrote
        the file.

    Raises:
        FileNotFoundError: if `path` does not exist.
        ValueError: if it is not an EXR file.

    Example:
        >>> from jscomb import exr
        >>> print(exr.read_provenance(exr.bundled()["cornell-glass-64"])["spp"])
        64
    """
    return native.provenance(read_headers(os.fspath(path)).parts)
