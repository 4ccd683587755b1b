"""Weights of pairs of pixels, over all windows.

A mean walks the windows and holds one weight a pixel at a time; a regression wants all
weights of a tile at once, as a matrix.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from jscomb.numerics.guards import divide, finite, first_finite
from jscomb.numerics.tiles import (
    Grid,
    Planes,
    Region,
    flat,
    fold_rows,
    sum_over_tiles,
)
from jscomb.numerics.windows import check_window

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
        >>> from jscomb.numerics.weights import gaussian_weights
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
    """From offsets [.., t, o] to places [.., t, t + o], 0 elsewhere.

    Row t is to be moved t places to the right: in memory that is one place more for
    each row, which is what a row longer by one does.
    """
    *outer, count, offsets = w.shape
    n = count + offsets - 1
    longer = jnp.pad(w, [(0, 0)] * (w.ndim - 1) + [(0, count)])
    flat = longer.reshape(*outer, count * (n + 1))
    return flat[..., : count * n].reshape(*outer, count, n)
