"""A denoiser whose kernels a network predicts."""

from collections.abc import Callable

import jax.numpy as jnp
from jaxtyping import Array, Float

from jscomb.numerics.exposure import in_units
from jscomb.numerics.guards import check_same_shape, divide, finite, first_finite
from jscomb.numerics.kernels import Kernels, predicted_mean
from jscomb.typing import Image, Scalar, Variance

Features = Float[Array, "h w f"]
Network = Callable[[Image, Variance, Features], Kernels]


def denoise(
    network: Network,
    noisy: Image,
    variance: Variance,
    features: Features,
    *,
    window: int = 11,
    exposure: Scalar | None = None,
) -> Image:
    """Average each pixel's window with weights that a network predicts.

    A pixel's weight is divided by 1 + v, at an exposure of one.

    Pure, scale-equivariant, and differentiable in every array and in the network's
    parameters, forwards too (for SURE).

    Args:
        network: of x, v and features, finite and at an exposure of one, to w² weights
            a pixel, such as `learning.networks.KernelPredictor`.
        noisy: x, linear radiance, shape [H,W,C].
        variance: v of the mean x, squared radiance, at least zero, likewise.
        features: of a range of about one, shape [H,W,F]; `features.stack`.
        window: width of the windows in pixels, odd; the network's.
        exposure: what to divide radiance by; None for `numerics.exposure` of x.

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
    valid = finite(noisy, variance, features)
    unit, x, v = in_units(exposure, valid, noisy, variance=variance)
    kernels = network(x, v, jnp.where(valid, features, 0.0))
    # Else a firefly spoils every window that it is in, and all that is learned is to
    # leave each pixel alone.
    trust = 1 / (1 + jnp.mean(v, axis=-1, keepdims=True))
    both = jnp.concatenate([trust * x, trust], axis=-1)
    (mean,) = predicted_mean(both[None], kernels, window, mask=valid)
    total, weight = mean[..., :-1], jnp.broadcast_to(mean[..., -1:], x.shape)
    image = unit * divide(total, weight, where=weight > 0)
    return jnp.where(valid, image, first_finite(noisy))
