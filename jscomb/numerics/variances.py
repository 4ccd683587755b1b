"""Sample variances of path-traced pixels, pooled to be usable.

Sample variances are as heavy-tailed as the pixels: a pixel whose samples all missed a
rare bright path looks certain. Layout: variances [H,W,C] of the mean, squared radiance.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jscomb.numerics.guards import check_same_shape, divide, finite
from jscomb.numerics.kernels import kernel_mean
from jscomb.numerics.windows import window_mean
from jscomb.typing import Mask, Variance

__all__ = [
    "ROBUST_WINDOW",
    "relative_precision",
    "robust_variance",
    "smooth_variance",
]

ROBUST_WINDOW = 19  # width in pixels of the neighbourhood
_NOISE = 10.0  # relative variance, times this, that halves the weight of a pixel
_NOISE_WINDOW = 9  # pixels that it is averaged over


def smooth_variance(
    variance: Variance,
    *,
    window: int = 15,
    sigma: float | None = None,
    weights: Float[Array, "h w window2"] | None = None,
) -> Variance:
    """Average variances over a window with equal, Gaussian or given weights.

    Args:
        variance: sample variance of the mean, squared radiance, shape [H,W,C].
        window: width of the window in pixels, odd.
        sigma: standard deviation in pixels of Gaussian weights.
        weights: weights of each pixel's window, at least zero, shape [H,W,window²],
            row-major over the offsets; shared by the channels (a network's output).

    Returns:
        the pooled variance, shape [H,W,C], without values that are not finite; 0 where
        a window has none that is.

    Raises:
        ValueError: if both `sigma` and `weights` are given, if `window` is even or
            `sigma` not positive, or if the weights have another shape.

    Example:
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
    return kernel_mean(variance, weights, window, mask=valid)


def robust_variance(
    variance: Variance, *, window: int = ROBUST_WINDOW, sigma: float = 3.0
) -> Variance:
    """Return each pixel's variance, or that of its neighbourhood if that is larger.

    For whitened rules under heavy-tailed noise: a pixel that missed a rare bright path
    does not count as certain, and a firefly keeps its own large variance.

    Args:
        variance: sample variance of the mean, squared radiance, shape [H,W,C].
        window: width of the neighbourhood in pixels, odd.
        sigma: standard deviation in pixels of its Gaussian weights.

    Returns:
        the variance, shape [H,W,C]; not finite where the input is not.

    Raises:
        ValueError: if `window` is even or `sigma` not positive.

    Example:
        >>> variance = jnp.ones((3, 3, 1)).at[1, 1].set(0.0).at[0, 0].set(9.0)
        >>> print(robust_variance(variance, window=3)[..., 0].round(2))
        [[9.   2.18 1.  ]
         [2.18 1.74 1.  ]
         [1.   1.   1.  ]]

    Source: ours; the defaults were chosen on five path-traced frames.
    """
    pooled = smooth_variance(variance, window=window, sigma=sigma)
    return jnp.maximum(variance, pooled)


def relative_precision(
    square: Float[Array, "h w 1"],
    variance: Float[Array, "h w 1"] | None,
    valid: Mask,
) -> Float[Array, "h w 1"]:
    """Return weights of pixels for relative squared errors, less where it is noisy.

    Args:
        square: of the radiance, shape [H,W,1].
        variance: of the noise, squared radiance, shape [H,W,1]; None for the same noise
            everywhere.
        valid: pixels that count, shape [H,W,1].

    Returns:
        `1 / (square (1 + 10 n))`, n the relative variance, mean over 9x9 pixels;
        inverse squared radiance, shape [H,W,1]; 0 at pixels that do not count or are
        black.

    Example:
        >>> one = jnp.ones((1, 1, 1))
        >>> print(relative_precision(2 * one, 0.2 * one, one > 0)[0, 0])
        [0.25]

    Source: ours; the constants were set on five path-traced scenes.
    """
    some = valid & (square > 0)
    if variance is not None:
        relative = divide(variance, square, where=some)
        near = window_mean(relative, _NOISE_WINDOW, mask=valid)
        square = square * (1 + _NOISE * near)
    return divide(jnp.ones_like(square), square, where=some)
