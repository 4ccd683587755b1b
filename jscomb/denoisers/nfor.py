r"""NFOR: nonlinearly weighted first-order regression on the renderer's features.

A consistent denoiser without a network: as samples grow, weights fall on ever fewer
pixels and the bias vanishes. Layout: images [H,W,C], linear radiance. In three steps:

    features    f, each half filtered by non-local means with weights of the other half
    regression  x_a by local_linear on the features, weights by non-local means on x_b,
                once for each strength; and the other way round
    mixing      of both strengths, by the share that makes the halves' error least

Target and weights come from different halves, so no fit follows its own noise.

Sources:
    B. Bitterli, F. Rousselle, B. Moon, J. Iglesias-Guitian, D. Adler, K. Mitchell,
    W. Jarosz, J. Novak, "Nonlinearly Weighted First-order Regression for Denoising
    Monte Carlo Renderings", 2016. Our mixing share is the least-squares one over a
    window, where the paper selects the better strength and filters the selection.
"""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jscomb.denoisers import nonlocal_means
from jscomb.features import select, stack
from jscomb.frame import Estimate, Frame, Needs, with_halves
from jscomb.numerics.guards import check_same_shape, divide, finite, first_finite
from jscomb.numerics.regression import joint_local_linear
from jscomb.numerics.tiles import compiled
from jscomb.numerics.windows import window_mean, window_sum
from jscomb.typing import Image, Scalar, Variance

Features = Float[Array, "h w f"]
# Of both halves, or with both strengths.
Halves = Float[Array, "2 h w c"]

_POOL = 3  # width that sample variances are averaged over: as they are they mislead
_FEATURE_WINDOW, _FEATURE_STRENGTH = 11, 1.0  # of the features' pre-filter
_LEAST = 1e-4  # of the mean square radiance; keeps black pixels from deciding


NEEDS = Needs(variance=True, halves=True)


def denoise(
    unbiased_a: Image,
    unbiased_b: Image,
    variance_a: Variance,
    variance_b: Variance,
    features_a: Features,
    features_b: Features,
    *,
    window: int = 19,
    patch: int = 7,
    strengths: tuple[float, float] = (0.5, 1.0),
    stride: int = 1,
    mixing: int = 31,
    ridge: Float[Array, " f"] | float = 0.1,
) -> tuple[Image, Image]:
    """Denoise both halves, each with the other's weights and features.

    Pure, differentiable in every array, and scale-equivariant. Costs four calls of
    `local_linear` with small windows.

    Args:
        unbiased_a: x_a, radiance, shape [H,W,C].
        unbiased_b: x_b, likewise, of other samples.
        variance_a: of the mean x_a, squared radiance, shape [H,W,C].
        variance_b: of x_b.
        features_a: of half a, shape [H,W,F]; F may be 0. Pre-filter noisy ones.
        features_b: of half b.
        window: width of the windows in pixels, odd.
        patch: width of the patches that non-local means compares, odd.
        strengths: of non-local means, the narrower first.
        stride: pixels between the centres of windows.
        mixing: width of the window that the share of each strength is found over, odd.
        ridge: of the regression.

    Returns:
        both halves denoised, [H,W,C] each; they share their inputs, and their mean is
        the denoised image. At an invalid pixel the half itself if finite, else the
        other half, else 0.

    Raises:
        ValueError: while tracing, if shapes differ, a width is even, `stride` does not
            fit, or a strength or the ridge is not positive.

    Example:
        >>> import numpy as np
        >>> x = jnp.asarray(np.random.default_rng(0).normal(1, 0.5, (2, 8, 8, 1)))
        >>> v, none = jnp.full_like(x[0], 0.25), x[0, ..., :0]
        >>> fit = jax.jit(denoise, static_argnames=("window", "patch"))
        >>> a, b = fit(x[0], x[1], v, v, none, none, window=5, patch=3)
        >>> print(f"{jnp.std(x.mean(axis=0)):.2f} {jnp.std((a + b) / 2):.2f}")
        0.31 0.03

    Source: Bitterli et al. 2016.
    """
    check_same_shape(
        unbiased_a=unbiased_a,
        unbiased_b=unbiased_b,
        variance_a=variance_a,
        variance_b=variance_b,
    )

    def fit(half: tuple[Image, Image, Variance, Features]) -> Halves:
        """With either strength."""
        x, guide, v, f = half
        noise = window_mean(v, _POOL, mask=finite(v))

        def one(strength: Scalar) -> Image:
            weights = nonlocal_means.weights(
                guide, noise, patch=patch, strength=strength
            )
            prediction, weight = joint_local_linear(
                [(x, weights)], f, window=window, stride=stride, ridge=ridge
            )
            return jnp.where(weight > 0, prediction, first_finite(x, guide))

        return lax.map(one, jnp.asarray(strengths, x.dtype))

    if not min(strengths) > 0:
        raise ValueError(f"strengths must be positive, got {strengths}")
    # One after the other, by a program that is compiled once.
    x, v = jnp.stack([unbiased_a, unbiased_b]), jnp.stack([variance_a, variance_b])
    features = jnp.stack([features_b, features_a])
    fits = lax.map(fit, (x, x[::-1], v[::-1], features))
    narrow, wide = jnp.moveaxis(fits, 1, 0)
    share = _narrow_share(narrow, wide, x[::-1], mixing)
    a, b = wide + share[None] * (narrow - wide)
    return a, b


def _narrow_share(
    narrow: Halves,
    wide: Halves,
    truth: Halves,
    window: int,
) -> Float[Array, "h w 1"]:
    """The share s of the narrow fit with the least sum of (wide + s (n - w) - x)^2.

    x is the half that was not fitted, in place of the truth; the sum is over a window,
    both halves and all channels. Pixels are weighed by their brightness, lest fireflies
    decide.
    """
    known = finite(*truth)
    along, square = jnp.zeros_like(narrow[0][..., :1]), 0.0
    for n, w, x in zip(narrow, wide, truth, strict=True):
        step, gap = n - w, jnp.where(known, x - w, 0.0)
        bright = jnp.mean(jnp.square(n), axis=-1, keepdims=True)
        scale = bright + _LEAST * jnp.mean(bright)
        weigh = lambda product, by=scale: divide(
            jnp.sum(product, axis=-1, keepdims=True), by, where=by > 0
        )
        along += weigh(step * gap)
        square += weigh(jnp.square(step))
    along, square = (
        window_sum(jnp.asarray(i), window, mask=known) for i in (along, square)
    )
    inside = (along > 0) & (along < square)
    share = divide(along, square, where=inside)
    return jnp.where(inside, share, jnp.where(along > 0, 1.0, 0.0).astype(share.dtype))


def filter_features(features_a: Features, features_b: Features) -> tuple[Image, Image]:
    """Filter the noise of depth of field and motion out of both halves' features.

    Args:
        features_a: of half a, shape [H,W,F].
        features_b: of half b, of other samples, or the same if they are free of noise.

    Returns:
        both, each by non-local means with the weights of the other, shape [H,W,F].

    Raises:
        ValueError: while tracing, if shapes differ.

    Example:
        >>> import numpy as np
        >>> noise = np.random.default_rng(0).normal(1, 0.1, (2, 8, 8, 1))
        >>> a, b = jax.jit(filter_features)(*jnp.asarray(noise))
        >>> print(f"{noise[0].std():.3f} {a.std():.3f}")
        0.091 0.006

    Source: Bitterli et al. 2016, section on pre-filtering.
    """
    if features_a.shape[-1] == 0:
        return features_a, features_b
    check_same_shape(features_a=features_a, features_b=features_b)
    square = jnp.square(features_a - features_b) / 2
    variance = window_mean(square, _POOL, mask=finite(square))

    def across(image: Image, guide: Image) -> Image:
        return nonlocal_means.denoise(
            image,
            guide,
            variance,
            window=_FEATURE_WINDOW,
            strength=_FEATURE_STRENGTH,
        )

    return across(features_a, features_b), across(features_b, features_a)


def denoise_frame(frame: Frame, *, window: int = 19, stride: int = 1) -> Estimate:
    """Denoise a frame from its two halves, and each half by itself if it has halves.

    Leaves out features that tell nothing, so it is not for `jit`.

    Args:
        frame: with two sub-buffers and their variances, or with four or more.
        window: width of the regression's windows in pixels, odd.
        stride: pixels between their centres.

    Returns:
        the denoised frame; and its halves, if each of them is a frame that could be
        denoised by itself: with four sub-buffers and variances, or eight or more.

    Raises:
        ValueError: if the frame has no sub-buffers, or no way to know the variance, or
            `window` is even, or `stride` does not fit it.

    Example:
        >>> import numpy as np
        >>> from jscomb.frame import make_frame
        >>> noise = np.random.default_rng(0).normal(1, 0.5, (2, 8, 8, 1))
        >>> frame = make_frame(noise, variance=np.full_like(noise, 0.25))
        >>> made = denoise_frame(frame, window=5)
        >>> print(f"{frame.color.std():.2f} {made.image.std():.2f}", made.halves)
        0.31 0.03 None
    """
    frame.require("nfor", NEEDS)
    one = lambda part: _denoise_whole(part, window, stride)
    return with_halves(frame, one, needs=NEEDS)


def _denoise_whole(frame: Frame, window: int, stride: int) -> Image:
    """A frame from its two halves."""
    a, b = frame.halves()
    stacks = stack(a), stack(b)
    needed = select(stacks)
    features = compiled(filter_features)(*(needed.of(s) for s in stacks))
    both = compiled(denoise, window=window, stride=stride)(
        a.color,
        b.color,
        a.variance,
        b.variance,
        *features,
        ridge=jnp.asarray(needed.ridge(0.1), frame.color.dtype),
    )
    return (both[0] + both[1]) / 2
