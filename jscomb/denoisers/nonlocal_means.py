r"""Non-local means: the mean of pixels whose surroundings look the same.

Layout: images [H,W,C]. Notation:

    u      guide, whose patches are compared, any unit
    v      its variance, unit of u squared
    p, q   a pixel, and another in its window
    k      strength; a larger one averages more

    d2_pq = ((u_p - u_q)^2 - (v_p + min(v_p, v_q))) / (k^2 (v_p + v_q))
    w_pq  = exp(-(mean of d2 over the patch and the channels)+)

The expected square of both pixels' noise is subtracted, so that noise alone does not
make patches differ. The guide may be the other half: then the result is linear in the
image, and its weights are independent of the image's noise.

Sources:
    A. Buades, B. Coll, J.-M. Morel, "A non-local algorithm for image denoising", 2005.
    F. Rousselle, M. Manzi, M. Zwicker, "Robust denoising using feature and color
    information", 2013 (the distance).
"""

import functools

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jscomb.frame import Estimate, Frame, Needs, with_halves
from jscomb.numerics.guards import check_same_shape, divide, finite, repeat_channel
from jscomb.numerics.tiles import Local, compiled
from jscomb.numerics.weights import Pairs, Weights, normalised_distance, weighted_mean
from jscomb.numerics.windows import check_window, reach_of
from jscomb.typing import Image, Scalar

__all__ = ["NEEDS", "denoise", "denoise_frame", "plan_frame", "reach", "weights"]

NEEDS = Needs(variance=True)

# The largest distance of one pixel: finite where the variance is 0, yet enough to
# separate two patches that differ in one channel of one pixel.
_FARTHEST = 1e6


def denoise(
    image: Image,
    guide: Float[Array, "h w _"],
    variance: Float[Array, "h w _"],
    *,
    window: int = 21,
    patch: int = 7,
    strength: Scalar | float = 0.5,
) -> Image:
    """Replace each pixel by the mean of those with similar patches of the guide.

    Pure, and differentiable in every array.

    Args:
        image: any unit, shape [H,W,C]; the guide, or the other half.
        guide: u, shape [H,W,G].
        variance: v of the guide, at least zero, shape [H,W,G].
        window: width in pixels of the window that is searched, odd.
        patch: width in pixels of the patches that are compared, odd.
        strength: k > 0.

    Returns:
        the mean, shape [H,W,C]. Invalid pixels are excluded; there the result is the
        image where it is finite, else 0.

    Raises:
        ValueError: while tracing, if shapes differ, a width is even or `strength` is
            a number that is not positive.

    Example:
        >>> image = jnp.array([0.9, 1.1, 4.9, 5.1]).reshape(1, 4, 1)
        >>> v = jnp.full_like(image, 0.01)
        >>> y = denoise(image, image, v, window=5, patch=1, strength=2.0)
        >>> print([f"{value:.2f}" for value in y.ravel()])
        ['0.99', '1.01', '4.99', '5.01']
    """
    if image.shape[:2] != guide.shape[:2]:
        raise ValueError(f"guide has shape {guide.shape}, image has {image.shape}")
    similar = weights(guide, variance, patch=patch, strength=strength)
    return weighted_mean(image, similar, window=window)


def weights(
    guide: Float[Array, "h w g"],
    variance: Float[Array, "h w g"],
    *,
    patch: int = 7,
    strength: Scalar | float = 0.5,
) -> Weights:
    """Return the weights w_pq, for a regression or any other weighted mean.

    Args:
        guide: u, shape [H,W,G].
        variance: v, at least zero, shape [H,W,G].
        patch: width in pixels of the patches, odd.
        strength: k > 0.

    Returns:
        the weights; those of invalid pixels are undefined.

    Raises:
        ValueError: while tracing, if shapes differ, `patch` is even or `strength` is
            a number that is not positive.

    Example:
        >>> from jscomb.numerics.weights import weighted_mean
        >>> image = jnp.array([1.0, 3.0, 5.0, 7.0]).reshape(1, 4, 1)
        >>> guide = jnp.array([0.0, 0.0, 1.0, 1.0]).reshape(1, 4, 1)
        >>> similar = weights(guide, jnp.full_like(guide, 0.01), patch=1)
        >>> mean = weighted_mean(image, similar, window=3)
        >>> print([f"{value:.2f}" for value in mean.ravel()])
        ['2.00', '2.00', '6.00', '6.00']

    Source: Rousselle et al. 2013.
    """
    variance = repeat_channel(variance, guide)
    check_same_shape(guide=guide, variance=variance)
    if isinstance(strength, int | float) and not strength > 0:
        raise ValueError(f"strength must be positive, got {strength}")
    halo = check_window(patch) // 2
    valid = finite(guide, variance).astype(guide.dtype)
    # `weighted_mean` sets all planes of invalid pixels to 0, so the last is a mask.
    image = jnp.concatenate([guide, variance, jnp.where(valid > 0, valid, jnp.nan)], -1)
    return Weights(image, functools.partial(_similarity, patch, strength), halo)


def reach(*, window: int = 21, patch: int = 7) -> int:
    """Return the distance in pixels that `denoise` depends on.

    Args:
        window: width in pixels of the window that is searched, odd, at least 3.
        patch: width in pixels of the patches, odd.

    Returns:
        half the window and half a patch.

    Example:
        >>> reach(window=21, patch=7)
        13
    """
    return reach_of(window, patch)


def denoise_frame(frame: Frame, *, window: int = 21) -> Estimate:
    """Denoise a frame, guided by its own colour.

    Args:
        frame: with variances, or sub-buffers to estimate them from.
        window: width in pixels of the window that is searched, odd.

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
    frame.require("nonlocal_means", NEEDS)
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
        13
    """
    run = compiled(denoise, window=window)
    images = frame.color, frame.variance
    return Local(lambda i: run(i[0], *i), images, reach(window=window))


def _similarity(patch: int, strength: Scalar | float, p: Pairs, q: Pairs) -> Array:
    """The weights of pairs of pixels at least `patch // 2` from the planes' border."""
    distance, known = _distance(p, q, strength)
    total, count = (_patch_sum(i, patch) for i in (distance, known))
    mean = divide(total, count, where=count > 0, otherwise=_FARTHEST)
    return jnp.exp(-jnp.maximum(mean, 0.0))


def _distance(p: Pairs, q: Pairs, strength: Scalar | float) -> tuple[Array, Array]:
    """Mean d2 over the channels of each pair, and 1 where both are valid, else 0."""
    channels = len(p) // 2
    known = p[-1] * q[-1]
    total = jnp.zeros((), known.dtype)
    for k in range(channels):  # plane by plane: a mean over an axis is not vectorised
        u_p, u_q, v_p, v_q = p[k], q[k], p[channels + k], q[channels + k]
        difference = jnp.square(u_p - u_q) - (v_p + jnp.minimum(v_p, v_q))
        noise = strength**2 * (v_p + v_q)
        total += normalised_distance(difference, noise, maximum=_FARTHEST)
    return total / channels * known, known


def _patch_sum(values: Array, patch: int) -> Array:
    """Sums over the patches that lie inside, along the first two axes."""
    for axis in (0, 1):
        size = tuple(patch if a == axis else 1 for a in range(values.ndim))
        strides = (1,) * values.ndim
        values = lax.reduce_window(values, 0.0, lax.add, size, strides, "VALID")
    return values
