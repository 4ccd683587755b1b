"""The mix of a rendering and its denoised image, and the bound for consistency."""

from collections.abc import Callable
from typing import Literal, get_args

import jax.numpy as jnp
from jax.scipy.special import ndtr
from jaxtyping import Array, Float

from jscomb.numerics.guards import (
    check_same_shape,
    divide,
    finite,
    first_finite,
    safe_sqrt,
    zero_invalid,
)
from jscomb.numerics.linear import channel_mean, channel_sum
from jscomb.numerics.tiles import in_memory, in_one_pass
from jscomb.numerics.windows import at_window_max, check_window, separable_sum
from jscomb.progressive._estimate import mixing_of_valid
from jscomb.typing import Image, Mask, Scalar, Variance

Width = Literal["relative", "absolute", "image mean"]
Mixing = Callable[[Image, Image, Variance, Image], Image]

_NARROWEST, _WIDEST = 1e-3, 100.0  # of the bound's Gaussian, in pixels

BOUND_WINDOW = 11  # width of the bound's windows in pixels
_STRENGTH, _SHIFT = 2.0, 4.2  # a and c

Noise = Float[Array, "h w 1"]


def combine(
    unbiased: Image,
    biased: Image,
    variance: Variance,
    sure: Image,
    *,
    mix: Mixing | None = None,
    bound: bool = True,
    noise: Noise | None = None,
    sigma: Scalar | None = None,
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
        noise: as for `bound_mixing`.
        sigma: as for `bound_mixing`.

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
    valid, x, y, v, s = zero_invalid(unbiased, biased, variance, sure)
    if mix is None:
        alpha = mixing_of_valid(x, y, v, s)
    else:
        alpha = mix(unbiased, biased, variance, sure)
    if bound:
        known = valid & finite(alpha)
        alpha = jnp.where(known, alpha, 0.0)
        alpha = _bounded(known, alpha, x, y, v, noise=noise, sigma=sigma)
    # As a blend, not x + alpha (y - x), so that 0 and 1 are exact.
    blend = (1 - alpha) * x + alpha * y
    return jnp.where(valid, blend, first_finite(biased, unbiased))


def bound_mixing(
    mixing: Image,
    unbiased: Image,
    biased: Image,
    variance: Variance,
    *,
    noise: Noise | None = None,
    sigma: Scalar | None = None,
    window: int = BOUND_WINDOW,
    strength: float = _STRENGTH,
    shift: float = _SHIFT,
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
        noise: variance of the channels' mean of x, squared radiance, at least zero,
            shape [H,W,1], such as `channel_variance` estimates; None for the paper's,
            which is right for independent channels.
        sigma: width of the Gaussian in pixels; None for `bound_sigma` of these images,
            which crops of an image do not know.
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

    Source: PD eq. 12-18.
    """
    check_same_shape(mixing=mixing, unbiased=unbiased, biased=biased, variance=variance)
    valid, *images = zero_invalid(mixing, unbiased, biased, variance)
    return _bounded(
        valid,
        *images,
        noise=noise,
        sigma=sigma,
        window=window,
        strength=strength,
        shift=shift,
    )


def _bounded(
    valid: Mask,
    alpha: Image,
    x: Image,
    y: Image,
    v: Variance,
    *,
    noise: Noise | None,
    sigma: Scalar | None,
    window: int = BOUND_WINDOW,
    strength: float = _STRENGTH,
    shift: float = _SHIFT,
) -> Image:
    """`bound_mixing` of images that are 0 at invalid pixels."""
    noise = _of_mean(v) if noise is None else jnp.where(valid, noise, 0.0)
    if sigma is None:
        sigma = _sigma(valid, x, noise)
    moved = channel_mean(alpha * (y - x))
    # In memory, or the pads of each window would compute them anew.
    moved, noise = in_memory(moved, noise)
    largest = at_window_max(
        noise, jnp.concatenate([moved, noise], axis=-1), window, mask=valid
    )
    # Both are 0 at invalid pixels; masked again they would not be fused.
    kernel = _kernel(sigma, window)
    around = separable_sum(moved, kernel), separable_sum(noise, jnp.square(kernel))

    def kept(largest: Array, mean: Noise, error: Noise) -> Noise:
        t = _magnitude(largest[..., :1] + mean, largest[..., 1:] + error)
        return ndtr(strength * (shift - t))

    return jnp.where(valid, alpha * in_one_pass(kept, largest, *around), 0.0)


def bound_sigma(
    unbiased: Image,
    variance: Variance,
    *,
    noise: Noise | None = None,
    width: Width = "relative",
) -> Scalar:
    """Return the width of the bound's Gaussian: the narrower the less noise there is.

    The paper has 100 min(sqrt(Var[x-]), 1), where x- is "the image mean". That may mean
    the mean of the pixels' variances, or the variance of the mean of all pixels, which
    is so small that a pixel's own mean is all that is tested.

    Args:
        unbiased: x, linear radiance, shape [H,W,C].
        variance: v of the mean x, squared radiance, at least zero, shape [H,W,C].
        noise: as for `bound_mixing`.
        width: "absolute", by the mean of the pixels' variances, in squared normalised
            radiance; "relative", ours, the same relative to the mean radiance, and so
            for images in any unit; "image mean", by the variance of the image's mean.

    Returns:
        the width, from 0.001 to 100 pixels.

    Raises:
        ValueError: while tracing, if shapes differ or the width is unknown.

    Example:
        >>> x = jnp.full((2, 2, 3), 2.0)
        >>> for width in ("relative", "absolute", "image mean"):
        ...     print(bound_sigma(x, 1.5e-4 * x, width=width).round(3))
        0.5
        1.0
        0.5

    Source: PD eq. 15.
    """
    check_same_shape(unbiased=unbiased, variance=variance)
    if width not in get_args(Width):
        raise ValueError(f"width must be one of {get_args(Width)}, got {width!r}")
    valid, x, v = zero_invalid(unbiased, variance)
    noise = _of_mean(v) if noise is None else jnp.where(valid, noise, 0.0)
    return _sigma(valid, x, noise, width=width)


def _sigma(valid: Mask, x: Image, noise: Noise, *, width: Width = "relative") -> Scalar:
    """`bound_sigma` of images that are 0 at invalid pixels."""
    count = jnp.maximum(jnp.sum(valid), 1).astype(x.dtype)
    square = jnp.sum(noise) / count
    if width == "image mean":
        square = square / count
    if width == "relative":
        radiance = jnp.sum(jnp.abs(channel_mean(x))) / count
        square = divide(square, jnp.square(radiance), where=radiance > 0)
    return jnp.clip(_WIDEST * safe_sqrt(square), _NARROWEST, _WIDEST)


def _of_mean(variance: Variance) -> Noise:
    """Variance of the mean of independent channels."""
    return channel_sum(variance) / variance.shape[-1] ** 2


def _kernel(sigma: Scalar, window: int) -> Float[Array, " taps"]:
    """Along one axis: rows times columns are the weights of eq. 15."""
    r = check_window(window) // 2
    offsets = jnp.arange(-r, r + 1, dtype=sigma.dtype)
    shape = jnp.exp(-jnp.square(offsets / sigma) / 2)
    return shape / jnp.sqrt(sigma * (2 * jnp.pi) ** 0.5)


def _magnitude(mean: Array, error: Array) -> Array:
    """|t| = |mean| / sqrt(error); beyond any bound where there is no error."""
    square = jnp.square(mean)
    rounding = jnp.finfo(mean.dtype).eps * square
    certain = jnp.where(square > 0, 1e6, jnp.zeros_like(square))
    ratio = divide(square, error, where=error > rounding, otherwise=certain)
    return safe_sqrt(ratio)
