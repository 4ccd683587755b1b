"""Pairs of sub-averages, checked, with zeros at invalid pixels."""

from typing import Literal, NamedTuple, get_args

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Real

from jscomb.numerics.guards import check_same_shape, first_finite, zero_invalid
from jscomb.typing import Image, Mask

SubAverages = Float[Array, "b h w c"]
Samples = Real[Array, ""] | float | int
Gamma = Float[Array, "*map"] | float
Guides = Literal["correlated", "independent", "both"]


class Pairs(NamedTuple):
    """Sub-averages y^j and z^j, finite everywhere.

    Attributes:
        y: independent estimates, 0 at invalid pixels, [B,H,W,C].
        z: correlated estimates, 0 at invalid pixels, [B,H,W,C].
        valid: pixels that are finite in all of them, [H,W,1].
        instead: replaces the result at invalid pixels: the first finite of the mean y,
            y^1, ..., and the same of z, else 0; [H,W,C].
    """

    y: SubAverages
    z: SubAverages
    valid: Mask
    instead: Image

    def some(self, which: slice) -> "Pairs":
        """Return only these pairs, valid where all are."""
        return self._replace(y=self.y[which], z=self.z[which])

    def guides(self, which: Guides) -> SubAverages:
        """Return the sub-averages whose differences the weights depend on."""
        if which not in get_args(Guides):
            raise ValueError(f"guides must be one of {get_args(Guides)}, got {which!r}")
        if which == "both":
            return jnp.concatenate([self.z, self.y])
        return self.z if which == "correlated" else self.y

    @property
    def mean(self) -> Image:
        """The mean y."""
        return mean(self.y)

    @property
    def excess(self) -> Image:
        """The mean z minus the mean y."""
        return mean(self.z) - mean(self.y)


def make_pairs(
    independent: SubAverages, correlated: SubAverages, *, count: int | None = None
) -> Pairs:
    """Check both stacks of sub-averages and pair them; `count` is B, None for any."""
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
    valid, y, z = zero_invalid(independent, correlated)
    instead = first_finite(
        mean(independent), *independent, mean(correlated), *correlated
    )
    return Pairs(y, z, valid, instead)


def mean(images: SubAverages) -> Image:
    """Mean of sub-averages, [H,W,C]."""
    return sum(images[1:], start=images[0]) / images.shape[0]


def check_samples(samples: Samples) -> None:
    """Raise if there is less than one sample; not checked while tracing."""
    if not isinstance(samples, Tracer) and not samples >= 1:
        raise ValueError(f"samples must be at least 1, got {samples}")


def check_rate(gamma: Gamma, samples: Samples) -> None:
    """Raise if gamma is negative or there is no sample; not checked while tracing."""
    check_samples(samples)
    if not isinstance(gamma, Tracer) and not np.all(np.asarray(gamma) >= 0):
        raise ValueError(f"gamma must be at least zero, got {np.min(gamma)}")
