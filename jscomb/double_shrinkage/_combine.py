"""The two shrinkages."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from jscomb.numerics.guards import (
    check_not_negative,
    check_same_shape,
    first_finite,
    weighted_ratio,
    zero_invalid,
)
from jscomb.typing import Image

Errors = Float[Array, "h w _"]


class Factors(NamedTuple):
    """Shares of the images, in [0, 1].

    Attributes:
        biased: k1, share of the biased image in the first blend, [H,W,*].
        prior: k2, share of the prior in the result, [H,W,*].
        error: s, expected squared error of the first blend, squared radiance, [H,W,*].
    """

    biased: Errors
    prior: Errors
    error: Errors

    def blend(self, unbiased: Image, biased: Image) -> Image:
        """Return x1, the blend of both integrators without the prior, [H,W,C]."""
        return self.biased * biased + (1 - self.biased) * unbiased


def factors(variance: Errors, mse: Errors, confidence: Errors) -> Factors:
    """Return the shares of minimum expected error.

    Differentiable. An image whose error is 0 has a share of 1; among several the
    unbiased one, then the biased one, then the prior.

    Args:
        variance: v of the unbiased image, squared radiance, shape [H,W,1] or [H,W,C].
        mse: m of the biased image, same.
        confidence: eta^2, same.

    Returns:
        the shares, of the broadcast shape.

    Raises:
        ValueError: if a value is negative; not checked while tracing.

    Example:
        >>> one = jnp.ones((1, 1, 1))
        >>> found = factors(one, 3 * one, 0.25 * one)
        >>> print(found.biased.item(), found.prior.item())
        0.25 0.75

    Source: DSC eq. 10.
    """
    check_not_negative(variance=variance, mse=mse, confidence=confidence)
    v, m, eta = jnp.broadcast_arrays(variance, mse, confidence)
    # Not v m / (v + m): that product leaves the range of float32 for dark images.
    error = v * weighted_ratio(m, v + m)
    return Factors(weighted_ratio(v, v + m), weighted_ratio(error, error + eta), error)


def combine(
    prior: Image,
    unbiased: Image,
    biased: Image,
    variance: Errors,
    mse: Errors,
    confidence: Errors,
) -> Image:
    """Blend two integrators, and the result with a prior, weighted by their errors.

    Pure, scale-equivariant, and differentiable in every array.

    Args:
        prior: p, linear radiance, shape [H,W,C].
        unbiased: u, linear radiance, shape [H,W,C].
        biased: b, linear radiance, shape [H,W,C].
        variance: v of the mean u, squared radiance, shape [H,W,1] or [H,W,C].
        mse: m, mean squared error of b, same.
        confidence: eta^2, same; 0 gives the prior, infinity the blend of u and b.

    Returns:
        the blend, linear radiance, shape [H,W,C]; at an invalid pixel the first finite
        of (b, u), else 0.

    Raises:
        ValueError: if shapes differ, or an error is negative (not checked while
            tracing).

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
    no_prior = jnp.isposinf(confidence)
    known = jnp.where(no_prior, 0.0, confidence)
    valid, p, u, b, v, m, eta = zero_invalid(
        prior, unbiased, biased, variance, mse, known
    )
    share = factors(v, m, eta)
    k2 = jnp.where(no_prior, 0.0, share.prior)
    image = k2 * p + (1 - k2) * share.blend(u, b)
    return jnp.where(valid, image, first_finite(biased, unbiased))
