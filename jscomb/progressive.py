r"""Progressive denoising: mix a rendering with its denoised image, consistently.

Layout: images [H,W,C], linear radiance; channels are mixed separately. Notation:

    x      unbiased rendering (path traced), y its denoised image
    v      variance of the mean x at each pixel, squared radiance
    s      SURE, the estimated squared error of y, see `numerics.sure`; of either sign
    alpha  mixing, in [0, 1]: the result is z = x + alpha (y - x)
    beta   1 - alpha

The least expected error of z, with D the divergence of the denoiser times v, is at

    alpha = (v - D) / (y - x)^2,    beta = (s - D) / (y - x)^2                   (9, 10)

and D = (s - (y - x)^2 + v) / 2 by what SURE is, so that both are the same choice,

    alpha = (v - s + (y - x)^2) / (2 (y - x)^2).

In one pixel that is noise; numerator and denominator are summed over a window. (With
the sum it is James-Stein's rule for a y that depends on x.)

The bound takes alpha back where a weighted mean of z over a neighbourhood is farther
from that of x than the noise explains. As samples grow v falls, and wherever y is
biased alpha goes to zero: z is consistent whatever y is.

Source: A. Firmino, J. Frisvad, H. Jensen, "Progressive Denoising of Monte Carlo
Rendered Images", 2022 (PD; eq. numbers below).
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax.scipy.special import ndtr
from jaxtyping import Array, Float

from jscomb.numerics.guards import (
    check_same_shape,
    divide,
    finite,
    first_finite,
    zero_invalid,
)
from jscomb.numerics.luminance import at_unit_luminance
from jscomb.numerics.windows import (
    at_window_max,
    check_window,
    separable_sum,
    window_sum,
)
from jscomb.typing import Image, Variance

Mixing = Callable[[Image, Image, Variance, Image], Image]

# What one pixel may weigh, times the rounding error: finite however small its variance.
_MOST_EVIDENCE = 1e4
_NARROWEST, _WIDEST = 1e-3, 100.0  # of the bound's Gaussian, in pixels


def combine(
    unbiased: Image,
    biased: Image,
    variance: Variance,
    sure: Image,
    *,
    mix: Mixing | None = None,
    bound: bool = True,
) -> Image:
    """Mix a rendering and its denoised image.

    Pure, scale-equivariant, and differentiable in every array.

    Args:
        unbiased: x, linear radiance, shape [H,W,C].
        biased: y, the denoised x, linear radiance, shape [H,W,C].
        variance: v of the mean x, squared radiance, at least zero, shape [H,W,C].
        sure: s, `numerics.sure.monte_carlo_sure(...).squared_error`, squared radiance,
            shape [H,W,C].
        mix: from these four arrays to alpha in [0, 1]: `mixing`, which is taken for
            None, or a network.
        bound: take alpha back where it is not consistent with the noise.

    Returns:
        z, linear radiance, shape [H,W,C]; at an invalid pixel the first finite of
        (y, x), else 0.

    Raises:
        ValueError: while tracing, if shapes differ.

    Example:
        >>> at = lambda value: jnp.full((3, 3, 1), value)
        >>> z = combine(at(3.0), at(1.0), at(1.0), at(2.0), bound=False)
        >>> print(z[0, 0])
        [2.25]

    Source: PD eq. 11, 18.
    """
    check_same_shape(unbiased=unbiased, biased=biased, variance=variance, sure=sure)
    alpha = (mix or mixing)(unbiased, biased, variance, sure)
    if bound:
        alpha = bound_mixing(alpha, unbiased, biased, variance)
    valid = finite(unbiased, biased, variance, sure)
    x, y = (jnp.where(valid, image, 0.0) for image in (unbiased, biased))
    # As a blend, not x + alpha (y - x), so that 0 and 1 are exact.
    blend = (1 - alpha) * x + alpha * y
    return jnp.where(valid, blend, first_finite(biased, unbiased))


def neural_combine(
    network: Callable[[Image, Image, Variance, Image], Float[Array, "h w 3 c"]],
    unbiased: Image,
    biased: Image,
    variance: Variance,
    sure: Image,
    *,
    activate: Callable[[Float[Array, "h w 3 c"]], Image] | None = None,
    bound: bool = True,
) -> Image:
    """Mix a rendering and its denoised image as a network says.

    Pure, scale-equivariant, and differentiable in every array and in the network's
    parameters.

    Args:
        network: of x, y, v and s, finite and normalised, to what `activate`
            takes, such as `learning.networks.MixingNetwork`.
        unbiased: x, linear radiance, shape [H,W,C].
        biased: y, likewise.
        variance: v of the mean x, squared radiance, at least zero, likewise.
        sure: s, squared radiance, likewise.
        activate: alpha from the outputs: `activation`, which is taken for None, or
            `direct_activation`.
        bound: take alpha back where it is not consistent with the noise.

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
    combine_normalised = lambda *images: neural_combine_normalised(
        network, *images, activate=activate, bound=bound
    )
    squares = variance, sure
    return at_unit_luminance(combine_normalised, unbiased, biased, squares=squares)


def neural_combine_normalised(
    network: Callable[[Image, Image, Variance, Image], Float[Array, "h w 3 c"]],
    unbiased: Image,
    biased: Image,
    variance: Variance,
    sure: Image,
    *,
    activate: Callable[[Float[Array, "h w 3 c"]], Image] | None = None,
    bound: bool = True,
) -> Image:
    """Mix normalised images; for crops of a normalised frame, and for training.

    Not scale-equivariant, and local without the bound: `neural_combine` without its
    normalisation.

    Args:
        network: as for `neural_combine`.
        unbiased: x, normalised radiance, shape [H,W,C].
        biased: y, likewise.
        variance: v of the mean x, at least zero, likewise.
        sure: s, likewise.
        activate: as for `neural_combine`.
        bound: lower alpha where the mix is not consistent with the noise.

    Returns:
        z, normalised radiance, shape [H,W,C]; at an invalid pixel the first finite of
        (y, x), else 0.

    Raises:
        ValueError: while tracing, if shapes differ.

    Example:
        >>> at = lambda value: jnp.full((3, 3, 1), value)
        >>> network = lambda *_: jnp.stack([at(0.5), at(0.25), at(1.0)], axis=2)
        >>> images = at(3.0), at(1.0), at(1.0), at(2.0)
        >>> print(neural_combine_normalised(network, *images, bound=False)[0, 0])
        [2.5]

    Source: PD eq. 11, 18, 19.
    """

    def mix(*images: Image) -> Image:
        _, x, y, v, s = zero_invalid(*images)
        return (activate or activation)(network(x, y, v, s))

    return combine(unbiased, biased, variance, sure, mix=mix, bound=bound)


def mixing(
    unbiased: Image,
    biased: Image,
    variance: Variance,
    sure: Image,
    *,
    window: int = 15,
    whiten: bool = False,
) -> Image:
    """Mixing of least estimated error over windows, without a network.

    Args:
        unbiased: x, linear radiance, shape [H,W,C].
        biased: y, linear radiance, shape [H,W,C].
        variance: v, squared radiance, at least zero, shape [H,W,C].
        sure: s, squared radiance, of either sign, shape [H,W,C].
        window: width of the windows in pixels, odd.
        whiten: count each pixel in units of its own variance, so that the noisiest do
            not decide for the window; those of variance 0 do not count. Wants a robust
            variance, such as `james_stein.robust_variance`, in `sure` as well.

    Returns:
        alpha, in [0, 1], shape [H,W,C]; 1 where x and y are the same all over the
        window.

    Raises:
        ValueError: while tracing, if shapes differ or `window` is even.

    Example:
        >>> at = lambda value: jnp.full((3, 3, 1), value)
        >>> print(mixing(at(3.0), at(1.0), at(1.0), at(2.0))[0, 0])
        [0.375]

    Source: PD eq. 9, 10, summed over windows and channels alike.
    """
    check_same_shape(unbiased=unbiased, biased=biased, variance=variance, sure=sure)
    valid = finite(unbiased, biased, variance, sure)
    images = unbiased, biased, variance, sure
    x, y, v, s = (jnp.where(valid, image, 0.0) for image in images)
    square, saved = jnp.square(y - x), v - s
    if whiten:
        most = _MOST_EVIDENCE / float(jnp.finfo(v.dtype).eps)
        unit = jnp.maximum(v, jnp.maximum(square, jnp.abs(saved)) / most)
        square, saved = (divide(i, unit, where=v > 0) for i in (square, saved))
    square = window_sum(square, window)
    gain = window_sum(saved, window) + square
    some = square > 0
    ratio = divide(gain, 2 * square, where=some, otherwise=1.0)
    return jnp.clip(ratio, 0.0, 1.0)


def risk(
    mixing: Image, unbiased: Image, biased: Image, variance: Variance, sure: Image
) -> Image:
    """Estimate the squared error of the mixed image.

    For a mixing that does not follow the noise; one that does is better on paper than
    in truth.

    Args:
        mixing: alpha, in [0, 1], shape [H,W,C].
        unbiased: x, linear radiance, shape [H,W,C].
        biased: y, linear radiance, shape [H,W,C].
        variance: v, squared radiance, at least zero, shape [H,W,C].
        sure: s, squared radiance, of either sign, shape [H,W,C].

    Returns:
        the estimate at each element, squared radiance, noisy, of either sign, shape
        [H,W,C]; average before use. 0 at invalid pixels.

    Raises:
        ValueError: while tracing, if shapes differ.

    Example:
        >>> at = lambda value: jnp.full((1, 1, 1), value)
        >>> for alpha in (0.0, 0.375, 1.0):  # x alone, the best mixing, y alone
        ...     print(risk(at(alpha), at(3.0), at(1.0), at(1.0), at(2.0))[0, 0])
        [1.]
        [0.4375]
        [2.]

    Source: PD eq. 8.
    """
    check_same_shape(mixing=mixing, unbiased=unbiased, biased=biased)
    check_same_shape(mixing=mixing, variance=variance, sure=sure)
    images = mixing, unbiased, biased, variance, sure
    valid = finite(*images)
    alpha, x, y, v, s = (jnp.where(valid, image, 0.0) for image in images)
    divergence = (s - jnp.square(y - x) + v) / 2
    beta = 1 - alpha
    return beta**2 * v + alpha**2 * s + 2 * alpha * beta * divergence


def activation(outputs: Float[Array, "h w 3 c"]) -> Image:
    """Alpha from what a network puts out, in the form of eq. 9.

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


def direct_activation(
    outputs: Float[Array, "h w 3 c"], *, beyond: float = 0.02
) -> Image:
    """Alpha from the first output alone, without the form of eq. 9.

    Args:
        outputs: xi_1 and two that do not count, shape [H,W,3,C].
        beyond: e, by which the logistic function is stretched before it is cut, so that
            0 and 1 are reached: a thousandth of a firefly is still one. 0 to train by,
            since what is cut has no derivative.

    Returns:
        clip((1 + 2 e) sigmoid(xi_1) - e, 0, 1), shape [H,W,C].

    Example:
        >>> first = jnp.array([-10.0, 0.0, 10.0]).reshape(1, 3, 1, 1)
        >>> outputs = jnp.concatenate([first, 0 * first, 0 * first], axis=2)
        >>> print([f"{alpha:.3f}" for alpha in direct_activation(outputs).ravel()])
        ['0.000', '0.500', '1.000']

    Source: PD table 4, which finds it worse; trained on our frames it is better.
    """
    share = jax.nn.sigmoid(outputs[:, :, 0])
    return jnp.clip((1 + 2 * beyond) * share - beyond, 0.0, 1.0)


def bound_mixing(
    mixing: Image,
    unbiased: Image,
    biased: Image,
    variance: Variance,
    *,
    window: int = 11,
    strength: float = 2.0,
    shift: float = 4.2,
) -> Image:
    """Lower the mixing where it moves the image by more than noise explains.

    A t-statistic of means over the channels and over a neighbourhood: the pixel of
    largest variance in the window, and the window with Gaussian weights, the narrower
    the less noise there is.

    Args:
        mixing: alpha, in [0, 1], shape [H,W,C].
        unbiased: x, linear radiance, shape [H,W,C].
        biased: y, linear radiance, shape [H,W,C].
        variance: v of the mean x, squared radiance, at least zero, shape [H,W,C].
        window: width of the windows in pixels, odd.
        strength: a, how soon the bound sets in.
        shift: c, at how many standard deviations.

    Returns:
        alpha' = alpha (1 - Phi(a (|t| - c))), shape [H,W,C]; 0 where x is certain and
        would be moved, and at invalid pixels.

    Raises:
        ValueError: while tracing, if shapes differ or `window` is even.

    Example:
        >>> at = lambda value: jnp.full((3, 3, 1), value)
        >>> for variance in (1.0, 0.025, 0.015):
        ...     alpha = jax.jit(bound_mixing)(at(0.5), at(1.0), at(2.0), at(variance))
        ...     print(f"{alpha[1, 1, 0]:.3f}")
        0.500
        0.374
        0.009

    Source: PD eq. 12-18. The width of the Gaussian there is absolute; here it is
    relative to the mean radiance, which is the same at an exposure of about one.
    """
    check_same_shape(mixing=mixing, unbiased=unbiased, biased=biased, variance=variance)
    images = mixing, unbiased, biased, variance
    valid = finite(*images)
    alpha, x, y, v = (jnp.where(valid, image, 0.0) for image in images)
    channels = x.shape[-1]
    moved = jnp.mean(alpha * (y - x), axis=-1, keepdims=True)
    noise = jnp.sum(v, axis=-1, keepdims=True) / channels**2
    largest = at_window_max(
        noise, jnp.concatenate([moved, noise], axis=-1), window, mask=valid
    )
    count = jnp.maximum(jnp.sum(valid), 1).astype(x.dtype)
    radiance = jnp.sum(jnp.abs(x)) / (count * channels)
    kernel = _kernel(jnp.sum(noise) / count, radiance, window)
    mean = largest[..., :1] + separable_sum(moved, kernel)
    error = largest[..., 1:] + separable_sum(noise, jnp.square(kernel))
    t = _magnitude(mean, error)
    return jnp.where(valid, alpha * ndtr(strength * (shift - t)), 0.0)


def _kernel(noise: Array, radiance: Array, window: int) -> Float[Array, " taps"]:
    """Along one axis: rows times columns are the weights of eq. 15."""
    square = divide(noise, jnp.square(radiance), where=radiance > 0)
    some = square > 0
    relative = jnp.where(some, jnp.sqrt(jnp.where(some, square, 1.0)), 0.0)
    sigma = jnp.clip(_WIDEST * relative, _NARROWEST, _WIDEST)
    r = check_window(window) // 2
    offsets = jnp.arange(-r, r + 1, dtype=noise.dtype)
    shape = jnp.exp(-jnp.square(offsets / sigma) / 2)
    return shape / jnp.sqrt(sigma * (2 * jnp.pi) ** 0.5)


def _magnitude(mean: Array, error: Array) -> Array:
    """|t| = |mean| / sqrt(error); beyond any bound where there is no error."""
    square = jnp.square(mean)
    least = jnp.finfo(mean.dtype).eps * square
    certain = jnp.where(square > 0, 1e6, jnp.zeros_like(square))
    ratio = divide(square, error, where=error > least, otherwise=certain)
    some = ratio > 0
    return jnp.where(some, jnp.sqrt(jnp.where(some, ratio, 1.0)), 0.0)
