"""Features for regression: those of a frame, without constant and equal ones.

The cost of a regression grows with the square of the number of features. A feature that
is constant over the frame gets a slope of zero, and equal ones share a slope; without
them the result changes by rounding only, if the ridge of a feature is divided by its
number of copies. The selection depends on values, so `select` runs in NumPy, outside of
`jit`.
"""

from collections.abc import Sequence
from types import MappingProxyType
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jscomb.frame import Frame
from jscomb.typing import Image

__all__ = ["FEATURES", "Selection", "scaled_depth", "select", "stack"]

FEATURES = MappingProxyType({"albedo": 3, "normal": 3, "depth": 1})
"""Channels of the features that networks see."""

_ROUNDING = 1e-6  # relative to the largest value, for constants in float32


class Selection(NamedTuple):
    """The channels of a stack of features that a regression needs.

    Attributes:
        channels: their numbers, ascending.
        copies: for each, the number of channels equal to it, itself included.
    """

    channels: tuple[int, ...]
    copies: tuple[int, ...]

    def of(self, features: Float[Array, "h w _"]) -> Float[Array, "h w _"]:
        """Return the selected channels, [H,W,F]."""
        return features[..., np.array(self.channels, int)]

    def ridge(self, ridge: float) -> Float[np.ndarray, " _"]:
        """Return the ridge of each selected channel, [F], divided by its copies."""
        return ridge / np.array(self.copies, np.float32)


def stack(frame: Frame) -> Image:
    """Return the features of a frame as channels of one image.

    Args:
        frame: with any of albedo, normal, depth and visibility.

    Returns:
        the channels of the features that the frame has, in this order, shape [H,W,F], F
        from 0 to 8. Depth is divided by its largest finite value.

    Example:
        >>> from jscomb.frame import make_frame
        >>> one, depth = jnp.ones((1, 2, 1)), jnp.array([2.0, 4.0]).reshape(1, 2, 1)
        >>> print(stack(make_frame(one, depth=depth, visibility=one))[0])
        [[0.5 1. ]
         [1.  1. ]]

    Source: NJS, section 4 (features of the regression).
    """
    albedo, normal, depth, visibility = (
        frame.albedo,
        frame.normal,
        frame.depth,
        frame.visibility,
    )
    if depth is not None:
        depth = scaled_depth(depth)
    given = [f for f in (albedo, normal, depth, visibility) if f is not None]
    height, width, _ = frame.color.shape
    none = jnp.zeros((height, width, 0), frame.color.dtype)
    return jnp.concatenate([none, *given], axis=-1)


def scaled_depth(depth: Float[Array, "h w 1"]) -> Float[Array, "h w 1"]:
    """Return depth in units of its largest finite value.

    Args:
        depth: any unit, shape [H,W,1].

    Returns:
        at most 1, same shape.

    Example:
        >>> print(scaled_depth(jnp.array([[[2.0], [4.0]]])).ravel())
        [0.5 1. ]
    """
    farthest = jnp.max(depth, where=jnp.isfinite(depth), initial=0.0)
    return depth / jnp.where(farthest > 0, farthest, 1.0)


def select(stacks: Sequence[Float[ArrayLike, "h w f"]]) -> Selection:
    """Select the channels that are not constant, missing, or equal to an earlier one.

    Args:
        stacks: the same features of each half, shape [H,W,F] each. A channel is
            constant if it is so in all of them, and missing if it has no finite value
            in one of them. Otherwise pixels that are not finite are ignored.

    Returns:
        the selected channels.

    Example:
        >>> ramp = np.linspace(0, 1, 6).reshape(2, 3)
        >>> print(select([np.stack([ramp, ramp, 0 * ramp, -ramp], axis=-1)]))
        Selection(channels=(0, 3), copies=(2, 1))
    """
    images = np.stack([np.asarray(s) for s in stacks])
    finite = np.isfinite(images)
    present = np.flatnonzero(finite.any(axis=(1, 2)).all(axis=0))
    known = finite[..., present].all(-1, keepdims=True)
    images = np.where(known, images, np.nan)
    count, height, width, all_ = images.shape
    pixels = images.reshape(count, height * width, all_)
    channels: list[int] = []
    copies: list[int] = []
    for number in map(int, present):
        channel = pixels[..., number]
        if _alike(channel, np.nanmax(channel, axis=1, keepdims=True, initial=-np.inf)):
            continue
        for place, other in enumerate(channels):
            if _alike(channel, pixels[..., other]):
                copies[place] += 1
                break
        else:
            channels.append(number)
            copies.append(1)
    return Selection(tuple(channels), tuple(copies))


def _alike(channel: np.ndarray, other: np.ndarray) -> bool:
    """Whether two channels differ only by rounding."""
    largest = np.nanmax(abs(channel), initial=0.0)
    return bool(np.nanmax(abs(channel - other), initial=0.0) <= _ROUNDING * largest)
