"""The error of a combination and its map, estimated from half buffers."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from jscomb.metrics._errors import grey_square, mean
from jscomb.numerics.guards import (
    check_same_shape,
    divide,
    safe_sqrt,
    zero_invalid,
)
from jscomb.numerics.linear import channel_mean
from jscomb.numerics.windows import block_sum, window_mean
from jscomb.typing import Image, Scalar

_WINDOW, _SIGMA = 19, 3.0  # of the maps, in pixels
_BLOCK = 8  # pixels whose evidence may be correlated


class ErrorEstimate(NamedTuple):
    """An estimated relative L2, without a reference.

    Attributes:
        map: relative squared error around each pixel, at least zero, [H,W,1].
        mean: over the frame, shape []; slightly negative if it drowns in noise.
        standard_error: of `mean`, shape [].
    """

    map: Float[Array, "h w 1"]
    mean: Scalar
    standard_error: Scalar


def estimate_error(
    image: Image,
    halves: Float[Array, "2 h w c"],
    unbiased: Float[Array, "2 h w c"],
    spread: Image,
    *,
    epsilon: float = 0.01,
) -> ErrorEstimate:
    """Estimate the relative L2 of a combination, and where in the frame it is.

    With z the combination, z_a and z_b the same made from each half and x_a, x_b the
    halves themselves,

        e = [(z_a - x_b)^2 + (z_b - x_a)^2 - (x_a - x_b)^2] / 2 - (z_a - z_b)^2 / 4

    has the expectation of z's squared error, if z has half the variance of its halves.
    It is linear in a firefly of one half, but of single pixels far too noisy. Where an
    image is wrong its bases differ, and so do its halves: the map is
    `spread + (z_a - z_b)^2 / 4`, times the factor that fits e best over the frame, by
    least squares weighted by the noise of x.

    Args:
        image: z, linear radiance, shape [H,W,C].
        halves: z_a and z_b, shape [2,H,W,C].
        unbiased: x_a and x_b, shape [2,H,W,C].
        spread: weighted variance of the bases of z, squared radiance, shape [H,W,C].
        epsilon: squared radiance that limits the weight of black pixels.

    Returns:
        the error, relative to z's squared radiance. Its standard error is that of
        independent blocks of 8x8 pixels; an error that spread and halves do not show
        is not in it.

    Raises:
        ValueError: while tracing, if shapes differ.

    Example:
        >>> import jax
        >>> x = 1 + 0.1 * jax.random.normal(jax.random.key(0), (2, 64, 64, 3))
        >>> z = jnp.full((2, 64, 64, 3), 1.1)  # a tenth too bright
        >>> found = estimate_error(z[0], z, x, jnp.full_like(z[0], 1e-4))
        >>> true = 0.01 / (1.1**2 + 0.01)
        >>> print(abs(found.mean / true - 1) < 0.1)
        True

    Source: ours.
    """
    (z_a, z_b), (x_a, x_b) = halves, unbiased
    check_same_shape(image=image, halves=z_a, unbiased=x_a, spread=spread)
    valid, z, z_a, z_b, x_a, x_b, spread = zero_invalid(
        image, z_a, z_b, x_a, x_b, spread
    )
    noise, change = jnp.square(x_a - x_b), jnp.square(z_a - z_b) / 4
    error = (jnp.square(z_a - x_b) + jnp.square(z_b - x_a) - noise) / 2 - change
    weight = grey_square(z) + epsilon
    relative = lambda square: jnp.where(valid, channel_mean(square) / weight, 0.0)
    both = jnp.concatenate([relative(spread + change), relative(noise / 2)], axis=-1)
    around = window_mean(both, _WINDOW, mask=valid, sigma=_SIGMA)
    shape, noise, error = around[..., :1], around[..., 1:], relative(error)
    level = mean(shape, valid)
    square = level + noise
    some = valid & (square > 0)
    trust = divide(jnp.ones_like(square), safe_sqrt(square), where=some)

    total = jnp.sum(trust * jnp.where(valid, shape, 0.0))
    one = lambda a, b: divide(a[None], b[None], where=b[None] > 0)[0]
    factor = one(jnp.sum(trust * error), total)
    residual = jnp.where(valid, trust * (error - factor * shape), 0.0)
    deviation = safe_sqrt(jnp.sum(jnp.square(block_sum(residual, _BLOCK))))
    return ErrorEstimate(
        jnp.maximum(factor, 0.0) * shape, factor * level, one(deviation, total) * level
    )
