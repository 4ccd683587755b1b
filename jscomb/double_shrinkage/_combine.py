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


def factors(variance: Errors, mse: Errors, prior_mse: Errors) -> Factors:
    """Return the shares of minimum expected error.

    Differentiable. An image whose error is 0 has a share of 1; among several the
    unbiased one, then the biased one, then the prior. One whose error is infinite has
    none; if all are, the unbiased one has all.

    Args:
        variance: v of the unbiased image, squared radiance, shape [H,W,1] or [H,W,C].
        mse: m of the biased image, same.
        prior_mse: eta^2, mean squared error of the prior, same.

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
    check_not_negative(variance=variance, mse=mse, prior_mse=prior_mse)
    v, m, eta = jnp.broadcast_arrays(variance, mse, prior_mse)
    of_biased, error = _blended(v, m)
    of_prior, _ = _blended(error, eta)
    return Factors(of_biased, of_prior, error)


def _blended(error: Errors, other: Errors) -> tuple[Errors, Errors]:
    """The other image's share of the best blend of two, and the blend's error."""
    lost, useless = jnp.isposinf(error), jnp.isposinf(other)
    e, o = jnp.where(lost, 1.0, error), jnp.where(useless, 1.0, other)
    share = jnp.where(lost, 1.0, weighted_ratio(e, e + o))
    # Not e o / (e + o): that product leaves the range of float32 for dark images.
    blend = jnp.where(lost, other, e * weighted_ratio(o, e + o))
    return jnp.where(useless, 0.0, share), jnp.where(useless, error, blend)


def combine(
    prior: Image,
    unbiased: Image,
    biased: Image,
    variance: Errors,
    mse: Errors,
    prior_mse: Errors,
) -> Image:
    """Blend two integrators, and the result with a prior, weighted by their errors.

    Pure, scale-equivariant, and differentiable in every array.

    Args:
        prior: p, linear radiance, shape [H,W,C].
        unbiased: u, linear radiance, shape [H,W,C].
        biased: b, linear radiance, shape [H,W,C].
        variance: v of the mean u, squared radiance, shape [H,W,1] or [H,W,C].
        mse: m, mean squared error of b, same; infinity gives b no share.
        prior_mse: eta^2, mean squared error of the prior, same; 0 gives the prior,
            infinity the blend of u and b.

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
    named = {"variance": variance, "mse": mse, "prior_mse": prior_mse}
    shapes = [(*unbiased.shape[:2], c) for c in (1, unbiased.shape[2])]
    for name, errors in named.items():
        if getattr(errors, "shape", None) not in shapes:
            got = getattr(errors, "shape", errors)
            raise ValueError(
                f"{name} must have shape {shapes[0]} or {shapes[1]}: {got}"
            )
    known = [jnp.where(jnp.isposinf(e), 0.0, e) for e in named.values()]
    valid, p, u, b, *known = zero_invalid(prior, unbiased, biased, *known)
    pairs = zip(named.values(), known, strict=True)
    share = factors(*(jnp.where(jnp.isposinf(e), e, k) for e, k in pairs))
    image = share.prior * p + (1 - share.prior) * share.blend(u, b)
    return jnp.where(valid, image, first_finite(biased, unbiased))
