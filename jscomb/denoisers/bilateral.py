"""Joint bilateral filter: the mean of near pixels with like features and radiance.

Layout: images [H,W,C], linear radiance. Radiance is compared through a smoothed image
and in units of its noise, features in units of their standard deviations.

Sources:
    J. Kopf et al., "Joint bilateral upsampling", 2007; T.-M. Li et al., "SURE-based
    optimization for adaptive sampling and reconstruction", 2012 (the distance).
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jscomb.features import stack
from jscomb.frame import Estimate, Frame, Needs, with_halves
from jscomb.numerics.guards import check_same_shape, finite, first_finite
from jscomb.numerics.tiles import compiled
from jscomb.numerics.weights import bilateral_weights, weighted_mean
from jscomb.numerics.windows import window_mean
from jscomb.typing import Image, Variance

_POOL = 3  # width that the guide and its variance are averaged over


NEEDS = Needs(variance=True)


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
    """Replace each pixel by the mean of near ones that are alike.

    Pure, differentiable in every array, and scale-equivariant.

    Args:
        image: radiance, shape [H,W,C].
        variance: of the mean, squared radiance, at least zero, shape [H,W,C].
        features: of a range of about one, shape [H,W,F]; F may be 0.
        window: width of the windows in pixels, odd.
        sigma: > 0, standard deviation of the distance, in pixels.
        sigma_radiance: > 0, of the radiance, in units of its noise.
        sigma_features: > 0, of the features, in their unit.

    Returns:
        the mean, shape [H,W,C]; at a pixel that is not finite in some input the image
        itself if finite, else 0.

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
    check_same_shape(image=image, variance=variance)
    if features.shape[:2] != image.shape[:2]:
        raise ValueError(f"features has shape {features.shape}, image {image.shape}")
    smooth, noise = (
        window_mean(i, _POOL, mask=finite(image, variance)) for i in (image, variance)
    )
    weights = bilateral_weights(
        features / (2**0.5 * sigma_features),
        smooth / (2**0.5 * sigma_radiance),
        noise,
        sigma=sigma,
    )
    filtered = weighted_mean(image, weights, window=window)
    # The smoothed image is finite around a pixel of infinite variance, too.
    return jnp.where(finite(variance), filtered, first_finite(image))


def denoise_frame(frame: Frame, *, window: int = 21) -> Estimate:
    """Denoise a frame with the features it has, and each of its halves by itself.

    Args:
        frame: with variances, or sub-buffers to estimate them from.
        window: width of the windows in pixels, odd.

    Returns:
        the denoised frame; its halves if they have variances.

    Raises:
        ValueError: if the frame has no way to know the variance, or `window` is even.

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
    run = compiled(denoise, window=window)
    one = lambda part: run(part.color, part.variance, stack(part))
    return with_halves(frame, one, needs=NEEDS)
