"""The James-Stein rule on arrays."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jscomb.numerics.guards import (
    check_same_shape,
    divide,
    finite,
    first_finite,
    repeat_channel,
    zero_invalid,
)
from jscomb.numerics.windows import check_window, reach_of, window_mean, window_sum
from jscomb.typing import Image, Mask, Variance

# Evidence against y that one pixel can give, times the rounding error: finite, yet so
# much that the share of its windows rounds to one, as it must where variance is zero.
_MAXIMUM_EVIDENCE = 1e4


def combine(
    unbiased: Image,
    biased: Image,
    variance: Variance,
    *,
    window: int = 15,
    whiten: bool = False,
    divergence: Image | None = None,
) -> Image:
    """Shrink `unbiased` towards `biased` by the positive-part James-Stein rule.

    Pure, scale-equivariant, and differentiable in every array. Costs one window sum,
    one map and one window mean, and as many images of memory.

    Sample variances of path-traced pixels are too noisy to be used directly: use
    `smooth_variance(variance)` for one variance a window, and
    `robust_variance(variance)` with `window=7, whiten=True`, which measures better.

    Args:
        unbiased: x, linear radiance, shape [H,W,C].
        biased: y, linear radiance, shape [H,W,C].
        variance: of the mean x, squared radiance, shape [H,W,C], at least zero (not
            checked). Without `whiten` the value at c is s2_c, the variance of c's
            window; with it, v_i of each pixel.
        window: width of the windows in pixels, odd, at least three.
        whiten: allow each pixel its own variance within a window.
        divergence: D, the covariance of y with x, squared radiance, shape [H,W,C]:
            `numerics.sure.monte_carlo_sure(...).divergence` of the denoiser that made
            y, with this variance. None: y does not depend on x.

    Returns:
        the combined rendering, linear radiance, shape [H,W,C]; at an invalid pixel
        the first finite of (y, x), else 0.

    Raises:
        ValueError: while tracing, if the shapes differ or `window` is even or < 3.

    Example:
        >>> x, y = jnp.full((4, 4, 1), 3.0), jnp.ones((4, 4, 1))
        >>> print(combine(x, y, jnp.ones_like(x), window=3)[0, 0].round(3))
        [2.674]

    Source: NJS eq. 5, 7, 13; the whitened form and the correction are ours.
    """
    valid, x, y, v = prepare(unbiased, biased, variance, window)
    if divergence is not None:
        check_same_shape(unbiased=unbiased, divergence=divergence)
        divergence = jnp.where(valid & finite(divergence), divergence, 0.0)
    share_of = _whitened_share if whiten else _share
    share = share_of(x - y, v, divergence, valid, window)
    share = window_mean(share, window, mask=valid)
    # As a blend, not y + share (x - y), so that shares of 0 and 1 are exact.
    blend = share * x + (1 - share) * y
    return jnp.where(valid, blend, first_finite(biased, unbiased))


def reach(*, window: int = 15) -> int:
    """Return how many pixels away `combine` sees: windows of shares and their mean.

    Args:
        window: width of the windows in pixels, odd.

    Returns:
        the distance along either axis, in pixels.

    Example:
        >>> print(reach(window=15))
        14
    """
    return reach_of(window, window)


def combine_dual(
    unbiased_a: Image,
    unbiased_b: Image,
    biased_a: Image,
    biased_b: Image,
    variance: Variance,
    *,
    window: int = 15,
    whiten: bool = False,
    share: Float[Array, "h w 1"] | float = 0.5,
) -> Image:
    """Combine each half's x with the other half's y, and blend.

    The biased image of the other half does not depend on this half's noise, as the
    theorem requires; the price is that each half has twice the variance.

    Args:
        unbiased_a: x of half a, linear radiance, shape [H,W,C].
        unbiased_b: x of half b, same shape.
        biased_a: y made from half a, same shape.
        biased_b: y made from half b, same shape.
        variance: of the mean of **both** halves, squared radiance, shape [H,W,C], as
            for `combine`; doubled here.
        window: width of the windows in pixels, odd, at least three.
        whiten: allow each pixel its own variance within a window.
        share: alpha, of the combination of x_a with y_b, in [0, 1]: a number or, of
            each pixel, shape [H,W,1].

    Returns:
        the combined rendering, linear radiance, shape [H,W,C].

    Raises:
        ValueError: while tracing, if the shapes differ or `window` is even or < 3.

    Example:
        >>> x, y = jnp.full((4, 4, 1), 3.0), jnp.ones((4, 4, 1))
        >>> print(combine_dual(x, x, y, y, y / 2, window=3)[0, 0].round(3))
        [2.674]

    Source: NJS table 2.
    """
    a = combine(unbiased_a, biased_b, 2 * variance, window=window, whiten=whiten)
    b = combine(unbiased_b, biased_a, 2 * variance, window=window, whiten=whiten)
    return share * a + (1 - share) * b


def prepare(
    unbiased: Image, biased: Image, variance: Variance, window: int
) -> tuple[Mask, Image, Image, Variance]:
    """Check shapes and window; the valid pixels, and the images with 0 elsewhere."""
    variance = repeat_channel(variance, unbiased)
    check_same_shape(unbiased=unbiased, biased=biased, variance=variance)
    if check_window(window) < 3:
        raise ValueError(f"window must be at least three, got {window}")
    valid, x, y, v = zero_invalid(unbiased, biased, variance)
    return valid, x, y, v


def _share(
    difference: Image,
    s2: Variance,
    divergence: Image | None,
    valid: Mask,
    window: int,
) -> Image:
    """eta_c for one variance a window."""
    energy, count = sum_and_count(jnp.square(difference), valid, window)
    if divergence is None:
        return _positive_part(degrees(count) * s2, energy)
    return _positive_part(count * s2 - window_sum(divergence, window), energy)


def _whitened_share(
    difference: Image,
    v: Variance,
    divergence: Image | None,
    valid: Mask,
    window: int,
) -> Image:
    """eta_c with each pixel measured in units of its own variance."""
    square = jnp.square(difference)
    # A sample variance of exactly 0 means that all samples missed the light, not that
    # the pixel is certain: one such pixel would make all its windows keep x.
    counted = valid & (v > 0)
    maximum = _MAXIMUM_EVIDENCE / float(jnp.finfo(v.dtype).eps)
    evidence = divide(square, v, where=v * maximum > square, otherwise=maximum)
    evidence = jnp.where(counted, evidence, 0.0)
    energy, count = sum_and_count(evidence, counted, window)
    if divergence is None:
        return _positive_part(degrees(count), energy)
    shared = divide(divergence, v, where=counted & (v * maximum > jnp.abs(divergence)))
    return _positive_part(count - window_sum(shared, window), energy)


def sum_and_count(
    image: Image, counted: Bool[Array, "h w _"], window: int
) -> tuple[Image, Image]:
    """Window sums of an image and of the pixels that count, both [H,W,C]."""
    count = window_sum(counted.astype(image.dtype), window)
    return window_sum(image, window), jnp.broadcast_to(count, image.shape)


def degrees(count: Float[Array, "h w c"]) -> Image:
    """The p - 2 degrees of freedom that shrinkage uses; none below three pixels."""
    return jnp.maximum(count - 2, 0.0)


def _positive_part(noise: Image, energy: Image) -> Image:
    """(1 - noise / energy)+, and 1 where there is no noise to remove."""
    noise = jnp.maximum(noise, 0.0)
    all_lost = jnp.where(noise > 0, 1.0, jnp.zeros_like(noise))
    return 1 - divide(noise, energy, where=energy > noise, otherwise=all_lost)
