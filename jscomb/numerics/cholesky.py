"""Many small symmetric systems at once, the batch last: loops run over the unknowns."""

from collections.abc import Callable

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

__all__ = ["solve"]


def solve(
    matrix: Float[Array, "f f m"],
    right: Float[Array, "f c m"],
    minimum: Float[Array, "f _"],
) -> Float[Array, "f c m"]:
    """Solve M systems of F unknowns, each with C right sides.

    Derivatives are solutions of the same systems; no factor is kept for them.

    Args:
        matrix: symmetric, positive definite up to rounding, shape [F,F,M].
        right: right sides, shape [F,C,M].
        minimum: > 0, a lower bound on the pivots of the exact matrix (for a
            semidefinite matrix plus a ridge, the ridge), shape [F,M] or [F,1].

    Returns:
        the solutions, shape [F,C,M]; finite even where rounding makes a pivot negative.

    Example:
        >>> matrix = jnp.array([[2.0, 1.0], [1.0, 2.0]])[..., None]
        >>> right = jnp.array([3.0, 3.0]).reshape(2, 1, 1)
        >>> print(solve(matrix, right, jnp.full((2, 1), 1e-6)).ravel().round(3))
        [1. 1.]
    """
    fixed = lax.stop_gradient((matrix, minimum))

    def product(x: Float[Array, "f c m"]) -> Float[Array, "f c m"]:
        return jnp.sum(matrix[:, :, None] * x[None], axis=1)

    def inverse(_: Callable[..., Array], right: Array) -> Float[Array, "f c m"]:
        return _eliminate(fixed[0], right, fixed[1])

    return lax.custom_linear_solve(product, right, inverse, symmetric=True)


def _eliminate(
    matrix: Float[Array, "f f m"],
    right: Float[Array, "f c m"],
    minimum: Float[Array, "f _"],
) -> Float[Array, "f c m"]:
    """The solutions, by factors of the matrix."""
    f = len(matrix)
    rest = jnp.concatenate([matrix, jnp.moveaxis(right, 1, 0)])
    columns, roots = [], []
    for k in range(f):
        root = lax.rsqrt(jnp.maximum(rest[0, 0], minimum[k]))
        column = rest[1:, 0] * root[None]
        columns.append(column)
        roots.append(root)
        rest = rest[1:, 1:] - column[:, None] * column[None, : f - k - 1]
    solution = jnp.zeros_like(right)
    for k in reversed(range(f)):
        below, reduced = jnp.split(columns[k], [f - k - 1])
        known = jnp.sum(below[:, None] * solution[k + 1 :], axis=0)
        solution = solution.at[k].set((reduced - known) * roots[k][None])
    return solution
