"""James-Stein combination with a network's variances."""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from jscomb.james_stein.shrinkage import combine
from jscomb.numerics.exposure import in_units
from jscomb.numerics.guards import check_same_shape, finite, first_finite
from jscomb.numerics.kernels import Kernels, predicted_mean
from jscomb.typing import Image, Scalar, Variance


class Parameters(NamedTuple):
    """What the network decides.

    Attributes:
        kernels: weights of the sample variances of each pixel's window, w² a pixel.
        share: alpha, of y^_a in y*, in [0, 1], shape [H,W,1].
    """

    kernels: Kernels
    share: Float[Array, "h w 1"]


Network = Callable[[Image, Variance, Image, Image], Parameters]


def neural_combine(
    network: Network,
    unbiased: Image,
    biased_a: Image,
    biased_b: Image,
    variance: Variance,
    *,
    window: int = 15,
    kernel_window: int = 15,
    whiten: bool = False,
    exposure: Scalar | None = None,
) -> Image:
    """Shrink towards the better regression by the variance that a network makes out.

    Pure, scale-equivariant, and differentiable in every array and in the network's
    parameters. The network's w² weights a pixel exist for a strip of rows at a time.

    Args:
        network: of x, v, y^_a and y^_b, finite and at an exposure of one, such as
            `learning.networks.JamesSteinNetwork`.
        unbiased: x, linear radiance, shape [H,W,C].
        biased_a: y^_a of `cross_regression`, likewise; or the biased image itself.
        biased_b: y^_b, likewise.
        variance: sample variance of the mean x, squared radiance, at least zero,
            likewise.
        window: width of the windows that are shrunk, in pixels, odd, at least three.
        kernel_window: width of the network's kernels in pixels, odd.
        whiten: allow each pixel its own variance within a window: the greater of its
            sample variance and what the network makes of its neighbourhood.
        exposure: what to divide radiance by; None for `numerics.exposure` of x.

    Returns:
        the combined rendering, linear radiance, shape [H,W,C]; at an invalid pixel the
        first finite of (y^_a, y^_b, x), else 0.

    Raises:
        ValueError: while tracing, if shapes differ, or the network has other kernels.

    Example:
        >>> import jax
        >>> x, y = jnp.full((4, 4, 1), 3.0), jnp.ones((4, 4, 1))
        >>> even = Kernels(x, lambda near: jnp.ones((*near.shape[:2], 15**2)), 0)
        >>> network = lambda *_: Parameters(even, 0.5 * y)
        >>> fast = jax.jit(neural_combine, static_argnames=("network", "window"))
        >>> print(fast(network, x, y, y, y, window=3)[0, 0].round(3))
        [2.674]

    Source: NJS eq. 6, 7, 10, 13; the whitened form is ours.
    """
    check_same_shape(
        unbiased=unbiased, biased_a=biased_a, biased_b=biased_b, variance=variance
    )
    valid = finite(unbiased, biased_a, biased_b, variance)
    unit, x, a, b, v = in_units(
        exposure, valid, unbiased, biased_a, biased_b, variance=variance
    )
    parameters = network(x, v, a, b)
    (s2,) = predicted_mean(v[None], parameters.kernels, kernel_window, mask=valid)
    if whiten:
        s2 = jnp.maximum(v, s2)
    y = parameters.share * a + (1 - parameters.share) * b
    # Where something is missing nothing is combined, nor does it count for others.
    shrunk = combine(x, y, jnp.where(valid, s2, jnp.nan), window=window, whiten=whiten)
    return jnp.where(valid, unit * shrunk, first_finite(biased_a, biased_b, unbiased))
