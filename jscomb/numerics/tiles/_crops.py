"""A local function over an image that is too large for it: by crops of one size.

Local: its result at a pixel depends on the images within `halo` pixels of it, and on
the image's border if that is as near. All that depends on more than this, such as a
median luminance, is computed once for the whole image and given to the function; where
that is impossible the halo is None, and the function cannot be cut.

Tiles cover an image; a crop is a tile with the halo around it. All crops have one size,
so there is one program. At the border a crop is moved inwards, not padded: windows are
clipped at the image's border, and nowhere else. So the result is that of the whole
image, to rounding.

The functions here share arguments: `function`, local, from crops of the images to
images of their size; `images`, a tree of arrays [H,W,...]; `halo`, in pixels;
`multiple`, which all crops start at multiples of, for functions that treat pixels by
blocks, such as a network that pools, or a regression with a stride.
"""

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

Images = Any  # pytree of [H,W,...]


class Local(NamedTuple):
    """A local function and its images, such as a combiner of a frame.

    Attributes:
        function: from images, or crops of them, to an image of their size.
        images: a tree of arrays [H,W,...].
        halo: pixels around a pixel that its result depends on; None for the whole
            image.
        multiple: what crops have to start at multiples of.
    """

    function: Callable[[Images], Any]
    images: Images
    halo: int | None
    multiple: int = 1

    def whole(self) -> Any:
        """Return the function's result for the whole images."""
        return self.function(self.images)


class Span(NamedTuple):
    """A tile and its crop along one axis, in pixels.

    Attributes:
        start: of the crop, in the image.
        size: of the crop.
        offset: of the tile, in the crop.
        pixels: of the tile.
    """

    start: int
    size: int
    offset: int
    pixels: int

    @property
    def crop(self) -> slice:
        """The crop in the image."""
        return slice(self.start, self.start + self.size)

    @property
    def tile(self) -> slice:
        """The tile in the image."""
        first = self.start + self.offset
        return slice(first, first + self.pixels)

    @property
    def inner(self) -> slice:
        """The tile in the crop."""
        return slice(self.offset, self.offset + self.pixels)


class Crop(NamedTuple):
    """A tile and its crop.

    Attributes:
        rows: along the first axis.
        columns: along the second.
    """

    rows: Span
    columns: Span


def length(size: int, tile: int, halo: int, multiple: int) -> int:
    """Return one side of all crops: so long that the last starts at a multiple."""
    minimum = tile + 2 * halo + multiple - 1
    return size if minimum >= size else minimum + (size - minimum) % multiple


def finite_halo(halo: int | None) -> int:
    """Return the halo; raise if the function depends on the whole image."""
    if halo is None:
        raise ValueError(
            "this function depends on the whole image (its halo is None) and cannot "
            "be split into crops or shards: combine it whole"
        )
    return halo


def _spans(size: int, tile: int, halo: int, multiple: int) -> list[Span]:
    """Return the tiles along one axis, in order."""
    long, spans = length(size, tile, halo, multiple), []
    for first in range(0, size, tile):
        start = max(0, min(first - halo, size - long)) // multiple * multiple
        spans.append(Span(start, long, first - start, min(tile, size - first)))
    return spans


def crops(
    shape: tuple[int, ...], *, tile: int, halo: int | None, multiple: int = 1
) -> list[Crop]:
    """Cover an image with tiles.

    Args:
        shape: of the image, [H,W,...].
        tile: width of a tile in pixels.
        halo: pixels around a tile that its result depends on.
        multiple: crops start at multiples of it.

    Returns:
        the tiles, row by row.

    Raises:
        ValueError: if a number is not positive, or the halo negative or None.

    Example:
        >>> for crop in crops((4, 9), tile=4, halo=1):
        ...     print(crop.columns.tile, "in", crop.columns.crop)
        slice(0, 4, None) in slice(0, 6, None)
        slice(4, 8, None) in slice(3, 9, None)
        slice(8, 9, None) in slice(3, 9, None)
    """
    halo = finite_halo(halo)
    if tile < 1 or multiple < 1 or halo < 0:
        raise ValueError(f"got tile={tile}, halo={halo}, multiple={multiple}")
    rows, columns = (_spans(size, tile, halo, multiple) for size in shape[:2])
    return [Crop(row, column) for row in rows for column in columns]


def stream_crops(
    function: Callable[[Images], Any],
    images: Images,
    *,
    tile: int,
    halo: int | None,
    multiple: int = 1,
) -> Iterator[tuple[tuple[slice, slice], Any]]:
    """Apply a local function to one crop after another, from the host's memory.

    Only one crop at a time is on the device: for images that its memory cannot hold,
    and to report progress.

    Args:
        function: local.
        images: a tree of arrays [H,W,...], best NumPy's.
        tile: width of a tile in pixels.
        halo: pixels around a tile that its result depends on.
        multiple: crops start at multiples of it.

    Yields:
        a tile's rows and columns, and the function's result there.

    Raises:
        ValueError: if a number is not positive, or the halo negative or None.

    Example:
        >>> from jscomb.numerics.windows import window_sum
        >>> sums, image = lambda image: window_sum(image, 3), np.ones((1, 5, 1))
        >>> for (_, columns), part in stream_crops(sums, image, tile=2, halo=1):
        ...     print(columns, part[..., 0])
        slice(0, 2, None) [[2. 3.]]
        slice(2, 4, None) [[3. 3.]]
        slice(4, 5, None) [[2.]]
    """
    program = jax.jit(function)
    shape = jax.tree.leaves(images)[0].shape
    cut = lambda tree, where: jax.tree.map(lambda i: i[where], tree)
    for rows, columns in crops(shape, tile=tile, halo=halo, multiple=multiple):
        result = program(cut(images, (rows.crop, columns.crop)))
        host = jax.tree.map(np.asarray, result)
        yield (rows.tile, columns.tile), cut(host, (rows.inner, columns.inner))


def map_crops(
    function: Callable[[Images], Any],
    images: Images,
    *,
    tile: int,
    halo: int | None,
    multiple: int = 1,
) -> Any:
    """Apply a local function by crops, one at a time, in a single program.

    Intermediate values exist for one crop at a time, also in reverse mode, which
    computes each crop again.

    Args:
        function: local.
        images: a tree of arrays [H,W,...].
        tile: width of a tile in pixels.
        halo: pixels around a tile that its result depends on.
        multiple: crops start at multiples of it.

    Returns:
        the function's result for the whole images, to rounding.

    Raises:
        ValueError: if a number is not positive, or the halo negative or None.

    Example:
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
    # Tiles at the right and lower border may be shorter: cut as whole ones from a crop
    # with zeros behind it.
    offsets = jnp.array([(r.offset, c.offset) for r, c in all_crops])

    @jax.checkpoint
    def one(start: jax.Array, offset: jax.Array) -> Any:
        result = function(jax.tree.map(lambda i: _cut(i, start, size), images))
        padded = lambda image: jnp.pad(
            image, [(0, tile), (0, tile), *[(0, 0)] * (image.ndim - 2)]
        )
        return jax.tree.map(lambda i: _cut(padded(i), offset, (tile, tile)), result)

    tiles = lax.map(lambda at: one(*at), (starts, offsets))
    lines = -(-height // tile)
    return jax.tree.map(lambda t: _joined(t, lines)[:height, :width], tiles)


def _cut(image: jax.Array, start: jax.Array, size: tuple[int, int]) -> jax.Array:
    """Cut a rectangle out of an image."""
    rest = image.ndim - 2
    zeros = [jnp.zeros((), start.dtype)] * rest
    return lax.dynamic_slice(image, [*start, *zeros], [*size, *image.shape[2:]])


def _joined(tiles: jax.Array, lines: int) -> jax.Array:
    """Join tiles [N,t,t,...], row by row, to an image."""
    count, tile, _, *rest = tiles.shape
    blocks = tiles.reshape(lines, count // lines, tile, tile, *rest)
    return jnp.moveaxis(blocks, 2, 1).reshape(
        lines * tile, count // lines * tile, *rest
    )


def tile_within(
    function: Callable[[Images], Any],
    images: Images,
    *,
    halo: int | None,
    budget: int,
    multiple: int = 1,
) -> int:
    """Return the widest tile whose crop fits a memory budget.

    Memory is what the compiler reports: inputs, results and all intermediate values.

    Args:
        function: local.
        images: a tree of arrays [H,W,...], or of their shapes.
        halo: pixels around a tile that its result depends on.
        budget: bytes.
        multiple: crops start at multiples of it.

    Returns:
        width of a tile in pixels, a multiple of `multiple`; at most that of the image.

    Raises:
        ValueError: if not even a tile as wide as its halo fits, or the halo is None.
        RuntimeError: if the backend does not report memory.

    Example:
        >>> image = jax.ShapeDtypeStruct((500, 500, 3), jnp.float32)
        >>> double = lambda image: 2 * image  # in and out, 24 bytes a pixel
        >>> tile = tile_within(double, image, halo=4, budget=2**20)
        >>> print(tile, (tile + 2 * 4) ** 2 * 24 <= 2**20)
        193 True
    """
    halo = finite_halo(halo)
    minimum = max(halo, 16, multiple)
    bytes_of = lambda tile: _memory(function, images, tile, halo, multiple)
    tile = max(jax.tree.leaves(images)[0].shape[:2])
    while tile > minimum:
        needed = bytes_of(tile)
        if needed <= budget:
            break
        # Memory grows about with a crop's area: aim a tenth lower.
        crop = (tile + 2 * halo) * (0.9 * budget / needed) ** 0.5
        tile = max(minimum, min(tile - 1, int(crop) - 2 * halo) // multiple * multiple)
    if tile <= minimum and (needed := bytes_of(minimum)) > budget:
        raise ValueError(
            f"a tile of {minimum} pixels with {halo} around it takes "
            f"{needed / 2**20:.0f} MiB, the budget is {budget / 2**20:.0f} MiB"
        )
    return max(tile, minimum)


def _memory(
    function: Callable[[Images], Any], images: Images, tile: int, halo: int, m: int
) -> int:
    """Return the bytes that the function needs for one crop."""
    height, width = jax.tree.leaves(images)[0].shape[:2]
    size = length(height, tile, halo, m), length(width, tile, halo, m)
    like = lambda i: jax.ShapeDtypeStruct((*size, *i.shape[2:]), i.dtype)
    program = jax.jit(function).lower(jax.tree.map(like, images)).compile()
    used = program.memory_analysis()
    if used is None:
        raise RuntimeError("this backend does not report what memory a program needs")
    inputs, results = used.argument_size_in_bytes, used.output_size_in_bytes
    return used.temp_size_in_bytes + inputs + results
