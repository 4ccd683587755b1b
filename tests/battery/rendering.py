"""A frame's images as one tree of arrays, what functions are tried and timed on."""

from collections.abc import Callable
from typing import NamedTuple, Self, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from jscomb.denoisers import smoothing
from jscomb.features import select, stack
from jscomb.frame import Estimate, Frame, make_frame
from jscomb.methods import METHODS
from jscomb.typing import Image, Scalar, Variance

Tree = TypeVar("Tree")

UNTRAINED = "james-stein", "whitened"
"""Combiners of one estimate without a network."""


def of_images(method: str) -> Callable[[Image, Image, Variance], Image]:
    """A method as a function of images, for `jit` and derivatives.

    Args:
        method: a pure one of one estimate.

    Returns:
        the function of x, y and the variance of the mean x, [H,W,C] each.
    """
    key = jax.random.key(0)
    return lambda x, y, v: METHODS[method].image(
        key, make_frame(x, variance=v), Estimate(y)
    )


class Rendering(NamedTuple):
    """What the functions are given.

    Attributes:
        unbiased_a: x of half a, radiance, [H,W,3].
        unbiased_b: of half b.
        biased_a: y of half a, likewise.
        biased_b: of half b.
        variance: of the mean x of both halves, squared radiance, likewise.
        features: of a range of about one, [H,W,F].
        unit: a radiance typical of the frame. All that depends on the whole frame is
            made of it, so that most functions are local.
    """

    unbiased_a: Image
    unbiased_b: Image
    biased_a: Image
    biased_b: Image
    variance: Variance
    features: Image
    unit: Scalar

    @property
    def unbiased(self) -> Image:
        """x, the mean of both halves."""
        return (self.unbiased_a + self.unbiased_b) / 2

    @property
    def biased(self) -> Image:
        """y, likewise."""
        return (self.biased_a + self.biased_b) / 2

    @property
    def grey(self) -> Variance:
        """The variance's mean over channels, [H,W,1]."""
        return jnp.mean(self.variance, axis=-1, keepdims=True)

    def scaled(self, scale: Scalar) -> Self:
        """In another unit of radiance."""
        images = [scale * image for image in self[:4]]
        square = scale * scale * self.variance
        return type(self)(*images, square, self.features, scale * self.unit)


def rendering_of(frame: Frame, *, name: str = "oidn") -> Rendering:
    """A frame's images.

    Args:
        frame: with halves, variance and a biased image with halves.
        name: of the biased image.

    Returns:
        them; only such features as tell something.
    """
    a, b = frame.halves()
    features = stack(frame)
    features = select([features]).of(features)
    biased = a.estimates[name].image, b.estimates[name].image
    images = a.color, b.color, *biased, frame.variance, features
    return Rendering(*images, frame.median_luminance)


def mirrored(images: Tree, size: int) -> Tree:
    """Images of `size` x `size` pixels.

    Args:
        images: a tree of arrays, of at most as many pixels, [...,H,W,C]; what has fewer
            axes stays as it is.
        size: in pixels.

    Returns:
        the tree, its images mirrored at their borders again and again.
    """

    def grown(image: jax.Array) -> jax.Array:
        if image.ndim < 3:
            return image
        height, width = image.shape[-3:-1]
        ends = [(0, 0)] * (image.ndim - 3)
        ends += [(0, size - height), (0, size - width), (0, 0)]
        return jnp.asarray(np.pad(image, ends, mode="symmetric"))

    return jax.tree.map(grown, images)


def bases(r: Rendering) -> tuple[jax.Array, jax.Array]:
    """Three biased images of each half; one is the unbiased image.

    Args:
        r: of two halves.

    Returns:
        both stacks, [3,H,W,3].
    """
    of = lambda x, y: jnp.stack([y, smoothing.box(x, window=3), x])
    return of(r.unbiased_a, r.biased_a), of(r.unbiased_b, r.biased_b)


def sub_averages(r: Rendering, count: int) -> tuple[jax.Array, jax.Array]:
    """Independent and correlated ones.

    Args:
        r: of two halves.
        count: how many, up to four; the last two are mixed of the others.

    Returns:
        both stacks, [B,H,W,3].
    """
    mixed = lambda a, b: [a, b, (3 * a + b) / 4, (a + 3 * b) / 4][:count]
    return (
        jnp.stack(mixed(r.unbiased_a, r.unbiased_b)),
        jnp.stack(mixed(r.biased_a, r.biased_b)),
    )
