"""Write frames and images, atomically."""

import os
from typing import Any

import numpy as np
from jaxtyping import ArrayLike

from jscomb.exr import native
from jscomb.exr._files import write_parts
from jscomb.frame import Frame, make_frame


def write_frame(
    path: str | os.PathLike,
    frame: Frame,
    *,
    provenance: dict[str, Any] | None = None,
    half: tuple[str, ...] = (),
) -> None:
    """Write a frame in jscomb's own format; `read_frame` returns it bit by bit.

    Args:
        path: EXR file; replaced atomically if it exists.
        frame: of at most 26 sub-buffers, float32.
        provenance: where the frame came from; anything that JSON can store.
        half: buffers to store in 16 bits: names of `Buffers` fields, `estimates`,
            `estimate_halves`, `half_difference`. Half the size, but lossy: three
            digits, and values below 6e-8 become 0.

    Returns:
        nothing.

    Raises:
        OSError: if the file cannot be written; `path` is unchanged.
        ValueError: if an estimate has the name of another part (a letter of a
            sub-buffer, `reference`, a name with a dot), or a value is too large for
            16 bits.

    Example:
        >>> import tempfile
        >>> from jscomb import exr
        >>> frame = make_frame(np.ones((2, 4, 4, 3), np.float32), samples=8)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     exr.write_frame(f"{folder}/frame.exr", frame)
        ...     print(exr.read_frame(f"{folder}/frame.exr").samples)
        8.0
    """
    write_parts(os.fspath(path), native.to_parts(frame, provenance or {}, half))


def write_image(
    path: str | os.PathLike,
    image: ArrayLike,
    *,
    error: ArrayLike | None = None,
    provenance: dict[str, Any] | None = None,
) -> None:
    """Write one RGB image that every viewer reads.

    Args:
        path: EXR file; replaced atomically if it exists.
        image: linear radiance, [H,W,3].
        error: its estimated relative squared error, [H,W,1]: the layer error.Y.
        provenance: where the image came from; anything that JSON can store.

    Returns:
        nothing.

    Raises:
        OSError: if the file cannot be written; `path` is unchanged.
        ValueError: if the shapes are not [H,W,3] and [H,W,1].

    Example:
        >>> import tempfile
        >>> from jscomb import exr
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     exr.write_image(f"{folder}/image.exr", np.full((2, 2, 3), 0.5))
        ...     print(exr.read_image(f"{folder}/image.exr")[0, 0])
        [0.5 0.5 0.5]
    """
    array = np.asarray(image, np.float32)
    if array.ndim != 3 or array.shape[2] != 3 or array.size == 0:
        raise ValueError(f"image must have shape [H,W,3], got {array.shape}")
    layers = {} if error is None else {"error": np.asarray(error)}
    for layer in layers.values():
        if layer.shape != (*array.shape[:2], 1):
            raise ValueError(f"error is {layer.shape}, the image {array.shape}")
    parts = native.to_parts(make_frame(array), provenance or {}, layers=layers)
    write_parts(os.fspath(path), parts)
