"""Error matrices of the bases from half buffers, of pixels and of windows."""

from collections.abc import Sequence

import jax.numpy as jnp
from jaxtyping import Array, Float

from jscomb.ensemble._evidence import (
    Bases,
    Count,
    Matrix,
    Packed,
    check_bases,
    evidence_of,
    pooled,
    unpacked,
)
from jscomb.numerics.guards import check_same_shape, divide, safe_sqrt
from jscomb.typing import Image, Variance

SCALES = 29, 61


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


def selection_errors(
    biased_a: Bases,
    biased_b: Bases,
    unbiased_a: Image,
    unbiased_b: Image,
    variance_a: Variance,
    variance_b: Variance,
) -> Bases:
    """Estimate the error of each base of the full frame, to select one a pixel by.

    MSE[y_i^a] = (y_i^a - x_b)^2 - v_b, and that of half b; of the full frame their mean
    less Var[y_i]. The halves' difference has four times the variance of their mean, so
    that Var[y_i] = (y_i^a - y_i^b)^2 / 4.

    Args:
        biased_a: y^a, each base made from half a, radiance, shape [N,H,W,C].
        biased_b: y^b, made from half b.
        unbiased_a: x_a, shape [H,W,C].
        unbiased_b: x_b, same shape.
        variance_a: of the mean x_a, squared radiance, same shape.
        variance_b: of x_b, same shape.

    Returns:
        the errors, squared radiance, noisy, of either sign, shape [N,H,W,C].

    Raises:
        ValueError: while tracing, if shapes differ or there is no base.

    Example:
        >>> at = lambda *values: jnp.array(values).reshape(-1, 1, 1, 1)
        >>> y_a, y_b, x, v = at(1.0, 3.5), at(2.0, 3.5), at(2.0)[0], at(0.25)[0]
        >>> print(selection_errors(y_a, y_b, x, x, v, v).ravel())
        [0. 2.]

    Source: ED eq. 36, 37.
    """
    check_bases(biased_a, biased_b, unbiased_a, unbiased_b)
    check_same_shape(unbiased_a=unbiased_a, variance_a=variance_a)
    check_same_shape(unbiased_a=unbiased_a, variance_b=variance_b)
    of_a = jnp.square(biased_a - unbiased_b[None]) - variance_b[None]
    of_b = jnp.square(biased_b - unbiased_a[None]) - variance_a[None]
    return (of_a + of_b) / 2 - jnp.square(biased_a - biased_b) / 4


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
    variance_a: Variance | None = None,
    variance_b: Variance | None = None,
    windows: Sequence[int] = SCALES,
    whole_frame: bool = True,
    shared: bool = True,
    block: int = 1,
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
        variance_a: of x_a, squared radiance, same shape: a noisy pixel of the half that
            stands for the truth has less weight, as in weighted least squares. None for
            equal weights.
        variance_b: of x_b, same shape.
        windows: widths in pixels of the windows that are averaged over, odd, ascending.
        whole_frame: also average over the whole frame.
        shared: one matrix for all channels, else one for each.
        block: width B in pixels of the blocks that have one matrix each; windows are
            rounded to odd numbers of blocks.

    Returns:
        `<M>` in excess of the plain average's error and relative to the pixel's
        radiance, without unit, shape [N,N,H/B,W/B,1], rounded up, or [N,N,H/B,W/B,C] if
        not shared. At an invalid pixel that of the pixels around it.

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
    a, b, count = evidence_of(
        *(biased_a, biased_b, unbiased_a, unbiased_b, variance_a, variance_b),
        shared=shared,
        block=block,
    )
    scales: list[int | None] = [2 * round((w / block - 1) / 2) + 1 for w in windows]
    if whole_frame:
        scales.append(None)
    means = [tuple(pooled(half, count, scale) for half in (a, b)) for scale in scales]
    larger_a, larger_b = means[-1]
    kept = (larger_a + larger_b) / 2
    for larger, (a, b) in reversed(list(zip(scales[1:], means[:-1], strict=True))):
        share = _agreement(a - larger_a, b - larger_b, larger, count)
        kept = kept + share * ((a + b) / 2 - kept)
        larger_a, larger_b = a, b
    return unpacked(kept, len(biased_a))


def _agreement(a: Packed, b: Packed, scale: int | None, count: Count) -> Count:
    """The share of both halves' difference that is not noise, in [0, 1], [H,W,1]."""
    # Each element relative to its spread, or those of a bad base would dominate.
    spread = safe_sqrt(pooled(jnp.square(a) + jnp.square(b), count, None))
    a, b = (divide(i, spread, where=spread > 0) for i in (a, b))
    both = jnp.sum(a * b, axis=-1, keepdims=True)
    square = jnp.sum(jnp.square((a + b) / 2), axis=-1, keepdims=True)
    both, square = (pooled(i, count, scale) for i in (both, square))
    return jnp.clip(divide(both, square, where=square > 0), 0.0, 1.0)
