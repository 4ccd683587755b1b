"""How alike two pixels are, as the weight of one in the other's window.

A weight is a function of pairs of pixels. A mean over windows walks the window and
holds one weight a pixel at a time; a regression wants all weights of a tile at once, as
a matrix. `denoisers.nonlocal_means` has another kind.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jscomb.numerics.guards import check_same_shape, divide, finite, first_finite
from jscomb.numerics.tiles import (
    Grid,
    Planes,
    Region,
    flat,
    fold_rows,
    sum_over_tiles,
)
from jscomb.numerics.windows import check_window
from jscomb.typing import Scalar

# A noisy guide's distance beyond which a weight is 0 in any precision.
_FARTHEST = 1e4
_TILE, _TILES = 64, 2

Pairs = Float[Array, "_ _ _ ..."]  # planes of pixels, one of each pair


class Weights(NamedTuple):
    """How each window weighs its pixels.

    Attributes:
        image: what the weights are made from, [H,W,K].
        pair: planes of the windows' centres and of pixels in them, [K,h,w,...], to the
            pairs' weights [h,w,...], finite and at least zero whatever the planes hold.
        halo: pixels on every side of [h,w] that a weight depends on and that have none
            themselves; with 0 the pairs need not be neighbours.
    """

    image: Float[Array, "h w k"]
    pair: Callable[[Pairs, Pairs], Array]
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

    def pair(p: Pairs, q: Pairs) -> Array:
        sum_of_both = _mean_of_both(p[-1], q[-1])
        return kernel.pair(p, q) * jnp.exp(1 - epsilon / sum_of_both)

    return kernel._replace(pair=pair)


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


def bilateral_weights(
    guide: Float[Array, "h w g"],
    noisy: Float[Array, "h w z"],
    variance: Float[Array, "h w z"],
    *,
    sigma: float,
) -> Weights:
    """Weights exp(-|p - q|^2 / 2 s^2 - |g_p - g_q|^2 - sum d_pq).

    with d_pq = (z_p - z_q)^2 / (v_p + v_q) of each noisy channel.

    Args:
        guide: g, in units of its standard deviation times the root of 2, shape [H,W,G];
            G may be 0.
        noisy: z, a guide with noise, scaled likewise, shape [H,W,Z]; Z may be 0.
        variance: v of the unscaled z, at least zero, shape [H,W,Z].
        sigma: s > 0, standard deviation in pixels of the distance's share.

    Returns:
        the weights.

    Raises:
        ValueError: if `sigma` is not positive, or noisy and variance differ in shape.

    Example:
        >>> image = jnp.array([1.0, 3.0, 5.0, 7.0]).reshape(1, 4, 1)
        >>> edge = jnp.array([0.0, 0.0, 9.0, 9.0]).reshape(1, 4, 1)
        >>> none = edge[..., :0]
        >>> near = bilateral_weights(edge, none, none, sigma=100.0)
        >>> mean = weighted_mean(image, near, window=3)
        >>> print([f"{value:.2f}" for value in mean.ravel()])
        ['2.00', '2.00', '6.00', '6.00']

    Source: J. Kopf et al., "Joint bilateral upsampling", 2007; T.-M. Li et al.,
    "SURE-based optimization for adaptive sampling and reconstruction", 2012 (the noisy
    guide); ED eq. 32-34.
    """
    if not sigma > 0:
        raise ValueError(f"sigma must be positive, got {sigma}")
    if noisy.shape != variance.shape:
        raise ValueError(f"variance has shape {variance.shape}, noisy {noisy.shape}")
    place = np.moveaxis(np.indices(guide.shape[:2]), 0, -1) / (2**0.5 * sigma)
    exact = jnp.concatenate([jnp.asarray(place, guide.dtype), guide], axis=-1)
    parts = np.cumsum([exact.shape[-1], noisy.shape[-1]])

    def pair(p: Pairs, q: Pairs) -> Array:
        (g_p, z_p, v_p), (g_q, z_q, v_q) = jnp.split(p, parts), jnp.split(q, parts)
        far = _square_distance(g_p, g_q)
        for one, other, v, w in zip(z_p, z_q, v_p, v_q, strict=True):
            square, noise = jnp.square(one - other), v + w
            known = _FARTHEST * noise > square
            most = jnp.where(square > 0, _FARTHEST, jnp.zeros_like(square))
            far += divide(square, noise, where=known, otherwise=most)
        return jnp.exp(-far)

    return Weights(jnp.concatenate([exact, noisy, variance], axis=-1), pair)


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

    def inner(planes: Pairs, own: int) -> Pairs:
        """Without what lies farther out than one of them wants."""
        rows, columns = (slice(halo - own, n - (halo - own)) for n in planes.shape[1:3])
        return planes[:, rows, columns]

    def pair(p: Pairs, q: Pairs) -> Array:
        one = first.pair(*(inner(i[:split], first.halo) for i in (p, q)))
        other = second.pair(*(inner(i[split:], second.halo) for i in (p, q)))
        return jnp.minimum(one, other)

    image = jnp.concatenate([first.image, second.image], axis=-1)
    return Weights(image, pair, halo)


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
    reach, halo = check_window(window) // 2, weights.halo
    tile = min(_TILE, max(image.shape[:2]))
    grid = Grid(tile, 1, reach, _TILES)
    wide = tile + 2 * halo

    def region(planes: Float[Array, "h w _"], reach: int) -> Region:
        return Region(jnp.moveaxis(jnp.where(valid, planes, 0.0), -1, 0), reach)

    def mean(near: Planes, seen: Planes) -> Planes:
        """Sums over the windows of a tile: of the image and of the weights."""
        centre = seen[:, reach : reach + wide, reach : reach + wide]

        def add_row(total: Planes, moved: list[Planes]) -> Planes:
            near, seen = moved
            for dx in range(window):
                w = weights.pair(centre, seen[:, :wide, dx : dx + wide])
                total = total + w[None] * near[:, :tile, dx : dx + tile]
            return total

        start = jnp.zeros((len(near), tile, tile), near.dtype)
        return fold_rows(add_row, start, [near, seen], window)

    taken = jnp.concatenate([image, jnp.ones_like(image[..., :1])], axis=-1)
    regions = [region(taken, reach), region(weights.image, reach + halo)]
    sums = jnp.moveaxis(sum_over_tiles(mean, regions, grid, reach=0), 0, -1)
    weight = jnp.broadcast_to(sums[..., -1:], image.shape)
    result = divide(sums[..., :-1], weight, where=weight > 0)
    return jnp.where(valid, result, first_finite(image))


def tile_weights(weights: Weights, planes: Planes, grid: Grid) -> Float[Array, "m n"]:
    """The weights of all pixels of a tile's neighbourhood for each centre.

    Args:
        weights: of pairs.
        planes: of `weights.image`, the neighbourhood and the halo around it, [K,n,n].
        grid: of the centres.

    Returns:
        the weights [M,N], of any value outside the windows.

    Example:
        >>> alike = gaussian_weights(jnp.array([0.0, 1.0, 1.0]).reshape(1, 3, 1), 1.0)
        >>> planes = jnp.tile(alike.image[..., 0], (3, 1))[None]
        >>> grid = Grid(side=1, stride=1, reach=1, batch=1)
        >>> print(tile_weights(alike, planes, grid).reshape(3, 3).round(2))
        [[0.37 1.   1.  ]
         [0.37 1.   1.  ]
         [0.37 1.   1.  ]]
    """
    if weights.halo == 0:
        return weights.pair(grid.centres(planes)[:, :, None], flat(planes)[:, None])
    offsets, inner = 2 * grid.reach + 1, grid.step + 2 * weights.halo
    middle = slice(grid.reach, grid.reach + inner)
    centre = planes[:, middle, middle, None]
    moved = jnp.stack([planes[:, :, k : k + inner] for k in range(offsets)], axis=-1)
    rows = [weights.pair(centre, moved[:, k : k + inner]) for k in range(offsets)]
    w = _place(jnp.stack(rows))  # [offset row, row, column, near column]
    w = _place(jnp.transpose(w, (2, 3, 1, 0)))  # [column, near column, row, near row]
    w = jnp.transpose(w, (2, 0, 3, 1)).reshape(grid.step**2, -1)
    rows, columns = grid.places
    return w[rows * grid.step + columns]


def _place(w: Float[Array, "a b t o"]) -> Float[Array, "a b t n"]:
    """From offsets [.., t, o] to places [.., t, t + o], 0 elsewhere.

    Row t is to be moved t places to the right: in memory that is one place more for
    each row, which is what a row longer by one does.
    """
    *outer, count, offsets = w.shape
    n = count + offsets - 1
    longer = jnp.pad(w, [(0, 0)] * (w.ndim - 1) + [(0, count)])
    flat = longer.reshape(*outer, count * (n + 1))
    return flat[..., : count * n].reshape(*outer, count, n)


def _gaussian(p: Pairs, q: Pairs) -> Array:
    """exp(-|p - q|^2)."""
    return jnp.exp(-_square_distance(p, q))


def _gaussian_of_both(p: Pairs, q: Pairs) -> Array:
    """The same with the mean of both pixels' bandwidths, the last plane."""
    square = _square_distance(p[:-1], q[:-1])
    return jnp.exp(-square / _mean_of_both(p[-1], q[-1]))


def _mean_of_both(p: Array, q: Array) -> Array:
    """Mean of each pair's values; positive."""
    p, q = (jnp.where(i > 0, i, 1.0) for i in (p, q))
    return (p + q) / 2


def _of_features(p: Pairs, q: Pairs) -> Array:
    """exp(-max (f_p - f_q)^2 / s_p): features, then their s, which is above zero."""
    (f_p, scale), (f_q, _) = jnp.split(p, 2), jnp.split(q, 2)
    scale = jnp.where(scale > 0, scale, 1.0)  # 0 outside the image
    pairs = zip(f_p, f_q, scale, strict=True)
    far = [jnp.square(one - other) / s for one, other, s in pairs]
    return jnp.exp(-functools.reduce(jnp.maximum, far))


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


def _square_distance(p: Pairs, q: Pairs) -> Array:
    """|p - q|^2; not expanded into products, which would cancel.

    Plane by plane: a sum over an axis would not be vectorised.
    """
    zero = jnp.zeros((), p.dtype)
    pairs = zip(p, q, strict=True)
    return sum((jnp.square(one - other) for one, other in pairs), start=zero)
