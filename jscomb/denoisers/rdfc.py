r"""RDFC-style filter: non-local means in which features have a say as well.

A pixel counts as far as its surroundings look the same *and* its features are the same:

    w_pq = min(w_pq of non-local means on the radiance, w_pq of the features)

The original mixes three such filters by an estimate of their errors; here `ensemble`
mixes, so this is one of them.

Source: F. Rousselle, M. Manzi, M. Zwicker, "Robust denoising using feature and color
information", 2013.
"""

import jax
from jaxtyping import Array, Float

from jscomb.denoisers import nonlocal_means
from jscomb.features import stack
from jscomb.frame import Estimate, Frame, Needs, with_halves
from jscomb.numerics.guards import check_same_shape
from jscomb.numerics.tiles import compiled
from jscomb.numerics.weights import feature_weights, minimum_of, weighted_mean
from jscomb.typing import Image, Variance


NEEDS = Needs(variance=True)


def denoise(
    image: Image,
    guide: Image,
    variance: Variance,
    features: Float[Array, "h w f"],
    *,
    window: int = 21,
    patch: int = 7,
    strength: float = 0.5,
    strength_features: float = 0.6,
) -> Image:
    """Replace each pixel by the mean of those alike in looks and in features.

    Pure, differentiable in every array, and scale-equivariant.

    Args:
        image: radiance, shape [H,W,C]; the guide itself, or of the other half.
        guide: radiance whose patches are compared, likewise.
        variance: of the mean of the guide, squared radiance, shape [H,W,C].
        features: of a range of about one, shape [H,W,F]; F may be 0.
        window: width in pixels of the window that is searched, odd.
        patch: width in pixels of the patches, odd.
        strength: > 0 of the radiance; larger calls more alike.
        strength_features: > 0, of the features.

    Returns:
        the mean, shape [H,W,C]. Pixels that are not finite in some input take no part;
        there the result is the image where it is finite, else 0.

    Raises:
        ValueError: while tracing, if shapes differ, a width is even or a strength is
            not positive.

    Example:
        >>> import jax.numpy as jnp
        >>> image = jnp.array([1.0, 1.2, 1.4, 5.0]).reshape(1, 4, 1)
        >>> depth = jnp.array([0.0, 1.0, 1.0, 1.0]).reshape(1, 4, 1)
        >>> v = jnp.full_like(image, 0.04)
        >>> y = denoise(image, image, v, depth, window=7, patch=1)
        >>> print([f"{value:.2f}" for value in y.ravel()])
        ['1.00', '1.30', '1.30', '5.00']
    """
    check_same_shape(image=image, guide=guide, variance=variance)
    if features.shape[:2] != image.shape[:2]:
        raise ValueError(f"features has shape {features.shape}, image {image.shape}")
    alike = nonlocal_means.weights(guide, variance, patch=patch, strength=strength)
    if features.shape[-1]:
        same = feature_weights(features, strength=strength_features)
        alike = minimum_of(alike, same)
    return weighted_mean(image, alike, window=window)


def denoise_frame(frame: Frame, *, window: int = 21) -> Estimate:
    """Denoise a frame with its albedo, normal and depth, and each of its halves.

    Any of them may be missing; visibility is not used.

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
        ['0.36', '0.06', '0.09']
    """

    frame.require("rdfc", NEEDS)

    def one(part: Frame) -> Image:
        # Visibility is a Monte Carlo estimate; its noise would pass for edges.
        buffers = part.buffers._replace(visibility=None)
        features = stack(part._replace(buffers=buffers))
        x, v = part.color, part.variance
        return compiled(denoise, window=window)(x, x, v, features)

    return with_halves(frame, one, needs=NEEDS)
