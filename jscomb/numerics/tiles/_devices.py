"""A local function over an image whose rows lie on several devices.

All devices have equally many rows and get the rows around them from their neighbours:
the halo, and at the image's ends twice the halo, since the crops there are moved
inwards (see `_crops`) and lie on one side of the device's rows only.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.sharding import Mesh, PartitionSpec

from jscomb.numerics.tiles._crops import Images, finite_halo, length

_AXIS = "rows"


def map_shards(
    function: Callable[[Images], Any],
    images: Images,
    *,
    halo: int | None,
    multiple: int = 1,
    devices: Sequence[Any] | None = None,
) -> Any:
    """Apply a local function on several devices, each to its rows.

    Only neighbours communicate, once for each image, and no device holds more than its
    rows and those around them.

    Args:
        function: local, from crops of the images to images of their size.
        images: a tree of arrays [H,W,...].
        halo: rows around a device's rows that its result depends on.
        multiple: crops start at multiples of it.
        devices: of one process or of several; None for all.

    Returns:
        the function's result for the whole images, to rounding, its rows split over the
        devices.

    Raises:
        ValueError: if a device has fewer rows than its neighbours need, or the halo is
            None.

    Example:
        >>> from jscomb.numerics.windows import window_sum
        >>> sums, one = lambda image: window_sum(image, 3), jax.devices()[:1]
        >>> print(map_shards(sums, jnp.ones((2, 3, 1)), halo=1, devices=one)[..., 0])
        [[4. 6. 4.]
         [4. 6. 4.]]
    """
    halo = finite_halo(halo)
    mesh = Mesh(np.array(jax.devices() if devices is None else devices), (_AXIS,))
    count = mesh.size
    height = jax.tree.leaves(images)[0].shape[0]
    rows = -(-height // count)
    size = length(height, rows, halo, multiple)
    spare = count * rows - height  # zeros below, so that all devices have equal rows
    reach = size - rows + spare
    if reach > rows and count > 1:
        raise ValueError(
            f"{height} rows on {count} devices are {rows} each, and {reach} around "
            "them: fewer devices have room"
        )

    def local(shard: Images) -> Any:
        """Compute one device's rows."""
        first = lax.axis_index(_AXIS) * rows
        start = jnp.clip(first - halo, 0, height - size) // multiple * multiple
        near = jax.tree.map(lambda i: _with_neighbours(i, reach, count), shard)
        result = function(_rows(near, start - first + reach, size))
        return _rows(_pad_below(result, spare), first - start, rows)

    by_rows = PartitionSpec(_AXIS)
    # Unchecked: loops inside start from constants, which are the same everywhere.
    mapped = jax.shard_map(
        local, mesh=mesh, in_specs=by_rows, out_specs=by_rows, check_vma=False
    )
    return jax.tree.map(lambda i: i[:height], mapped(_pad_below(images, spare)))


def _with_neighbours(image: jax.Array, reach: int, devices: int) -> jax.Array:
    """Add the last rows of the device above and the first of the one below."""
    ring = range(devices - 1)
    above = lax.ppermute(
        image[image.shape[0] - reach :], _AXIS, [(i, i + 1) for i in ring]
    )
    below = lax.ppermute(image[:reach], _AXIS, [(i + 1, i) for i in ring])
    return jnp.concatenate([above, image, below])


def _rows(images: Images, start: jax.Array, count: int) -> Images:
    """Cut rows out of all images."""
    cut = lambda image: lax.dynamic_slice_in_dim(image, start, count, axis=0)
    return jax.tree.map(cut, images)


def _pad_below(images: Images, count: int) -> Images:
    """Add rows of zeros below all images."""
    pad = lambda image: jnp.pad(image, [(0, count), *[(0, 0)] * (image.ndim - 1)])
    return jax.tree.map(pad, images)
