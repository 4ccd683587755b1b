"""EXR in and out: what renderers write, as a `Frame`, and back.

`read_frame` recognises who wrote a file (or directory) and maps it to the conventions
of the toolkit: linear RGB, variance of the mean, an explicit sample count, pixels
without data not finite. `write_frame` writes jscomb's own multi-part file, which holds
all of a frame bit by bit.

Every error is an `OSError` or a `ValueError` of one line that names the file and says
what is wrong with it. Writing is atomic: a file that was there is replaced only by a
whole one.
"""

import importlib.resources
import os
import pathlib
from typing import Any

import numpy as np
from jax import Array
from jaxtyping import ArrayLike

from jscomb.exr import own
from jscomb.exr.dialects import DIALECTS, recognise
from jscomb.exr.dialects.images import Asked
from jscomb.exr.files import MAX_BYTES, read_parts, write_parts
from jscomb.frame import Frame, make_frame


def bundled() -> dict[str, pathlib.Path]:
    """The frames that come with the package, to try things on.

    Returns:
        files by name: cornell-glass-64 and cornell-glass-1024, one scene path traced
        with 64 and with 1024 samples a pixel, denoised, with features and a reference.

    Example:
        >>> print(sorted(bundled()))
        ['cornell-glass-1024', 'cornell-glass-64']
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
    max_bytes: int = MAX_BYTES,
) -> Frame:
    """Read what a renderer wrote.

    Args:
        path: an EXR file, or the directory of a Tungsten frame. Of a frame in several
            files, the one of its colour.
        samples: samples a pixel, for files that do not say (Mitsuba); overrides what a
            file says. Where a file holds statistics of single samples, the variance of
            the mean depends on it.
        dialect: a key of `dialects.DIALECTS`; recognised from the contents if None.
        statistics: read variances; without them a sample count is never needed.
        max_bytes: that the pixels of each file may take in memory; a file that claims
            more is refused before its pixels are read.

    Returns:
        the frame, in float32.

    Raises:
        FileNotFoundError: if there is nothing at `path`.
        ValueError: if the file is not a whole EXR file, or lacks channels, or its
            sample count is needed and not known; names the file and what is missing.

    Example:
        >>> frame = read_frame(bundled()["cornell-glass-64"])
        >>> print(frame.color.shape, frame.samples, list(frame.estimates))
        (192, 192, 3) 64.0 ['oidn']
    """
    path = os.fspath(path)
    if not os.path.exists(path):
        raise FileNotFoundError(f"{path}: no such file or directory")
    if samples is not None and samples < 1:
        raise ValueError(f"{path}: samples must be at least 1, got {samples}")
    name = dialect
    try:
        name = name or recognise(path)
        if name not in DIALECTS:
            known = ", ".join(DIALECTS)
            raise ValueError(f"unknown dialect {name!r}, expected one of {known}")
        contents = DIALECTS[name](path, Asked(samples, statistics, max_bytes))
        return contents if isinstance(contents, Frame) else make_frame(**contents)
    except _MALFORMED as error:
        if path in str(error):
            raise ValueError(str(error)) from None
        raise ValueError(f"{path}: read as {name}: {error}") from None


# What attributes and channels of unexpected types, sizes or encodings lead to.
_MALFORMED = (ValueError, TypeError, AttributeError, KeyError, IndexError)


def read_image(path: str | os.PathLike, *, max_bytes: int = MAX_BYTES) -> Array:
    """Read only the colour of an EXR file of any dialect.

    Args:
        path: an EXR file, or the directory of a Tungsten frame.
        max_bytes: as for `read_frame`.

    Returns:
        the full image, linear radiance, shape [H,W,C].

    Raises:
        FileNotFoundError: if there is nothing at `path`.
        ValueError: if the file is not a whole EXR file with colour.

    Example:
        >>> print(read_image(bundled()["cornell-glass-64"]).shape)
        (192, 192, 3)
    """
    return read_frame(path, statistics=False, max_bytes=max_bytes).color


def write_frame(
    path: str | os.PathLike,
    frame: Frame,
    *,
    provenance: dict[str, Any] | None = None,
    half: tuple[str, ...] = (),
) -> None:
    """Write a frame as jscomb's own EXR file; `read_frame` gives it back bit by bit.

    Args:
        path: the file; replaced atomically if it exists.
        frame: of any number of sub-buffers up to 26, float32.
        provenance: where it came from; anything that JSON can hold.
        half: buffers to store in 16 bits: names of `Buffers` fields, `biased`,
            `biased_halves`, `half_difference`. Lossy (three digits, and below 6e-8
            nothing); half the size.

    Returns:
        nothing.

    Raises:
        OSError: if the file cannot be written; nothing at `path` has changed.
        ValueError: if a biased image has the name of another part (a letter of a
            sub-buffer, `reference`, anything with a dot), or a value is too large for
            16 bits.

    Example:
        >>> import tempfile
        >>> frame = make_frame(np.ones((2, 4, 4, 3), np.float32), samples=8)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_frame(f"{folder}/frame.exr", frame)
        ...     print(read_frame(f"{folder}/frame.exr").samples)
        8.0
    """
    write_parts(os.fspath(path), own.to_parts(frame, provenance or {}, half))


def write_image(
    path: str | os.PathLike,
    image: ArrayLike,
    *,
    provenance: dict[str, Any] | None = None,
) -> None:
    """Write one RGB image that every viewer reads.

    Args:
        path: the file; replaced atomically if it exists.
        image: linear radiance, shape [H,W,3].
        provenance: where it came from; anything that JSON can hold.

    Returns:
        nothing.

    Raises:
        OSError: if the file cannot be written; nothing at `path` has changed.
        ValueError: if the shape is not [H,W,3].

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_image(f"{folder}/image.exr", np.full((2, 2, 3), 0.5))
        ...     print(read_image(f"{folder}/image.exr")[0, 0])
        [0.5 0.5 0.5]
    """
    array = np.asarray(image, np.float32)
    if array.ndim != 3 or array.shape[2] != 3 or array.size == 0:
        raise ValueError(f"image must have shape [H,W,3], got {array.shape}")
    write_frame(path, make_frame(array), provenance=provenance)


def read_provenance(path: str | os.PathLike) -> dict[str, Any]:
    """Where a file that jscomb wrote came from.

    Args:
        path: an EXR file.

    Returns:
        what `write_frame` or `write_image` was given; empty for another writer.

    Raises:
        FileNotFoundError: if there is nothing at `path`.
        ValueError: if it is not an EXR file.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     file = f"{folder}/image.exr"
        ...     write_image(file, np.ones((2, 2, 3)), provenance={"window": 7})
        ...     print(read_provenance(file))
        {'window': 7}
    """
    parts = read_parts(os.fspath(path), header_only=True)
    return own.provenance(parts)
