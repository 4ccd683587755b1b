"""What the combiner needs to know: its own risk, the guide's noise, what helps."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jscomb.james_stein._combine import degrees, prepare, sum_and_count
from jscomb.james_stein._regression import (
    EPSILON,
    RIDGE,
    Features,
    Options,
    check_features,
    fit,
    guide_noise,
)
from jscomb.metrics import Change, mean_change
from jscomb.numerics.guards import (
    check_same_shape,
    divide,
    finite,
    first_finite,
    safe_sqrt,
)
from jscomb.typing import Image, Key, Scalar, Variance

__all__ = ["COARSE", "guide_noise", "risk", "risk_bound", "worth_regressing"]

COARSE = 4  # stride of the regression that decides for a frame


def risk(
    unbiased: Image, biased: Image, variance: Variance, *, window: int = 15
) -> Image:
    """Estimate the squared error of each window's James-Stein result.

    The sum over the window of the squared error of y + eta_c (x - y), before windows
    are averaged; unbiased for equal variances, Gaussian noise and a y independent of x.
    A single value is noisy and may be negative where eta_c = 0: average before use.

    Args:
        unbiased: x, linear radiance, shape [H,W,C].
        biased: y, linear radiance, shape [H,W,C].
        variance: s2_c of each window, squared radiance, shape [H,W,C].
        window: width of the windows in pixels, odd, at least three.

    Returns:
        the estimated sum of squared errors in the window of each pixel, squared
        radiance, shape [H,W,C]; divide by the count of pixels for a mean. 0 at an
        invalid pixel.

    Raises:
        ValueError: while tracing, if the shapes differ or `window` is even or < 3.

    Example:
        >>> x, y = jnp.full((3, 3, 1), 3.0), jnp.ones((3, 3, 1))
        >>> found = risk(x, y, jnp.ones_like(x), window=3)[1, 1, 0]
        >>> print(f"{found:.2f}")  # x itself has 9 pixels of variance 1
        7.64

    Source: NJS eq. 8 where eta > 0, and |x-y|^2 - p s2 (Stein's estimate for the
    constant y) where eta = 0.
    """
    valid, x, y, s2 = prepare(unbiased, biased, variance, window)
    energy, count = sum_and_count(jnp.square(x - y), valid, window)
    noise = degrees(count) * s2
    lost = divide(noise, energy, where=energy > noise)
    keeps = (energy > noise) | (noise <= 0)
    estimate = jnp.where(keeps, count * s2 - noise * lost, energy - count * s2)
    return jnp.where(valid, estimate, 0.0)


def risk_bound(
    bias: Image,
    biased_variance: Variance,
    variance: Variance,
    *,
    window: int = 15,
) -> Image:
    """Bound the expected squared error of each window's James-Stein result.

    The expectation of the rule without the positive part, which has no smaller error;
    by Jensen's inequality, for Gaussian noise of equal variance and a y independent of
    x: below p s2, the error of x, however large the bias.

    Args:
        bias: Lambda, expectation of y minus the truth, radiance, shape [H,W,C].
        biased_variance: xi2 of y, squared radiance, at least zero, same shape.
        variance: s2_c of each window, squared radiance, at least zero, same shape.
        window: width of the windows in pixels, odd, at least three.

    Returns:
        the bound of the sum of squared errors in the window of each pixel, squared
        radiance, shape [H,W,C]; 0 at an invalid pixel.

    Raises:
        ValueError: while tracing, if the shapes differ or `window` is even or < 3.

    Example:
        >>> one = jnp.ones((3, 3, 1))
        >>> print(f"{risk_bound(2 * one, 0 * one, one, window=3)[1, 1, 0]:.2f}")
        7.91

    Source: NJS eq. 9: p s2 - (p-2)^2 s2^2 / (Lambda' Lambda + p xi2 + p s2).
    """
    valid, bias, xi2, s2 = prepare(bias, biased_variance, variance, window)
    energy, count = sum_and_count(jnp.square(bias) + xi2, valid, window)
    noise, energy = degrees(count) * s2, energy + count * s2
    saved = noise * divide(noise, energy, where=energy > 0)
    return jnp.where(valid, count * s2 - saved, 0.0)


def worth_regressing(
    key: Key,
    unbiased_a: Image,
    unbiased_b: Image,
    biased_a: Image,
    biased_b: Image,
    features_a: Features,
    features_b: Features,
    variance_a: Variance,
    variance_b: Variance,
    *,
    window: int = 51,
    stride: int = COARSE,
    ridge: Float[Array, " _"] | float = RIDGE,
    epsilon: Scalar | float = 1.0,
) -> Change:
    """Estimate from the halves whether regression lowers the error of the whole frame.

    Compares y* with the mean y of both halves' biased images. With r the true image,

        |y* - r|^2 - |y - r|^2 = y*^2 - y^2 - r (y^_a + y^_b) + r (y_a + y_b).

    Half b's noise is independent of y_a, so x_b stands for r there. Given half b, y^_a
    is linear in x_a, so x_a stands for r there once the contribution of its own noise
    is subtracted, sum_i v_i dy^_a,i / dx_a,i, estimated by the regression of one random
    image. So the estimate is unbiased, except that its weights 1 / (y^2 + epsilon) and
    the bandwidth follow the noise a little. A single pixel's is too noisy to use.

    Args:
        key: of the random image, a typed key.
        unbiased_a: x_a, normalised radiance, shape [H,W,C].
        unbiased_b: x_b, same shape.
        biased_a: y_a, same shape.
        biased_b: y_b, same shape.
        features_a: the other features of half a, shape [H,W,F].
        features_b: of half b, same shape.
        variance_a: of the mean x_a, squared radiance, shape [H,W,C].
        variance_b: of x_b.
        window: width of the windows in pixels, odd.
        stride: pixels between the centres of windows; one number for the frame does
            not need every pixel's window.
        ridge: of the regression.
        epsilon: squared radiance that limits the weight of black pixels.

    Returns:
        the change of the relative L2; `helps` tells whether to regress. Excludes
        pixels that are not finite in some input.

    Raises:
        ValueError: while tracing, if shapes differ.

    Example:
        >>> import numpy as np
        >>> ramp = np.linspace(0, 1, 16)[:, None, None] * np.ones((1, 16, 1))
        >>> noise = np.random.default_rng(0).normal(0, 0.2, (2, 16, 16, 1))
        >>> flat, v = np.full_like(ramp, 0.5), np.full_like(ramp, 0.04)
        >>> images = *(ramp + noise), flat, flat, ramp, ramp, v, v
        >>> judge = jax.jit(worth_regressing, static_argnames="window")
        >>> change = judge(jax.random.key(0), *map(jnp.asarray, images), window=9)
        >>> print(f"{change.mean:.1f} {change.helps}")
        -0.1 True

    Source: ours; the random image is Hutchinson's estimate of a trace.
    """
    check_same_shape(
        unbiased_a=unbiased_a,
        unbiased_b=unbiased_b,
        biased_a=biased_a,
        biased_b=biased_b,
        variance_a=variance_a,
        variance_b=variance_b,
    )
    check_features(biased_a, features_a, features_b)
    bandwidth = 2 * guide_noise(biased_a, biased_b) + EPSILON
    options = Options(bandwidth, window, stride, ridge)

    def probed(key: Key, x: Image, v: Variance, guide: Image, features: Features):
        """The prediction, and an estimate of v_i dy^_i / dx_i."""
        probe = safe_sqrt(v) * jax.random.rademacher(key, v.shape, v.dtype)
        own = first_finite(guide)
        both = jnp.concatenate([x, probe], axis=-1)
        y = jnp.concatenate([own, jnp.zeros_like(own)], axis=-1)
        prediction, change = jnp.split(fit(both, guide, features, y, options), 2, -1)
        return prediction, probe * change

    first, second = jax.random.split(key)
    a, own_a = probed(first, unbiased_a, variance_a, biased_b, features_b)
    b, own_b = probed(second, unbiased_b, variance_b, biased_a, features_a)
    y = (biased_a + biased_b) / 2
    truth = unbiased_a * (a - biased_b) + unbiased_b * (b - biased_a) - own_a - own_b
    square = jnp.square((a + b) / 2) - jnp.square(y) - truth
    valid = finite(square, variance_a, variance_b, features_a, features_b)
    return mean_change(jnp.where(valid, square, jnp.nan), y, epsilon=epsilon)
