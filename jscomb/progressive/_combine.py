"""The mix of a rendering and its denoised image, and the bound for consistency."""

from collections.abc import Callable

import jax.numpy as jnp
from jax.scipy.special import ndtr
from jaxtyping import Array, Float

from jscomb.numerics.guards import (
    check_same_shape,
    divide,
    first_finite,
    safe_sqrt,
    zero_invalid,
)
from jscomb.numerics.windows import at_window_max, check_window, separable_sum
from jscomb.progressive._estimate import mixing
from jscomb.typing import Image, Variance

Mixing = Callable[[Image, Image, Variance, Image], Image]

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
        mix: from these four arrays to alpha in [0, 1], such as a network; None for
            `mixing`.
        bound: lower alpha where the mix is not consistent with the noise.

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
    valid, x, y, _, _ = zero_invalid(unbiased, biased, variance, sure)
    # As a blend, not x + alpha (y - x), so that 0 and 1 are exact.
    blend = (1 - alpha) * x + alpha * y
    return jnp.where(valid, blend, first_finite(biased, unbiased))


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
    """Lower the mixing where it changes the image by more than the noise explains.

    A t-statistic of means over the channels and over a neighbourhood: the pixel of
    largest variance in the window, and the window with Gaussian weights, the narrower
    the less noise there is.

    Args:
        mixing: alpha, in [0, 1], shape [H,W,C].
        unbiased: x, linear radiance, shape [H,W,C].
        biased: y, linear radiance, shape [H,W,C].
        variance: v of the mean x, squared radiance, at least zero, shape [H,W,C].
        window: width of the windows in pixels, odd.
        strength: a, how steeply the bound sets in.
        shift: c, the number of standard deviations where it does.

    Returns:
        alpha' = alpha (1 - Phi(a (|t| - c))), shape [H,W,C]; 0 where x is certain and
        would change, and at invalid pixels.

    Raises:
        ValueError: while tracing, if shapes differ or `window` is even.

    Example:
        >>> import jax
        >>> at = lambda value: jnp.full((3, 3, 1), value)
        >>> for variance in (1.0, 0.025, 0.015):
        ...     alpha = jax.jit(bound_mixing)(at(0.5), at(1.0), at(2.0), at(variance))
        ...     print(f"{alpha[1, 1, 0]:.3f}")
        0.500
        0.374
        0.009

    Source: PD eq. 12-18. The width of the Gaussian there is absolute; here it is
    relative to the mean radiance, which is the same for normalised images.
    """
    check_same_shape(mixing=mixing, unbiased=unbiased, biased=biased, variance=variance)
    valid, alpha, x, y, v = zero_invalid(mixing, unbiased, biased, variance)
    channels = x.shape[-1]
    moved = jnp.mean(alpha * (y - x), axis=-1, keepdims=True)
    noise = jnp.sum(v, axis=-1, keepdims=True) / channels**2
    largest = at_window_max(
        noise, jnp.concatenate([moved, noise], axis=-1), window, mask=valid
    )
    # Both are 0 at invalid pixels; masked again they would not be fused.
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
    sigma = jnp.clip(_WIDEST * safe_sqrt(square), _NARROWEST, _WIDEST)
    r = check_window(window) // 2
    offsets = jnp.arange(-r, r + 1, dtype=noise.dtype)
    shape = jnp.exp(-jnp.square(offsets / sigma) / 2)
    return shape / jnp.sqrt(sigma * (2 * jnp.pi) ** 0.5)


def _magnitude(mean: Array, error: Array) -> Array:
    """|t| = |mean| / sqrt(error); beyond any bound where there is no error."""
    square = jnp.square(mean)
    rounding = jnp.finfo(mean.dtype).eps * square
    certain = jnp.where(square > 0, 1e6, jnp.zeros_like(square))
    ratio = divide(square, error, where=error > rounding, otherwise=certain)
    return safe_sqrt(ratio)
