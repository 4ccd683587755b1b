"""A local function over an image that is too large for it: by crops of one size.

Local: what it makes of a pixel depends on the images within `halo` pixels of it, and on
the image's border if that is as near. All that depends on more than this, such as an
exposure, is computed once for the whole image and given to the function.

An image is covered by tiles; a crop is a tile with the halo around it. All crops have
one size, so there is one program. At the border a crop is moved inwards, not filled up:
windows are clipped at the image's border, and nowhere else. So the result is that of
the whole image, to rounding.
"""

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

Images = Any  # pytree of [H,W,...]


class Local(NamedTuple):
    """A local function and what it is of, such as a combiner of a frame.

    Attributes:
        function: of images, or of crops of them, to an image of their size.
        images: a tree of arrays [H,W,...].
        halo: pixels around a pixel that its result depends on.
        multiple: what crops have to start at multiples of; more than one for functions
            that treat pixels by blocks, such as a network that pools.
    """

    function: Callable[[Images], Any]
    images: Images
    halo: int
    multiple: int = 1

    def whole(self) -> Any:
        """Return the function's result for the whole images."""
        return self.function(self.images)


class Span(NamedTuple):
    """A tile and its crop along one axis, in pixels.

    Attributes:
        start: of the crop, in the image.
        size: of the crop.
        first: of the tile's pixels, in the crop.
        pixels: of the tile.
    """

    start: int
    size: int
    first: int
    pixels: int

    @property
    def crop(self) -> slice:
        """In the image."""
        return slice(self.start, self.start + self.size)

    @property
    def own(self) -> slice:
        """The tile, in the image."""
        return slice(self.start + self.first, self.start + self.first + self.pixels)

    @property
    def inner(self) -> slice:
        """The tile, in the crop."""
        return slice(self.first, self.first + self.pixels)


class Crop(NamedTuple):
    """A tile and its crop.

    Attributes:
        rows: along the first axis.
        columns: along the second.
    """

    rows: Span
    columns: Span


def length(size: int, tile: int, halo: int, multiple: int) -> int:
    """Pixels along one side of all crops.

    Args:
        size: of the image.
        tile: pixels from one tile to the next.
        halo: around a tile.
        multiple: what the crops' starts are multiples of.

    Returns:
        the tile and its halo, and what else it takes that the last crop, which ends
        with the image, starts at a multiple.
    """
    least = tile + 2 * halo + multiple - 1
    return size if least >= size else least + (size - least) % multiple


def spans(size: int, tile: int, halo: int, multiple: int) -> list[Span]:
    """Tiles along one axis.

    Args:
        size: of the image in pixels.
        tile: pixels from one tile to the next.
        halo: around a tile.
        multiple: what the crops' starts are multiples of.

    Returns:
        the tiles in order.
    """
    long, found = length(size, tile, halo, multiple), []
    for first in range(0, size, tile):
        start = max(0, min(first - halo, size - long)) // multiple * multiple
        found.append(Span(start, long, first - start, min(tile, size - first)))
    return found


def crops(
    shape: tuple[int, ...], *, tile: int, halo: int, multiple: int = 1
) -> list[Crop]:
    """Tiles that cover an image.

    Args:
        shape: of the image, [H,W,...].
        tile: width of a tile in pixels.
        halo: pixels around a tile that its result depends on.
        multiple: crops start at multiples of it; for functions that treat pixels by
            blocks, such as a network that pools, or a regression with a stride.

    Returns:
        the tiles, row by row.

    Raises:
        ValueError: if a number is not positive, or the halo negative.

    Example:
        >>> for crop in crops((4, 9), tile=4, halo=1):
        ...     print(crop.columns.own, "in", crop.columns.crop)
        slice(0, 4, None) in slice(0, 6, None)
        slice(4, 8, None) in slice(3, 9, None)
        slice(8, 9, None) in slice(3, 9, None)
    """
    if tile < 1 or multiple < 1 or halo < 0:
        raise ValueError(f"got tile={tile}, halo={halo}, multiple={multiple}")
    rows, columns = (spans(size, tile, halo, multiple) for size in shape[:2])
    return [Crop(row, column) for row in rows for column in columns]


def stream_crops(
    function: Callable[[Images], Any],
    images: Images,
    *,
    tile: int,
    halo: int,
    multiple: int = 1,
) -> Iterator[tuple[tuple[slice, slice], Any]]:
    """Work on one crop after the other, on the host's arrays.

    Only a crop at a time is on the device: for images that its memory does not hold,
    and to show how far it is.

    Args:
        function: local, of the images' crops to images of their size.
        images: a tree of arrays [H,W,...], best NumPy's.
        tile: width of a tile in pixels.
        halo: pixels around a tile that its result depends on.
        multiple: crops start at multiples of it.

    Yields:
        where a tile lies, and the function's result there.

    Raises:
        ValueError: if a number is not positive, or the halo negative.

    Example:
        >>> from jscomb.numerics.windows import window_sum
        >>> sums, image = lambda image: window_sum(image, 3), np.ones((1, 5, 1))
        >>> for (_, columns), own in stream_crops(sums, image, tile=2, halo=1):
        ...     print(columns, own[..., 0])
        slice(0, 2, None) [[2. 3.]]
        slice(2, 4, None) [[3. 3.]]
        slice(4, 5, None) [[2.]]
    """
    one = jax.jit(function)
    shape = jax.tree.leaves(images)[0].shape
    for rows, columns in crops(shape, tile=tile, halo=halo, multiple=multiple):
        here = rows.crop, columns.crop
        made = one(jax.tree.map(lambda image, here=here: image[here], images))
        inner = rows.inner, columns.inner
        own = jax.tree.map(lambda image, inner=inner: np.asarray(image)[inner], made)
        yield (rows.own, columns.own), own


def map_crops(
    function: Callable[[Images], Any],
    images: Images,
    *,
    tile: int,
    halo: int,
    multiple: int = 1,
) -> Any:
    """Apply a local function by crops, one at a time, in a single program.

    Pure and differentiable. What the function needs on its way exists for one crop at a
    time, also in reverse mode, which works each crop out again.

    Args:
        function: local, of the images' crops to images of their size.
        images: a tree of arrays [H,W,...].
        tile: width of a tile in pixels.
        halo: pixels around a tile that its result depends on.
        multiple: crops start at multiples of it.

    Returns:
        what the function makes of the whole images, to rounding.

    Raises:
        ValueError: if a number is not positive, or the halo negative.

    Example:
        >>> import jax.numpy as jnp
        >>> from jscomb.numerics.windows import window_sum
        >>> sums = map_crops(
        ...     lambda image: window_sum(image, 3), jnp.ones((5, 6, 1)), tile=2, halo=1
        ... )
        >>> print(sums[..., 0].astype(int))
        [[4 6 6 6 6 4]
         [6 9 9 9 9 6]
         [6 9 9 9 9 6]
         [6 9 9 9 9 6]
         [4 6 6 6 6 4]]
    """
    height, width = jax.tree.leaves(images)[0].shape[:2]
    all_crops = crops((height, width), tile=tile, halo=halo, multiple=multiple)
    size = all_crops[0].rows.size, all_crops[0].columns.size
    starts = jnp.array([(r.start, c.start) for r, c in all_crops])
    # Tiles at the right and lower border may be cut short: taken as whole ones from a
    # crop that has zeros behind it.
    firsts = jnp.array([(r.first, c.first) for r, c in all_crops])

    @jax.checkpoint
    def one(start: jax.Array, first: jax.Array) -> Any:
        made = function(jax.tree.map(lambda i: _cut(i, start, size), images))
        spare = lambda image: jnp.pad(
            image, [(0, tile), (0, tile), *[(0, 0)] * (image.ndim - 2)]
        )
        return jax.tree.map(lambda i: _cut(spare(i), first, (tile, tile)), made)

    tiles = lax.map(lambda at: one(*at), (starts, firsts))
    lines = -(-height // tile)
    return jax.tree.map(lambda t: _joined(t, lines)[:height, :width], tiles)


def _cut(image: jax.Array, start: jax.Array, size: tuple[int, int]) -> jax.Array:
    """A rectangle of an image."""
    rest = image.ndim - 2
    zeros = [jnp.zeros((), start.dtype)] * rest
    return lax.dynamic_slice(image, [*start, *zeros], [*size, *image.shape[2:]])


def _joined(tiles: jax.Array, lines: int) -> jax.Array:
    """Tiles [N,t,t,...] as the image that they are of."""
    count, tile, _, *rest = tiles.shape
    blocks = tiles.reshape(lines, count // lines, tile, tile, *rest)
    return jnp.moveaxis(blocks, 2, 1).reshape(
        lines * tile, count // lines * tile, *rest
    )


def tile_within(
    function: Callable[[Images], Any],
    images: Images,
    *,
    halo: int,
    budget: int,
    multiple: int = 1,
) -> int:
    """The widest tile whose crop the function works on within a memory budget.

    By what the compiler says that the program takes: its inputs, its results and all
    between.

    Args:
        function: local, of the images' crops to images of their size.
        images: a tree of arrays [H,W,...], or of their shapes.
        halo: pixels around a tile that its result depends on.
        budget: bytes.
        multiple: crops start at multiples of it.

    Returns:
        width of a tile in pixels, a multiple of `multiple`; at most that of the image.

    Raises:
        ValueError: if not even a crop with a tile as wide as its halo has room.
        RuntimeError: if the backend does not tell.

    Example:
        >>> image = jax.ShapeDtypeStruct((500, 500, 3), jnp.float32)
        >>> double = lambda image: 2 * image  # in and out, 24 bytes a pixel
        >>> tile = tile_within(double, image, halo=4, budget=2**20)
        >>> print(tile, (tile + 2 * 4) ** 2 * 24 <= 2**20)
        193 True
    """
    height, width = jax.tree.leaves(images)[0].shape[:2]
    largest = max(height, width)
    least = max(halo, 16, multiple)
    bytes_of = lambda tile: _memory(function, images, tile, halo, multiple)
    tile = largest
    while tile > least:
        needed = bytes_of(tile)
        if needed <= budget:
            break
        # Memory grows with a crop's area; a tenth less, since it does so only about.
        crop = (tile + 2 * halo) * (0.9 * budget / needed) ** 0.5
        tile = max(least, min(tile - 1, int(crop) - 2 * halo) // multiple * multiple)
    if tile <= least and (needed := bytes_of(least)) > budget:
        raise ValueError(
            f"a tile of {least} pixels with {halo} around it takes "
            f"{needed / 2**20:.0f} MiB, the budget is {budget / 2**20:.0f} MiB"
        )
    return max(tile, least)


def _memory(
    function: Callable[[Images], Any], images: Images, tile: int, halo: int, m: int
) -> int:
    """Bytes that the function takes for one crop."""
    height, width = jax.tree.leaves(images)[0].shape[:2]
    size = length(height, tile, halo, m), length(width, tile, halo, m)
    like = lambda i: jax.ShapeDtypeStruct((*size, *i.shape[2:]), i.dtype)
    used = jax.jit(function).lower(jax.tree.map(like, images)).compile()
    of = used.memory_analysis()
    if of is None:
        raise RuntimeError("this backend does not tell what memory a program takes")
    return of.temp_size_in_bytes + of.argument_size_in_bytes + of.output_size_in_bytes
