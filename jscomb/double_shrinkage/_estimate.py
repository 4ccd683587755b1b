"""Estimate the errors of both images and of the prior, without a reference.

A single pixel's estimate is too noisy, so it is pooled over a window. Errors are
assumed to grow with radiance; otherwise a lamp and its edge would dominate all around
them. For squared errors e, levels l^2 that they are proportional to, and s^2, the mean
square of the images that e comes from:

    m_i = l_i^2 sum_j (e_j / s_j^2) / sum_j (l_j^2 / s_j^2).

A pixel's part in the sums is at most about one, so that no firefly dominates.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jscomb.double_shrinkage._combine import Errors, factors
from jscomb.numerics.guards import (
    check_same_shape,
    divide,
    safe_sqrt,
    weighted_ratio,
    zero_invalid,
)
from jscomb.numerics.tiles import in_memory
from jscomb.numerics.windows import block_sum, window_sum
from jscomb.typing import Image, Scalar

_DEVIATIONS = 3.0  # of the unbiased image, that a prior may be away from it
_BLOCK = 8  # width in pixels of the blocks whose noise is compared


def unbiased_error(
    unbiased: Image, biased: Image, variance: Image, *, window: int = 15
) -> Image:
    """Estimate the variance of the unbiased image, robust for single pixels.

    A sample variance misses rare bright samples, that of a neighbourhood misses
    fireflies; the result is the mean of both.

    Args:
        unbiased: u, linear radiance, shape [H,W,C].
        biased: b, linear radiance, shape [H,W,C].
        variance: sample variance of the mean u, squared radiance, shape [H,W,C].
        window: width of the windows in pixels, odd.

    Returns:
        v, squared radiance, shape [H,W,C]; 0 at invalid pixels, which are excluded.

    Raises:
        ValueError: if shapes differ or `window` is even.

    Example:
        >>> one = jnp.ones((1, 2, 1))
        >>> variance = jnp.array([0.0, 1.0]).reshape(1, 2, 1)
        >>> print(unbiased_error(one, one, variance, window=3)[0, :, 0])
        [0.25 0.75]

    Source: ours; equal shares had the lowest error on three scenes.
    """
    check_same_shape(unbiased=unbiased, biased=biased, variance=variance)
    _, u, b, v = zero_invalid(unbiased, biased, variance)
    level = jnp.square(b)
    return (v + _pooled(v, level, (jnp.square(u) + level) / 2, window)) / 2


def biased_error(
    unbiased_a: Image,
    unbiased_b: Image,
    biased_a: Image,
    biased_b: Image,
    *,
    window: int = 15,
) -> Image:
    """Estimate the mean squared error of a biased image from halves.

    All four images are independent, so (b_a - u_a) (b_b - u_b) is an unbiased estimate
    of the squared bias, and (b_a - b_b)^2 / 4 of the variance of the mean. Both are
    pooled relative to the mean square of b_a and b_b.

    Args:
        unbiased_a: u_a, linear radiance, shape [H,W,C].
        unbiased_b: u_b, linear radiance, shape [H,W,C].
        biased_a: b_a, of half the biased integrator's samples, shape [H,W,C].
        biased_b: b_b, of the other half, shape [H,W,C].
        window: width of the windows in pixels, odd.

    Returns:
        m of the mean of b_a and b_b, squared radiance, at least zero, shape [H,W,C];
        the mean square of all four where b is 0; 0 at invalid pixels, which are
        excluded.

    Raises:
        ValueError: if shapes differ or `window` is even.

    Example:
        >>> at = lambda value: jnp.full((1, 1, 1), value)
        >>> m = biased_error(at(4.0), at(4.0), at(5.0), at(7.0))
        >>> print(f"{m.item():.3f}")  # (5 - 4) (7 - 4) + (5 - 7)^2 / 4
        4.000

    Source: DSC section 4.4, by halves as in the dual buffers that it cites.
    """
    images = {
        "unbiased_a": unbiased_a,
        "unbiased_b": unbiased_b,
        "biased_a": biased_a,
        "biased_b": biased_b,
    }
    check_same_shape(**images)
    _, ua, ub, ba, bb = zero_invalid(*images.values())
    level = (jnp.square(ba) + jnp.square(bb)) / 2
    size = (jnp.square(ua) + jnp.square(ub)) / 4 + level / 2
    pooled = lambda square: _pooled(square, level, size, window)
    squared_bias = jnp.maximum(pooled((ba - ua) * (bb - ub)), 0.0)
    mse = squared_bias + pooled(jnp.square(ba - bb) / 4)
    return jnp.where(level > 0, mse, size)


def _pooled(errors: Image, level: Image, size: Image, window: int) -> Image:
    """Errors pooled relative to a level; pixels where `size` is 0 are excluded."""
    total, weight = (
        window_sum(weighted_ratio(image, size), window) for image in (errors, level)
    )
    return level * weighted_ratio(total, weight)


def radius_bias(
    mean: Image, weighted: Image, radii: Float[Array, " passes"], *, window: int = 15
) -> Image:
    """Estimate the squared bias of photon mapping from passes with different radii.

    The bias of density estimation is about proportional to the squared radius. So the
    slope of the passes' images over r^2, times the mean of r^2, is the bias of their
    mean. With few passes, or radii that hardly differ, the pooled slope stays noisy,
    and its square too large.

    Args:
        mean: mean of the passes' images, linear radiance, shape [H,W,C].
        weighted: mean of the passes' images times their r^2, shape [H,W,C].
        radii: r of each pass, in any unit, shape [passes]; not all the same.
        window: width of the windows in pixels, odd.

    Returns:
        the squared bias, squared radiance, shape [H,W,C]; 0 at invalid pixels.

    Raises:
        ValueError: if shapes differ or `window` is even.

    Example:
        >>> radii = jnp.array([1.0, 2.0])
        >>> passes = 1 + 0.1 * radii**2  # where the truth is 1
        >>> at = lambda value: jnp.mean(value).reshape(1, 1, 1)
        >>> found = radius_bias(at(passes), at(passes * radii**2), radii)
        >>> print(f"{found.item():.4f} {jnp.mean(passes) - 1:.4f}")
        0.0625 0.2500

    Source: after T. Hachisuka, W. Jarosz, H. W. Jensen, "A progressive error estimation
    framework for photon density estimation", 2010, which derives kernels instead.
    """
    check_same_shape(mean=mean, weighted=weighted)
    _, b, br = zero_invalid(mean, weighted)
    square = jnp.square(radii)
    typical: Scalar = jnp.mean(square)
    spread = jnp.broadcast_to(jnp.var(square), b.shape)
    slope = weighted_ratio(br - typical * b, spread)
    level = jnp.abs(b)
    return jnp.square(typical * _pooled(slope, level, level, window))


def prior_error(
    prior: Image,
    unbiased: Image,
    biased: Image,
    variance: Errors,
    mse: Errors,
    *,
    window: int = 15,
) -> Image:
    """Estimate how far the truth lies from the prior, by empirical Bayes over windows.

    The expected squared distance between the prior and the blend of both integrators is
    that between the prior and the truth, plus the blend's own error s. So eta^2 is what
    exceeds s, pooled relative to the square of the prior.

    Args:
        prior: p, linear radiance, shape [H,W,C].
        unbiased: u, linear radiance, shape [H,W,C].
        biased: b, linear radiance, shape [H,W,C].
        variance: v of u, squared radiance, at least zero, shape [H,W,1] or [H,W,C].
        mse: m of b, same.
        window: width of the windows in pixels, odd.

    Returns:
        eta^2, squared radiance, at least zero, shape [H,W,C]; the mean square of blend
        and prior where the prior is 0; 0 at invalid pixels, which are excluded.

    Raises:
        ValueError: if shapes differ or `window` is even.

    Example:
        >>> at = lambda value: jnp.full((1, 1, 1), value)
        >>> eta = prior_error(at(1.0), at(3.0), at(3.0), at(2.0), at(2.0))
        >>> print(f"{eta.item():.3f}")  # (3 - 1)^2 - 2 * 2 / (2 + 2)
        3.000

    Source: ours, in place of DSC's network (section 4.3).
    """
    check_same_shape(prior=prior, unbiased=unbiased, biased=biased)
    _, p, u, b, v, m = zero_invalid(prior, unbiased, biased, variance, mse)
    share = factors(v, m, jnp.zeros_like(v))
    blend = share.blend(u, b)
    excess, level = jnp.square(blend - p) - share.error, jnp.square(p)
    excess, blend = in_memory(excess, blend)
    size = (jnp.square(blend) + level) / 2
    eta = jnp.maximum(_pooled(excess, level, size, window), 0.0)
    return jnp.where(level > 0, eta, size)


def limit_prior(prior: Image, unbiased: Image, biased: Image, variance: Image) -> Image:
    """Limit a prior to what the noise of the unbiased or the biased image allows.

    A regression may be wild beside a light, where pooled errors do not tell. Here a
    value beyond three standard deviations of u becomes the farthest that is not, or b
    where that is farther: u may be a firefly, or have missed a light.

    Args:
        prior: p, linear radiance, shape [H,W,C].
        unbiased: u, linear radiance, shape [H,W,C].
        biased: b, linear radiance, shape [H,W,C].
        variance: v of u, squared radiance, at least zero, shape [H,W,C].

    Returns:
        the prior, shape [H,W,C]; not finite where an image is not.

    Raises:
        ValueError: if shapes differ.

    Example:
        >>> at = lambda value: jnp.full((1, 1, 1), value)
        >>> print(limit_prior(at(69.0), at(0.5), at(0.25), at(0.0625)).item())
        1.25

    Source: ours.
    """
    check_same_shape(prior=prior, unbiased=unbiased, biased=biased, variance=variance)
    deviation = _DEVIATIONS * safe_sqrt(variance)
    lowest = jnp.minimum(unbiased - deviation, biased)
    return jnp.clip(prior, lowest, jnp.maximum(unbiased + deviation, biased))


class Dependence(NamedTuple):
    """How far the noise of a biased image follows that of the unbiased one.

    Attributes:
        correlation: of the differences of their halves, mean over blocks, shape [].
        standard_error: of `correlation`, over blocks, shape [].
    """

    correlation: Scalar
    standard_error: Scalar

    @property
    def certain(self) -> Bool[Array, ""]:
        """Whether the correlation is beyond five standard errors: a denoised image."""
        return self.correlation > 5 * self.standard_error


def dependence(
    unbiased_a: Image, unbiased_b: Image, biased_a: Image, biased_b: Image
) -> Dependence:
    """Measure whether a biased image was made from the samples of the unbiased one.

    A denoised image keeps some of the noise that it was made from; one of another
    integrator has noise of its own. The correlation is that of the halves' differences
    in blocks of 8x8 pixels, zero in the mean where both are independent: it changes its
    sign when the halves of one of them are exchanged.

    Args:
        unbiased_a: u of half a, linear radiance, shape [H,W,C].
        unbiased_b: u of half b, same shape.
        biased_a: b of half a, same shape.
        biased_b: b of half b, same shape.

    Returns:
        the correlation; zero where nothing differs.

    Raises:
        ValueError: while tracing, if shapes differ.

    Example:
        >>> import jax
        >>> u, own = jax.random.normal(jax.random.key(0), (2, 2, 64, 64, 3))
        >>> for b in (0.1 * u, own):
        ...     print(bool(dependence(*u, *b).certain))
        True
        False

    Source: ours.
    """
    check_same_shape(
        unbiased_a=unbiased_a,
        unbiased_b=unbiased_b,
        biased_a=biased_a,
        biased_b=biased_b,
    )
    _, u_a, u_b, b_a, b_b = zero_invalid(unbiased_a, unbiased_b, biased_a, biased_b)
    u, b = (jnp.mean(i, axis=-1, keepdims=True) for i in (u_a - u_b, b_a - b_b))
    # Each divided by its largest value, so that no product leaves the range.
    largest = [jnp.max(jnp.abs(i)) for i in (u, b)]
    u, b = (i / jnp.where(m > 0, m, 1.0) for i, m in zip((u, b), largest, strict=True))
    both, energy_u, energy_b = (
        block_sum(i, _BLOCK) for i in (u * b, jnp.square(u), jnp.square(b))
    )
    differ = (energy_u > 0) & (energy_b > 0)
    scale = safe_sqrt(energy_u) * safe_sqrt(energy_b)
    correlation = divide(both, scale, where=differ & (scale > 0))
    count = jnp.maximum(jnp.sum(differ), 1).astype(correlation.dtype)
    mean = jnp.sum(correlation) / count
    spread = jnp.sum(jnp.where(differ, jnp.square(correlation - mean), 0.0)) / count
    # Few blocks may agree by chance, but not by less than independent pixels would.
    spread = jnp.maximum(spread, 1 / _BLOCK**2)
    return Dependence(mean, safe_sqrt(spread / count))
