"""Shrinkage of the difference of two renderings in bands of spatial scale.

With r = (x - y) / s the difference relative to the radiance, G_0 the identity, G_k
Gaussian filters of ascending width and none beyond the last, the bands sum to r,

    d_k = (G_k - G_(k+1)) r,    v_k = sum over the kernel's squares of v / s^2,

and each is shrunk by the share of its power around the pixel that is not noise,

    eta_k = (1 - t <v_k> / <d_k^2>)+,    x^ = y + s sum_k eta_k d_k,

where <.> is the mean weighted by G_k (for the finest band by the widest filter). A
denoiser that lost a texture or an edge leaves it in the difference at one scale, where
a window of all scales sees mostly noise. Without noise the result is x.
"""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np

from jscomb.numerics.guards import (
    check_same_shape,
    divide,
    first_finite,
    masked_mean,
    safe_sqrt,
    weighted_ratio,
    zero_invalid,
)
from jscomb.numerics.linear import channel_mean
from jscomb.numerics.tiles import in_memory
from jscomb.numerics.windows import gaussian_kernel, reach_of, separable_sum
from jscomb.typing import Image, Scalar, Variance

SIGMAS = 0.7, 1.0, 1.4, 2.0
STRENGTH = 2.0
_FEW = 12.0  # samples whose variance is so noisy that the strength rises by one


def combine_bands(
    unbiased: Image,
    biased: Image,
    variance: Variance,
    *,
    sigmas: Sequence[float] = SIGMAS,
    strength: Scalar | float = STRENGTH,
    epsilon: Scalar | float | None = None,
) -> Image:
    """Shrink `unbiased` towards `biased` in bands of spatial scale.

    Pure, scale-equivariant without `epsilon`, and differentiable in every array. Sample
    variances are used as they are: a firefly has a large one.

    Args:
        unbiased: x, linear radiance, shape [H,W,C].
        biased: y, linear radiance, shape [H,W,C].
        variance: of the mean x, squared radiance, shape [H,W,C].
        sigmas: standard deviations in pixels of the filters G_k, ascending.
        strength: t; more than 1 because y follows x, and because the share of a few
            pixels is itself noisy. See `strength_for`.
        epsilon: squared radiance added to that of a pixel, which limits the weight of
            black ones; None for a hundredth of the squared mean of y.

    Returns:
        the combined rendering, linear radiance, shape [H,W,C]; at an invalid pixel the
        first finite of (y, x), else 0.

    Raises:
        ValueError: while tracing, if shapes differ or `sigmas` do not ascend.

    Example:
        >>> x, y = jnp.full((9, 9, 1), 3.0), jnp.ones((9, 9, 1))
        >>> for noise in (0.0, 1.0, 100.0):
        ...     print(combine_bands(x, y, jnp.full_like(x, noise))[4, 4].round(2))
        [3.]
        [2.97]
        [1.]

    Source: ours, after NJS eq. 5; the constants were set on path-traced frames.
    """
    check_same_shape(unbiased=unbiased, biased=biased, variance=variance)
    if not sigmas or min(np.diff([0.0, *sigmas])) <= 0:
        raise ValueError(f"sigmas must be positive and ascend, got {[*sigmas]}")
    valid, x, y, v = zero_invalid(unbiased, biased, variance)
    bright = channel_mean(y)
    if epsilon is None:
        epsilon = 0.01 * jnp.square(masked_mean(bright, valid))
    square = jnp.square(bright) + epsilon
    scale = jnp.broadcast_to(safe_sqrt(square), x.shape)
    some = valid & (scale > 0)
    difference = divide(x - y, scale, where=some)
    noise = divide(v, jnp.broadcast_to(square, v.shape), where=some)
    difference, noise = in_memory(difference, channel_mean(noise))

    gaussians = [_gaussian(sigma) for sigma in sigmas]
    kernels = [np.ones(1), *gaussians]
    around = [gaussians[-1], *gaussians]
    ones = valid.astype(x.dtype)
    mass = in_memory(*(separable_sum(ones, kernel) for kernel in kernels))
    filtered = [
        weighted_ratio(separable_sum(difference, kernel), weight)
        for kernel, weight in zip(kernels, mass, strict=True)
    ]

    def covariance(i: int, j: int) -> Image:
        """Of the differences filtered by a kernel and by one at least as wide."""
        beyond = (len(kernels[j]) - len(kernels[i])) // 2
        inner = kernels[j][beyond : len(kernels[j]) - beyond]
        total = separable_sum(noise, kernels[i] * inner)
        return weighted_ratio(total, mass[i] * mass[j])

    t, kept = jnp.asarray(strength, x.dtype), jnp.zeros_like(difference)
    for k, kernel in enumerate(around):
        band, spread = filtered[k], covariance(k, k)
        if k + 1 < len(kernels):
            band = band - filtered[k + 1]
            spread += covariance(k + 1, k + 1) - 2 * covariance(k, k + 1)
        power = channel_mean(jnp.square(band))
        power, spread = (separable_sum(i * ones, kernel) for i in (power, spread))
        (ratio,) = in_memory(divide(spread, power, where=power > 0, otherwise=1.0))
        kept += jnp.clip(1 - t * ratio, 0.0, 1.0) * band
    return jnp.where(valid, y + scale * kept, first_finite(biased, unbiased))


def strength_for(samples: Scalar | float | None) -> Scalar | float:
    """Return the strength of `combine_bands` for a number of samples.

    The fewer the samples, the noisier is their variance, and the more often it is too
    small where no sample found the light.

    Args:
        samples: a pixel; None if unknown.

    Returns:
        t, without unit: 2 + 12 / samples.

    Example:
        >>> print(strength_for(16.0), strength_for(None))
        2.75 2.0

    Source: ours; set so that eleven path-traced scenes are never made 1 % worse.
    """
    return STRENGTH if samples is None else STRENGTH + _FEW / samples


def reach_of_bands(*, sigmas: Sequence[float] = SIGMAS) -> int:
    """Return how many pixels away `combine_bands` sees, with `epsilon`.

    Args:
        sigmas: as of `combine_bands`.

    Returns:
        the distance in pixels.

    Example:
        >>> print(reach_of_bands())
        10
    """
    window = len(_gaussian(sigmas[-1]))
    return reach_of(window, window)


def _gaussian(sigma: float) -> np.ndarray:
    """Weights along one axis, cut off where they hardly matter."""
    return gaussian_kernel(2 * int(np.ceil(2.5 * sigma)) + 1, sigma)
