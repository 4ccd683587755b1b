"""How far from the truth the biased image and the prior are, without a reference.

Every estimate is noise in a single pixel, and has to be pooled over windows. Errors are
taken to grow with radiance, or a lamp and its edge would decide for all around them:
for squared errors e, levels l^2 that they go with, and the size s^2 of all that e is
made of,

    m_i = l_i^2 sum_j (e_j / s_j^2) / sum_j (l_j^2 / s_j^2).

No pixel counts for much more than one, whatever fireflies it has.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jscomb.double_shrinkage.shrinkage import Errors, factors
from jscomb.numerics.guards import check_same_shape, divide, finite
from jscomb.numerics.windows import window_sum
from jscomb.typing import Image, Scalar


def unbiased_error(
    unbiased: Image, biased: Image, variance: Image, *, window: int = 15
) -> Image:
    """Variance of the unbiased image that a single pixel can be trusted with.

    A sample variance misses what its samples missed, and that of a neighbourhood knows
    nothing of a firefly: the mean of both, the latter relative to the biased image's
    square.

    Args:
        unbiased: u, linear radiance, shape [H,W,C].
        biased: b, likewise.
        variance: sample variance of the mean u, squared radiance, at least zero,
            likewise.
        window: width of the windows in pixels, odd.

    Returns:
        v, squared radiance, shape [H,W,C]. Pixels that are not finite take no part, and
        are 0.

    Raises:
        ValueError: while tracing, if shapes differ or `window` is even.

    Example:
        >>> one = jnp.ones((1, 2, 1))
        >>> variance = jnp.array([0.0, 1.0]).reshape(1, 2, 1)
        >>> print(unbiased_error(one, one, variance, window=3)[0, :, 0])
        [0.25 0.75]

    Source: ours; half and half measured best on three scenes.
    """
    check_same_shape(unbiased=unbiased, biased=biased, variance=variance)
    valid = finite(unbiased, biased, variance)
    u, b, v = (jnp.where(valid, i, 0.0) for i in (unbiased, biased, variance))
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
    """Mean squared error of a biased image, from halves of both integrators.

    All four are independent of each other, so (b_a - u_a) (b_b - u_b) is an unbiased
    estimate of the squared bias and (b_a - b_b)^2 / 4 of the variance of the mean. Both
    are pooled relative to the mean square of b_a and b_b.

    Args:
        unbiased_a: u_a, linear radiance, shape [H,W,C].
        unbiased_b: u_b, likewise.
        biased_a: b_a, of half the biased integrator's samples, likewise.
        biased_b: b_b, likewise.
        window: width of the windows in pixels, odd.

    Returns:
        m, of the mean of b_a and b_b, squared radiance, at least zero, shape [H,W,C].
        Where b is 0 it knows nothing, and m is the mean square of all four. Pixels that
        are not finite take no part, and are 0.

    Raises:
        ValueError: while tracing, if shapes differ or `window` is even.

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
    valid = finite(*images.values())
    ua, ub, ba, bb = (jnp.where(valid, i, 0.0) for i in images.values())
    level = (jnp.square(ba) + jnp.square(bb)) / 2
    size = (jnp.square(ua) + jnp.square(ub)) / 4 + level / 2
    pooled = lambda square: _pooled(square, level, size, window)
    squared_bias = jnp.maximum(pooled((ba - ua) * (bb - ub)), 0.0)
    mse = squared_bias + pooled(jnp.square(ba - bb) / 4)
    return jnp.where(level > 0, mse, size)


def _pooled(errors: Image, level: Image, size: Image, window: int) -> Image:
    """Errors relative to a level, pooled; pixels where `size` is 0 take no part."""
    total, weight = (
        window_sum(divide(image, size, where=size > 0), window)
        for image in (errors, level)
    )
    return level * divide(total, weight, where=weight > 0)


def radius_bias(
    mean: Image, weighted: Image, radii: Float[Array, " passes"], *, window: int = 15
) -> Image:
    """Squared bias of a photon-mapped image, from passes of unlike radii.

    The bias of density estimation is about proportional to the squared radius. So the
    slope of the passes' images over it, times its mean, is the bias of their mean. The
    slope is pooled relative to the mean image; with few passes, or radii that hardly
    differ, it is noise all the same, and its square too large.

    Args:
        mean: mean of the passes' images, linear radiance, shape [H,W,C].
        weighted: mean of the passes' images times their squared radius, of any unit,
            shape [H,W,C].
        radii: r of each pass, of the same unit, shape [passes]; not all the same.
        window: width in pixels that the slope is pooled over, odd.

    Returns:
        the squared bias, squared radiance, shape [H,W,C]; 0 at pixels that are not
        finite.

    Raises:
        ValueError: while tracing, if shapes differ or `window` is even.

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
    valid = finite(mean, weighted)
    b, br = (jnp.where(valid, image, 0.0) for image in (mean, weighted))
    square = jnp.square(radii)
    typical: Scalar = jnp.mean(square)
    spread = jnp.broadcast_to(jnp.var(square), b.shape)
    slope = divide(br - typical * b, spread, where=spread > 0)
    level = jnp.abs(b)
    return jnp.square(typical * _pooled(slope, level, level, window))


def confidence(
    prior: Image,
    unbiased: Image,
    biased: Image,
    variance: Errors,
    mse: Errors,
    *,
    window: int = 15,
) -> Image:
    """How far the truth lies from the prior: empirical Bayes over windows.

    The squared distance between the prior and the blend of both integrators is that to
    the truth and the blend's own error; what exceeds the latter is the prior's. Pooled
    relative to the prior's square.

    Args:
        prior: p, linear radiance, shape [H,W,C].
        unbiased: u, linear radiance, shape [H,W,C].
        biased: b, linear radiance, shape [H,W,C].
        variance: v of u, squared radiance, at least zero, shape [H,W,1] or [H,W,C].
        mse: m, of b, likewise.
        window: width of the windows in pixels, odd.

    Returns:
        eta^2, squared radiance, at least zero, shape [H,W,C]. Where the prior is 0 it
        is the blend's mean square with it; pixels that are not finite take no part, and
        are 0.

    Raises:
        ValueError: while tracing, if shapes differ or `window` is even.

    Example:
        >>> at = lambda value: jnp.full((1, 1, 1), value)
        >>> eta = confidence(at(1.0), at(3.0), at(3.0), at(2.0), at(2.0))
        >>> print(f"{eta.item():.3f}")  # (3 - 1)^2 - 2 * 2 / (2 + 2)
        3.000

    Source: ours, in place of DSC's network (section 4.3).
    """
    check_same_shape(prior=prior, unbiased=unbiased, biased=biased)
    valid = finite(prior, unbiased, biased, variance, mse)
    p, u, b, v, m = (
        jnp.where(valid, image, 0.0)
        for image in (prior, unbiased, biased, variance, mse)
    )
    share = factors(v, m, jnp.zeros_like(v))
    blend = share.blend(u, b)
    excess, level = jnp.square(blend - p) - share.error, jnp.square(p)
    size = (jnp.square(blend) + level) / 2
    eta = jnp.maximum(_pooled(excess, level, size, window), 0.0)
    return jnp.where(level > 0, eta, size)
