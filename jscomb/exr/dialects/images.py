"""What all dialects share: how a file is asked for, and images out of its channels."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jscomb.exr.files import MAX_BYTES, Part, read_parts, stack
from jscomb.frame import Estimate

Arguments = dict[str, Any]  # of make_frame


class Asked(NamedTuple):
    """How a file is to be read.

    Attributes:
        samples: samples a pixel; overrides what a file says. None if not given.
        statistics: read variances.
        max_bytes: that the pixels of one file may take in memory.
    """

    samples: int | None = None
    statistics: bool = True
    max_bytes: int = MAX_BYTES


def single(path: str, asked: Asked) -> Part:
    """The first part of a file; other programs' dialects have one.

    Args:
        path: an EXR file.
        asked: how to read it.

    Returns:
        the part.
    """
    return read_parts(path, max_bytes=asked.max_bytes)[0]


def rgb(part: Part, layer: str) -> np.ndarray:
    """R, G, B of a layer; grey from Y.

    Args:
        part: of a file.
        layer: prefix of its channels, may be empty.

    Returns:
        the image, [H,W,3].

    Raises:
        ValueError: if they are missing; names the channels that are there.
    """
    image = stack(part, layer, "RGB")
    if image is None:
        grey = stack(part, layer, "Y")
        if grey is None:
            prefix = f"{layer}." if layer else ""
            listed = ", ".join(sorted(part.channels)[:12])
            raise ValueError(f"channels {prefix}R, G, B are missing; it has {listed}")
        image = np.repeat(grey, 3, axis=-1)
    return image


def any_image(part: Part, layer: str) -> np.ndarray:
    """A layer as three channels, whatever its letters.

    Args:
        part: of a file.
        layer: prefix of its channels, may be empty.

    Returns:
        the image, [H,W,3].

    Raises:
        ValueError: if there is none.
    """
    for suffixes in ("RGB", "XYZ"):
        image = stack(part, layer, suffixes)
        if image is not None:
            return image
    for suffix in "YZVTR":
        image = stack(part, layer, suffix)
        if image is not None:
            return np.repeat(image, 3, axis=-1)
    return rgb(part, layer)  # raises: says what is there


def biased(full: np.ndarray, halves: np.ndarray | None) -> Estimate:
    """A biased image as arrays of JAX.

    Args:
        full: [H,W,3].
        halves: [2,H,W,3] or None.

    Returns:
        the image.
    """
    return Estimate(jnp.asarray(full), None if halves is None else jnp.asarray(halves))


def finite_depth(depth: np.ndarray) -> np.ndarray:
    """Depth with 0 for the infinite background.

    Args:
        depth: any shape.

    Returns:
        likewise.
    """
    return np.where(np.isinf(depth), 0, depth)


def of_the_mean(variance: np.ndarray, samples: int | None, held: str) -> np.ndarray:
    """Variance of the mean from the mean squared deviation of single samples.

    Args:
        variance: mean squared deviation from the mean, squared radiance.
        samples: samples a pixel.
        held: what the file holds, for the error.

    Returns:
        the variance, likewise.

    Raises:
        ValueError: if the number of samples is not known or less than two.
    """
    if samples is None:
        raise ValueError(
            f"it holds {held} of single samples but not their number: give the samples "
            "a pixel"
        )
    if samples < 2:
        raise ValueError(f"a variance needs at least two samples, got {samples}")
    return np.maximum(variance, 0) / (samples - 1)
