"""Pairs of sub-averages, checked, and made safe where a pixel is invalid."""

from typing import NamedTuple

import jax.numpy as jnp
from jax.core import Tracer
from jaxtyping import Array, Float, Real

from jscomb.numerics.guards import check_same_shape, finite, first_finite
from jscomb.typing import Image, Mask

SubAverages = Float[Array, "b h w c"]
Samples = Real[Array, ""] | float | int


class Pairs(NamedTuple):
    """Sub-averages y^j and z^j, finite everywhere.

    Attributes:
        y: independent estimates, 0 where not valid, [B,H,W,C].
        z: correlated estimates, likewise.
        valid: pixels that are finite in all of them, [H,W,1].
        instead: what stands where a pixel is not valid: the first finite of the mean
            y, of y^1, ..., and the same of z, else 0; [H,W,C].
    """

    y: SubAverages
    z: SubAverages
    valid: Mask
    instead: Image

    def some(self, which: slice) -> "Pairs":
        """Only these pairs, valid where all are."""
        return self._replace(y=self.y[which], z=self.z[which])

    @property
    def mean(self) -> Image:
        """The mean y."""
        return mean(self.y)

    @property
    def excess(self) -> Image:
        """The mean z less the mean y."""
        return mean(self.z) - mean(self.y)


def make_pairs(
    independent: SubAverages, correlated: SubAverages, *, count: int | None = None
) -> Pairs:
    """Check sub-averages and put those of one pixel together.

    Args:
        independent: y^1, ..., y^B, linear radiance, shape [B,H,W,C].
        correlated: z^1, ..., z^B, linear radiance, shape [B,H,W,C].
        count: what B must be; None for any.

    Returns:
        the pairs.

    Raises:
        ValueError: names the argument, its shape and what was expected.
    """
    for name, images in (("independent", independent), ("correlated", correlated)):
        if images.ndim != 4 or images.shape[0] != (count or images.shape[0] or 1):
            wanted = f"{count or ''} sub-averages, shape [{count or 'B'},H,W,C]"
            raise ValueError(f"{name} must be {wanted.strip()}; got {images.shape}")
    check_same_shape(independent=independent[0], correlated=correlated[0])
    if independent.shape != correlated.shape:
        raise ValueError(
            f"correlated has shape {correlated.shape}, independent has "
            f"{independent.shape}"
        )
    valid = finite(*independent, *correlated)
    y, z = (jnp.where(valid, images, 0.0) for images in (independent, correlated))
    instead = first_finite(
        mean(independent), *independent, mean(correlated), *correlated
    )
    return Pairs(y, z, valid, instead)


def mean(images: SubAverages) -> Image:
    """Mean of sub-averages, image by image.

    Args:
        images: shape [B,H,W,C].

    Returns:
        shape [H,W,C].
    """
    return sum(images[1:], start=images[0]) / images.shape[0]


def check_samples(samples: Samples) -> None:
    """Raise if less than one sample; while tracing nothing is known, nothing raised.

    Args:
        samples: n, samples a pixel in each sub-average.

    Returns:
        nothing.

    Raises:
        ValueError: says what was got.
    """
    if not isinstance(samples, Tracer) and not samples >= 1:
        raise ValueError(f"samples must be at least 1, got {samples}")
