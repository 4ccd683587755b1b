"""The mixing of minimum error and its risk, from SURE, and noise between channels."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jscomb.numerics.guards import check_same_shape, divide, zero_invalid
from jscomb.numerics.linear import channel_sum
from jscomb.numerics.windows import window_sum
from jscomb.typing import Image, Variance

# What one pixel may weigh, times the rounding error: finite however small its variance.
_MAXIMUM_EVIDENCE = 1e4

MIXING_WINDOW = 15  # width of the windows in pixels


def mixing(
    unbiased: Image,
    biased: Image,
    variance: Variance,
    sure: Image,
    *,
    window: int = MIXING_WINDOW,
    whiten: bool = False,
) -> Image:
    """Return the mixing of minimum estimated error over windows.

    Args:
        unbiased: x, linear radiance, shape [H,W,C].
        biased: y, linear radiance, shape [H,W,C].
        variance: v, squared radiance, at least zero, shape [H,W,C].
        sure: s, squared radiance, of either sign, shape [H,W,C].
        window: width of the windows in pixels, odd.
        whiten: divide by each pixel's own variance, so that the noisiest do not
            dominate the window; excludes pixels of variance 0. Needs a robust variance
            (`numerics.variances.robust_variance`), in `sure` as well.

    Returns:
        alpha, in [0, 1], shape [H,W,C]; 1 where x and y agree in the whole window.

    Raises:
        ValueError: while tracing, if shapes differ or `window` is even.

    Example:
        >>> at = lambda value: jnp.full((3, 3, 1), value)
        >>> print(mixing(at(3.0), at(1.0), at(1.0), at(2.0))[0, 0])
        [0.375]

    Source: PD eq. 9, 10, summed over windows and channels alike.
    """
    check_same_shape(unbiased=unbiased, biased=biased, variance=variance, sure=sure)
    _, *images = zero_invalid(unbiased, biased, variance, sure)
    return mixing_of_valid(*images, window=window, whiten=whiten)


def mixing_of_valid(
    x: Image,
    y: Image,
    v: Variance,
    s: Image,
    *,
    window: int = MIXING_WINDOW,
    whiten: bool = False,
) -> Image:
    """`mixing` of images that are 0 at invalid pixels."""
    square, saved = jnp.square(y - x), v - s
    if whiten:
        maximum = _MAXIMUM_EVIDENCE / float(jnp.finfo(v.dtype).eps)
        unit = jnp.maximum(v, jnp.maximum(square, jnp.abs(saved)) / maximum)
        square, saved = (divide(i, unit, where=v > 0) for i in (square, saved))
    square = window_sum(square, window)
    gain = window_sum(saved, window) + square
    ratio = divide(gain, 2 * square, where=square > 0, otherwise=1.0)
    return jnp.clip(ratio, 0.0, 1.0)


def risk(
    mixing: Image, unbiased: Image, biased: Image, variance: Variance, sure: Image
) -> Image:
    """Estimate the squared error of the mixed image.

    For a mixing that does not follow the noise; for one that does it is too small.

    Args:
        mixing: alpha, in [0, 1], shape [H,W,C].
        unbiased: x, linear radiance, shape [H,W,C].
        biased: y, linear radiance, shape [H,W,C].
        variance: v, squared radiance, at least zero, shape [H,W,C].
        sure: s, squared radiance, of either sign, shape [H,W,C].

    Returns:
        the estimate at each element, squared radiance, noisy, of either sign, shape
        [H,W,C]; average before use. 0 at invalid pixels.

    Raises:
        ValueError: while tracing, if shapes differ.

    Example:
        >>> at = lambda value: jnp.full((1, 1, 1), value)
        >>> for alpha in (0.0, 0.375, 1.0):  # x alone, the best mixing, y alone
        ...     print(risk(at(alpha), at(3.0), at(1.0), at(1.0), at(2.0))[0, 0])
        [1.]
        [0.4375]
        [2.]

    Source: PD eq. 8.
    """
    check_same_shape(mixing=mixing, unbiased=unbiased, biased=biased)
    check_same_shape(mixing=mixing, variance=variance, sure=sure)
    _, alpha, x, y, v, s = zero_invalid(mixing, unbiased, biased, variance, sure)
    divergence = (s - jnp.square(y - x) + v) / 2
    beta = 1 - alpha
    return beta**2 * v + alpha**2 * s + 2 * alpha * beta * divergence


def channel_variance(
    half_a: Image, half_b: Image, variance: Variance, *, window: int = 15
) -> Float[Array, "h w 1"]:
    """Estimate the variance of the channels' mean, by how alike the channels' noise is.

    A path is bright in all channels at once, so their noise is correlated, and the mean
    of C channels has up to C times the variance that it had if they were independent.
    The factor is estimated from the difference d of the halves, over windows:
    sum((sum_c d_c)^2 / v) / sum(sum_c d_c^2 / v), which is from 0 to C.

    Args:
        half_a: x of half a, linear radiance, shape [H,W,C].
        half_b: x of half b, same shape.
        variance: v of the mean x, squared radiance, at least zero, shape [H,W,C].
        window: width of the windows in pixels, odd.

    Returns:
        the variance, squared radiance, shape [H,W,1]; 0 at invalid pixels.

    Raises:
        ValueError: while tracing, if shapes differ or `window` is even.

    Example:
        >>> grey, v = jnp.ones((2, 2, 3)), jnp.full((2, 2, 3), 0.03)
        >>> print(channel_variance(grey, -grey, v)[0, 0].round(3))  # one noise for all
        [0.03]

    Source: PD section 4.2 takes the channels as independent, a third of this one.
    """
    check_same_shape(half_a=half_a, half_b=half_b, variance=variance)
    valid, a, b, v = zero_invalid(half_a, half_b, variance)
    d = a - b
    energy, total = channel_sum(jnp.square(d)), channel_sum(v)
    # Relative to the variance, so that bright pixels do not decide for their windows.
    alike, each = (
        window_sum(divide(e, total, where=total > 0), window)
        for e in (jnp.square(channel_sum(d)), energy)
    )
    # Where the halves are equal nothing is known, and the most is assumed.
    c = float(d.shape[-1])
    factor = divide(alike, each, where=each > 0, otherwise=c)
    return jnp.where(valid, factor * total / c**2, 0.0)
