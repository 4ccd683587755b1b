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
    """
    return window_mean(image, window, mask=finite(image))
