r"""Windowed weighted least squares about every pixel, as matrix products.

In the window of each centre c a linear model of the features is fitted to the target;
a pixel's result is the weighted mean of the predictions of all windows that contain it.
Layout: images [H,W,*]. Notation:

    t    target, [H,W,C], any unit
    g    guide, [H,W,G], which decides what pixels are alike
    f    features, [H,W,F], which the model is linear in
    h    bandwidth, unit of g squared
    w    weights, w_ci = exp(-|g_i - g_c|^2 / h) for i in the window of c, else 0
    s    scale of each feature in a window, s_c = max_i |f_i - f_c| + scale_floor
    d    scaled features, d_i = (f_i - f_c) / s_c

    a_c, b_c = argmin sum_i w_ci (t_i - a - b.d_i)^2 + ridge |b|^2
    t^_i     = sum_c w_ci (a_c + b_c.d_i) / sum_c w_ci

The constant has no ridge, which would darken isolated bright pixels. So it can be
eliminated, and the unknowns are only the slopes:

    (C_w(d, d) + ridge) b = C_w(d, t),    a + b.d_i = mean_w(t) + b.(d_i - mean_w(d)),

with C_w(p, q) = sum_i w_ci (p_i - mean_w(p)) (q_i - mean_w(q)).

Fast, because the M centres of a tile (see `tiles`) share a neighbourhood of N pixels.
With W [M,N] their weights and Phi the products of features and targets, [moments,N],
Phi W' holds all moments of all windows; with B [..., M] the coefficients, B W holds all
predictions. Features are relative to one pixel in the tile's middle, which lies in all
of its windows, so no moment is large compared to s^2, and float32 suffices.

Sources:
    B. Moon, N. Carr, S.-E. Yoon, "Adaptive rendering based on weighted local
    regression", 2014, for the model; NJS eq. 10-12 and DSC eq. 11-17 for the weights
    and the mean of the predictions. The tiles and the closed form are ours.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from jscomb.numerics import cholesky
from jscomb.numerics.guards import (
    check_same_shape,
    check_static,
    weighted_ratio,
    zero_invalid,
)
from jscomb.numerics.tiles import (
    Grid,
    Planes,
    Region,
    by_device,
    flat,
    sum_over_tiles,
)
from jscomb.numerics.weights import Weights, gaussian_weights, tile_weights
from jscomb.numerics.windows import check_window, window_max, window_min
from jscomb.typing import Image, Mask, Scalar

__all__ = ["LocalFit", "joint_local_linear", "local_linear"]

_SIDE, _STEP = 16, 32  # of a tile, centres or pixels: fastest on a CPU


class LocalFit(NamedTuple):
    """Mean of the windows' predictions.

    Attributes:
        prediction: t^, unit of the target, [H,W,C]; 0 where `weight` is 0.
        weight: sum_c w_ci, [H,W,1]. At a valid pixel at least 1 for a stride of 1, but
            possibly 0 for larger strides; at an invalid pixel 0.
    """

    prediction: Image
    weight: Float[Array, "h w 1"]


def local_linear(
    target: Image,
    guide: Float[Array, "h w _"],
    features: Float[Array, "h w f"],
    bandwidth: Float[Array, "h w 1"] | Scalar | float,
    *,
    window: int = 51,
    stride: int = 1,
    ridge: Float[Array, " f"] | float = 0.1,
    scale_floor: float = 0.1,
) -> LocalFit:
    """Fit a linear model of the features in every window; average the predictions.

    With eleven features it executes about 500 operations for each pixel of each window.
    Strides of 2, 4 and 8 are 2.6, 5 and 9 times as fast (51x51, two cores). Memory does
    not depend on the window. Pixels that are not finite in some input are excluded.

    Args:
        target: t, any unit, shape [H,W,C].
        guide: g, shape [H,W,G].
        features: f, shape [H,W,F]; F may be 0.
        bandwidth: h > 0, unit of the guide squared: one number, or shape [H,W,1] for
            the mean of both pixels' values. Where h is not positive pixels are invalid.
        window: width in pixels, odd.
        stride: pixels between the centres of windows, along both axes; at most half the
            window. Above 1 a pixel at the border may lie in no window.
        ridge: > 0, of the scaled features: one number, or one a feature, shape [F].
        scale_floor: > 0, unit of the features; smaller variation counts as noise.

    Returns:
        the predictions and their weights.

    Raises:
        ValueError: while tracing, if sizes differ, `window` is even, `stride` does not
            fit, or a number that must be positive is not.

    Example:
        >>> depth = jnp.arange(12.0).reshape(3, 4, 1)
        >>> fit = local_linear(3 * depth, depth, depth, 100.0, window=3, ridge=1e-6)
        >>> print(jnp.abs(fit.prediction - 3 * depth).max().round(3))
        0.0

    Source: NJS eq. 10-12, without their ridge on the constant.
    """
    weighted = target, gaussian_weights(guide, bandwidth)
    (fit,) = joint_local_linear(
        [weighted],
        features,
        window=window,
        stride=stride,
        ridge=ridge,
        scale_floor=scale_floor,
    )
    return fit


def joint_local_linear(
    targets: Sequence[tuple[Image, Weights]],
    features: Float[Array, "h w f"],
    *,
    predict: Weights | None = None,
    powers: Sequence[int | float] = (1,),
    window: int = 51,
    stride: int = 1,
    ridge: Float[Array, " f"] | float = 0.1,
    scale_floor: float = 0.1,
) -> tuple:
    """Fit one linear model to several targets, each with its own weights.

    Minimises the sum of their squared errors, whose normal equations are the sum of
    theirs. The fits for all powers of the weights take little longer than one where the
    weights are what takes long.

    Args:
        targets: images [H,W,C] of one unit, with their weights.
        features: f, shape [H,W,F].
        predict: weights for the mean of the predictions; None for the first target's.
        powers: that all weights are raised to, > 0, for a fit each; for exponential
            weights their bandwidth is divided by it.
        window: width in pixels, odd.
        stride: pixels between the centres of windows.
        ridge: > 0, of the scaled features: one number, or one a feature, shape [F].
        scale_floor: > 0, unit of the features.

    Returns:
        a `LocalFit` for each power, in their order.

    Raises:
        ValueError: while tracing, as `local_linear`, or if a power is not positive.

    Example:
        >>> depth = jnp.arange(12.0).reshape(3, 4, 1)
        >>> even = gaussian_weights(0 * depth, 1.0)
        >>> both = [(3 * depth, even), (3 * depth + 2, even)]
        >>> (fit,) = joint_local_linear(both, depth, window=3, ridge=1e-6)
        >>> print(jnp.abs(fit.prediction - (3 * depth + 1)).max().round(3))
        0.0

    Source: DSC eq. 11-15.
    """
    grid = _grid(window, stride)
    similarity = [weights for _, weights in targets]
    similarity += [] if predict is None else [predict]
    _check(targets, features, similarity, ridge, scale_floor)
    if not powers or not min(powers) > 0:
        raise ValueError(f"powers must be positive, got {powers}")
    count = len(targets)
    valid, clean, *images = zero_invalid(
        features, *(image for image, _ in targets), *(s.image for s in similarity)
    )
    ridges = jnp.broadcast_to(jnp.asarray(ridge, features.dtype), features.shape[2:])
    inside = grid.inside

    def fit(basis: Planes, scale: Planes, *planes: Planes) -> Planes:
        """Sum weighted predictions, and weights, over a tile's windows."""
        size = basis.shape[1:]
        basis, centred = _centred(basis, grid)
        scale = jnp.where(centred[None], grid.centres(scale), 1.0)
        weights = [
            jnp.where(inside, tile_weights(s, plane, grid), 0.0)
            for s, plane in zip(similarity, planes[count:], strict=True)
        ]
        products = [_products(basis, flat(target)) for target in planes[:count]]

        def one(power: int | float) -> Float[Array, "_ n"]:
            # An integer power is products, any other takes logarithms.
            exponent = int(power) if power == int(power) else power
            raised = [w**exponent for w in weights]
            moments = [
                jnp.einsum("pn,mn->pm", product, w, precision="highest")
                for product, w in zip(products, raised, strict=False)
            ]
            # An invalid centre without moments predicts 0, and its rounding has no
            # derivative.
            moment = jnp.where(centred[None], sum(moments[1:], moments[0]), 0.0)
            b = _coefficients(moment, scale, ridges)
            b = jnp.concatenate([b, centred[None].astype(b.dtype)])
            w = raised[0 if predict is None else -1]
            spread = jnp.einsum("pm,mn->pn", b, w, precision="highest")
            terms = jnp.split(spread[:-1], len(basis))
            predicted = sum(
                term * f[None] for term, f in zip(terms, basis, strict=True)
            )
            return jnp.concatenate([predicted, spread[-1:]])

        return jnp.concatenate([one(p) for p in powers]).reshape(-1, *size)

    region = lambda image, reach: Region(jnp.moveaxis(image, -1, 0), reach)
    basis = jnp.concatenate([valid.astype(clean.dtype), clean], -1)
    scale = jnp.where(valid, _scale(clean, valid, window) + scale_floor, 0.0)
    halos = [0] * count + [s.halo for s in similarity]
    regions = [
        region(basis, grid.reach),
        region(scale, 0),
        *(region(i, grid.reach + h) for i, h in zip(images, halos, strict=True)),
    ]
    sums = jnp.moveaxis(sum_over_tiles(fit, regions, grid), 0, -1)
    return tuple(_mean(each, valid) for each in jnp.split(sums, len(powers), axis=-1))


def _mean(sums: Image, valid: Mask) -> LocalFit:
    """Divide the sum of weighted predictions by that of the weights, its last plane."""
    total, weight = sums[..., :-1], sums[..., -1:]
    # A subnormal weight has lost digits, and is 0 on some devices.
    normal = valid & (weight > float(jnp.finfo(weight.dtype).tiny))
    weight = jnp.where(normal, weight, 0.0)
    return LocalFit(weighted_ratio(total, weight), weight)


def _centred(basis: Planes, grid: Grid) -> tuple[Float[Array, "p n"], Array]:
    """Return 1 and features relative to an origin, 0 at invalid pixels; valid centres.

    The origin is the valid centre nearest to the tile's middle. It affects only the
    rounding.
    """
    centres = grid.centres(basis)
    valid = centres[0] > 0
    distance = ((grid.places - (grid.step - 1) / 2) ** 2).sum(axis=0)
    distance = distance.astype(basis.dtype)
    origin = centres[:, jnp.argmin(jnp.where(valid, distance, np.inf))]
    origin = lax.stop_gradient(origin).at[0].set(0.0)
    pixels = flat(basis)
    return pixels - origin[:, None] * pixels[:1], valid


def _products(
    basis: Float[Array, "p n"], target: Float[Array, "c n"]
) -> Float[Array, "_ n"]:
    """Return Phi: products of the basis with itself (upper triangle) and the target."""
    rows = [basis[k : k + 1] * basis[k:] for k in range(len(basis))]
    return jnp.concatenate([*rows, *(f * target for f in basis[:, None])])


def _coefficients(
    moments: Float[Array, "_ m"],
    scale: Float[Array, "f m"],
    ridges: Float[Array, " f"],
) -> Float[Array, "_ m"]:
    """Return the constant and the slopes of all windows, for the basis, [P*C,M]."""
    p, m = len(scale) + 1, moments.shape[1]
    square = np.zeros((p, p), int)
    square[np.triu_indices(p)] = np.arange(p * (p + 1) // 2)
    square = np.maximum(square, square.T)
    ff = moments[square]  # sum w f f', [P,P,M]
    ft = moments[p * (p + 1) // 2 :].reshape(p, -1, m)  # sum w f t, [P,C,M]
    total = ff[0, 0]
    per_weight = weighted_ratio(jnp.ones_like(total), total)
    mean_f, mean_t = ff[0, 1:] * per_weight[None], ft[0] * per_weight[None]
    spread = ff[1:, 1:] - ff[0, 1:, None] * mean_f[None]
    spread = spread / (scale[:, None] * scale[None])
    ridge = (ridges[None] * jnp.eye(p - 1, dtype=ridges.dtype))[..., None]
    joint = (ft[1:] - ff[0, 1:, None] * mean_t[None]) / scale[:, None]
    slopes = cholesky.solve(spread + ridge, joint, ridges[:, None]) / scale[:, None]
    constant = mean_t - jnp.sum(slopes * mean_f[:, None], axis=0)
    return jnp.concatenate([constant, slopes.reshape(-1, m)])


def _scale(features: Image, valid: Mask, window: int) -> Image:
    """Return max_i |f_i - f_c| over each window, 0 at an invalid centre.

    One feature after another: all at once would dominate the memory of the fit.
    """

    def one(plane: Float[Array, "h w"]) -> Float[Array, "h w"]:
        f = plane[..., None]
        above = window_max(f, window, mask=valid) - f
        below = f - window_min(f, window, mask=valid)
        return jnp.where(valid, jnp.maximum(above, below), 0.0)[..., 0]

    planes = lax.map(jax.checkpoint(one), jnp.moveaxis(features, -1, 0))
    return jnp.moveaxis(planes, 0, -1)


def _grid(window: int, stride: int) -> Grid:
    """Return tiles whose middle lies in all of their windows.

    A quarter of the reach is spare, for when the pixel in the middle is invalid.
    """
    reach = check_window(window) // 2
    check_static(stride=stride)
    maximum = reach + 1
    if not 1 <= stride <= maximum:
        raise ValueError(
            f"stride must be from 1 to {maximum} for {window=}, got {stride}"
        )
    side = max(1, min(_SIDE, _STEP // stride))
    # Those whose weights just fit the cache.
    centres = by_device(cpu=512, accelerator=2**15)
    while (grid := Grid(side, stride, reach, max(1, centres // side**2))).side > 1:
        if np.ptp(grid.places, axis=1).max() <= 1.5 * reach:
            break
        side -= 1
    return grid


def _check(
    targets: Sequence[tuple[Image, Weights]],
    features: Array,
    similarity: Sequence[Weights],
    ridge: Array | float,
    scale_floor: float,
) -> None:
    """Raise unless sizes agree and numbers are positive."""
    target = targets[0][0]
    check_same_shape(**{f"target {k}": image for k, (image, _) in enumerate(targets)})
    others = [("features", features), *(("guide", s.image) for s in similarity)]
    for name, image in others:
        if image.ndim != 3 or image.shape[:2] != target.shape[:2]:
            raise ValueError(
                f"{name} has shape {image.shape}, target has {target.shape}: "
                "height and width must agree"
            )
    for name, number in {"ridge": ridge, "scale_floor": scale_floor}.items():
        if isinstance(number, int | float) and not number > 0:
            raise ValueError(f"{name} must be positive, got {number}")
