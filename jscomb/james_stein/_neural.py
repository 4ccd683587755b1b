"""James-Stein combination with a network's variances."""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from jscomb.james_stein._combine import combine
from jscomb.numerics.guards import check_same_shape, first_finite, zero_invalid
from jscomb.numerics.kernels import Kernels, predicted_mean
from jscomb.numerics.luminance import at_unit_luminance
from jscomb.typing import Image, Variance

KERNEL = 15  # width in pixels


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
    kernel_window: int = KERNEL,
    whiten: bool = False,
) -> Image:
    """Shrink towards the regressed image by the variance that a network estimates.

    Pure, scale-equivariant, and differentiable in every array and in the network's
    parameters. The network's w² weights a pixel exist for a strip of rows at a time.
    Radiance is divided by the median luminance of x before, and scaled back after.

    Args:
        network: of x, v, y^_a and y^_b, finite and normalised, such as
            `learning.networks.JamesSteinNetwork`.
        unbiased: x, linear radiance, shape [H,W,C].
        biased_a: y^_a of `cross_regression`, or the biased image, same shape.
        biased_b: y^_b, same shape.
        variance: sample variance of the mean x, squared radiance, at least zero,
            same shape.
        window: width of the windows that are shrunk, in pixels, odd, at least three.
        kernel_window: width of the network's kernels in pixels, odd.
        whiten: allow each pixel its own variance within a window: the greater of its
            sample variance and what the network makes of its neighbourhood.

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
    names = "unbiased", "biased_a", "biased_b", "variance"
    normalised = lambda *images: combine_inputs(
        network,
        dict(zip(names, images, strict=True)),
        window=window,
        kernel_window=kernel_window,
        whiten=whiten,
    )
    images = unbiased, biased_a, biased_b
    return at_unit_luminance(normalised, *images, squares=[variance])


def combine_inputs(
    network: Network,
    inputs: Mapping[str, Image],
    *,
    window: int = 7,
    kernel_window: int = KERNEL,
    whiten: bool = True,
) -> Image:
    """Combine normalised images by name, for crops of a frame and for training.

    Local, and not scale-equivariant: `neural_combine` without its normalisation.

    Args:
        network: as for `neural_combine`.
        inputs: unbiased, biased_a, biased_b and variance, as `neural_inputs` makes.
        window: width of the windows that are shrunk, in pixels, odd, at least three.
        kernel_window: width of the network's kernels in pixels, odd.
        whiten: allow each pixel its own variance within a window.

    Returns:
        the combined rendering, normalised radiance, shape [H,W,C]; at an invalid pixel
        the first finite of (y^_a, y^_b, x), else 0.

    Raises:
        ValueError: while tracing, if shapes differ, or the network has other kernels.

    Example:
        >>> x, y = jnp.full((4, 4, 1), 3.0), jnp.ones((4, 4, 1))
        >>> even = Kernels(x, lambda near: jnp.ones((*near.shape[:2], 15**2)), 0)
        >>> network = lambda *_: Parameters(even, 0.5 * y)
        >>> inputs = {"unbiased": x, "biased_a": y, "biased_b": y, "variance": y}
        >>> print(combine_inputs(network, inputs)[0, 0].round(3))
        [2.562]

    Source: NJS eq. 6, 7, 10, 13; the whitened form is ours.
    """
    check_same_shape(**inputs)
    names = "unbiased", "biased_a", "biased_b", "variance"
    x, a, b, v = (inputs[name] for name in names)
    instead = first_finite(a, b, x)
    valid, x, a, b, v = zero_invalid(x, a, b, v)
    parameters = network(x, v, a, b)
    (s2,) = predicted_mean(v[None], parameters.kernels, kernel_window, mask=valid)
    if whiten:
        s2 = jnp.maximum(v, s2)
    y = parameters.share * a + (1 - parameters.share) * b
    # An invalid pixel is not combined, and excluded from its neighbours' windows.
    shrunk = combine(x, y, jnp.where(valid, s2, jnp.nan), window=window, whiten=whiten)
    return jnp.where(valid, shrunk, instead)
