r"""Stein's unbiased risk estimate: squared error of a denoised image, without truth.

Layout: images [H,W,C], linear radiance. Notation, for each element i of an image:

    x    noisy, unbiased image; truth mu; x ~ N(mu, v), elements independent
    v    variance of x (of the mean)
    F    denoiser, any function of an image; J its Jacobian at x
    b    probe, independent elements of mean 0 and variance v

    E[(F(x) - mu)_i^2] = E[(F(x) - x)_i^2 + 2 J_ii v_i - v_i]                  (SURE)
    J_ii v_i = E[b_i (J b)_i]                                           (Monte Carlo)

J b is one forward derivative, exact at any scale of x; a difference quotient of float32
images loses its digits on bright pixels or its slope on dark ones. The estimate of one
element is mostly noise and often negative: average it over windows or frames. Noise
with heavy tails or correlated between pixels violates the assumption and biases it.

Sources:
    C. Stein, "Estimation of the mean of a multivariate normal distribution", 1981.
    S. Ramani, T. Blu, M. Unser, "Monte-Carlo SURE", 2008.
    A. Firmino, J. Frisvad, H. Jensen, "Progressive Denoising of Monte Carlo Rendered
    Images", 2022 (PD eq. 1, 2).
"""

from collections.abc import Callable
from typing import Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from jscomb.numerics.guards import (
    check_not_negative,
    check_same_shape,
    check_static,
    finite,
    repeat_channel,
    safe_sqrt,
    zero_invalid,
)
from jscomb.numerics.windows import window_mean
from jscomb.typing import Image, Key, Variance

__all__ = ["Risk", "exact_sure", "monte_carlo_sure", "pooled"]

Probe = Literal["rademacher", "gaussian"]


class Risk(NamedTuple):
    """A denoised image and its estimated error, [H,W,C] each.

    Attributes:
        denoised: F(x), linear radiance.
        squared_error: estimate of (F(x) - mu)^2, squared radiance; unbiased, noisy, of
            either sign; 0 at invalid pixels.
        divergence: estimate of J_ii v_i, squared radiance; 0 at invalid pixels.
    """

    denoised: Image
    squared_error: Image
    divergence: Image


def monte_carlo_sure(
    key: Key,
    denoise: Callable[[Image], Image],
    noisy: Image,
    variance: Variance,
    *,
    probes: int = 1,
    probe: Probe = "rademacher",
    slope_limit: float | None = None,
) -> Risk:
    """Denoise, and estimate the squared error of every element of the result.

    Takes one forward derivative of the denoiser for each probe, one after the other.
    Scale-equivariant if the denoiser is.

    Args:
        key: a typed key, for the probes.
        denoise: F, from an image to one of the same shape; with forward derivatives.
            Features that guide it are treated as constants.
        noisy: x, linear radiance, shape [H,W,C].
        variance: v, squared radiance, at least zero, shape [H,W,C].
        probes: number to average over; reduces the noise of the divergence, not that
            of (F(x) - x)^2.
        probe: random signs, "rademacher" (usually better, and exact with one probe
            where each output depends on its own pixel alone), or "gaussian".
        slope_limit: largest |J_ii| that is believed; None for any, which is unbiased. A
            denoiser whose curve is steep near black has slopes there that the noise of
            a rendering, which has no negative pixels, never meets.

    Returns:
        the denoised image, its estimated squared error, and the divergence. Pixels that
        are not finite in x or v are not probed.

    Raises:
        ValueError: while tracing, if shapes differ, the denoiser changes the shape,
            `probes` or the limit is not positive or the probe unknown; outside of `jit`
            also if the variance is negative.

    Example:
        >>> x = jnp.full((4, 4, 1), 3.0)
        >>> half = lambda image: image / 2
        >>> risk = monte_carlo_sure(jax.random.key(0), half, x, jnp.ones_like(x))
        >>> print(f"{risk.squared_error.mean():.3f} {risk.divergence.mean():.3f}")
        2.250 0.500

    Source: PD eq. 1, 2, with the exact derivative.
    """
    check_static(probes=probes, probe=probe)
    if probes < 1:
        raise ValueError(f"probes must be positive, got {probes}")
    if probe not in get_args(Probe):
        raise ValueError(f"probe must be one of {get_args(Probe)}, got {probe!r}")
    if slope_limit is not None and not slope_limit > 0:
        raise ValueError(f"slope_limit must be positive, got {slope_limit}")
    variance = repeat_channel(variance, noisy)
    deviation = _deviation(noisy, variance)
    draw = jax.random.rademacher if probe == "rademacher" else jax.random.normal

    def one(key: Array) -> tuple[Image, Image]:
        """F(x), and the divergence estimated by one probe."""
        b = deviation * draw(key, noisy.shape, noisy.dtype)
        denoised, moved = jax.jvp(denoise, (noisy,), (b,))
        _check_denoised(denoised, noisy)
        return denoised, b * moved

    first, others = jax.random.split(key)
    denoised, total = one(first)
    if probes > 1:
        add = lambda total, key: (total + one(key)[1], None)
        total, _ = lax.scan(add, total, jax.random.split(others, probes - 1))
    divergence = total / probes
    if slope_limit is not None:
        largest = slope_limit * jnp.square(deviation)
        divergence = jnp.clip(divergence, -largest, largest)
    return _risk(noisy, variance, denoised, divergence)


def exact_sure(
    denoise: Callable[[Image], Image], noisy: Image, variance: Variance
) -> Risk:
    """Return the risk with the exact divergence, to check small images.

    Takes one derivative for every element.

    Args:
        denoise: F, from an image to one of the same shape; with forward derivatives.
        noisy: x, linear radiance, shape [H,W,C].
        variance: v, squared radiance, shape [H,W,C].

    Returns:
        the same as `monte_carlo_sure`.

    Raises:
        ValueError: while tracing, if shapes differ or the denoiser changes the shape;
            outside of `jit` also if the variance is negative.

    Example:
        >>> x = jnp.full((2, 2, 1), 3.0)
        >>> mean = lambda image: jnp.broadcast_to(jnp.mean(image), image.shape)
        >>> risk = exact_sure(mean, x, jnp.ones_like(x))
        >>> print(risk.squared_error[0, 0], risk.divergence[0, 0])
        [-0.5] [0.25]
    """
    variance = repeat_channel(variance, noisy)
    deviation = _deviation(noisy, variance).ravel()
    denoised, push = jax.linearize(denoise, noisy)
    _check_denoised(denoised, noisy)

    def one(place: Array) -> Array:
        """J_ii v_i of one element."""
        b = jnp.where(jnp.arange(noisy.size) == place, deviation, 0.0)
        return deviation[place] * push(b.reshape(noisy.shape)).ravel()[place]

    divergence = lax.map(one, jnp.arange(noisy.size)).reshape(noisy.shape)
    return _risk(noisy, variance, denoised, divergence)


def pooled(risk: Risk, noisy: Image, variance: Variance, *, window: int) -> Risk:
    """Average the estimates over windows.

    Args:
        risk: from `monte_carlo_sure`.
        noisy: x, linear radiance, shape [H,W,C].
        variance: v, squared radiance, shape [H,W,C].
        window: width of the windows in pixels, odd.

    Returns:
        the risk with `squared_error` and `divergence` averaged over the valid pixels of
        each window.

    Raises:
        ValueError: while tracing, if shapes differ or `window` is even.

    Example:
        >>> x = jnp.zeros((1, 4, 1))
        >>> noisy = jnp.array([4.0, -2.0, 1.0, 1.0]).reshape(1, 4, 1)
        >>> risk = pooled(Risk(x, noisy, noisy), x, x, window=3)
        >>> print(risk.squared_error[0, :, 0])
        [1. 1. 0. 1.]
    """
    variance = repeat_channel(variance, noisy)
    check_same_shape(noisy=noisy, variance=variance, denoised=risk.denoised)
    valid = finite(noisy, variance)
    mean = lambda image: window_mean(image, window, mask=valid)
    return Risk(risk.denoised, mean(risk.squared_error), mean(risk.divergence))


def _deviation(noisy: Image, variance: Variance) -> Image:
    """Standard deviation of valid pixels, else 0."""
    check_same_shape(noisy=noisy, variance=variance)
    check_not_negative(variance=variance)
    _, _, variance = zero_invalid(noisy, variance)
    return safe_sqrt(variance)


def _risk(noisy: Image, variance: Variance, denoised: Image, divergence: Image) -> Risk:
    """SURE of every element."""
    valid, x, v, y = zero_invalid(noisy, variance, denoised)
    d = jnp.where(valid, divergence, 0.0)
    return Risk(denoised, jnp.square(y - x) + 2 * d - v, d)


def _check_denoised(denoised: Array, noisy: Image) -> None:
    """Raise if the denoiser changed the shape."""
    if denoised.shape != noisy.shape:
        raise ValueError(
            f"denoise made {denoised.shape} of an image of {noisy.shape}: the shapes "
            "must be equal"
        )
