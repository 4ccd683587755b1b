r"""James-Stein combination of an unbiased and a biased rendering.

Layout: images [H,W,C], linear radiance; channels are shrunk separately. Notation:

    x    unbiased rendering (path traced)
    y    biased rendering (denoised, photon mapped), any image at all
    v    variance of the mean x at each pixel, squared radiance
    s2   the variance that a whole window is taken to have
    c    centre of a window, i a pixel in it, p the number of its pixels
    eta  the share of x - y that survives in a window, in [0, 1]

In each window the positive-part James-Stein rule keeps

    eta_c = (1 - (p-2) s2_c / sum_i (x_i - y_i)^2)+            one variance a window
    eta_c = (1 - (p-2) / sum_i (x_i - y_i)^2 / v_i)+           whitened

of the difference; every pixel takes the mean share of all windows that contain it,

    x^_i = y_i + mean_c(eta_c) (x_i - y_i).

For p >= 3, Gaussian noise and a y that does not depend on x, each window's result has
a lower expected squared error than x, whatever y is: summed over the window for equal
variances, and in units of the variance for the whitened rule, which needs no equality.
A denoised y does depend on x, and path-traced noise is not Gaussian, so in practice
neither is a guarantee: at low sample counts a good denoiser alone is often better.
The first is mended by the divergence of the denoiser, D_i = (J Sigma)_ii: then

    eta_c = (1 - sum_i (v_i - D_i) / sum_i (x_i - y_i)^2)+

has the least expected error that Stein's lemma knows (whitened: each i over v_i).

A window of fewer than three pixels has nothing to borrow from and keeps x, and so does
one without any variance. The whitened sum leaves out pixels of variance 0. Pixels that
are not finite in x, y or v take no part in any window; see `numerics.guards`.

Sources:
    J. Gu, J. Iglesias-Guitian, B. Moon, "Neural James-Stein Combiner for Unbiased and
    Estimate Renderings", 2022 (NJS; eq. numbers below).
    W. James, C. Stein, "Estimation with quadratic loss", 1961.
    A. Baranchik, "Multiple regression and estimation of the mean of a multivariate
    normal distribution", 1964 (the positive part).
"""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jscomb.numerics.guards import check_same_shape, divide, finite, first_finite
from jscomb.numerics.kernels import kernel_mean
from jscomb.numerics.windows import (
    check_window,
    window_mean,
    window_sum,
)
from jscomb.typing import Image, Mask, Variance

# Evidence against y that one pixel can give, times the rounding error: finite, yet so
# much that the share of its windows rounds to one, as it must where variance is zero.
_MOST_EVIDENCE = 1e4


def combine(
    unbiased: Image,
    biased: Image,
    variance: Variance,
    *,
    window: int = 15,
    whiten: bool = False,
    divergence: Image | None = None,
) -> Image:
    """Shrink `unbiased` towards `biased` by the positive-part James-Stein rule.

    Pure, and differentiable in every array; the derivative through a window reaches
    all of its pixels. Costs one window sum, one map and one window mean, and as many
    images of memory. Where the two renderings agree the result is their value.

    `variance` is used as it is. Sample variances of path-traced pixels are too noisy
    for that: use `smooth_variance(variance)` for one variance a window, and
    `robust_variance(variance)` with `window=7, whiten=True`, which measures better.

    Args:
        unbiased: x, linear radiance, shape [H,W,C].
        biased: y, linear radiance, shape [H,W,C].
        variance: of the mean x, squared radiance, shape [H,W,C], at least zero (not
            checked). Without `whiten` the value at c is s2_c, the variance of c's
            window; with it, v_i of each pixel.
        window: width of the windows in pixels, odd, at least three.
        whiten: allow each pixel its own variance within a window.
        divergence: D, how much of the variance y has in common with x, squared
            radiance, shape [H,W,C]: `numerics.sure.monte_carlo_sure(...).divergence`
            of the denoiser that made y, with this variance. None: y does not depend on
            x.

    Returns:
        the combined rendering, linear radiance, shape [H,W,C]; at an invalid pixel
        the first finite of (y, x), else 0.

    Raises:
        ValueError: while tracing, if the shapes differ or `window` is even or < 3.

    Example:
        >>> import jax.numpy as jnp
        >>> x, y = jnp.full((4, 4, 1), 3.0), jnp.ones((4, 4, 1))
        >>> print(combine(x, y, jnp.ones_like(x), window=3)[0, 0].round(3))
        [2.674]

    Source: NJS eq. 5, 7, 13; the whitened form and the correction are ours.
    """
    valid, x, y, v = _prepare(unbiased, biased, variance, window)
    if divergence is not None:
        check_same_shape(unbiased=unbiased, divergence=divergence)
        divergence = jnp.where(valid & finite(divergence), divergence, 0.0)
    share_of = _whitened_share if whiten else _share
    share = share_of(x - y, v, divergence, valid, window)
    share = window_mean(share, window, mask=valid)
    # As a blend, not y + share (x - y), so that shares of 0 and 1 are exact.
    blend = share * x + (1 - share) * y
    return jnp.where(valid, blend, first_finite(biased, unbiased))


def combine_dual(
    unbiased_a: Image,
    unbiased_b: Image,
    biased_a: Image,
    biased_b: Image,
    variance: Variance,
    *,
    window: int = 15,
    whiten: bool = False,
) -> Image:
    """Combine each half's x with the other half's y, and average.

    The biased image of the other half does not depend on this half's noise, which is
    what dominance asks for; the price is that each half has twice the variance.

    Args:
        unbiased_a: x of half a, linear radiance, shape [H,W,C].
        unbiased_b: x of half b, likewise.
        biased_a: y made from half a, likewise.
        biased_b: y made from half b, likewise.
        variance: of the mean of **both** halves, squared radiance, shape [H,W,C], as
            for `combine`; doubled here.
        window: width of the windows in pixels, odd, at least three.
        whiten: allow each pixel its own variance within a window.

    Returns:
        the combined rendering, linear radiance, shape [H,W,C].

    Raises:
        ValueError: while tracing, if the shapes differ or `window` is even or < 3.

    Example:
        >>> x, y = jnp.full((4, 4, 1), 3.0), jnp.ones((4, 4, 1))
        >>> print(combine_dual(x, x, y, y, y / 2, window=3)[0, 0].round(3))
        [2.674]

    Source: NJS table 2.
    """
    a = combine(unbiased_a, biased_b, 2 * variance, window=window, whiten=whiten)
    b = combine(unbiased_b, biased_a, 2 * variance, window=window, whiten=whiten)
    return (a + b) / 2


def risk(
    unbiased: Image, biased: Image, variance: Variance, *, window: int = 15
) -> Image:
    """Estimate the squared error of each window's James-Stein result.

    Its expectation is that of the sum over the window's pixels of the squared error of
    (y + eta_c (x - y)), before windows are averaged; for equal variances, Gaussian
    noise and a y independent of x it is unbiased. A single value is noisy and may be
    negative where eta_c = 0: average before use.

    Args:
        unbiased: x, linear radiance, shape [H,W,C].
        biased: y, linear radiance, shape [H,W,C].
        variance: s2_c of each window, squared radiance, shape [H,W,C].
        window: width of the windows in pixels, odd, at least three.

    Returns:
        the estimated sum of squared errors in the window of each pixel, squared
        radiance, shape [H,W,C]; divide by the count of pixels for a mean. At an
        invalid pixel 0.

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
    valid, x, y, s2 = _prepare(unbiased, biased, variance, window)
    energy, count = _sum_and_count(jnp.square(x - y), valid, window)
    noise = _borrowed(count) * s2
    lost = divide(noise, energy, where=energy > noise)
    keeps = (energy > noise) | (noise <= 0)
    estimate = jnp.where(keeps, count * s2 - noise * lost, energy - count * s2)
    return jnp.where(valid, estimate, 0.0)


def smooth_variance(
    variance: Variance,
    *,
    window: int = 15,
    sigma: float | None = None,
    weights: Float[Array, "h w window2"] | None = None,
) -> Variance:
    """Pool sample variances over a window: equal, Gaussian or given weights.

    Sample variances of path-traced pixels are as heavy-tailed as the pixels: one that
    missed a rare bright path looks certain. Pooling is what makes them usable.

    Args:
        variance: sample variance of the mean, squared radiance, shape [H,W,C].
        window: width of the window in pixels, odd.
        sigma: standard deviation in pixels of Gaussian weights.
        weights: weights of each pixel's window, at least zero, shape [H,W,window²],
            row-major over the offsets; shared by the channels (a network's output).

    Returns:
        the pooled variance, shape [H,W,C]. Values that are not finite take no part;
        where nothing does, the result is 0.

    Raises:
        ValueError: if both `sigma` and `weights` are given, if `window` is even or
            `sigma` not positive, or if the weights have another shape.

    Example:
        >>> import jax.numpy as jnp
        >>> print(smooth_variance(jnp.eye(3)[..., None], window=3)[1, 1].round(3))
        [0.333]

    Source: NJS eq. 6.
    """
    check_same_shape(variance=variance)
    valid = finite(variance)
    if weights is None:
        return window_mean(variance, window, mask=valid, sigma=sigma)
    if sigma is not None:
        raise ValueError("give sigma or weights, not both")
    return kernel_mean(variance, weights, window, mask=valid)


def robust_variance(
    variance: Variance, *, window: int = 19, sigma: float = 3.0
) -> Variance:
    """Each pixel's variance, but never below that of its neighbourhood.

    For the whitened rule under heavy-tailed noise: a pixel that missed a rare bright
    path is not taken to be certain, and a firefly keeps its own large variance.

    Args:
        variance: sample variance of the mean, squared radiance, shape [H,W,C].
        window: width of the neighbourhood in pixels, odd.
        sigma: standard deviation in pixels of its Gaussian weights.

    Returns:
        the variance, shape [H,W,C]; pixels that are not finite stay so.

    Raises:
        ValueError: if `window` is even or `sigma` not positive.

    Example:
        >>> variance = jnp.ones((3, 3, 1)).at[1, 1].set(0.0).at[0, 0].set(9.0)
        >>> print(robust_variance(variance, window=3)[..., 0].round(2))
        [[9.   2.18 1.  ]
         [2.18 1.74 1.  ]
         [1.   1.   1.  ]]

    Source: ours; the defaults were chosen on five path-traced frames.
    """
    pooled = smooth_variance(variance, window=window, sigma=sigma)
    return jnp.maximum(variance, pooled)


def _prepare(
    unbiased: Image, biased: Image, variance: Variance, window: int
) -> tuple[Mask, Image, Image, Variance]:
    """Check shapes and window; the valid pixels, and the images with 0 elsewhere."""
    check_same_shape(unbiased=unbiased, biased=biased, variance=variance)
    if check_window(window) < 3:
        raise ValueError(f"window must be at least three, got {window}")
    images = unbiased, biased, variance
    valid = finite(*images)
    x, y, v = (jnp.where(valid, image, 0.0) for image in images)
    return valid, x, y, v


def _share(
    difference: Image,
    s2: Variance,
    divergence: Image | None,
    valid: Mask,
    window: int,
) -> Image:
    """eta_c for one variance a window."""
    energy, count = _sum_and_count(jnp.square(difference), valid, window)
    if divergence is None:
        return _positive_part(_borrowed(count) * s2, energy)
    return _positive_part(count * s2 - window_sum(divergence, window), energy)


def _whitened_share(
    difference: Image,
    v: Variance,
    divergence: Image | None,
    valid: Mask,
    window: int,
) -> Image:
    """eta_c with each pixel measured in units of its own variance."""
    square = jnp.square(difference)
    # A sample variance of exactly 0 tells of samples that all missed the light, not of
    # certainty: taken literally, one such pixel would make all its windows keep x.
    counted = valid & (v > 0)
    most = _MOST_EVIDENCE / float(jnp.finfo(v.dtype).eps)
    evidence = divide(square, v, where=v * most > square, otherwise=most)
    evidence = jnp.where(counted, evidence, 0.0)
    energy, count = _sum_and_count(evidence, counted, window)
    if divergence is None:
        return _positive_part(_borrowed(count), energy)
    in_common = divide(divergence, v, where=counted & (v * most > jnp.abs(divergence)))
    return _positive_part(count - window_sum(in_common, window), energy)


def _sum_and_count(
    image: Image, counted: Bool[Array, "h w _"], window: int
) -> tuple[Image, Image]:
    """Window sums of an image and of the pixels that count, both [H,W,C]."""
    count = window_sum(counted.astype(image.dtype), window)
    return window_sum(image, window), jnp.broadcast_to(count, image.shape)


def _borrowed(count: Image) -> Image:
    """The p - 2 dimensions that shrinkage gains from; none below three pixels."""
    return jnp.maximum(count - 2, 0.0)


def _positive_part(noise: Image, energy: Image) -> Image:
    """(1 - noise / energy)+, and 1 where there is no noise to remove."""
    noise = jnp.maximum(noise, 0.0)
    all_lost = jnp.where(noise > 0, 1.0, jnp.zeros_like(noise))
    return 1 - divide(noise, energy, where=energy > noise, otherwise=all_lost)
