"""Linear functions whose derivatives XLA makes slow, with derivatives of their own."""

import functools
import operator
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jscomb.typing import Image

__all__ = ["channel_mean", "channel_sum", "stack_sum", "with_transpose"]

Values = Float[Array, "..."]


def with_transpose(
    function: Callable[[Values], Values],
    transpose: Callable[[Values], Values],
    image: Values,
) -> Values:
    """Return function(image), linear in the image, with a known reverse derivative.

    The one that JAX derives of sums over windows pads every term of the sum, and takes
    up to five times as long as the sum.

    Args:
        function: linear, from one array to another of its shape; may depend on no other
            array that has a derivative.
        transpose: of the function, from its result's shape to that of the image; may be
            the function itself.
        image: any unit and shape.

    Returns:
        what the function returns; with derivatives of either mode and any order.

    Example:
        >>> import jax
        >>> before = lambda x: jnp.pad(x, (1, 0))[:-1]
        >>> after = lambda x: jnp.pad(x, (0, 1))[1:]
        >>> moved = lambda x: with_transpose(before, after, x)
        >>> x = jnp.array([1.0, 2.0, 4.0])
        >>> print(moved(x), jax.grad(lambda y: jnp.sum(x * moved(y)))(x))
        [0. 1. 2.] [2. 4. 0.]
    """
    # The only primitive with a transpose of one's own under `vmap`. What it is told to
    # solve, the identity, is not looked at.
    same = lambda image: image
    forward, backward = (lambda _, b, f=f: f(b) for f in (function, transpose))
    if transpose is function:  # traced once
        return lax.custom_linear_solve(same, image, forward, symmetric=True)
    return lax.custom_linear_solve(same, image, forward, backward)


def channel_sum(image: Float[Array, "*n c"]) -> Float[Array, "*n 1"]:
    """Sum over the channels of each pixel.

    On a CPU several times as fast as `jnp.sum`: a reduction has a loop of its own, a
    sum of slices is part of the loop that reads it.

    Args:
        image: any unit, shape [...,C].

    Returns:
        the sums, shape [...,1].

    Example:
        >>> print(channel_sum(jnp.array([[1.0, 2.0, 3.0]])))
        [[6.]]
    """
    return _sum(image, -1)


def stack_sum(stack: Float[Array, "n h w c"]) -> Image:
    """Sum a stack of images, as `channel_sum` sums channels.

    Args:
        stack: any unit, shape [N,H,W,C].

    Returns:
        the sum, shape [H,W,C].

    Example:
        >>> print(stack_sum(jnp.arange(4.0).reshape(2, 1, 2, 1))[0, :, 0])
        [2. 4.]
    """
    return _sum(stack, 0)[0]


@functools.partial(jax.custom_jvp, nondiff_argnums=(1,))
def _sum(array: Array, axis: int) -> Array:
    """Sum over slices, of one element along the axis each."""
    return functools.reduce(operator.add, jnp.split(array, array.shape[axis], axis))


@_sum.defjvp
def _sum_jvp(
    axis: int, primals: tuple[Array], tangents: tuple[Array]
) -> tuple[Array, Array]:
    """Its transpose repeats an element, that of slices pads them."""
    return _sum(*primals, axis), jnp.sum(*tangents, axis=axis, keepdims=True)


def channel_mean(image: Float[Array, "*n c"]) -> Float[Array, "*n 1"]:
    """Average over the channels of each pixel.

    Args:
        image: any unit, shape [...,C].

    Returns:
        the means, shape [...,1].

    Example:
        >>> print(channel_mean(jnp.array([[1.0, 2.0, 3.0]])))
        [[2.]]
    """
    return channel_sum(image) / image.shape[-1]
