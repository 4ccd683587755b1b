"""Convolution of an image, or of one twice as coarse, fast on a CPU, also backward.

XLA's own is fast there except for its derivative in the kernel: that needs few outputs
at once, and is slow in any loop. Of whole images we split the outputs; of strips of
rows, which come from a loop, it is a matrix product of patches.
"""

import functools

import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Float

from jscomb.numerics.tiles import map_rows

__all__ = ["convolve", "convolve_doubled", "doubled"]

_PATCH_ROWS = 8  # rows of patches in memory at once
_OUTPUTS = 64  # of a kernel that XLA differentiates at once


def convolve(
    image: Float[Array, "_ w i"], kernel: Float[Array, "k k i o"], *, rows: int
) -> Float[Array, "_ w o"]:
    """Correlate an image, zero outside, with a kernel.

    Args:
        image: shape [H,W,in].
        kernel: shape [k,k,in,out], k odd.
        rows: rows of zeros above and below the image: k // 2 for a result of H rows, 0
            for only those rows that have all their neighbours.

    Returns:
        shape [H + 2 rows - (k - 1),W,out].

    Raises:
        ValueError: while tracing, if `rows` is larger than the kernel's reach.

    Example:
        >>> import jax.numpy as jnp
        >>> ones = jnp.ones((3, 3, 1, 1))
        >>> print(convolve(ones[..., 0], ones, rows=1)[0, :, 0])
        [4. 6. 4.]
    """
    reach = kernel.shape[0] // 2
    if rows > reach:
        raise ValueError(f"a kernel that reaches {reach} rows got {rows} of zeros")
    return _convolve(image, kernel, rows)


def convolve_doubled(
    image: Float[Array, "h w i"], kernel: Float[Array, "3 3 i o"]
) -> Float[Array, "_ _ o"]:
    """Correlate an image, each of its pixels repeated as 2x2, with a kernel of 3x3.

    Each pixel of a block sees only 2x2 pixels of the image: with the kernel's weights
    summed accordingly, four ninths of the work of `convolve` of the repeated image.

    Args:
        image: shape [H,W,in]; zero outside.
        kernel: shape [3,3,in,out].

    Returns:
        shape [2H,2W,out].

    Example:
        >>> import jax.numpy as jnp
        >>> ones = jnp.ones((3, 3, 1, 1))
        >>> print(convolve_doubled(ones[:1, :2, :, 0], ones)[0, :, 0])
        [4. 6. 6. 4.]
    """
    return _convolve_doubled(image, kernel)


def doubled(image: Float[Array, "h w c"]) -> Float[Array, "_ _ c"]:
    """Repeat each pixel as a block of 2x2.

    Args:
        image: shape [H,W,C].

    Returns:
        shape [2H,2W,C].

    Example:
        >>> import jax.numpy as jnp
        >>> print(doubled(jnp.ones((3, 4, 2))).shape)
        (6, 8, 2)
    """
    h, w, c = image.shape
    blocks = jnp.broadcast_to(image[:, None, :, None], (h, 2, w, 2, c))
    return blocks.reshape(2 * h, 2 * w, c)


def _by_xla(image: Array, kernel: Array, rows: int) -> Array:
    """Convolve by XLA."""
    reach = kernel.shape[0] // 2
    return _padded_by_xla(image, kernel, ((rows, rows), (reach, reach)))


def _padded_by_xla(
    image: Array, kernel: Array, padding: tuple[tuple[int, int], tuple[int, int]]
) -> Array:
    """Convolve by XLA, with zeros before and after the rows and columns."""
    return lax.conv_general_dilated(
        image[None],
        kernel,
        window_strides=(1, 1),
        padding=padding,
        dimension_numbers=("NHWC", "HWIO", "NHWC"),
    )[0]


_convolve = jax.custom_jvp(_by_xla, nondiff_argnums=(2,))


@functools.partial(_convolve.defjvp, symbolic_zeros=True)
def _convolve_jvp(rows: int, primals, tangents) -> tuple[Array, Array]:
    """Differentiate; the term in the kernel has a fast transpose."""
    (image, kernel), (image_dot, kernel_dot) = primals, tangents
    result = _convolve(image, kernel, rows)
    terms = []
    if not isinstance(image_dot, SymbolicZero):
        terms.append(_by_xla(image_dot, kernel, rows))
    if not isinstance(kernel_dot, SymbolicZero):
        terms.append(_in_kernel(image, kernel_dot, rows))
    return result, sum(terms, start=jnp.zeros_like(result))


@jax.custom_jvp
def _convolve_doubled(image: Array, kernel: Array) -> Array:
    """Convolve the four pixels of all blocks apart, and interleave them."""

    def summed(kernel: Array, second: int, axis: int) -> Array:
        """The kernel's weights for the block's first or second pixel along an axis."""
        before, at, after = jnp.split(kernel, 3, axis)
        pair = (before + at, after) if second else (before, at + after)
        return jnp.concatenate(pair, axis)

    def pixels(row: int, column: int) -> Array:
        """That pixel of every block, [H,W,out]."""
        near = (1 - row, row), (1 - column, column)
        return _padded_by_xla(image, summed(summed(kernel, row, 0), column, 1), near)

    rows = [jnp.stack([pixels(row, 0), pixels(row, 1)], axis=2) for row in (0, 1)]
    h, w, _, outputs = rows[0].shape
    return jnp.stack(rows, axis=1).reshape(2 * h, 2 * w, outputs)


@functools.partial(_convolve_doubled.defjvp, symbolic_zeros=True)
def _convolve_doubled_jvp(primals, tangents) -> tuple[Array, Array]:
    """Differentiate, the term in the kernel as that of `convolve`."""
    (image, kernel), (image_dot, kernel_dot) = primals, tangents
    result = _convolve_doubled(image, kernel)
    terms = []
    if not isinstance(image_dot, SymbolicZero):
        terms.append(_convolve_doubled(image_dot, kernel))
    if not isinstance(kernel_dot, SymbolicZero):
        terms.append(_in_kernel(doubled(image), kernel_dot, 1))
    return result, sum(terms, start=jnp.zeros_like(result))


def _in_kernel(image: Array, kernel_dot: Array, rows: int) -> Array:
    """The derivative's term in the kernel, in the form of the fastest transpose."""
    if jax.default_backend() != "cpu":
        return _by_xla(image, kernel_dot, rows)
    whole = 0 < rows == kernel_dot.shape[0] // 2
    return (_by_groups if whole else _by_patches)(image, kernel_dot, rows)


def _by_groups(image: Array, kernel: Array, rows: int) -> Array:
    """Convolve by XLA, some outputs at a time."""
    ends = list(range(_OUTPUTS, kernel.shape[-1], _OUTPUTS))
    groups = [_by_xla(image, k, rows) for k in jnp.split(kernel, ends, axis=-1)]
    return jnp.concatenate(groups, axis=-1)


def _by_patches(image: Array, kernel: Array, rows: int) -> Array:
    """Convolve by a product of patches and the kernel, a strip of rows at a time."""
    size, _, inputs, outputs = kernel.shape
    reach, (height, width, _) = size // 2, image.shape
    matrix = kernel.reshape(size * size * inputs, outputs)

    def strip(near: Array) -> Array:
        near = jnp.pad(near, ((0, 0), (reach, reach), (0, 0)))
        taps = [(i, j) for i in range(size) for j in range(size)]
        n = near.shape[0] - 2 * reach
        patches = [near[i : i + n, j : j + width] for i, j in taps]
        return jnp.concatenate(patches, axis=-1) @ matrix

    result = map_rows(strip, [(image, reach)], rows=_PATCH_ROWS)
    return result[reach - rows : height - (reach - rows)]
