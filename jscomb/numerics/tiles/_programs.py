"""Compiled programs of functions, each compiled once for its static options."""

import functools
from collections.abc import Callable, Hashable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array


def compiled(function: Callable[..., Any], **static: Hashable) -> Callable[..., Any]:
    """Return a function with its static options bound, compiled once a shape.

    Called eagerly, a function that loops over tiles compiles its loops at every call.

    Args:
        function: of arrays and options; the same object at every call.
        static: options that its program depends on, such as the width of a window.

    Returns:
        the function of its other arguments.

    Example:
        >>> import jax.numpy as jnp
        >>> from jscomb.numerics.windows import window_sum
        >>> print(compiled(window_sum, window=3)(jnp.ones((1, 3, 1)))[0, :, 0])
        [2. 3. 2.]
        >>> compiled(window_sum, window=3) is compiled(window_sum, window=3)
        True
    """
    return _compiled(function, *sorted(static.items()))


@functools.cache
def _compiled(function: Callable[..., Any], *static: tuple[str, Hashable]) -> Callable:
    """Compile; options in one order, so that equal ones share a program."""
    return jax.jit(functools.partial(function, **dict(static)))


def padded(tree: Any, *, multiple: int = 64) -> Any:
    """Return images with invalid pixels up to a multiple in height and width.

    Programs are compiled for one size: so those near each other share them. A function
    that leaves invalid pixels out of its windows makes of the rest what it made before.

    Args:
        tree: of arrays; images are those with three axes or more, [...,H,W,C], of any
            unit.
        multiple: of the height and of the width.

    Returns:
        the tree, its images with NaN below and to the right; to be `cut`.

    Example:
        >>> print(padded(jnp.ones((1, 3, 1)), multiple=2)[..., 0])
        [[ 1.  1.  1. nan]
         [nan nan nan nan]]
    """
    return compiled(_pad, multiple=multiple)(tree)


def _pad(tree: Any, *, multiple: int) -> Any:
    """`padded`, as one program."""

    def pad(image: Array) -> Array:
        if image.ndim < 3:
            return image
        below, right = (-size % multiple for size in image.shape[-3:-1])
        ends = [(0, 0)] * (image.ndim - 3) + [(0, below), (0, right), (0, 0)]
        return jnp.pad(image, ends, constant_values=jnp.nan)

    return jax.tree.map(pad, tree)


def cut(tree: Any, height: int, width: int) -> Any:
    """Return images without the pixels below and to the right of a size.

    Args:
        tree: as for `padded`.
        height: in pixels.
        width: in pixels.

    Returns:
        the tree, its images [...,height,width,C].

    Example:
        >>> print(cut(padded(jnp.ones((1, 3, 1))), 1, 3)[..., 0])
        [[1. 1. 1.]]
    """
    part = lambda i: i if i.ndim < 3 else i[..., :height, :width, :]
    return jax.tree.map(part, tree)


def by_device(*, cpu: int, accelerator: int) -> int:
    """Return how much to compute at a time, on the device that programs run on.

    What fits into a processor's cache leaves most cores of an accelerator idle, and
    each piece costs it a launch of every loop.

    Args:
        cpu: on processors.
        accelerator: on all other devices.

    Returns:
        one of both.

    Example:
        >>> by_device(cpu=1, accelerator=2)
        1
    """
    return cpu if jax.default_backend() == "cpu" else accelerator


def in_one_pass(function: Callable[..., Any], *arguments: Any) -> Any:
    """Return function(*arguments), computed from arrays in memory, in loops of its own.

    For CPUs, XLA fuses what makes an array into every loop that reads it, so that it is
    computed anew for each of N results. Elsewhere its own choice stands.

    Args:
        function: of the arguments; elementwise, or there is nothing to gain.
        arguments: trees of arrays.

    Returns:
        what the function returns.

    Example:
        >>> print(in_one_pass(lambda x: (x, 2 * x), jnp.ones(1))[1])
        [2.]
    """
    if jax.default_backend() != "cpu":
        return function(*arguments)
    like = jax.eval_shape(function, *arguments)
    never = lambda *_: jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), like)
    first = jax.tree.leaves(arguments)[0].ravel()
    # A branch that is always taken, which the compiler cannot know: nothing is fused
    # across it. It removes `lax.optimization_barrier` on CPUs.
    at_most_one = jnp.sum(first[:1] == 0)
    return lax.cond(at_most_one < 2, function, never, *arguments)


def in_memory(*arrays: Array) -> tuple[Array, ...]:
    """Return arrays as they are, computed once for all loops that read them.

    Pads and sums over windows read at their borders, which makes their loops slow for
    arithmetic.

    Args:
        arrays: of any shapes.

    Returns:
        the arrays.

    Example:
        >>> (x,) = in_memory(jnp.ones(1))
        >>> print(x)
        [1.]
    """
    return in_one_pass(lambda *same: same, *arrays)
