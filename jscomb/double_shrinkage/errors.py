"""How far from the truth the biased image and the prior are, without a reference."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jscomb.double_shrinkage.shrinkage import Errors, factors
from jscomb.numerics.guards import check_same_shape, divide, finite
from jscomb.numerics.windows import window_mean
from jscomb.typing import Image, Scalar


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
    are noise in a single pixel, and their mean is taken over windows.

    Args:
        unbiased_a: u_a, linear radiance, shape [H,W,C].
        unbiased_b: u_b, likewise.
        biased_a: b_a, of half the biased integrator's samples, likewise.
        biased_b: b_b, likewise.
        window: width of the windows in pixels, odd.

    Returns:
        m, of the mean of b_a and b_b, squared radiance, at least the variance's share,
        shape [H,W,C]. Pixels that are not finite take no part; there it is the mean of
        the others.

    Raises:
        ValueError: while tracing, if shapes differ or `window` is even.

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
    pooled = lambda image: window_mean(image, window, mask=valid)
    squared_bias = pooled((ba - ua) * (bb - ub))
    return jnp.maximum(squared_bias, 0.0) + pooled(jnp.square(ba - bb)) / 4


def radius_bias(
    mean: Image, weighted: Image, radii: Float[Array, " passes"], *, window: int = 15
) -> Image:
    """Squared bias of a photon-mapped image, from passes of unlike radii.

    The bias of density estimation is about proportional to the squared radius. So the
    slope of the passes' images over it, times its mean, is the bias of their mean.

    Args:
        mean: mean of the passes' images, linear radiance, shape [H,W,C].
        weighted: mean of the passes' images times their squared radius, of any unit,
            shape [H,W,C].
        radii: r of each pass, of the same unit, shape [passes]; not all the same.
        window: width in pixels that the slope is averaged over, odd.

    Returns:
        the squared bias, squared radiance, shape [H,W,C]; 0 at pixels that are not
        finite.

    Raises:
        ValueError: while tracing, if shapes differ or `window` is even.

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
    return jnp.square(typical * window_mean(slope, window, mask=valid))


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
    the truth and the blend's own error; what exceeds the latter is the prior's.

    Args:
        prior: p, linear radiance, shape [H,W,C].
        unbiased: u, linear radiance, shape [H,W,C].
        biased: b, linear radiance, shape [H,W,C].
        variance: v of u, squared radiance, at least zero, shape [H,W,1] or [H,W,C].
        mse: m, of b, likewise.
        window: width of the windows in pixels, odd.

    Returns:
        eta^2, squared radiance, at least zero, shape [H,W,C]; pixels that are not
        finite take no part.

    Raises:
        ValueError: while tracing, if shapes differ or `window` is even.

    Source: ours, in place of DSC's network (section 4.3).
    """
    check_same_shape(prior=prior, unbiased=unbiased, biased=biased)
    valid = finite(prior, unbiased, biased, variance, mse)
    p, u, b, v, m = (
        jnp.where(valid, image, 0.0)
        for image in (prior, unbiased, biased, variance, mse)
    )
    share = factors(v, m, jnp.zeros_like(v))
    blend = share.biased * b + (1 - share.biased) * u
    excess = jnp.square(blend - p) - share.error
    return jnp.maximum(window_mean(excess, window, mask=valid), 0.0)
