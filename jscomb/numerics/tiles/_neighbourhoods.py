"""An image as overlapping tiles: cut apart, computed a few at a time, summed again.

For functions that couple each pixel with a large window and need much memory a pixel. A
tile is a square with some centres in it that share one neighbourhood: the square and
`reach` pixels around it. Layout: planes [K,H,W], channels first, so that a pixel's
neighbours in a row are adjacent in memory.

Memory: besides the planes only one batch of tiles and one strip of results exist at a
time. Reverse mode computes each batch again rather than store it.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from jscomb.numerics.tiles._programs import by_device

Planes = Float[Array, "_ _ _"]  # [K,H,W], or a part of it
Carry = TypeVar("Carry")


class Grid(NamedTuple):
    """Places of the centres, and how many share a tile.

    Every square block of `stride` pixels a side has one centre. Its row in the block
    changes with the block's column and its column with the block's row: on a regular
    grid most lines of pixels would have no centre, and a thin edge could lie between
    them.

    Attributes:
        side: blocks along one side of a tile.
        stride: pixels along one side of a block.
        reach: radius in pixels of the windows about the centres.
        batch: maximum number of tiles computed at once.
    """

    side: int
    stride: int
    reach: int
    batch: int

    @property
    def step(self) -> int:
        """Pixels along one side of a tile, and from one to the next."""
        return self.side * self.stride

    @property
    def places(self) -> np.ndarray:
        """Row and column of each centre in its tile, [2,M]."""
        block = np.arange(self.side)
        shift = block % self.stride
        if self.side < self.stride:
            shift = block * self.stride // self.side
        rows = np.add.outer(block * self.stride, shift)
        return np.stack([rows.ravel(), rows.T.ravel()])

    @property
    def inside(self) -> np.ndarray:
        """True at the pixels of a neighbourhood in each centre's window, [M,N]."""
        near = np.arange(self.width(self.reach)) - self.reach
        rows, columns = (
            abs(near - place[:, None]) <= self.reach for place in self.places
        )
        return (rows[:, :, None] & columns[:, None, :]).reshape(len(rows), -1)

    def width(self, reach: int) -> int:
        """Width in pixels of a tile and `reach` pixels to either side."""
        return self.step + 2 * reach

    def tiles(self, size: int) -> int:
        """Number of tiles along an axis of `size` pixels."""
        return -(-size // self.step)

    def centres(self, planes: Planes) -> Float[Array, "k m"]:
        """Values of a region of a tile at the tile's centres."""
        size = planes.shape[1]
        rows, columns = self.places + (size - self.step) // 2
        return flat(planes)[:, rows * size + columns]


class Region(NamedTuple):
    """Planes of which each tile sees its square and some pixels around it.

    Attributes:
        planes: zero outside the image, [K,H,W].
        reach: pixels to every side of the tile.
    """

    planes: Planes
    reach: int


def tile_side(height: int, width: int) -> int:
    """Return the side of tiles in pixels for functions of every pixel's window.

    Args:
        height: of the image.
        width: of the image.

    Returns:
        the side that suits the device, at most that of the image.

    Example:
        >>> tile_side(1080, 1920), tile_side(3, 5)
        (64, 5)
    """
    return min(by_device(cpu=64, accelerator=512), max(height, width))


def sum_over_tiles(
    function: Callable[..., Array],
    regions: Sequence[Region],
    grid: Grid,
    *,
    reach: int | None = None,
) -> Planes:
    """Sum the results of a function of the neighbourhoods of all tiles.

    Args:
        function: from one tile's regions, [K,n,n] each with n = grid.width(its reach),
            to planes [C,n,n] with n = grid.width(reach). Batched by `vmap`.
        regions: of one image size.
        grid: of the centres.
        reach: pixels around a tile that its result extends to; None for the windows'.

    Returns:
        at each pixel the sum over the results that contain it, [C,H,W].

    Example:
        >>> plane = Region(jnp.ones((1, 4, 4)), 1)
        >>> grid = Grid(side=2, stride=1, reach=1, batch=1)
        >>> print(sum_over_tiles(jnp.ones_like, [plane], grid)[0])
        [[1. 2. 2. 1.]
         [2. 4. 4. 2.]
         [2. 4. 4. 2.]
         [1. 2. 2. 1.]]
    """
    height, width = regions[0].planes.shape[1:]
    columns = grid.tiles(width)
    pieces = -(-columns // grid.batch)  # of a strip, each of equally many tiles
    batch = -(-columns // pieces)
    reaches = [around for _, around in regions]
    reach = grid.reach if reach is None else reach
    padded = [_padded(region, grid, pieces * batch) for region in regions]
    size, long = grid.width(reach), pieces * batch * grid.step
    wide = (batch - 1) * grid.step + size

    def piece(strips: list[Planes], number: Array) -> Planes:
        """Sum over one batch of tiles, [C,n,wide]."""
        tiles = []
        for strip, around in zip(strips, reaches, strict=True):
            n = grid.width(around)
            # As long as `_cut` needs, so that nothing is padded here.
            length = (batch + -(-n // grid.step)) * grid.step
            start = number * batch * grid.step
            near = lax.dynamic_slice_in_dim(strip, start, length, axis=2)
            tiles.append(_cut(near, grid.step, n, batch, axis=2))
        return _paste(jax.vmap(function)(*tiles), grid.step, wide, axis=2)

    def strip(number: Array) -> Planes:
        """Sum over one row of tiles, [C,n,long + n - step]."""
        strips = [
            lax.dynamic_slice_in_dim(
                planes, number * grid.step, grid.width(around), axis=1
            )
            for planes, around in zip(padded, reaches, strict=True)
        ]
        one = jax.checkpoint(lambda number: piece(strips, number))
        sums = lax.map(one, jnp.arange(pieces))
        return _paste(sums, batch * grid.step, long + size - grid.step, axis=2)

    rows = grid.tiles(height)
    sums = lax.map(jax.checkpoint(strip), jnp.arange(rows))
    total = _paste(sums, grid.step, (rows - 1) * grid.step + size, axis=1)
    return total[:, reach : reach + height, reach : reach + width]


def fold_rows(
    add_row: Callable[[Carry, list[Planes]], Carry],
    start: Carry,
    near: Sequence[Planes],
    window: int,
) -> Carry:
    """Fold over the rows of the windows of a tile.

    The planes move up a row at every step: to read them at a traced row would take
    several times as long. Reverse mode computes each row again.

    Args:
        add_row: from the state and the planes, moved up so that the k-th row of each
            pixel's window lies at the pixel's place in the tile, to the next state.
        start: first state, a tree of arrays.
        near: a tile's regions.
        window: rows of a window in pixels.

    Returns:
        the last state.

    Example:
        >>> plane = jnp.arange(4.0).reshape(1, 4, 1)
        >>> add = lambda total, near: total + near[0][:, :2]
        >>> print(fold_rows(add, jnp.zeros((1, 2, 1)), [plane], 3).ravel())
        [3. 6.]
    """

    @jax.checkpoint
    def step(carry: tuple[Carry, list[Planes]], _) -> tuple:
        state, moved = carry
        state = add_row(state, moved)
        return (state, [jnp.roll(planes, -1, axis=1) for planes in moved]), None

    return lax.scan(step, (start, list(near)), None, length=window)[0][0]


def map_rows(
    function: Callable[..., Array],
    images: Sequence[tuple[Float[Array, "h _ _"], int]],
    *,
    rows: int = 16,
) -> Float[Array, "h _ _"]:
    """Compute an image in strips of rows, one at a time.

    For a function that needs much memory a pixel. Reverse mode computes each strip
    again rather than store it.

    Args:
        function: from strips of all images, [rows + 2 reach,W,C] each, to [rows,W,C]; W
            and C may differ.
        images: of one height, each with its reach, the rows around a strip that the
            function sees of it; zero outside the image.
        rows: rows of a strip of the result.

    Returns:
        the strips' results as one image, [H,W,C].

    Example:
        >>> image = jnp.arange(4.0).reshape(4, 1, 1)
        >>> sums = lambda near: near[:-2] + near[1:-1] + near[2:]
        >>> print(map_rows(sums, [(image, 1)], rows=2).ravel())
        [1. 3. 6. 5.]
    """
    height = images[0][0].shape[0]
    rows = min(rows, height)
    count = -(-height // rows)

    def strips(image: Array, reach: int) -> Array:
        size = rows + 2 * reach
        total = (count + -(-size // rows)) * rows  # as `_cut` needs
        ends = [(reach, total - reach - height), (0, 0), (0, 0)]
        return _cut(jnp.pad(image, ends), rows, size, count, axis=0)

    each = [strips(image, reach) for image, reach in images]
    if count == 1:
        return function(*(strip[0] for strip in each))[:height]
    results = lax.map(jax.checkpoint(lambda strips: function(*strips)), each)
    return results.reshape(count * rows, *results.shape[2:])[:height]


def flat(planes: Planes) -> Float[Array, "k n"]:
    """Return planes with their pixels along one axis.

    Args:
        planes: shape [K,H,W].

    Returns:
        shape [K,H*W], row by row.

    Example:
        >>> print(flat(jnp.arange(4.0).reshape(1, 2, 2)))
        [[0. 1. 2. 3.]]
    """
    count, height, width = planes.shape
    return planes.reshape(count, height * width)


def _padded(region: Region, grid: Grid, columns: int) -> Planes:
    """Pad planes with zeros: enough for every tile, and for `_cut`."""
    planes, reach = region
    _, height, width = planes.shape
    n = grid.width(reach)
    rows = (grid.tiles(height) - 1) * grid.step + n
    long = (columns + -(-n // grid.step)) * grid.step
    ends = [(0, 0, 0)]
    for size, total in ((height, rows), (width, long)):
        ends.append((reach, total - reach - size, 0))
    return lax.pad(planes, jnp.zeros((), planes.dtype), ends)


def _cut(planes: Array, step: int, size: int, count: int, axis: int) -> Array:
    """Cut pieces of `size` pixels, `step` apart, and stack them on a new first axis.

    Reshapes and one concatenation in the final layout: XLA then makes the copy here,
    and does not repeat its index arithmetic at every use.
    """
    parts = -(-size // step)
    shape = planes.shape
    blocks = planes.reshape(*shape[:axis], count + parts, step, *shape[axis + 1 :])
    pieces = []
    for k in range(parts):
        part = lax.slice_in_dim(blocks, k, k + count, axis=axis)
        part = lax.slice_in_dim(part, 0, min(step, size - k * step), axis=axis + 1)
        pieces.append(jnp.moveaxis(part, axis, 0))
    return jnp.concatenate(pieces, axis=axis + 1)


def _paste(tiles: Array, step: int, length: int, axis: int) -> Array:
    """Sum the pieces at their places: the transpose of `_cut`."""
    count, size = tiles.shape[0], tiles.shape[axis + 1]
    whole = (count + -(-size // step)) * step
    shape = (*tiles.shape[1 : axis + 1], whole, *tiles.shape[axis + 2 :])
    cut = lambda planes: _cut(planes, step, size, count, axis)
    (planes,) = jax.linear_transpose(cut, jax.ShapeDtypeStruct(shape, tiles.dtype))(
        tiles
    )
    return lax.slice_in_dim(planes, 0, length, axis=axis)
