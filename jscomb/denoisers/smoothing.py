"""Means over a window whose weights depend on distance only: simple denoisers.

Layout: images [H,W,C], any unit. Pure, and differentiable in every array.
"""

from jscomb.frame import Estimate, Frame, Needs, with_halves
from jscomb.numerics.guards import finite
from jscomb.numerics.tiles import Local, compiled
from jscomb.numerics.windows import reach_of, window_mean
from jscomb.typing import Image

__all__ = ["NEEDS", "box", "denoise_frame", "gaussian", "plan_frame", "reach"]

NEEDS = Needs()


def gaussian(image: Image, *, sigma: float = 2.0) -> Image:
    """Return the mean with Gaussian weights, out to three standard deviations.

    Args:
        image: shape [H,W,C].
        sigma: > 0, standard deviation in pixels.

    Returns:
        the mean of the finite pixels, shape [H,W,C]; 0 where there are none.

    Raises:
        ValueError: while tracing, if `sigma` is not positive.

    Example:
        >>> import jax.numpy as jnp
        >>> point = jnp.zeros((1, 5, 1)).at[0, 2].set(1.0)
        >>> print([f"{share:.3f}" for share in gaussian(point, sigma=0.5).ravel()])
        ['0.000', '0.106', '0.787', '0.106', '0.000']
    """
    return window_mean(image, _window(sigma), mask=finite(image), sigma=sigma)


def box(image: Image, *, window: int = 7) -> Image:
    """Return the mean with equal weights.

    Args:
        image: shape [H,W,C].
        window: width in pixels, odd.

    Returns:
        the mean of the finite pixels, shape [H,W,C]; 0 where there are none.

    Raises:
        ValueError: while tracing, if `window` is even or less than one.

    Example:
        >>> import jax.numpy as jnp
        >>> image = jnp.array([1.0, jnp.nan, 3.0, 9.0]).reshape(1, 4, 1)
        >>> print(box(image, window=3)[0, :, 0])
        [1. 2. 6. 6.]
    """
    return window_mean(image, window, mask=finite(image))


def reach(*, sigma: float = 2.0) -> int:
    """Return the distance in pixels that `gaussian` depends on.

    Args:
        sigma: > 0, standard deviation in pixels.

    Returns:
        half its window, three standard deviations.

    Example:
        >>> reach(sigma=2.0)
        6
    """
    return reach_of(_window(sigma))


def denoise_frame(frame: Frame, *, sigma: float = 2.0) -> Estimate:
    """Blur a frame by `gaussian`.

    Args:
        frame: any.
        sigma: > 0, standard deviation in pixels.

    Returns:
        the estimate.

    Raises:
        ValueError: if `sigma` is not positive.

    Example:
        >>> import numpy as np
        >>> from jscomb.frame import make_frame
        >>> noise = np.random.default_rng(0).normal(1, 0.5, (2, 16, 16, 1))
        >>> frame = make_frame(noise)
        >>> made = denoise_frame(frame)
        >>> print([f"{i.std():.2f}" for i in (frame.color, made.image, made.halves)])
        ['0.36', '0.07', '0.09']
    """
    frame.require("gaussian", NEEDS)
    image = lambda part: plan_frame(part, sigma=sigma).whole()
    return with_halves(frame, image, needs=NEEDS)


def plan_frame(frame: Frame, *, sigma: float = 2.0) -> Local:
    """Return `denoise_frame` as a local function of images, for crops.

    Args:
        frame: as for `denoise_frame`.
        sigma: > 0, standard deviation in pixels.

    Returns:
        the function, its images and how far it sees.

    Example:
        >>> import jax.numpy as jnp
        >>> from jscomb.frame import make_frame
        >>> one = jnp.ones((2, 4, 4, 1))
        >>> print(plan_frame(make_frame(one, variance=one)).halo)
        6
    """
    run = compiled(gaussian, sigma=sigma)
    return Local(run, frame.color, reach(sigma=sigma))


def _window(sigma: float) -> int:
    """Width of a Gaussian's window in pixels, odd."""
    return 2 * int(3 * sigma + 0.5) + 1
