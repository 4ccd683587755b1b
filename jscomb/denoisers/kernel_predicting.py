"""A denoiser whose kernels a network predicts."""

from collections.abc import Callable

import jax.numpy as jnp
from jaxtyping import Array, Float

from jscomb.numerics.guards import (
    check_same_shape,
    first_finite,
    weighted_ratio,
    zero_invalid,
)
from jscomb.numerics.kernels import Kernels, predicted_mean
from jscomb.numerics.luminance import at_unit_luminance
from jscomb.typing import Image, Variance

Features = Float[Array, "h w f"]
Network = Callable[[Image, Variance, Features], Kernels]


def denoise(
    network: Network,
    noisy: Image,
    variance: Variance,
    features: Features,
    *,
    window: int = 11,
) -> Image:
    """Average each pixel's window with weights that a network predicts.

    A pixel's weight is divided by 1 + v, with v normalised by the median luminance.

    Pure, scale-equivariant, and differentiable in every array and in the network's
    parameters, forwards too (for SURE).

    Args:
        network: of x, v and features, finite and normalised, to w² weights
            a pixel, such as `learning.networks.KernelPredictor`.
        noisy: x, linear radiance, shape [H,W,C].
        variance: v of the mean x, squared radiance, at least zero, likewise.
        features: of a range of about one, shape [H,W,F]; `features.stack`.
        window: width of the windows in pixels, odd; the network's.

    Returns:
        the denoised image, linear radiance, shape [H,W,C]; pixels that are not finite
        in some input take no part and stay as they are, or 0.

    Raises:
        ValueError: while tracing, if shapes differ, or the network has another window.

    Example:
        >>> even = lambda x, v, f: Kernels(x, lambda i: jnp.ones((*i.shape[:2], 9)), 0)
        >>> x = jnp.array([1.0, 2.0, 6.0]).reshape(1, 3, 1)
        >>> y = denoise(even, x, 0 * x, x[..., :0], window=3)
        >>> print([f"{value:.2f}" for value in y.ravel()])
        ['1.50', '3.00', '4.00']

    Source: S. Bako et al., "Kernel-predicting convolutional networks for denoising
    Monte Carlo renderings", 2017; the division is ours.
    """
    check_same_shape(noisy=noisy, variance=variance)
    denoise_one = lambda x, v: denoise_normalised(
        network, x, v, features, window=window
    )
    return at_unit_luminance(denoise_one, noisy, squares=[variance])


def denoise_normalised(
    network: Network,
    noisy: Image,
    variance: Variance,
    features: Features,
    *,
    window: int = 11,
) -> Image:
    """Denoise a normalised image; for crops of a normalised frame, and for training.

    Local, and not scale-equivariant: `denoise` without its normalisation.

    Args:
        network: as for `denoise`.
        noisy: x, normalised radiance, shape [H,W,C].
        variance: v of the mean x, at least zero, likewise.
        features: of a range of about one, shape [H,W,F].
        window: width of the windows in pixels, odd; the network's.

    Returns:
        the denoised image, normalised radiance, shape [H,W,C].

    Raises:
        ValueError: while tracing, if shapes differ, or the network has another window.

    Example:
        >>> even = lambda x, v, f: Kernels(x, lambda i: jnp.ones((*i.shape[:2], 9)), 0)
        >>> x = jnp.array([1.0, 2.0, 6.0]).reshape(1, 3, 1)
        >>> y = denoise_normalised(even, x, 0 * x, x[..., :0], window=3)
        >>> print([f"{value:.2f}" for value in y.ravel()])
        ['1.50', '3.00', '4.00']
    """
    check_same_shape(noisy=noisy, variance=variance)
    valid, x, v, f = zero_invalid(noisy, variance, features)
    kernels = network(x, v, f)
    # Otherwise a firefly corrupts every window that contains it, and the network only
    # learns to leave each pixel alone.
    trust = 1 / (1 + jnp.mean(v, axis=-1, keepdims=True))
    both = jnp.concatenate([trust * x, trust], axis=-1)
    (mean,) = predicted_mean(both[None], kernels, window, mask=valid)
    image = weighted_ratio(mean[..., :-1], mean[..., -1:])
    return jnp.where(valid, image, first_finite(noisy))
