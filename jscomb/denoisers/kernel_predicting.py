"""A denoiser whose kernels a network predicts.

Each pixel becomes the mean of its window, with the network's weights, each divided by
1 + v: without the division a firefly corrupts every window that contains it, and the
network only learns to leave each pixel alone.

Source: S. Bako et al., "Kernel-predicting convolutional networks for denoising Monte
Carlo renderings", 2017; the division is ours.
"""

from collections.abc import Callable, Mapping

import jax.numpy as jnp
from jaxtyping import Array, Float

from jscomb.features import FEATURES, stack
from jscomb.frame import Frame, Needs
from jscomb.numerics.guards import (
    check_same_shape,
    first_finite,
    repeat_channel,
    weighted_ratio,
    zero_invalid,
)
from jscomb.numerics.kernels import Kernels, predicted_mean
from jscomb.numerics.luminance import at_unit_luminance
from jscomb.typing import Image, Variance

__all__ = ["NEEDS", "denoise", "denoise_inputs", "denoise_normalised", "neural_inputs"]

Features = Float[Array, "h w f"]
Network = Callable[[Image, Variance, Features], Kernels]

NEEDS = Needs(variance=True, channels=3, features=tuple(FEATURES), normalised=True)


def denoise(
    network: Network,
    noisy: Image,
    variance: Variance,
    features: Features,
) -> Image:
    """Average each pixel's window with weights that a network predicts.

    Pure, scale-equivariant, and differentiable in every array and in the network's
    parameters, forwards too (for SURE). Divides radiance by its median luminance.

    Args:
        network: from x, v and features, finite and normalised, to w² weights a pixel,
            such as `learning.networks.KernelPredictor`.
        noisy: x, linear radiance, shape [H,W,C].
        variance: v of the mean x, squared radiance, at least zero, shape [H,W,C].
        features: about in [-1, 1], shape [H,W,F]; see `features.stack`.

    Returns:
        the denoised image, linear radiance, shape [H,W,C]; invalid pixels are excluded
        and unchanged, or 0 where x is not finite.

    Raises:
        ValueError: while tracing, if shapes differ.

    Example:
        >>> nine = lambda near: jnp.ones((*near.shape[:2], 9))
        >>> even = lambda x, v, f: Kernels(x, nine, 0, 3)
        >>> x = jnp.array([1.0, 2.0, 6.0]).reshape(1, 3, 1)
        >>> y = denoise(even, x, 0 * x, x[..., :0])
        >>> print([f"{value:.2f}" for value in y.ravel()])
        ['1.50', '3.00', '4.00']
    """
    variance = repeat_channel(variance, noisy)
    check_same_shape(noisy=noisy, variance=variance)
    denoise_one = lambda x, v: denoise_normalised(network, x, v, features)
    return at_unit_luminance(denoise_one, noisy, squares=[variance])


def denoise_normalised(
    network: Network,
    noisy: Image,
    variance: Variance,
    features: Features,
) -> Image:
    """Denoise a normalised image; for crops of a normalised frame, and for training.

    Local, and not scale-equivariant: `denoise` without its normalisation.

    Args:
        network: as for `denoise`.
        noisy: x, normalised radiance, shape [H,W,C].
        variance: v of the mean x, at least zero, shape [H,W,C].
        features: about in [-1, 1], shape [H,W,F].

    Returns:
        the denoised image, normalised radiance, shape [H,W,C].

    Raises:
        ValueError: while tracing, if shapes differ.

    Example:
        >>> nine = lambda near: jnp.ones((*near.shape[:2], 9))
        >>> even = lambda x, v, f: Kernels(x, nine, 0, 3)
        >>> x = jnp.array([1.0, 2.0, 6.0]).reshape(1, 3, 1)
        >>> y = denoise_normalised(even, x, 0 * x, x[..., :0])
        >>> print([f"{value:.2f}" for value in y.ravel()])
        ['1.50', '3.00', '4.00']
    """
    check_same_shape(noisy=noisy, variance=variance)
    valid, x, v, f = zero_invalid(noisy, variance, features)
    kernels = network(x, v, f)
    trust = 1 / (1 + jnp.mean(v, axis=-1, keepdims=True))
    both = jnp.concatenate([trust * x, trust], axis=-1)
    (mean,) = predicted_mean(both[None], kernels, mask=valid)
    image = weighted_ratio(mean[..., :-1], mean[..., -1:])
    return jnp.where(valid, image, first_finite(noisy))


def neural_inputs(frame: Frame) -> dict[str, Image]:
    """Return what `denoise_inputs` takes of a frame.

    Args:
        frame: normalised, with variance, albedo, normal and depth.

    Returns:
        noisy and variance, shape [H,W,3], albedo, normal and depth, scaled to at most
        one.

    Raises:
        ValueError: if the frame lacks any of them.

    Example:
        >>> from jscomb.frame import make_frame
        >>> one, three = jnp.ones((2, 2, 1)), jnp.ones((2, 2, 3))
        >>> features = {"albedo": three, "normal": three, "depth": 5 * one}
        >>> frame = make_frame(three, variance=three, **features).normalised()
        >>> print(neural_inputs(frame)["depth"][0, 0])
        [1.]
    """
    frame.require("a kernel predictor", NEEDS)
    images = {"noisy": frame.color, "variance": frame.variance}
    features, first = stack(frame), 0
    for name, channels in FEATURES.items():
        images[name] = features[..., first : first + channels]
        first += channels
    return images


def denoise_inputs(network: Network, inputs: Mapping[str, Image]) -> Image:
    """Denoise what `neural_inputs` returns, or crops of it.

    Args:
        network: as for `denoise`.
        inputs: images by name, normalised.

    Returns:
        the denoised image, normalised radiance, shape [H,W,3].

    Example:
        >>> nine = lambda near: jnp.ones((*near.shape[:2], 9))
        >>> even = lambda x, v, f: Kernels(x, nine, 0, 3)
        >>> x = jnp.broadcast_to(jnp.array([1.0, 2.0, 6.0])[:, None], (1, 3, 3))
        >>> names = "noisy", "variance", "albedo", "normal", "depth"
        >>> inputs = dict(zip(names, [x, 0 * x, x, x, x[..., :1]], strict=True))
        >>> print(denoise_inputs(even, inputs)[0, :, 0])
        [1.5 3.  4. ]
    """
    features = jnp.concatenate([inputs[name] for name in FEATURES], axis=-1)
    noisy, variance = inputs["noisy"], inputs["variance"]
    return denoise_normalised(network, noisy, variance, features)
