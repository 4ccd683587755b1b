r"""Cross-regression: a better biased image from what both halves know.

Layout: images [H,W,C], normalised radiance, because the constants below are absolute.
Notation:

    x_a, x_b   unbiased half buffers, of disjoint samples
    y_a, y_b   a biased image of each half
    f          features: y and what the renderer wrote, [H,W,F]
    kappa      squared noise of the guide, |y_a - y_b|^2 / 2

In every window, x_a is fitted by a linear model of the features of half b, weighted by
how alike the pixels of y_b are,

    y^_a = local_linear(x_a, guide y_b, features f_b, bandwidth 2 kappa + epsilon),

and y^_b the same way with the halves exchanged; their mean y* = (y^_a + y^_b) / 2 is
the new biased image. Target and guide are independent, so the fit does not follow the
noise.

Differences from the paper, all measured (`experiments/james_stein`): the
constant has no ridge; where windows have hardly any weight a pixel fades to y instead
of falling back abruptly; and kappa is a median, because the mean over a frame is
dominated by the edges of its light sources and blurs all other edges.
`guide_noise(..., robust=False)` gives the paper's.

Source:
    NJS eq. 10-12.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from jscomb.numerics.guards import (
    check_same_shape,
    divide,
    finite,
    first_finite,
    masked_mean,
)
from jscomb.numerics.medians import median
from jscomb.numerics.regression import local_linear
from jscomb.typing import Image, Scalar

Features = Float[Array, "h w f"]

# NJS's constants, and our fall back, shared with `worth_regressing`.
EPSILON, RIDGE, SCALE_FLOOR, FALL_BACK = 0.01, 0.1, 0.1, 0.1


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
    epsilon: float = EPSILON,
    ridge: Float[Array, " _"] | float = RIDGE,
    scale_floor: float = SCALE_FLOOR,
    fall_back: float = FALL_BACK,
) -> tuple[Image, Image]:
    """Fit each half's unbiased image to the other half's biased image and features.

    Pure, and differentiable in every array. Costs two calls of `local_linear`.

    Args:
        unbiased_a: x_a, normalised radiance, shape [H,W,C].
        unbiased_b: x_b, same shape.
        biased_a: y_a, same shape; guide, and first C features.
        biased_b: y_b, same shape.
        features_a: the other features of half a, shape [H,W,F]; F may be 0.
        features_b: of half b, same shape.
        window: width of the windows in pixels, odd.
        stride: pixels between the centres of windows; 2 is 2.5 times as fast.
        kappa: squared noise of the guide; None for `guide_noise` of the halves.
        epsilon: added to the bandwidth, squared radiance.
        ridge: of the regression, one number or one for each of the C+F features.
        scale_floor: of the regression, unit of the features.
        fall_back: weight of the guide beside those of the windows, for a stride of 1;
            at larger strides divided by the stride's square, as there are fewer
            windows.

    Returns:
        y^_a and y^_b, shape [H,W,C]; at an invalid pixel the first finite of the guide,
        the other y and the two x, else 0.

    Raises:
        ValueError: while tracing, if shapes differ, or as `local_linear`.

    Example:
        >>> import jax
        >>> import numpy as np
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
    check_features(biased_a, features_a, features_b)
    if kappa is None:
        kappa = guide_noise(biased_a, biased_b)
    options = Options(
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
        fit(unbiased_a, biased_b, features_b, y_b, options),
        fit(unbiased_b, biased_a, features_a, y_a, options),
    )


def check_features(y: Image, a: Features, b: Features) -> None:
    """Raise unless both halves have the same features, of the image's size."""
    wanted = (*y.shape[:2], a.shape[-1])
    for name, features in {"features_a": a, "features_b": b}.items():
        if features.shape != wanted:
            raise ValueError(f"{name} has shape {features.shape}, expected {wanted}")


class Options(NamedTuple):
    """Options of a fit, named as in `cross_regression`."""

    bandwidth: Scalar
    window: int
    stride: int
    ridge: Float[Array, " _"] | float
    scale_floor: float = SCALE_FLOOR
    fall_back: float = FALL_BACK


def fit(
    x: Image,
    guide: Float[Array, "h w _"],
    features: Features,
    y: Image,
    options: Options,
) -> Image:
    """The windows' mean prediction of x, fading to y, which is finite.

    With a stride most pixels are no centre of a window. A pixel that is like no other
    would be predicted as x by a window about itself, so x stands in for that window.
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
    """Estimate the squared noise of a pixel of the biased image, kappa.

    Args:
        biased_a: y_a, radiance, shape [H,W,C].
        biased_b: y_b, same shape.
        robust: the median over the pixels; else the paper's mean, which is dominated
            by the few brightest pixels of a frame.

    Returns:
        |y_a - y_b|^2 / 2 of a typical pixel, squared radiance summed over the channels,
        of the finite pixels; 0 if there are none.

    Raises:
        ValueError: while tracing, if the shapes differ.

    Example:
        >>> a, b = jnp.full((2, 2, 3), 1.0), jnp.full((2, 2, 3), 1.2)
        >>> print(f"{guide_noise(a, b):.3f}")
        0.060

    Source: NJS eq. 10, the text below it.
    """
    check_same_shape(biased_a=biased_a, biased_b=biased_b)
    valid = finite(biased_a, biased_b)
    difference = jnp.where(valid, biased_a - biased_b, 0.0)
    square = jnp.sum(jnp.square(difference), axis=-1, keepdims=True) / 2
    if robust:
        return median(square, valid)
    return masked_mean(square, valid)
