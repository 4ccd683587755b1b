"""Weights of pairs of pixels, over all windows of an image."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
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


_COLUMNS = 8  # of a window at a time, at most, for derivatives


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
    # Traced once rather than once a column; what it encloses becomes its argument.
    like = jax.ShapeDtypeStruct((guide.shape[-1], wide, wide), guide.dtype)
    pair, enclosed = jax.closure_convert(weights.pair, like, like)
    pair = jax.jit(pair)

    def region(planes: Float[Array, "h w _"], reach: int) -> Region:
        return Region(jnp.moveaxis(planes, -1, 0), reach)

    def start(near: Planes, seen: Planes) -> tuple[Planes, Planes]:
        """The centres, and sums to begin with."""
        centre = seen[:, reach : reach + wide, reach : reach + wide]
        return centre, jnp.zeros((len(near), tile, tile), near.dtype)

    @jax.custom_jvp
    def sum_windows(near: Planes, seen: Planes, *enclosed: Array) -> Planes:
        """Sum over the windows of a tile: the image and the weights."""
        centre, zero = start(near, seen)

        def add_row(total: Planes, moved: list[Planes]) -> Planes:
            near, seen = moved
            for dx in range(window):
                w = pair(centre, seen[:, :wide, dx : dx + wide], *enclosed)
                total = total + w[None] * near[:, :tile, dx : dx + tile]
            return total

        return fold_rows(add_row, zero, [near, seen], window)

    pieces = -(-window // _COLUMNS)  # of a row
    columns = -(-window // pieces)

    def sum_pieces(near: Planes, seen: Planes, *enclosed: Array) -> Planes:
        """The same by few columns at a time, for derivatives.

        Those of a whole row take the compiler minutes, and are slower.
        """
        centre, zero = start(near, seen)

        def piece(k: Array) -> tuple[Planes, Planes, Array]:
            """Planes from the k-th piece's first column on, and which columns count."""
            row, first = k // pieces, k % pieces * columns
            at = jnp.minimum(first, window - columns)
            cut = lambda planes, size: lax.dynamic_slice(
                planes, (0 * row, row, at), (len(planes), size, size + columns - 1)
            )
            counts = at + jnp.arange(columns) >= first
            return cut(near, tile), cut(seen, wide), counts

        @jax.checkpoint
        def add_piece(carry: tuple, k: Array) -> tuple:
            total, (near, seen, counts) = carry
            for dx in range(columns):
                w = pair(centre, seen[:, :, dx : dx + wide], *enclosed)
                w = jnp.where(counts[dx], w, 0.0)
                total = total + w[None] * near[:, :, dx : dx + tile]
            return (total, piece(k + 1)), None

        numbers = jnp.arange(window * pieces)
        # A step's planes are cut in the step before, or each use would cut them again.
        return lax.scan(add_piece, (zero, piece(numbers[0])), numbers)[0][0]

    sum_windows.defjvp(lambda *given: jax.jvp(sum_pieces, *given))

    counted = jnp.concatenate([clean, valid.astype(image.dtype)], axis=-1)
    regions = [region(counted, reach), region(guide, reach + halo)]
    sums = jnp.moveaxis(
        sum_over_tiles(
            lambda *near: sum_windows(*near, *enclosed), regions, grid, reach=0
        ),
        0,
        -1,
    )
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
    pair = jax.jit(weights.pair)  # traced once
    rows = [pair(centre, moved[:, k : k + inner]) for k in range(offsets)]
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
