"""Error matrices of the bases from half buffers, of pixels and of windows."""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jscomb.numerics.guards import (
    check_same_shape,
    divide,
    masked_mean,
    safe_sqrt,
    zero_invalid,
)
from jscomb.numerics.medians import median_of
from jscomb.numerics.windows import window_mean
from jscomb.typing import Image, Mask

Bases = Float[Array, "n h w c"]
Matrix = Float[Array, "n n h w _"]
Packed = Float[Array, "h w _"]  # upper triangles of matrices

# Added to squared radiances, of the frame's mean squared: limits black pixels.
_FLOOR = 0.01
SCALES = 11, 21, 41, 81


def mse_matrix(
    biased_a: Bases, biased_b: Bases, unbiased_a: Image, unbiased_b: Image
) -> Matrix:
    """Estimate the error matrix of every pixel and channel from the halves.

    Args:
        biased_a: y^a, each base made from half a, radiance, shape [N,H,W,C].
        biased_b: y^b, made from half b.
        unbiased_a: x_a, shape [H,W,C].
        unbiased_b: x_b, same shape.

    Returns:
        `<M>`, squared radiance, shape [N,N,H,W,C].

    Raises:
        ValueError: while tracing, if shapes differ or there is no base.

    Example:
        >>> at = lambda *values: jnp.array(values).reshape(-1, 1, 1, 1)
        >>> y, x = at(1.0, 3.0), at(2.0)[0]
        >>> print(mse_matrix(y, y, x, x)[..., 0, 0, 0])
        [[ 1. -1.]
         [-1.  1.]]

    Source: ED eq. 11, 12.
    """
    check_bases(biased_a, biased_b, unbiased_a, unbiased_b)
    product = unbiased_a * unbiased_b

    def one(y: Bases, truth: Image) -> Matrix:
        pairs = y[:, None] * y[None] - (y[:, None] + y[None]) * truth[None, None]
        return pairs + product[None, None]

    return (one(biased_a, unbiased_b) + one(biased_b, unbiased_a)) / 2


def true_matrix(biased: Float[Array, "s n h w c"], truth: Image) -> Matrix:
    """The error matrix itself, from many renderings of the same frame.

    Args:
        biased: each base of S independent renderings, shape [S,N,H,W,C]; for the matrix
            of halves those of one half.
        truth: the true image, shape [H,W,C].

    Returns:
        M, squared radiance, shape [N,N,H,W,C].

    Example:
        >>> noisy, biased = jnp.array([3.0, 1.0]), jnp.array([3.0, 3.0])
        >>> y = jnp.stack([noisy, biased], axis=1).reshape(2, 2, 1, 1, 1)
        >>> print(true_matrix(y, jnp.full((1, 1, 1), 2.0))[..., 0, 0, 0])
        [[1. 0.]
         [0. 1.]]

    Source: ED eq. 7, 15.
    """
    error = biased - truth[None, None]
    return jnp.mean(error[:, :, None] * error[:, None], axis=0)


def error_matrix(
    biased_a: Bases,
    biased_b: Bases,
    unbiased_a: Image,
    unbiased_b: Image,
    *,
    windows: Sequence[int] = SCALES,
    whole_frame: bool = True,
    shared: bool = True,
) -> Matrix:
    """Estimate the error matrix over windows, as local as the halves agree.

    From the largest scale to the smallest each window's mean is taken as far as both
    halves agree, within the larger window, on how it differs from that:

        share = <d_a . d_b> / <|(d_a + d_b) / 2|^2>,    d = <M>_window - <M>_larger.

    Args:
        biased_a: y^a, each base made from half a, radiance, shape [N,H,W,C].
        biased_b: y^b, made from half b.
        unbiased_a: x_a, shape [H,W,C].
        unbiased_b: x_b, same shape.
        windows: widths in pixels, odd, ascending. One of them without `whole_frame`
            gives the plain mean over that window.
        whole_frame: the frame is the largest scale.
        shared: one matrix for all channels, else one for each.

    Returns:
        `<M>` in excess of the plain average's error and relative to the pixel's
        radiance, without unit, shape [N,N,H,W,1], or [N,N,H,W,C] if not shared. At an
        invalid pixel that of the pixels around it.

    Raises:
        ValueError: while tracing, if shapes differ, there is no base, or no scale.

    Example:
        >>> y = jnp.stack([jnp.full((4, 4, 1), value) for value in (2.1, 3.0)])
        >>> x = jnp.full((4, 4, 1), 2.0)
        >>> matrix = error_matrix(y, y, x, x, windows=[])[..., 0, 0, 0]  # one for all
        >>> print([f"{element:.3f}" for element in matrix.ravel()])
        ['-0.045', '-0.031', '-0.031', '0.106']

    Source: ours, from ED eq. 11, 12.
    """
    check_bases(biased_a, biased_b, unbiased_a, unbiased_b)
    if not windows and not whole_frame:
        raise ValueError("error_matrix needs a window, or the whole frame")
    a, b, valid = evidence_of(biased_a, biased_b, unbiased_a, unbiased_b, shared)
    means = [
        tuple(window_mean(half, window, mask=valid) for half in (a, b))
        for window in windows
    ]
    if whole_frame:
        whole = lambda half: masked_mean(half, valid, per_channel=True)
        means.append(tuple(jnp.broadcast_to(whole(h), h.shape) for h in (a, b)))
    larger_a, larger_b = means[-1]
    kept = (larger_a + larger_b) / 2
    pools = [*windows[1:], None]
    for pool, (a, b) in reversed(
        list(zip(pools, means, strict=False))[: len(means) - 1]
    ):
        share = _agreement(a - larger_a, b - larger_b, pool, valid)
        kept = kept + share * ((a + b) / 2 - kept)
        larger_a, larger_b = a, b
    return unpacked(kept, len(biased_a))


def _agreement(
    a: Packed, b: Packed, pool: int | None, valid: Mask
) -> Float[Array, "h w 1"]:
    """The share of both halves' difference that is not noise, in [0, 1], [H,W,1]."""
    spread = jnp.mean(jnp.square(a) + jnp.square(b), axis=(0, 1), keepdims=True)
    # Each element relative to its spread, or those of a bad base would dominate.
    spread = jnp.broadcast_to(safe_sqrt(spread), a.shape)
    a, b = (divide(i, spread, where=spread > 0) for i in (a, b))
    both = jnp.sum(a * b, axis=-1, keepdims=True)
    square = jnp.sum(jnp.square((a + b) / 2), axis=-1, keepdims=True)
    if pool is None:
        both, square = (
            jnp.broadcast_to(jnp.mean(jnp.where(valid, i, 0.0)), i.shape)
            for i in (both, square)
        )
    else:
        both, square = (window_mean(i, pool, mask=valid) for i in (both, square))
    return jnp.clip(divide(both, square, where=square > 0), 0.0, 1.0)


class Evidence(NamedTuple):
    """Upper triangles of <M> from each half, relative to the radiance.

    In excess of the plain average's error, so that the noise of x, which is common to
    all elements, does not dominate.

    Attributes:
        a: of <M>^a, [H,W,P*C] with P pairs; without unit.
        b: of <M>^b, same shape.
        valid: pixels that are finite in all images, [H,W,1].
    """

    a: Packed
    b: Packed
    valid: Mask


def evidence_of(
    biased_a: Bases,
    biased_b: Bases,
    unbiased_a: Image,
    unbiased_b: Image,
    shared: bool,
) -> Evidence:
    """Estimate <M>^a and <M>^b at every pixel, relative to its radiance.

    Channels are averaged if `shared`; 0 at invalid pixels.
    """
    rows, columns = np.triu_indices(len(biased_a))
    images = biased_a, biased_b, unbiased_a, unbiased_b
    valid, y_a, y_b, x_a, x_b = zero_invalid(*images)
    means = jnp.mean(y_a, axis=0), jnp.mean(y_b, axis=0)
    # The median: one base may spread the glow of a light far beyond it.
    typical = (median_of(y_a) + median_of(y_b)) / 2
    bright = jnp.mean(typical, axis=-1, keepdims=True)
    square = jnp.square(bright) + _FLOOR * jnp.square(masked_mean(bright, valid))
    scale = jnp.broadcast_to(square, x_a.shape)

    def one(y: Bases, mean: Image, truth: Image) -> Packed:
        e = y - mean[None]
        both = e[rows] * e[columns] + (e[rows] + e[columns]) * (mean - truth)[None]
        both = divide(both, jnp.broadcast_to(scale[None], both.shape), where=both != 0)
        if shared:
            both = jnp.mean(both, axis=-1, keepdims=True)
        return jnp.moveaxis(both, 0, 2).reshape(*valid.shape[:2], -1)

    return Evidence(one(y_a, means[0], x_b), one(y_b, means[1], x_a), valid)


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
