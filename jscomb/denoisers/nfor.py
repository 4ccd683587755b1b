r"""NFOR: nonlinearly weighted first-order regression on the renderer's features.

A consistent denoiser without a network: as samples grow, the weights concentrate on
fewer pixels and the bias vanishes. Layout: images [H,W,C], linear radiance. Steps:

    features    f of each half, by non-local means with the other half's weights
    regression  x_a by local_linear on the features, weights by non-local means on x_b,
                once for each strength; and with a and b exchanged
    mixing      of both strengths, by the share that minimises the halves' error

Target and weights come from different halves, so no fit follows its own noise. The
result is not local: a mean over the whole image enters the mixing.

A half's fit has the other half's weights, so it is not quite independent of it, as an
image made of one half alone is. Where a half has no halves of its own, both fits are
all that there is, and the paper's way to judge each by the other half.

Sources:
    B. Bitterli, F. Rousselle, B. Moon, J. Iglesias-Guitian, D. Adler, K. Mitchell,
    W. Jarosz, J. Novak, "Nonlinearly Weighted First-order Regression for Denoising
    Monte Carlo Renderings", 2016. Our share is the least-squares one over a window; the
    paper selects the better strength and filters the selection.
"""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jscomb.denoisers import nonlocal_means
from jscomb.features import select, stack
from jscomb.frame import Estimate, Frame, Needs, with_halves
from jscomb.numerics.guards import (
    check_same_shape,
    divide,
    finite,
    first_finite,
    weighted_ratio,
)
from jscomb.numerics.regression import joint_local_linear
from jscomb.numerics.tiles import compiled
from jscomb.numerics.windows import window_mean, window_sum
from jscomb.typing import Image, Variance

__all__ = ["NEEDS", "denoise", "denoise_frame", "filter_features"]

NEEDS = Needs(variance=True, halves=True, variance_of_halves=True)

Features = Float[Array, "h w f"]
Pair = Float[Array, "2 h w c"]  # of the halves, or of the strengths

_POOL = 3  # width that sample variances are averaged over: single ones are too noisy
_FEATURE_WINDOW, _FEATURE_STRENGTH = 11, 1.0  # of the features' pre-filter
_MINIMUM = 1e-4  # of the mean square radiance; keeps black pixels from dominating


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

    Pure, differentiable in every array, and scale-equivariant. The weights of one
    strength are a power of the other's, and are computed once.

    Args:
        unbiased_a: x_a, radiance, shape [H,W,C].
        unbiased_b: x_b, of other samples, shape [H,W,C].
        variance_a: of the mean x_a, squared radiance, shape [H,W,C].
        variance_b: of x_b.
        features_a: of half a, shape [H,W,F]; F may be 0. Filter noisy ones first.
        features_b: of half b.
        window: width of the windows in pixels, odd.
        patch: width of the patches that non-local means compares, odd.
        strengths: of non-local means, > 0, the smaller first.
        stride: pixels between the centres of windows.
        mixing: width in pixels of the window that a share is solved for, odd.
        ridge: of the regression, > 0.

    Returns:
        both halves denoised, [H,W,C] each; they depend on each other, and their mean is
        the denoised image. At an invalid pixel the half if finite, else the other half,
        else 0.

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

    def fit(half: tuple[Image, Image, Variance, Features]) -> Pair:
        """One half with either strength: weights of one are powers of the other's."""
        x, guide, v, f = half
        noise = window_mean(v, _POOL, mask=finite(v))
        widest = max(strengths)
        weights = nonlocal_means.weights(guide, noise, patch=patch, strength=widest)
        fits = joint_local_linear(
            [(x, weights)],
            f,
            powers=[(widest / strength) ** 2 for strength in strengths],
            window=window,
            stride=stride,
            ridge=ridge,
        )
        otherwise = first_finite(x, guide)
        return jnp.stack([jnp.where(w > 0, t, otherwise) for t, w in fits])

    if not min(strengths) > 0:
        raise ValueError(f"strengths must be positive, got {strengths}")
    x, v = jnp.stack([unbiased_a, unbiased_b]), jnp.stack([variance_a, variance_b])
    features = jnp.stack([features_b, features_a])
    # `map`, not `vmap`: one program, and the memory of one fit.
    fits = lax.map(fit, (x, x[::-1], v[::-1], features))
    narrow, wide = jnp.moveaxis(fits, 1, 0)
    share = _narrow_share(narrow, wide, x[::-1], mixing)
    a, b = wide + share[None] * (narrow - wide)
    return a, b


def _narrow_share(
    narrow: Pair, wide: Pair, other: Pair, window: int
) -> Float[Array, "h w 1"]:
    """Return the share s in [0, 1] that minimises the sum of (wide + s (n - w) - x)^2.

    x is the half that was not fitted, in place of the truth; the sum is over a window,
    both halves and all channels. Pixels are weighted by their inverse square radiance,
    to avoid that fireflies dominate.
    """
    valid = finite(*other)

    def products(n: Image, w: Image, x: Image) -> tuple[Array, Array]:
        step, gap = n - w, jnp.where(valid, x - w, 0.0)
        bright = jnp.mean(jnp.square(n), axis=-1, keepdims=True)
        scale = bright + _MINIMUM * jnp.mean(bright)
        over = lambda each: weighted_ratio(jnp.sum(each, -1, keepdims=True), scale)
        return over(step * gap), over(jnp.square(step))

    along, square = (
        window_sum(jnp.sum(each, axis=0), window, mask=valid)
        for each in jax.vmap(products)(narrow, wide, other)
    )
    inside = (along > 0) & (along < square)
    end = jnp.where(along > 0, jnp.ones_like(along), 0.0)
    return divide(along, square, where=inside, otherwise=end)


def filter_features(features_a: Features, features_b: Features) -> tuple[Image, Image]:
    """Remove the noise of depth of field and motion from both halves' features.

    Args:
        features_a: of half a, shape [H,W,F].
        features_b: of half b, of other samples, or the same if without noise.

    Returns:
        both, each filtered by non-local means with the other's weights, shape [H,W,F].

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
    """Denoise a frame from its two halves.

    Not for `jit`: constant features are excluded, to save time.

    Args:
        frame: with two sub-buffers and variances, or with four sub-buffers.
        window: width of the regression's windows in pixels, odd.
        stride: pixels between their centres.

    Returns:
        the estimate; its halves are made of each half alone if each has two sub-buffers
        and variances, or four sub-buffers; else they are both fits, whose mean it is.

    Raises:
        ValueError: if the frame has no halves with variances, `window` is even, or
            `stride` does not fit it.

    Example:
        >>> import numpy as np
        >>> from jscomb.frame import make_frame
        >>> noise = np.random.default_rng(0).normal(1, 0.5, (2, 8, 8, 1))
        >>> frame = make_frame(noise, variance=np.full_like(noise, 0.25))
        >>> made = denoise_frame(frame, window=5)
        >>> print([f"{i.std():.2f}" for i in (frame.color, made.image, made.halves)])
        ['0.31', '0.03', '0.06']
    """
    frame.require("nfor", NEEDS)
    if NEEDS.missing_for_halves(frame):
        both = jnp.stack(_denoise_both(frame, window, stride))
        return Estimate(jnp.mean(both, axis=0), both)
    mean = lambda part: jnp.mean(jnp.stack(_denoise_both(part, window, stride)), axis=0)
    return with_halves(frame, mean, needs=NEEDS)


def _denoise_both(frame: Frame, window: int, stride: int) -> tuple[Image, Image]:
    """Denoise both halves of a frame."""
    a, b = frame.halves()
    stacks = stack(a), stack(b)
    needed = select(stacks)
    features = compiled(filter_features)(*(needed.of(s) for s in stacks))
    return compiled(denoise, window=window, stride=stride)(
        a.color,
        b.color,
        a.variance,
        b.variance,
        *features,
        ridge=jnp.asarray(needed.ridge(0.1), frame.color.dtype),
    )
