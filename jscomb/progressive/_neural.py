"""The mix with a network's alpha."""

import types
from collections.abc import Callable, Mapping

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jscomb.numerics.guards import check_same_shape, zero_invalid
from jscomb.numerics.luminance import at_unit_luminance
from jscomb.progressive._combine import Noise, combine
from jscomb.typing import Image, Scalar, Variance

_BEYOND = 0.02  # by which the logistic function passes 0 and 1

Outputs = Float[Array, "h w 3 c"]
Network = Callable[[Image, Image, Variance, Image], Outputs]


def activation(outputs: Outputs, *, limit: bool = True) -> Image:
    """Return alpha from a network's outputs, in the form of eq. 9.

    Args:
        outputs: xi_1, xi_2, xi_3 of each channel, shape [H,W,3,C].
        limit: clip to [0, 1]; not for training, since what is clipped has no
            derivative.

    Returns:
        (xi_1 - xi_2) / max(xi_3, 1e-6), limited, shape [H,W,C].

    Example:
        >>> outputs = jnp.array([0.5, 0.25, 1.0]).reshape(1, 1, 3, 1)
        >>> print(activation(outputs)[0, 0])
        [0.25]

    Source: PD eq. 19.
    """
    first, second, third = (outputs[:, :, k] for k in range(3))
    share = (first - second) / jnp.maximum(third, 1e-6)
    return jnp.clip(share, 0.0, 1.0) if limit else share


def direct_activation(outputs: Outputs, *, limit: bool = True) -> Image:
    """Return alpha from the first output alone, without the form of eq. 9.

    Args:
        outputs: xi_1 and two unused outputs, shape [H,W,3,C].
        limit: stretch the logistic function by 2 % at both ends and clip, so that it
            reaches 0 and 1: a thousandth of a firefly is still one. Not for training,
            since what is clipped has no derivative.

    Returns:
        sigmoid(xi_1), limited: clip(1.04 sigmoid(xi_1) - 0.02, 0, 1); shape [H,W,C].

    Example:
        >>> first = jnp.array([-10.0, 0.0, 10.0]).reshape(1, 3, 1, 1)
        >>> outputs = jnp.concatenate([first, 0 * first, 0 * first], axis=2)
        >>> print([f"{alpha:.3f}" for alpha in direct_activation(outputs).ravel()])
        ['0.000', '0.500', '1.000']

    Source: PD table 4.
    """
    share = jax.nn.sigmoid(outputs[:, :, 0])
    return jnp.clip((1 + 2 * _BEYOND) * share - _BEYOND, 0.0, 1.0) if limit else share


FORMS = types.MappingProxyType({"quotient": activation, "direct": direct_activation})
"""Alpha from a network's outputs, by the network's attribute `form`."""


def neural_combine(
    network: Network,
    unbiased: Image,
    biased: Image,
    variance: Variance,
    sure: Image,
    *,
    bound: bool = True,
    noise: Noise | None = None,
) -> Image:
    """Mix a rendering and its denoised image by a network's alpha.

    Pure, scale-equivariant, and differentiable in every array and in the network's
    parameters.

    Args:
        network: of x, y, v and s, finite and normalised, to what `activation` takes,
            such as `learning.networks.MixingNetwork`; or what another of `FORMS` takes,
            if its attribute `form` says so.
        unbiased: x, linear radiance, shape [H,W,C].
        biased: y, same shape.
        variance: v of the mean x, squared radiance, at least zero, same shape.
        sure: s, squared radiance, same shape.
        bound: lower alpha where the mix is not consistent with the noise.
        noise: variance of the channels' mean, as for `bound_mixing`.

    Returns:
        z, linear radiance, shape [H,W,C]; at an invalid pixel the first finite of
        (y, x), else 0.

    Raises:
        ValueError: while tracing, if shapes differ.

    Example:
        >>> at = lambda value: jnp.full((3, 3, 1), value)
        >>> network = lambda *_: jnp.stack([at(0.5), at(0.25), at(1.0)], axis=2)
        >>> z = neural_combine(network, at(3.0), at(1.0), at(1.0), at(2.0), bound=False)
        >>> print(z[0, 0].round(3))
        [2.5]

    Source: PD eq. 11, 18, 19.
    """
    check_same_shape(unbiased=unbiased, biased=biased, variance=variance, sure=sure)
    names = ["unbiased", "biased", "variance", "sure"]
    squares = [variance, sure]
    if noise is not None:
        names, squares = [*names, "noise"], [*squares, noise]
    normalised = lambda *images: combine_inputs(
        network, dict(zip(names, images, strict=True)), bound=bound
    )
    return at_unit_luminance(normalised, unbiased, biased, squares=squares)


def combine_inputs(
    network: Network,
    inputs: Mapping[str, Image],
    *,
    bound: bool = True,
    limit: bool = True,
    sigma: Scalar | None = None,
) -> Image:
    """Mix normalised images by name, for crops of a frame and for training.

    Not scale-equivariant, and local with a given sigma or without the bound:
    `neural_combine` without its normalisation.

    Args:
        network: as for `neural_combine`.
        inputs: unbiased, biased, variance and sure, and noise if it is known, as
            `neural_inputs` makes.
        bound: lower alpha where the mix is not consistent with the noise.
        limit: alpha to [0, 1]; not for training.
        sigma: of the bound, see `bound_sigma`; None for that of these images.

    Returns:
        z, normalised radiance, shape [H,W,C]; at an invalid pixel the first finite of
        (y, x), else 0.

    Raises:
        ValueError: while tracing, if shapes differ.

    Example:
        >>> at = lambda value: jnp.full((1, 1, 1), value)
        >>> network = lambda *_: jnp.zeros((1, 1, 3, 1))
        >>> names = "unbiased", "biased", "variance", "sure"
        >>> inputs = dict(zip(names, map(at, (3.0, 1.0, 1.0, 2.0))))
        >>> print(combine_inputs(network, inputs, bound=False).item())
        3.0

    Source: PD eq. 11, 18, 19.
    """
    activate = FORMS[getattr(network, "form", "quotient")]

    def mix(*images: Image) -> Image:
        _, x, y, v, s = zero_invalid(*images)
        return activate(network(x, y, v, s), limit=limit)

    return combine(**inputs, mix=mix, bound=bound, sigma=sigma)
