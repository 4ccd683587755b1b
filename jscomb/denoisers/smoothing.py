"""Means over a window that look at nothing but distance: simple bases of an ensemble.

Layout: images [H,W,C], any unit. Pure, and differentiable in every array.
"""

from jscomb.numerics.guards import finite
from jscomb.numerics.windows import window_mean
from jscomb.typing import Image


def gaussian(image: Image, *, sigma: float = 2.0) -> Image:
    """Mean with Gaussian weights, out to three standard deviations.

    Args:
        image: shape [H,W,C].
        sigma: > 0, standard deviation in pixels.

    Returns:
        the mean of the pixels that are finite, shape [H,W,C]; 0 where there are none.

    Raises:
        ValueError: while tracing, if `sigma` is not positive.

    Example:
        >>> import jax.numpy as jnp
        >>> point = jnp.zeros((1, 5, 1)).at[0, 2].set(1.0)
        >>> print([f"{share:.3f}" for share in gaussian(point, sigma=0.5).ravel()])
        ['0.000', '0.106', '0.787', '0.106', '0.000']
    """
    window = 2 * int(3 * sigma + 0.5) + 1
    return window_mean(image, window, mask=finite(image), sigma=sigma)


def box(image: Image, *, window: int = 7) -> Image:
    """Mean with equal weights.

    Args:
        image: shape [H,W,C].
        window: width in pixels, odd.

    Returns:
        the mean of the pixels that are finite, shape [H,W,C]; 0 where there are none.

    Raises:
        ValueError: while tracing, if `window` is even or less than one.

    Example:
        >>> import jax.numpy as jnp
        >>> image = jnp.array([1.0, jnp.nan, 3.0, 9.0]).reshape(1, 4, 1)
        >>> print(box(image, window=3)[0, :, 0])
        [1. 2. 6. 6.]
    """
    return window_mean(image, window, mask=finite(image))
