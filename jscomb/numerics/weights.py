"""How the windows of a tile weigh their pixels.

A weight is a function of a tile's neighbourhood, so that no more than a batch of tiles'
weights exists at a time. `denoisers.nonlocal_means` has another kind.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jscomb.numerics.guards import check_same_shape, divide, finite, first_finite
from jscomb.numerics.tiles import Grid, Planes, Region, flat, sum_over_tiles
from jscomb.numerics.windows import check_window
from jscomb.typing import Scalar

_TILE, _TILES = 16, 4


class Weights(NamedTuple):
    """How each window weighs its pixels.

    Attributes:
        image: what the weights are made from, [H,W,K].
        function: planes of a tile's neighbourhood, [K,n,n], to weights [M,N] of its
            centres and pixels, finite and at least zero whatever the planes hold. The
            grid tells where the centres are.
        halo: pixels around the neighbourhood that `function` sees besides.
    """

    image: Float[Array, "h w k"]
    function: Callable[[Planes, Grid], Float[Array, "m n"]]
    halo: int = 0


def gaussian_weights(
    guide: Float[Array, "h w g"], bandwidth: Float[Array, "h w 1"] | Scalar | float
) -> Weights:
    """Weights exp(-|g_i - g_c|^2 / h).

    Args:
        guide: g, shape [H,W,G].
        bandwidth: h > 0, unit of the guide squared: one number, or shape [H,W,1] for
            the mean of both pixels' values. Elsewhere pixels are invalid.

    Returns:
        the weights.

    Raises:
        ValueError: if the bandwidth is a number that is not positive, or its shape is
            not [H,W,1].

    Example:
        >>> image = jnp.array([1.0, 3.0, 5.0, 7.0]).reshape(1, 4, 1)
        >>> guide = jnp.array([0.0, 0.0, 1.0, 1.0]).reshape(1, 4, 1)
        >>> mean = weighted_mean(image, gaussian_weights(guide, 0.01), window=3)
        >>> print(mean[0, :, 0])
        [2. 2. 6. 6.]

    Source: NJS eq. 11 (one bandwidth), DSC eq. 12 (one a pixel).
    """
    if isinstance(bandwidth, int | float) and not bandwidth > 0:
        raise ValueError(f"bandwidth must be positive, got {bandwidth}")
    h = jnp.asarray(bandwidth, guide.dtype)
    if h.ndim and h.shape != (*guide.shape[:2], 1):
        raise ValueError(f"bandwidth has shape {h.shape}, guide has {guide.shape}")
    h = jnp.where(h > 0, h, jnp.nan)
    if h.ndim == 0:  # divided by once a pixel, not once a weight
        return Weights(guide / jnp.sqrt(h), _gaussian)
    return Weights(jnp.concatenate([guide, h], axis=-1), _gaussian_of_both)


def noise_free_weights(
    guide: Float[Array, "h w g"],
    variance: Float[Array, "h w 1"],
    *,
    epsilon: float,
) -> Weights:
    """Weights exp(-(|g_i - g_c|^2 - v_i - v_c) / (v_i + v_c + eps)).

    As Gaussian ones, but less what noise alone makes of the distance: in a mean over
    windows, pixels of more noise are worth up to e times as much.

    Args:
        guide: g, shape [H,W,G].
        variance: v of the guide, its unit squared, at least zero, shape [H,W,1].
        epsilon: > 0, in the same unit.

    Returns:
        the weights.

    Raises:
        ValueError: if the variance's shape is not [H,W,1].

    Example:
        >>> image = jnp.array([1.0, 3.0]).reshape(1, 2, 1)
        >>> variance = jnp.array([0.0, 1.0]).reshape(1, 2, 1)
        >>> noisy = noise_free_weights(0 * image, variance, epsilon=1e-3)
        >>> mean = weighted_mean(image, noisy, window=3)
        >>> print([f"{value:.2f}" for value in mean.ravel()])  # (1 + 3 e) / (1 + e), 2
        ['2.46', '2.00']

    Source: DSC eq. 17.
    """
    kernel = gaussian_weights(guide, 2 * variance + epsilon)

    def function(planes: Planes, grid: Grid) -> Float[Array, "m n"]:
        sum_of_both = _mean_of_both(planes[-1:], grid)
        return kernel.function(planes, grid) * jnp.exp(1 - epsilon / sum_of_both)

    return kernel._replace(function=function)


def feature_weights(
    features: Float[Array, "h w f"], *, strength: float = 0.6, least: float = 1e-3
) -> Weights:
    """Weights exp(-max_f (f_i - f_c)^2 / (k^2 max(least, |grad f_c|^2))).

    The gradient keeps slopes together, such as depth along a floor, that are no edges.

    Args:
        features: f, of a range of about one, shape [H,W,F], F at least 1.
        strength: k > 0; larger calls more alike.
        least: > 0, differences whose square is smaller count as none.

    Returns:
        the weights.

    Raises:
        ValueError: if `strength` or `least` is not positive.

    Example:
        >>> image = jnp.array([1.0, 3.0, 5.0, 7.0]).reshape(1, 4, 1)
        >>> albedo = jnp.array([0.0, 0.0, 1.0, 1.0]).reshape(1, 4, 1)
        >>> mean = weighted_mean(image, feature_weights(albedo), window=3)
        >>> print([f"{value:.2f}" for value in mean.ravel()])
        ['2.00', '2.00', '6.00', '6.00']

    Source: Rousselle et al. 2013, "Robust denoising using feature and color
    information", eq. 6 to 8, for features without noise.
    """
    if not (strength > 0 and least > 0):
        raise ValueError(f"strength = {strength} and least = {least} must be positive")
    slope = jnp.maximum(sum(_square_slope(features, axis) for axis in (0, 1)), least)
    return Weights(jnp.concatenate([features, strength**2 * slope], -1), _of_features)


def least_of(first: Weights, second: Weights) -> Weights:
    """The lesser of two weights: pixels must be alike in both ways.

    Args:
        first: some weights.
        second: others, of an image of the same size.

    Returns:
        their minimum.

    Raises:
        ValueError: while tracing, if the sizes differ.

    Example:
        >>> image = jnp.array([1.0, 3.0, 5.0, 7.0]).reshape(1, 4, 1)
        >>> step = lambda at: gaussian_weights(jnp.where(image > at, 1.0, 0.0), 0.01)
        >>> print(weighted_mean(image, least_of(step(2), step(4)), window=3)[0, :, 0])
        [1. 3. 6. 6.]
    """
    check_same_shape(first=first.image[..., :1], second=second.image[..., :1])
    split, halo = first.image.shape[-1], max(first.halo, second.halo)

    def inner(planes: Planes, own: int) -> Planes:
        """Without what lies farther out than one of them wants."""
        cut = slice(halo - own, planes.shape[1] - (halo - own))
        return planes[:, cut, cut]

    def function(planes: Planes, grid: Grid) -> Float[Array, "m n"]:
        one = first.function(inner(planes[:split], first.halo), grid)
        other = second.function(inner(planes[split:], second.halo), grid)
        return jnp.minimum(one, other)

    image = jnp.concatenate([first.image, second.image], axis=-1)
    return Weights(image, function, halo)


def weighted_mean(
    image: Float[Array, "h w _"], weights: Weights, *, window: int
) -> Float[Array, "h w _"]:
    """Mean over the window of each pixel. Pure, and differentiable in every array.

    Args:
        image: any unit, shape [H,W,C].
        weights: of the pixels in the windows.
        window: width in pixels, odd.

    Returns:
        the mean, shape [H,W,C]. Pixels that are not finite in image or weights take no
        part; there the result is the image where it is finite, else 0.

    Raises:
        ValueError: while tracing, if the window is even.

    Example:
        >>> image = jnp.array([1.0, 3.0, 8.0]).reshape(1, 3, 1)
        >>> even = gaussian_weights(0 * image, 1.0)
        >>> print(weighted_mean(image, even, window=3)[0, :, 0])
        [2.  4.  5.5]
    """
    valid = finite(image, weights.image)
    reach = check_window(window) // 2
    grid = Grid(_TILE, 1, reach, _TILES)

    def region(planes: Float[Array, "h w _"], reach: int) -> Region:
        return Region(jnp.moveaxis(jnp.where(valid, planes, 0.0), -1, 0), reach)

    def mean(near: Planes, seen: Planes) -> Planes:
        """Sums over the windows of a tile: of the image and of the weights."""
        w = jnp.where(grid.inside, weights.function(seen, grid), 0.0)
        total = jnp.einsum("kn,mn->km", flat(near), w, precision="highest")
        return total.reshape(-1, _TILE, _TILE)

    taken = jnp.concatenate([image, jnp.ones_like(image[..., :1])], axis=-1)
    regions = [region(taken, reach), region(weights.image, reach + weights.halo)]
    sums = jnp.moveaxis(sum_over_tiles(mean, regions, grid, reach=0), 0, -1)
    weight = jnp.broadcast_to(sums[..., -1:], image.shape)
    result = divide(sums[..., :-1], weight, where=weight > 0)
    return jnp.where(valid, result, first_finite(image))


def _gaussian(planes: Planes, grid: Grid) -> Float[Array, "m n"]:
    """exp(-|p_i - p_c|^2)."""
    return jnp.exp(-_square_distance(planes, grid))


def _gaussian_of_both(planes: Planes, grid: Grid) -> Float[Array, "m n"]:
    """The same with the mean of both pixels' bandwidths, the last plane."""
    square = _square_distance(planes[:-1], grid)
    return jnp.exp(-square / _mean_of_both(planes[-1:], grid))


def _mean_of_both(plane: Planes, grid: Grid) -> Float[Array, "m n"]:
    """Mean of each centre's and each pixel's value, [1,n,n]; positive."""
    positive = jnp.where(plane > 0, plane, 1.0)
    (near,), (centre,) = flat(positive), grid.centres(positive)
    return (near[None] + centre[:, None]) / 2


def _of_features(planes: Planes, grid: Grid) -> Float[Array, "m n"]:
    """exp(-max (f_i - f_c)^2 / s_c): features, then their s, which is above zero."""
    f, s = jnp.split(planes, 2)
    near, centre, scale = flat(f), grid.centres(f), grid.centres(s)
    scale = jnp.where(scale > 0, scale, 1.0)  # 0 outside the image
    far = jnp.zeros((centre.shape[1], near.shape[1]), planes.dtype)
    for f_i, f_c, s_c in zip(near, centre, scale, strict=True):
        far = jnp.maximum(far, jnp.square(f_i[None] - f_c[:, None]) / s_c[:, None])
    return jnp.exp(-far)


def _square_slope(features: Float[Array, "h w f"], axis: int) -> Float[Array, "h w f"]:
    """Squared central difference along an axis; without pixels that are not finite."""
    size = features.shape[axis]
    at = lambda step: jnp.take(
        features, np.clip(np.arange(size) + step, 0, size - 1), axis=axis
    )
    after, before = at(1), at(-1)
    known = finite(after, before)
    difference = jnp.where(known, after, 0.0) - jnp.where(known, before, 0.0)
    return jnp.square(difference / 2)


def _square_distance(planes: Planes, grid: Grid) -> Float[Array, "m n"]:
    """|p_i - p_c|^2; not expanded into products, which would cancel."""
    pairs = zip(flat(planes), grid.centres(planes), strict=True)
    zero = jnp.zeros((), planes.dtype)
    return sum((jnp.square(near[None] - c[:, None]) for near, c in pairs), start=zero)
