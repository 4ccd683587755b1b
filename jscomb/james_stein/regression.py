r"""Cross-regression: a biased image made anew from what both halves know.

Layout: images [H,W,C], linear radiance divided by the frame's exposure, because the
constants below are absolute. Notation:

    x_a, x_b   unbiased half buffers, of disjoint samples
    y_a, y_b   a biased image of each half
    f          features: y and what the renderer wrote, [H,W,F]
    kappa      squared noise of the guide, |y_a - y_b|^2 / 2

In every window, x_a is fitted by a linear model of the features of half b, weighted by
how alike the pixels of y_b are,

    y^_a = local_linear(x_a, guide y_b, features f_b, bandwidth 2 kappa + epsilon),

and likewise y^_b; their mean y* = (y^_a + y^_b) / 2 is the new biased image. Target and
guide are independent, so the fit does not follow the noise.

Away from the paper, all measured (`experiments/regression_error.py`): the constant has
no ridge; where the windows hardly speak for a pixel it fades to y instead of falling;
and kappa is a median, because the mean over a frame is that of its light sources' edges
and leaves no edge elsewhere. `guide_noise(..., robust=False)` gives the paper's.

Source:
    NJS eq. 10-12.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jscomb.features import select, stack
from jscomb.frame import Estimate, Frame
from jscomb.metrics import Change, mean_change
from jscomb.numerics.guards import check_same_shape, divide, finite, first_finite
from jscomb.numerics.medians import median
from jscomb.numerics.regression import local_linear
from jscomb.typing import Image, Key, Scalar, Variance

Features = Float[Array, "h w f"]

# NJS's constants, and our fall back; said once, so that what `worth_regressing` judges
# is what `cross_regression` does.
_EPSILON, _RIDGE, _SCALE_FLOOR, _FALL_BACK = 0.01, 0.1, 0.1, 0.1
_COARSE = 4  # stride of the regression that decides for a frame


def cross_regression(
    unbiased_a: Image,
    unbiased_b: Image,
    biased_a: Image,
    biased_b: Image,
    features_a: Features,
    features_b: Features,
    *,
    window: int = 51,
    stride: int = 1,
    kappa: Scalar | float | None = None,
    epsilon: float = _EPSILON,
    ridge: Float[Array, " _"] | float = _RIDGE,
    scale_floor: float = _SCALE_FLOOR,
    fall_back: float = _FALL_BACK,
) -> tuple[Image, Image]:
    """Fit each half's unbiased image to the other half's biased image and features.

    Pure, and differentiable in every array. Costs two calls of `local_linear`.

    Args:
        unbiased_a: x_a, shape [H,W,C].
        unbiased_b: x_b, likewise.
        biased_a: y_a, likewise; guide, and first C features.
        biased_b: y_b, likewise.
        features_a: the other features of half a, shape [H,W,F]; F may be 0.
        features_b: of half b, likewise.
        window: width of the windows in pixels, odd.
        stride: pixels between the centres of windows; 2 is 2.5 times as fast.
        kappa: squared noise of the guide; None for `guide_noise` of the halves.
        epsilon: added to the bandwidth, squared radiance.
        ridge: of the regression, one number or one for each of the C+F features.
        scale_floor: of the regression, unit of the features.
        fall_back: weight of the guide beside those of the windows, for a stride of 1.
            At larger strides fewer windows speak, and it is divided by the stride's
            square.

    Returns:
        y^_a and y^_b, shape [H,W,C]; at an invalid pixel the first finite of the guide,
        the other y and the two x, else 0.

    Raises:
        ValueError: while tracing, if shapes differ, or as `local_linear`.

    Example:
        >>> ramp = np.linspace(0, 1, 16)[:, None, None] * np.ones((1, 16, 1))
        >>> noise = np.random.default_rng(0).normal(0, 0.2, (2, 16, 16, 1))
        >>> images = *(ramp + noise), np.full_like(ramp, 0.5), np.full_like(ramp, 0.5)
        >>> fit = jax.jit(cross_regression, static_argnames="window")
        >>> a, b = fit(*map(jnp.asarray, (*images, ramp, ramp)), window=9)
        >>> for image in (images[0], images[2], a, b):  # x_a, y_a, y^_a, y^_b
        ...     print(f"{np.sqrt(np.mean((image - ramp) ** 2)):.3f}")
        0.202
        0.307
        0.027
        0.022

    Source: NJS eq. 10-12.
    """
    check_same_shape(
        unbiased_a=unbiased_a,
        unbiased_b=unbiased_b,
        biased_a=biased_a,
        biased_b=biased_b,
    )
    _check_features(biased_a, features_a, features_b)
    if kappa is None:
        kappa = guide_noise(biased_a, biased_b)
    options = _Options(
        2 * jnp.asarray(kappa, biased_a.dtype) + epsilon,
        window,
        stride,
        ridge,
        scale_floor,
        fall_back,
    )
    y_a = first_finite(biased_a, biased_b, unbiased_b, unbiased_a)
    y_b = first_finite(biased_b, biased_a, unbiased_a, unbiased_b)
    return (
        _fit(unbiased_a, biased_b, features_b, y_b, options),
        _fit(unbiased_b, biased_a, features_a, y_a, options),
    )


def _check_features(y: Image, a: Features, b: Features) -> None:
    """Raise unless both halves have the same features, of the image's size."""
    wanted = (*y.shape[:2], a.shape[-1])
    for name, features in {"features_a": a, "features_b": b}.items():
        if features.shape != wanted:
            raise ValueError(f"{name} has shape {features.shape}, expected {wanted}")


class _Options(NamedTuple):
    """Of both fits; the names are those of `cross_regression`."""

    bandwidth: Scalar
    window: int
    stride: int
    ridge: Float[Array, " _"] | float
    scale_floor: float
    fall_back: float


def _fit(
    x: Image,
    guide: Float[Array, "h w _"],
    features: Features,
    y: Image,
    options: _Options,
) -> Image:
    """The windows' mean prediction of x, fading to y, which is finite.

    With a stride most pixels lack the window of their own. Where no other window speaks
    for a pixel, its own would see it alone and predict x, so that is what it gets.
    """
    stride = options.stride
    basis = jnp.concatenate([guide, features], axis=-1)
    prediction, weight = local_linear(
        x,
        guide,
        basis,
        options.bandwidth,
        window=options.window,
        stride=stride,
        ridge=options.ridge,
        scale_floor=options.scale_floor,
    )
    density = 1 / stride**2
    lacking = jnp.where(finite(x, basis), 0.0 if stride == 1 else density, 0.0)
    lacking, share = lacking.astype(weight.dtype), options.fall_back * density
    x = jnp.where(lacking > 0, x, 0.0)
    total = weight * prediction + lacking * x + share * y
    shares = jnp.broadcast_to(weight + lacking + share, total.shape)
    return divide(total, shares, where=shares > 0, otherwise=y)


def guide_noise(biased_a: Image, biased_b: Image, *, robust: bool = True) -> Scalar:
    """Squared noise that a pixel of the biased image has, kappa.

    Args:
        biased_a: y_a, radiance, shape [H,W,C].
        biased_b: y_b, likewise.
        robust: the median over the pixels; else the paper's mean, which the few
            brightest pixels of a frame decide.

    Returns:
        |y_a - y_b|^2 / 2 of a typical pixel, squared radiance summed over the channels.
        Pixels that are not finite do not count; 0 if there are no others.

    Raises:
        ValueError: while tracing, if the shapes differ.

    Example:
        >>> a, b = jnp.full((2, 2, 3), 1.0), jnp.full((2, 2, 3), 1.2)
        >>> print(f"{guide_noise(a, b):.3f}")
        0.060

    Source: NJS eq. 11, the text below it.
    """
    check_same_shape(biased_a=biased_a, biased_b=biased_b)
    valid = finite(biased_a, biased_b)
    difference = jnp.where(valid, biased_a - biased_b, 0.0)
    square = jnp.sum(jnp.square(difference), axis=-1, keepdims=True) / 2
    if robust:
        return median(square, valid)
    return jnp.sum(square) / jnp.maximum(jnp.sum(valid), 1).astype(square.dtype)


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
    stride: int = _COARSE,
    ridge: Float[Array, " _"] | float = _RIDGE,
    epsilon: Scalar | float = 1.0,
) -> Change:
    """Estimate from the halves whether regression lowers the error of the whole frame.

    Compares y* with the mean y of both halves' biased images. With r the true image,

        |y* - r|^2 - |y - r|^2 = y*^2 - y^2 - r (y^_a + y^_b) + r (y_a + y_b).

    Half b's noise is independent of y_a, so x_b stands for r there. Given half b, y^_a
    is linear in x_a, so x_a stands for r there once the share of its own noise is taken
    off, sum_i v_i dy^_a,i / dx_a,i, for which the regression of one random image is
    enough. So the estimate is unbiased, but for its weights 1 / (y^2 + epsilon) and the
    bandwidth, which follow the noise a little. A single pixel's is too noisy to use.

    Args:
        key: of the random image, a typed key.
        unbiased_a: x_a, shape [H,W,C].
        unbiased_b: x_b, likewise.
        biased_a: y_a, likewise.
        biased_b: y_b, likewise.
        features_a: the other features of half a, shape [H,W,F].
        features_b: of half b, likewise.
        variance_a: v of the mean x_a, squared radiance, shape [H,W,C].
        variance_b: of x_b.
        window: width of the windows in pixels, odd.
        stride: pixels between the centres of windows; the decision is one number for
            the frame, and does not need every pixel's window.
        ridge: of the regression.
        epsilon: squared radiance that keeps black pixels from deciding.

    Returns:
        the change of the relative L2; `helps` tells whether to regress. Pixels that are
        not finite in some input do not count.

    Raises:
        ValueError: while tracing, if shapes differ.

    Example:
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
    _check_features(biased_a, features_a, features_b)
    bandwidth = 2 * guide_noise(biased_a, biased_b) + _EPSILON
    options = _Options(bandwidth, window, stride, ridge, _SCALE_FLOOR, _FALL_BACK)

    def fit(key: Key, x: Image, v: Variance, guide: Image, features: Features):
        """The prediction, and an estimate of v_i dy^_i / dx_i."""
        sign = jax.random.rademacher(key, v.shape, v.dtype)
        some = v > 0  # the root of 0 has no derivative
        probe = jnp.where(some, jnp.sqrt(jnp.where(some, v, 1.0)), 0.0) * sign
        own = first_finite(guide)
        both = jnp.concatenate([x, probe], axis=-1)
        y = jnp.concatenate([own, jnp.zeros_like(own)], axis=-1)
        prediction, change = jnp.split(_fit(both, guide, features, y, options), 2, -1)
        return prediction, probe * change

    first, second = jax.random.split(key)
    a, own_a = fit(first, unbiased_a, variance_a, biased_b, features_b)
    b, own_b = fit(second, unbiased_b, variance_b, biased_a, features_a)
    y = (biased_a + biased_b) / 2
    truth = unbiased_a * (a - biased_b) + unbiased_b * (b - biased_a) - own_a - own_b
    square = jnp.square((a + b) / 2) - jnp.square(y) - truth
    valid = finite(square, variance_a, variance_b, features_a, features_b)
    return mean_change(jnp.where(valid, square, jnp.nan), y, epsilon=epsilon)


class Regressed(NamedTuple):
    """A frame's biased image after regression, if that pays.

    Attributes:
        estimate: y* and its halves y^_a and y^_b; or the image as it was.
        change: of the relative L2, estimated; negative where regression pays.
        ran: whether `estimate` is regressed.
    """

    estimate: Estimate
    change: Change
    ran: bool


# Called with values, a loop over tiles would be compiled anew each time.
_cross_regression = jax.jit(cross_regression, static_argnames=("window", "stride"))
_worth_regressing = jax.jit(worth_regressing, static_argnames=("window", "stride"))


def regress(
    key: Key,
    frame: Frame,
    name: str,
    *,
    window: int = 51,
    stride: int = 1,
    always: bool = False,
) -> Regressed:
    """Regress a frame's biased image where the halves say that it lowers the error.

    Divides by the exposure, and leaves out features that tell nothing. Decides on
    values, so it is not for `jit`.

    Args:
        key: for the decision, see `worth_regressing`.
        frame: with sub-buffers and a biased image that has halves.
        name: of the biased image.
        window: width of the windows in pixels, odd.
        stride: pixels between the centres of windows.
        always: regress whatever the halves say; `change` is still what they say.

    Returns:
        the new biased image, or the old one, and why.

    Raises:
        ValueError: if the frame has no such image, or no halves, or as
            `cross_regression`.

    Example:
        >>> from jscomb.frame import make_frame
        >>> ramp = np.linspace(0, 1, 16)[:, None, None] * np.ones((1, 16, 1))
        >>> noise = np.random.default_rng(0).normal(0, 0.2, (2, 16, 16, 1))
        >>> flat = np.full_like(noise, 0.5)
        >>> biased = {"flat": Estimate(jnp.asarray(flat[0]), jnp.asarray(flat))}
        >>> frame = make_frame(ramp + noise, depth=ramp, biased=biased)
        >>> found = regress(jax.random.key(0), frame, "flat", window=9)
        >>> print(f"{found.change.mean:.1f} {found.ran}")
        -0.2 True
    """
    halves = frame.estimates[name].halves if name in frame.estimates else None
    if halves is None:
        has = [n for n, image in frame.estimates.items() if image.halves is not None]
        raise ValueError(f"no biased image {name!r} with halves; there are {has}")
    exposure = frame.median_luminance
    a, b = frame.halves()
    needed = select([stack(a), stack(b)])
    xa, xb, ya, yb = (i / exposure for i in (a.color, b.color, *halves))
    fa, fb = (needed.of(stack(half)) for half in (a, b))
    # The biased image's own channels come first.
    ridges = np.append(np.full(xa.shape[-1], _RIDGE), needed.ridge(_RIDGE))
    options = {"window": window, "ridge": jnp.asarray(ridges, xa.dtype)}
    va, vb = (v / jnp.square(exposure) for v in (_variance(a, b), _variance(b, a)))
    coarse = min(_COARSE, window // 2 + 1)
    change = _worth_regressing(
        key, xa, xb, ya, yb, fa, fb, va, vb, stride=coarse, **options
    )
    if not (always or change.helps):
        return Regressed(frame.estimates[name], change, ran=False)
    both = _cross_regression(xa, xb, ya, yb, fa, fb, stride=stride, **options)
    halves = exposure * jnp.stack(both)
    return Regressed(Estimate(jnp.mean(halves, axis=0), halves), change, ran=True)


def _variance(half: Frame, other: Frame) -> Variance:
    """Of a half's mean; from the difference of both where nothing else tells it."""
    if half.buffers.variance is None and half.sub_buffers == 1:
        return jnp.square(half.color - other.color) / 2
    return half.variance
