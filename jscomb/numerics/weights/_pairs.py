"""Weights of pairs of pixels, over all windows of an image."""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from jscomb.numerics.guards import (
    check_image,
    first_finite,
    weighted_ratio,
    zero_invalid,
)
from jscomb.numerics.tiles import (
    Grid,
    Planes,
    Region,
    flat,
    fold_rows,
    sum_over_tiles,
    tile_side,
)
from jscomb.numerics.windows import check_window

Pairs = Float[Array, "_ _ _ ..."]  # planes of one pixel of each pair


class Weights(NamedTuple):
    """A function of two pixels, and the image that it is evaluated on.

    Attributes:
        image: [H,W,K]; a pixel that is not finite is invalid.
        pair: from planes of the centres and of pixels in their windows, [K,h,w,...], to
            weights [h,w,...], finite and at least zero for any finite planes.
        halo: pixels on every side of [h,w] that weights depend on without having one;
            with 0 the pairs may lie anywhere.
    """

    image: Float[Array, "h w k"]
    pair: Callable[[Pairs, Pairs], Array]
    halo: int = 0


def weighted_mean(
    image: Float[Array, "h w _"], weights: Weights, *, window: int
) -> Float[Array, "h w _"]:
    """Average over the window of each pixel.

    Args:
        image: any unit, shape [H,W,C].
        weights: of the pixels in the windows.
        window: width in pixels, odd.

    Returns:
        the mean, shape [H,W,C]. Pixels that are not finite in image or weights are
        excluded; there the result is the image where it is finite, else 0.

    Raises:
        ValueError: while tracing, if the window is even.

    Example:
        >>> image = jnp.array([1.0, 3.0, 8.0]).reshape(1, 3, 1)
        >>> from jscomb.numerics.weights import gaussian_weights
        >>> even = gaussian_weights(0 * image, 1.0)
        >>> print(weighted_mean(image, even, window=3)[0, :, 0])
        [2.  4.  5.5]
    """
    check_image(image=image, guide=weights.image)
    valid, clean, guide = zero_invalid(image, weights.image)
    reach, halo = check_window(window) // 2, weights.halo
    tile = tile_side(*image.shape[:2])
    grid = Grid(tile, 1, reach, 2)
    wide = tile + 2 * halo

    def region(planes: Float[Array, "h w _"], reach: int) -> Region:
        return Region(jnp.moveaxis(planes, -1, 0), reach)

    def sum_windows(near: Planes, seen: Planes) -> Planes:
        """Sum over the windows of a tile: the image and the weights."""
        centre = seen[:, reach : reach + wide, reach : reach + wide]

        def add_row(total: Planes, moved: list[Planes]) -> Planes:
            near, seen = moved
            for dx in range(window):
                w = weights.pair(centre, seen[:, :wide, dx : dx + wide])
                total = total + w[None] * near[:, :tile, dx : dx + tile]
            return total

        start = jnp.zeros((len(near), tile, tile), near.dtype)
        return fold_rows(add_row, start, [near, seen], window)

    counted = jnp.concatenate([clean, valid.astype(image.dtype)], axis=-1)
    regions = [region(counted, reach), region(guide, reach + halo)]
    sums = jnp.moveaxis(sum_over_tiles(sum_windows, regions, grid, reach=0), 0, -1)
    mean = weighted_ratio(sums[..., :-1], sums[..., -1:])
    return jnp.where(valid, mean, first_finite(image))


def tile_weights(weights: Weights, planes: Planes, grid: Grid) -> Float[Array, "m n"]:
    """Return the weights of a tile's neighbourhood for each centre.

    Args:
        weights: of pairs.
        planes: `weights.image` in the neighbourhood and the halo around it, [K,n,n].
        grid: of the centres.

    Returns:
        the weights [M,N], arbitrary outside the windows.

    Example:
        >>> from jscomb.numerics.weights import gaussian_weights
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
    """Move offsets [..., t, o] to places [..., t, t + o], 0 elsewhere.

    Row t moves t places to the right: in memory one place more for each row, which is
    what a row longer by one does.
    """
    *outer, count, offsets = w.shape
    n = count + offsets - 1
    longer = jnp.pad(w, [(0, 0)] * (w.ndim - 1) + [(0, count)])
    flat = longer.reshape(*outer, count * (n + 1))
    return flat[..., : count * n].reshape(*outer, count, n)
