"""The two shrinkages."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from jscomb.numerics.guards import (
    check_not_negative,
    check_same_shape,
    divide,
    finite,
    first_finite,
)
from jscomb.typing import Image

Errors = Float[Array, "h w _"]


class Factors(NamedTuple):
    """Shares, in [0, 1].

    Attributes:
        biased: k1, share of the biased image in the first blend, [H,W,*].
        prior: k2, share of the prior in the result, [H,W,*].
        error: s, expected squared error of the first blend, squared radiance, [H,W,*].
    """

    biased: Errors
    prior: Errors
    error: Errors

    def blend(self, unbiased: Image, biased: Image) -> Image:
        """x1, of least error without the prior, [H,W,C]."""
        return self.biased * biased + (1 - self.biased) * unbiased


def factors(variance: Errors, mse: Errors, confidence: Errors) -> Factors:
    """The shares of least expected error.

    Pure, and differentiable in every array. An error of zero takes all: first the
    unbiased image's, then the biased one's, then the prior's.

    Args:
        variance: v of the unbiased image, squared radiance, at least zero, shape
            [H,W,1] or [H,W,C].
        mse: m, mean squared error of the biased image, likewise.
        confidence: eta^2, squared radiance, at least zero, likewise.

    Returns:
        the shares, of the broadcast shape.

    Raises:
        ValueError: if an error is known to be negative.

    Example:
        >>> one = jnp.ones((1, 1, 1))
        >>> found = factors(one, 3 * one, 0.25 * one)
        >>> print(found.biased.item(), found.prior.item())
        0.25 0.75

    Source: DSC eq. 10.
    """
    check_not_negative(variance=variance, mse=mse, confidence=confidence)
    v, m, eta = jnp.broadcast_arrays(variance, mse, confidence)
    biased = divide(v, v + m, where=v + m > 0)
    # Not v m / (v + m), whose product leaves float32 for dark images.
    error = v * divide(m, v + m, where=v + m > 0)
    prior = divide(error, error + eta, where=error + eta > 0)
    return Factors(biased, prior, error)


def combine(
    prior: Image,
    unbiased: Image,
    biased: Image,
    variance: Errors,
    mse: Errors,
    confidence: Errors,
) -> Image:
    """Blend two integrators, and the result with a prior, each as its error allows.

    Pure, scale-equivariant, and differentiable in every array.

    Args:
        prior: p, linear radiance, shape [H,W,C].
        unbiased: u, linear radiance, shape [H,W,C].
        biased: b, linear radiance, shape [H,W,C].
        variance: v of the mean u, squared radiance, at least zero, shape [H,W,1] or
            [H,W,C].
        mse: m, mean squared error of b, likewise.
        confidence: eta^2, squared radiance, likewise; 0 gives the prior, infinity the
            inverse-error blend of u and b.

    Returns:
        the blend, linear radiance, shape [H,W,C]; at an invalid pixel the first finite
        of (b, u), else 0.

    Raises:
        ValueError: if shapes differ or an error is known to be negative.

    Example:
        >>> at = lambda value: jnp.full((1, 1, 1), value)
        >>> x = combine(at(0.0), at(4.0), at(8.0), at(1.0), at(3.0), at(0.25))
        >>> print(float(x[0, 0, 0]))
        1.25

    Source: DSC eq. 9.
    """
    check_same_shape(unbiased=unbiased, biased=biased, prior=prior)
    named = {"variance": variance, "mse": mse, "confidence": confidence}
    shapes = [(*unbiased.shape[:2], c) for c in (1, unbiased.shape[2])]
    for name, errors in named.items():
        if getattr(errors, "shape", None) not in shapes:
            got = getattr(errors, "shape", errors)
            raise ValueError(
                f"{name} must have shape {shapes[0]} or {shapes[1]}: {got}"
            )
    endless = jnp.isposinf(confidence)  # no prior at all
    known = jnp.where(endless, 0.0, confidence)
    valid = finite(prior, unbiased, biased, variance, mse, known)
    p, u, b, v, m, eta = (
        jnp.where(valid, image, 0.0)
        for image in (prior, unbiased, biased, variance, mse, known)
    )
    share = factors(v, m, eta)
    k2 = jnp.where(endless, 0.0, share.prior)
    image = k2 * p + (1 - k2) * share.blend(u, b)
    return jnp.where(valid, image, first_finite(biased, unbiased))
