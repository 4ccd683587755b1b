r"""Joint bilateral filter: the mean of near pixels with similar features and radiance.

Layout: images [H,W,C], linear radiance. Notation:

    x, v   image and its variance; z, n their means over 3x3 pixels
    f      features
    p, q   a pixel, and another in its window

    w_pq = exp(-|p - q|^2 / (2 s^2) - |f_p - f_q|^2 / (2 s_f^2)
               - sum over channels (z_p - z_q)^2 / (2 s_r^2 (n_p + n_q)))

Sources:
    J. Kopf et al., "Joint bilateral upsampling", 2007; T.-M. Li et al., "SURE-based
    optimization for adaptive sampling and reconstruction", 2012 (the distance).
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jscomb.features import stack
from jscomb.frame import Estimate, Frame, Needs, with_halves
from jscomb.numerics.guards import (
    check_same_shape,
    finite,
    first_finite,
    repeat_channel,
)
from jscomb.numerics.tiles import Local, compiled
from jscomb.numerics.weights import bilateral_weights, weighted_mean
from jscomb.numerics.windows import reach_of, window_mean
from jscomb.typing import Image, Variance

__all__ = ["NEEDS", "denoise", "denoise_frame", "plan_frame", "reach"]

NEEDS = Needs(variance=True)

_POOL = 3  # width that the guide and its variance are averaged over


def denoise(
    image: Image,
    variance: Variance,
    features: Float[Array, "h w f"],
    *,
    window: int = 21,
    sigma: float = 5.0,
    sigma_radiance: float = 2.0,
    sigma_features: float = 0.15,
) -> Image:
    """Replace each pixel by the mean of similar ones near it.

    Pure, differentiable in every array, and scale-equivariant.

    Args:
        image: x, radiance, shape [H,W,C].
        variance: v of the mean, squared radiance, at least zero, shape [H,W,C].
        features: f, of a range of about one, shape [H,W,F]; F may be 0.
        window: width in pixels, odd.
        sigma: s > 0, of the distance, in pixels.
        sigma_radiance: s_r > 0, in standard deviations of the noise.
        sigma_features: s_f > 0, in the unit of the features.

    Returns:
        the mean, shape [H,W,C]; at an invalid pixel the image if finite, else 0.

    Raises:
        ValueError: while tracing, if shapes differ, `window` is even or `sigma` is not
            positive.

    Example:
        >>> image = jnp.array([1.0, 3.0, 5.0, 7.0]).reshape(1, 4, 1)
        >>> albedo = jnp.array([0.0, 0.0, 1.0, 1.0]).reshape(1, 4, 1)
        >>> found = denoise(image, jnp.full_like(image, 9.0), albedo, window=3)
        >>> print([f"{value:.1f}" for value in found.ravel()])
        ['2.0', '2.0', '6.0', '6.0']
    """
    variance = repeat_channel(variance, image)
    check_same_shape(image=image, variance=variance)
    if features.shape[:2] != image.shape[:2]:
        raise ValueError(f"features has shape {features.shape}, image {image.shape}")
    valid = finite(image, variance)
    smooth, noise = (window_mean(i, _POOL, mask=valid) for i in (image, variance))
    weights = bilateral_weights(
        features / (2**0.5 * sigma_features),
        smooth / (2**0.5 * sigma_radiance),
        noise,
        sigma=sigma,
    )
    filtered = weighted_mean(image, weights, window=window)
    # The smoothed image is finite around a pixel of infinite variance, too.
    return jnp.where(finite(variance), filtered, first_finite(image))


def reach(*, window: int = 21) -> int:
    """Return the distance in pixels that `denoise` depends on.

    Args:
        window: width in pixels, odd.

    Returns:
        half the window, and one pixel more for the pooled guide.

    Example:
        >>> reach(window=21)
        11
    """
    return reach_of(window, _POOL)


def denoise_frame(frame: Frame, *, window: int = 21) -> Estimate:
    """Denoise a frame, guided by the features it has.

    Args:
        frame: with variances, or sub-buffers to estimate them from.
        window: width in pixels, odd.

    Returns:
        the estimate.

    Raises:
        ValueError: if the frame has no variance, or `window` is even.

    Example:
        >>> import numpy as np
        >>> from jscomb.frame import make_frame
        >>> noise = np.random.default_rng(0).normal(1, 0.5, (2, 16, 16, 1))
        >>> frame = make_frame(noise, variance=np.full_like(noise, 0.25))
        >>> made = denoise_frame(frame, window=9)
        >>> print([f"{i.std():.2f}" for i in (frame.color, made.image, made.halves)])
        ['0.36', '0.05', '0.06']
    """
    frame.require("bilateral", NEEDS)
    image = lambda part: plan_frame(part, window=window).whole()
    return with_halves(frame, image, needs=NEEDS)


def plan_frame(frame: Frame, *, window: int = 21) -> Local:
    """Return `denoise_frame` as a local function of images, for crops.

    Args:
        frame: as for `denoise_frame`.
        window: width in pixels, odd.

    Returns:
        the function, its images and how far it sees.

    Example:
        >>> from jscomb.frame import make_frame
        >>> one = jnp.ones((2, 4, 4, 1))
        >>> print(plan_frame(make_frame(one, variance=one)).halo)
        11
    """
    run = compiled(denoise, window=window)
    images = frame.color, frame.variance, stack(frame)
    return Local(lambda i: run(*i), images, reach(window=window))
