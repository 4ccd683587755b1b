"""A local function over an image whose rows lie on several devices.

Each device has as many rows as any other and gets the rows around them from its
neighbours: the halo, and at the image's ends as much again, since the crops there are
moved inwards (see `crops`) and lie on one side of the device's own rows only.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.sharding import Mesh, PartitionSpec

from jscomb.numerics.tiles.crops import Images, length

_AXIS = "rows"


def map_shards(
    function: Callable[[Images], Any],
    images: Images,
    *,
    halo: int,
    multiple: int = 1,
    devices: Sequence[Any] | None = None,
) -> Any:
    """Apply a local function with every device at work on its rows.

    Pure and differentiable, under `jit` too. Only neighbours speak to each other, once
    for each image, and no device holds more than its rows and those around them.

    Args:
        function: local, of the images' crops to images of their size.
        images: a tree of arrays [H,W,...].
        halo: pixels around a device's rows that its result depends on.
        multiple: crops start at multiples of it.
        devices: of one process or of several; None for all that there are.

    Returns:
        what the function makes of the whole images, to rounding, its rows split over
        the devices.

    Raises:
        ValueError: if there are so many devices that one has fewer rows than it has to
            tell its neighbours.

    Example:
        >>> from jscomb.numerics.windows import window_sum
        >>> sums, one = lambda image: window_sum(image, 3), jax.devices()[:1]
        >>> print(map_shards(sums, jnp.ones((2, 3, 1)), halo=1, devices=one)[..., 0])
        [[4. 6. 4.]
         [4. 6. 4.]]
    """
    mesh = Mesh(np.array(jax.devices() if devices is None else devices), (_AXIS,))
    count = mesh.size
    height = jax.tree.leaves(images)[0].shape[0]
    rows = -(-height // count)
    size = length(height, rows, halo, multiple)
    spare = count * rows - height  # below the image, so that rows are equally many
    reach = size - rows + spare
    if reach > rows and count > 1:
        raise ValueError(
            f"{height} rows on {count} devices are {rows} each, and {reach} around "
            "them: fewer devices have room"
        )

    def local(own: Images) -> Any:
        """Of one device's rows."""
        first = lax.axis_index(_AXIS) * rows
        start = jnp.clip(first - halo, 0, height - size) // multiple * multiple
        near = jax.tree.map(lambda i: _with_neighbours(i, reach, count), own)
        made = function(_rows(near, start - first + reach, size))
        end = lambda image: _below(image, spare)
        return _rows(jax.tree.map(end, made), first - start, rows)

    spread = PartitionSpec(_AXIS)
    # Unchecked: loops inside begin with constants, which are the same everywhere.
    mapped = jax.shard_map(
        local, mesh=mesh, in_specs=spread, out_specs=spread, check_vma=False
    )
    padded = jax.tree.map(lambda image: _below(image, spare), images)
    return jax.tree.map(lambda image: image[:height], mapped(padded))


def _with_neighbours(image: jax.Array, reach: int, devices: int) -> jax.Array:
    """A device's rows between the last of the one above and the first below."""
    ring = range(devices - 1)
    above = lax.ppermute(
        image[image.shape[0] - reach :], _AXIS, [(i, i + 1) for i in ring]
    )
    below = lax.ppermute(image[:reach], _AXIS, [(i + 1, i) for i in ring])
    return jnp.concatenate([above, image, below])


def _rows(images: Images, start: jax.Array, count: int) -> Images:
    """Some rows of all images."""
    cut = lambda image: lax.dynamic_slice_in_dim(image, start, count, axis=0)
    return jax.tree.map(cut, images)


def _below(image: jax.Array, count: int) -> jax.Array:
    """The image with zeros below it."""
    return jnp.pad(image, [(0, count), *[(0, 0)] * (image.ndim - 1)])
