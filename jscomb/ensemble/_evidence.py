"""What one half of a frame says of bases made from the other."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from jscomb.numerics.guards import (
    check_same_shape,
    masked_mean,
    weighted_ratio,
    zero_invalid,
)
from jscomb.numerics.medians import median_of
from jscomb.numerics.variances import relative_precision
from jscomb.numerics.windows import block_sum, window_sum
from jscomb.typing import Image, Mask, Variance

Bases = Float[Array, "n h w c"]
Matrix = Float[Array, "n n rows columns _"]
Packed = Float[Array, "rows columns _"]  # upper triangles of matrices
Count = Float[Array, "rows columns 1"]

# Added to squared radiances, of the frame's mean squared: limits black pixels.
_FLOOR = 0.01


class Evidence(NamedTuple):
    """Upper triangles of <M> from each half, relative to the radiance, of blocks.

    In excess of the plain average's error, so that the noise of x, which is common to
    all elements, does not dominate.

    Attributes:
        a: of <M>^a, mean over each block, [H/B,W/B,P*C] with P pairs; without unit.
        b: of <M>^b, same shape.
        pixels: how many of each block are finite in all images, [H/B,W/B,1].
    """

    a: Packed
    b: Packed
    pixels: Count


def evidence_of(
    biased_a: Bases,
    biased_b: Bases,
    unbiased_a: Image,
    unbiased_b: Image,
    variance_a: Variance | None = None,
    variance_b: Variance | None = None,
    *,
    shared: bool,
    block: int = 1,
) -> Evidence:
    """Estimate <M>^a and <M>^b in every block, relative to its radiance.

    Channels are averaged if `shared`; 0 in blocks without a valid pixel.
    """
    rows, columns = np.triu_indices(len(biased_a))
    images = biased_a, biased_b, unbiased_a, unbiased_b
    valid, y_a, y_b, x_a, x_b = zero_invalid(*images)
    # The median: one base may spread the glow of a light far beyond it.
    typical = (median_of(y_a) + median_of(y_b)) / 2
    bright = jnp.mean(typical, axis=-1, keepdims=True)
    scale = jnp.square(bright) + _FLOOR * jnp.square(masked_mean(bright, valid))
    count = block_sum(valid.astype(scale.dtype), block)

    def one(y: Bases, truth: Image, variance: Variance | None) -> Packed:
        weight = _weight(scale, variance, valid)
        mean = jnp.mean(y, axis=0)
        e, excess = y - mean[None], mean - truth

        @jax.checkpoint  # or the images of every pair are kept for derivatives
        def element(pair: tuple[Array, Array]) -> Packed:
            e_i, e_j = e[pair[0]], e[pair[1]]
            both = e_i * e_j + (e_i + e_j) * excess
            if shared:
                both = jnp.mean(both, axis=-1, keepdims=True)
            return block_sum(weight * both, block)

        sums = lax.map(element, (rows, columns))  # no pair's images at once
        packed = jnp.moveaxis(sums, 0, 2).reshape(*count.shape[:2], -1)
        return weighted_ratio(packed, count)

    return Evidence(one(y_a, x_b, variance_b), one(y_b, x_a, variance_a), count)


def _weight(
    scale: Float[Array, "h w 1"], variance: Variance | None, valid: Mask
) -> Float[Array, "h w 1"]:
    """Of a pixel, the inverse of its squared radiance and of its noise around it.

    Its noise is that of the half that stands for the truth: where a firefly makes that
    noisy it says little of any base. The other half's noise must not matter: a firefly
    that a base lets through would hide there.
    """
    if variance is None:
        return relative_precision(scale, None, valid)
    _, clean = zero_invalid(variance)
    return relative_precision(scale, jnp.mean(clean, axis=-1, keepdims=True), valid)


def pooled(values: Packed, count: Count, window: int | None) -> Packed:
    """Means over windows of blocks, or over all of them, weighted by their pixels."""
    if window is not None:
        total, weight = (window_sum(i, window) for i in (values * count, count))
        return weighted_ratio(total, weight)
    total, weight = (
        jnp.sum(i, axis=(0, 1), keepdims=True) for i in (values * count, count)
    )
    return jnp.broadcast_to(weighted_ratio(total, weight), values.shape)


def unpacked(upper: Packed, n: int) -> Matrix:
    """Symmetric matrices [N,N,H,W,C] from their upper triangles."""
    place = np.zeros((n, n), int)
    place[np.triu_indices(n)] = np.arange(n * (n + 1) // 2)
    pairs = jnp.moveaxis(upper.reshape(*upper.shape[:2], n * (n + 1) // 2, -1), 2, 0)
    return pairs[np.maximum(place, place.T)]


def check_bases(biased_a: Bases, biased_b: Bases, x_a: Image, x_b: Image) -> None:
    """Raise unless there is a base and all images have one shape."""
    check_same_shape(unbiased_a=x_a, unbiased_b=x_b)
    for name, bases in {"biased_a": biased_a, "biased_b": biased_b}.items():
        if bases.ndim != 4 or len(bases) == 0:
            raise ValueError(
                f"{name} must be [N,H,W,C] with at least one base, got {bases.shape}"
            )
        if bases.shape[1:] != x_a.shape or len(bases) != len(biased_a):
            raise ValueError(
                f"{name} has shape {bases.shape}, expected "
                f"{(len(biased_a), *x_a.shape)}: unbiased_a has {x_a.shape}"
            )
