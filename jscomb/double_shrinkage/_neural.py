"""Double shrinkage with errors that a network pools, and its error of the prior."""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from jscomb.double_shrinkage._combine import combine
from jscomb.numerics.guards import check_same_shape, first_finite, zero_invalid
from jscomb.numerics.kernels import Kernels, predicted_mean
from jscomb.numerics.luminance import at_unit_luminance
from jscomb.typing import Image

Error = Float[Array, "h w 1"]


class Filters(NamedTuple):
    """Output of the network.

    Attributes:
        kernels: weights of v and of m in each pixel's window, 2 w² a pixel.
        prior_mse: eta^2, squared radiance, at least zero, [H,W,1].
    """

    kernels: Kernels
    prior_mse: Error


Network = Callable[[Image, Image, Image, Error, Error], Filters]


def neural_combine(
    network: Network,
    prior: Image,
    unbiased: Image,
    biased: Image,
    variance: Error,
    mse: Error,
) -> Image:
    """Blend two integrators and a prior by errors that a network pools.

    Pure, scale-equivariant, and differentiable in every array and in the network's
    parameters. The network's 2 w² weights a pixel exist for one strip of rows at a
    time.

    Args:
        network: of p, u, b, v and m, finite and normalised, such as
            `learning.networks.ShrinkageNetwork`.
        prior: p, linear radiance, shape [H,W,C].
        unbiased: u, linear radiance, shape [H,W,C].
        biased: b, linear radiance, shape [H,W,C].
        variance: v of the mean u, estimated as the network's was in training, mean over
            channels, squared radiance, at least zero, shape [H,W,1]. The paper's is a
            sample variance; `neural_inputs` pools half of it (`unbiased_error`), and so
            the trained networks know it.
        mse: m of b, same.

    Returns:
        the blend, linear radiance, shape [H,W,C]; at an invalid pixel the first finite
        of (b, u), else 0.

    Raises:
        ValueError: if shapes differ.

    Example:
        >>> import jax
        >>> at = lambda value: jnp.full((2, 2, 1), value)
        >>> head = lambda near: jnp.ones((*near.shape[:2], 2 * 13**2))
        >>> network = lambda *_: Filters(Kernels(at(1.0), head, 0, 13), at(0.25))
        >>> fast = jax.jit(neural_combine, static_argnames="network")
        >>> images = at(0.0), at(4.0), at(8.0), at(1.0), at(3.0)
        >>> print(fast(network, *images)[0, 0].round(3))
        [4.211]

    Source: DSC section 4.3, eq. 9, 10.
    """
    check_same_shape(unbiased=unbiased, biased=biased, prior=prior)
    names = "unbiased", "prior", "biased", "variance", "mse"
    normalised = lambda *images: combine_inputs(
        network, dict(zip(names, images, strict=True))
    )
    images, squares = (unbiased, prior, biased), (variance, mse)
    return at_unit_luminance(normalised, *images, squares=squares)


def combine_inputs(network: Network, inputs: Mapping[str, Image]) -> Image:
    """Blend normalised images by name, for crops of a frame and for training.

    Local, and not scale-equivariant: `neural_combine` without its normalisation.

    Args:
        network: as for `neural_combine`.
        inputs: prior, unbiased, biased, variance and mse, as `neural_inputs` makes.

    Returns:
        the blend, normalised radiance, shape [H,W,C]; at an invalid pixel the first
        finite of (biased, unbiased), else 0.

    Raises:
        ValueError: if shapes differ.

    Example:
        >>> at = lambda value: jnp.full((2, 2, 1), value)
        >>> head = lambda near: jnp.ones((*near.shape[:2], 2 * 13**2))
        >>> network = lambda *_: Filters(Kernels(at(1.0), head, 0, 13), at(0.25))
        >>> inputs = dict(prior=at(0.0), unbiased=at(4.0), biased=at(8.0))
        >>> inputs |= dict(variance=at(1.0), mse=at(3.0))
        >>> print(combine_inputs(network, inputs)[0, 0].round(3))
        [1.25]

    Source: DSC section 4.3, eq. 9, 10.
    """
    names = "prior", "unbiased", "biased", "variance", "mse"
    p, u, b, v, m = (inputs[name] for name in names)
    check_same_shape(unbiased=u, biased=b, prior=p)
    check_same_shape(variance=v, mse=m)
    valid, p, u, b, v, m = zero_invalid(p, u, b, v, m)
    kernels, eta = network(p, u, b, v, m)
    v, m = predicted_mean(jnp.stack([v, m]), kernels, mask=valid)
    blend = combine(p, u, b, v, m, eta)
    return jnp.where(valid, blend, first_finite(inputs["biased"], inputs["unbiased"]))
