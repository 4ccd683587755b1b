"""What all dialects share: options of reading, and images from channels."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jscomb.exr._files import MAX_BYTES, Part, read_parts, stack
from jscomb.frame import Estimate

Arguments = dict[str, Any]  # of make_frame


class Options(NamedTuple):
    """Options of reading a file.

    Attributes:
        samples: samples a pixel, overrides the file's; None if not given.
        statistics: read variances.
        max_bytes: memory that the pixels of one file may take.
    """

    samples: int | None = None
    statistics: bool = True
    max_bytes: int = MAX_BYTES


def single(path: str, options: Options) -> Part:
    """Return the first part of a file; other programs write only one."""
    return read_parts(path, max_bytes=options.max_bytes)[0]


def rgb(part: Part, layer: str) -> np.ndarray:
    """Return R, G, B of a layer, or Y three times, [H,W,3]; raise if missing."""
    image = stack(part, layer, "RGB")
    if image is None:
        grey = stack(part, layer, "Y")
        if grey is None:
            prefix = f"{layer}." if layer else ""
            listed = ", ".join(sorted(part.channels)[:12])
            raise ValueError(f"channels {prefix}R, G, B are missing among {listed}")
        image = np.repeat(grey, 3, axis=-1)
    return image


def any_image(part: Part, layer: str) -> np.ndarray:
    """Return a layer of any suffixes as three channels, [H,W,3]; raise if missing."""
    for suffixes in ("RGB", "XYZ"):
        image = stack(part, layer, suffixes)
        if image is not None:
            return image
    for suffix in "YZVTR":
        image = stack(part, layer, suffix)
        if image is not None:
            return np.repeat(image, 3, axis=-1)
    return rgb(part, layer)  # raises


def estimate(image: np.ndarray, halves: np.ndarray | None) -> Estimate:
    """Return an estimate of JAX arrays, [H,W,3] and [2,H,W,3]."""
    return Estimate(jnp.asarray(image), None if halves is None else jnp.asarray(halves))


def clipped(albedo: np.ndarray | None) -> np.ndarray | None:
    """Return an optional albedo, clipped to [0, 1]."""
    return None if albedo is None else np.clip(albedo, 0, 1)


def finite_depth(depth: np.ndarray) -> np.ndarray:
    """Return depths with 0 for an infinite background."""
    return np.where(np.isinf(depth), 0, depth)


def variance_of_mean(
    deviation: np.ndarray, samples: int | None, stored: str
) -> np.ndarray:
    """Return the variance of the mean from the mean squared deviation of samples.

    `stored` names in the error what the file stores of single samples.
    """
    if samples is None:
        raise ValueError(
            f"it stores {stored} of single samples but not their number: give the "
            "samples a pixel"
        )
    if samples < 2:
        raise ValueError(f"a variance needs at least two samples, got {samples}")
    return np.maximum(deviation, 0) / (samples - 1)
