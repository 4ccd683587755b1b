"""Variance of heavy-tailed noise, pooled over windows.

Layout: images [H,W,C]; a variance is that of a mean, in its unit squared.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jscomb.numerics.guards import check_same_shape, finite
from jscomb.numerics.windows import weighted_mean, window_mean
from jscomb.typing import Variance


def smooth_variance(
    variance: Variance,
    *,
    window: int = 15,
    sigma: float | None = None,
    weights: Float[Array, "h w window2"] | None = None,
) -> Variance:
    """Pool sample variances over a window: equal, Gaussian or given weights.

    Sample variances of path-traced pixels are as heavy-tailed as the pixels: one that
    missed a rare bright path looks certain. Pooling is what makes them usable.

    Args:
        variance: sample variance of the mean, squared radiance, shape [H,W,C].
        window: width of the window in pixels, odd.
        sigma: standard deviation in pixels of Gaussian weights.
        weights: weights of each pixel's window, at least zero, shape [H,W,window²],
            row-major over the offsets; shared by the channels (a network's output).

    Returns:
        the pooled variance, shape [H,W,C]. Values that are not finite take no part;
        where nothing does, the result is 0.

    Raises:
        ValueError: if both `sigma` and `weights` are given, if `window` is even or
            `sigma` not positive, or if the weights have another shape.

    Example:
        >>> import jax.numpy as jnp
        >>> print(smooth_variance(jnp.eye(3)[..., None], window=3)[1, 1].round(3))
        [0.333]

    Source: NJS eq. 6.
    """
    check_same_shape(variance=variance)
    valid = finite(variance)
    if weights is None:
        return window_mean(variance, window, mask=valid, sigma=sigma)
    if sigma is not None:
        raise ValueError("give sigma or weights, not both")
    return weighted_mean(variance, weights, window, mask=valid)


def robust_variance(
    variance: Variance, *, window: int = 19, sigma: float = 3.0
) -> Variance:
    """Each pixel's variance, but never below that of its neighbourhood.

    For rules that trust a single pixel's variance, under heavy-tailed noise: a pixel
    that missed a rare bright path is not taken to be certain, and a firefly keeps its
    own large variance.

    Args:
        variance: sample variance of the mean, squared radiance, shape [H,W,C].
        window: width of the neighbourhood in pixels, odd.
        sigma: standard deviation in pixels of its Gaussian weights.

    Returns:
        the variance, shape [H,W,C]; pixels that are not finite stay so.

    Raises:
        ValueError: if `window` is even or `sigma` not positive.

    Source: ours; the defaults were chosen on five path-traced frames.
    """
    pooled = smooth_variance(variance, window=window, sigma=sigma)
    return jnp.maximum(variance, pooled)
