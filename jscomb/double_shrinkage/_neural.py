"""Double shrinkage with a network's errors and confidence."""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from jscomb.double_shrinkage.shrinkage import combine
from jscomb.numerics.guards import check_same_shape, first_finite, zero_invalid
from jscomb.numerics.kernels import Kernels, predicted_mean
from jscomb.numerics.luminance import at_unit_luminance
from jscomb.typing import Image

Error = Float[Array, "h w 1"]


class Filters(NamedTuple):
    """What the network decides.

    Attributes:
        kernels: weights of v and of m in each pixel's window, 2 w² a pixel.
        confidence: eta^2, squared radiance, at least zero, shape [H,W,1].
    """

    kernels: Kernels
    confidence: Error


Network = Callable[[Image, Image, Image, Error, Error], Filters]


def neural_combine(
    network: Network,
    prior: Image,
    unbiased: Image,
    biased: Image,
    variance: Error,
    mse: Error,
    *,
    window: int = 13,
) -> Image:
    """Blend two integrators and a prior by errors that a network pools.

    Pure, scale-equivariant, and differentiable in every array and in the network's
    parameters. The network's 2 w² weights a pixel exist for a strip of rows at a time.

    Args:
        network: of p, u, b, v and m, finite and normalised, such as
            `learning.networks.ShrinkageNetwork`.
        prior: p, linear radiance, shape [H,W,C].
        unbiased: u, likewise.
        biased: b, likewise.
        variance: sample variance v of the mean u, mean over channels, squared radiance,
            at least zero, shape [H,W,1].
        mse: m, of b, likewise.
        window: width of the kernels in pixels, odd; the network's.

    Returns:
        the blend, linear radiance, shape [H,W,C]; at an invalid pixel the first finite
        of (b, u), else 0.

    Raises:
        ValueError: while tracing, if shapes differ, or the network has another window.

    Example:
        >>> import jax
        >>> at = lambda value: jnp.full((2, 2, 1), value)
        >>> head = lambda near: jnp.ones((*near.shape[:2], 2 * 13**2))
        >>> network = lambda *_: Filters(Kernels(at(1.0), head, 0), at(0.25))
        >>> fast = jax.jit(neural_combine, static_argnames="network")
        >>> images = at(0.0), at(4.0), at(8.0), at(1.0), at(3.0)
        >>> print(fast(network, *images)[0, 0].round(3))
        [4.211]

    Source: DSC section 4.3, eq. 9, 10.
    """
    check_same_shape(unbiased=unbiased, biased=biased, prior=prior)
    combine_normalised = lambda u, p, b, v, m: neural_combine_normalised(
        network, p, u, b, v, m, window=window
    )
    images, squares = (unbiased, prior, biased), (variance, mse)
    return at_unit_luminance(combine_normalised, *images, squares=squares)


def neural_combine_normalised(
    network: Network,
    prior: Image,
    unbiased: Image,
    biased: Image,
    variance: Error,
    mse: Error,
    *,
    window: int = 13,
) -> Image:
    """Blend normalised images; for crops of a normalised frame, and for training.

    Local, and not scale-equivariant: `neural_combine` without its normalisation.

    Args:
        network: as for `neural_combine`.
        prior: p, normalised radiance, shape [H,W,C].
        unbiased: u, likewise.
        biased: b, likewise.
        variance: v of the mean u, mean over channels, at least zero, shape [H,W,1].
        mse: m, of b, likewise.
        window: width of the kernels in pixels, odd; the network's.

    Returns:
        the blend, normalised radiance, shape [H,W,C]; at an invalid pixel the first
        finite of (b, u), else 0.

    Raises:
        ValueError: while tracing, if shapes differ, or the network has another window.

    Example:
        >>> at = lambda value: jnp.full((2, 2, 1), value)
        >>> head = lambda near: jnp.ones((*near.shape[:2], 2 * 13**2))
        >>> network = lambda *_: Filters(Kernels(at(1.0), head, 0), at(0.25))
        >>> images = at(0.0), at(4.0), at(8.0), at(1.0), at(3.0)
        >>> print(neural_combine_normalised(network, *images)[0, 0].round(3))
        [1.25]

    Source: DSC section 4.3, eq. 9, 10.
    """
    check_same_shape(unbiased=unbiased, biased=biased, prior=prior)
    check_same_shape(variance=variance, mse=mse)
    valid, p, u, b, v, m = zero_invalid(prior, unbiased, biased, variance, mse)
    kernels, eta = network(p, u, b, v, m)
    v, m = predicted_mean(jnp.stack([v, m]), kernels, window, mask=valid)
    blend = combine(p, u, b, v, m, eta)
    return jnp.where(valid, blend, first_finite(biased, unbiased))
