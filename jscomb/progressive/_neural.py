"""The mix with a network's alpha."""

from collections.abc import Callable, Mapping

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jscomb.numerics.guards import check_same_shape, zero_invalid
from jscomb.numerics.luminance import at_unit_luminance
from jscomb.progressive._combine import combine
from jscomb.typing import Image, Variance

Outputs = Float[Array, "h w 3 c"]
Network = Callable[[Image, Image, Variance, Image], Outputs]
Activation = Callable[[Outputs], Image]


def activation(outputs: Outputs) -> Image:
    """Return alpha from a network's outputs, in the form of eq. 9.

    Args:
        outputs: xi_1, xi_2, xi_3 of each channel, shape [H,W,3,C].

    Returns:
        clip((xi_1 - xi_2) / max(xi_3, 1e-6), 0, 1), shape [H,W,C].

    Example:
        >>> outputs = jnp.array([0.5, 0.25, 1.0]).reshape(1, 1, 3, 1)
        >>> print(activation(outputs)[0, 0])
        [0.25]

    Source: PD eq. 19.
    """
    first, second, third = (outputs[:, :, k] for k in range(3))
    return jnp.clip((first - second) / jnp.maximum(third, 1e-6), 0.0, 1.0)


def direct_activation(outputs: Outputs, *, beyond: float = 0.02) -> Image:
    """Return alpha from the first output alone, without the form of eq. 9.

    Args:
        outputs: xi_1 and two unused outputs, shape [H,W,3,C].
        beyond: e, by which the logistic function is stretched before it is clipped, so
            that it reaches 0 and 1: a thousandth of a firefly is still one. 0 for
            training, since what is clipped has no derivative.

    Returns:
        clip((1 + 2 e) sigmoid(xi_1) - e, 0, 1), shape [H,W,C].

    Example:
        >>> first = jnp.array([-10.0, 0.0, 10.0]).reshape(1, 3, 1, 1)
        >>> outputs = jnp.concatenate([first, 0 * first, 0 * first], axis=2)
        >>> print([f"{alpha:.3f}" for alpha in direct_activation(outputs).ravel()])
        ['0.000', '0.500', '1.000']

    Source: PD table 4.
    """
    share = jax.nn.sigmoid(outputs[:, :, 0])
    return jnp.clip((1 + 2 * beyond) * share - beyond, 0.0, 1.0)


def neural_combine(
    network: Network,
    unbiased: Image,
    biased: Image,
    variance: Variance,
    sure: Image,
    *,
    activate: Activation = activation,
    bound: bool = True,
) -> Image:
    """Mix a rendering and its denoised image by a network's alpha.

    Pure, scale-equivariant, and differentiable in every array and in the network's
    parameters.

    Args:
        network: of x, y, v and s, finite and normalised, to what `activate`
            takes, such as `learning.networks.MixingNetwork`.
        unbiased: x, linear radiance, shape [H,W,C].
        biased: y, same shape.
        variance: v of the mean x, squared radiance, at least zero, same shape.
        sure: s, squared radiance, same shape.
        activate: alpha from the outputs: `activation` or `direct_activation`.
        bound: lower alpha where the mix is not consistent with the noise.

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
    names = "unbiased", "biased", "variance", "sure"
    normalised = lambda *images: combine_inputs(
        network, dict(zip(names, images, strict=True)), activate=activate, bound=bound
    )
    squares = variance, sure
    return at_unit_luminance(normalised, unbiased, biased, squares=squares)


def combine_inputs(
    network: Network,
    inputs: Mapping[str, Image],
    *,
    activate: Activation = direct_activation,
    bound: bool = False,
) -> Image:
    """Mix normalised images by name, for crops of a frame and for training.

    Not scale-equivariant, and local without the bound: `neural_combine` without its
    normalisation.

    Args:
        network: as for `neural_combine`.
        inputs: unbiased, biased, variance and sure, as `neural_inputs` makes.
        activate: alpha from the network's outputs.
        bound: lower alpha where the mix is not consistent with the noise.

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
        >>> print(combine_inputs(network, inputs).item())
        2.0

    Source: PD eq. 11, 18, 19; alpha as one output and no bound measured better.
    """

    def mix(*images: Image) -> Image:
        _, x, y, v, s = zero_invalid(*images)
        return activate(network(x, y, v, s))

    return combine(**inputs, mix=mix, bound=bound)
