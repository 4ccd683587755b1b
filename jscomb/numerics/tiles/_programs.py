"""Compiled programs of functions, each compiled once for its static options."""

import functools
from collections.abc import Callable, Hashable
from typing import Any

import jax


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
