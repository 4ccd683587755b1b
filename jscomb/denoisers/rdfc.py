r"""RDFC-style filter: non-local means that compares features as well.

A pixel counts as far as both its surroundings *and* its features are similar:

    w_pq = min(w_pq of non-local means on the radiance, w_pq of the features)

The original mixes three such filters by their estimated errors; here `ensemble` mixes,
so this is one of them.

Source: F. Rousselle, M. Manzi, M. Zwicker, "Robust denoising using feature and color
information", 2013.
"""

from jaxtyping import Array, Float

from jscomb.denoisers import nonlocal_means
from jscomb.features import stack
from jscomb.frame import Estimate, Frame, Needs, with_halves
from jscomb.numerics.guards import check_same_shape, repeat_channel
from jscomb.numerics.tiles import Local, compiled
from jscomb.numerics.weights import feature_weights, minimum_of, weighted_mean
from jscomb.typing import Image, Variance

__all__ = ["NEEDS", "denoise", "denoise_frame", "plan_frame", "reach"]

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
    """Replace each pixel by the mean of those with similar patches and features.

    Pure, differentiable in every array, and scale-equivariant.

    Args:
        image: radiance, shape [H,W,C]; the guide, or the other half.
        guide: radiance whose patches are compared, shape [H,W,C].
        variance: of the mean of the guide, squared radiance, shape [H,W,C].
        features: of a range of about one, shape [H,W,F]; F may be 0.
        window: width in pixels of the window that is searched, odd.
        patch: width in pixels of the patches, odd.
        strength: > 0, of the radiance; a larger one averages more.
        strength_features: > 0, of the features.

    Returns:
        the mean, shape [H,W,C]. Invalid pixels are excluded; there the result is the
        image where it is finite, else 0.

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
    variance = repeat_channel(variance, guide)
    check_same_shape(image=image, guide=guide, variance=variance)
    if features.shape[:2] != image.shape[:2]:
        raise ValueError(f"features has shape {features.shape}, image {image.shape}")
    weights = nonlocal_means.weights(guide, variance, patch=patch, strength=strength)
    if features.shape[-1]:
        of_features = feature_weights(features, strength=strength_features)
        weights = minimum_of(weights, of_features)
    return weighted_mean(image, weights, window=window)


def reach(*, window: int = 21, patch: int = 7) -> int:
    """Return the distance in pixels that `denoise` depends on.

    Features reach no farther than half the window: their gradient, one pixel, is taken
    at its centre only.

    Args:
        window: width in pixels of the window that is searched, odd, at least 3.
        patch: width in pixels of the patches, odd.

    Returns:
        that of non-local means.

    Example:
        >>> reach(window=21, patch=7)
        13
    """
    return nonlocal_means.reach(window=window, patch=patch)


def denoise_frame(frame: Frame, *, window: int = 21) -> Estimate:
    """Denoise a frame, guided by those of albedo, normal and depth that it has.

    Visibility is a Monte Carlo estimate, whose noise would look like edges: not used.

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
        ['0.36', '0.06', '0.09']
    """
    frame.require("rdfc", NEEDS)
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
        >>> import jax.numpy as jnp
        >>> from jscomb.frame import make_frame
        >>> one = jnp.ones((2, 4, 4, 1))
        >>> print(plan_frame(make_frame(one, variance=one)).halo)
        13
    """
    run = compiled(denoise, window=window)
    features = stack(frame._replace(buffers=frame.buffers._replace(visibility=None)))
    images = frame.color, frame.variance, features
    return Local(lambda i: run(i[0], *i), images, reach(window=window))
