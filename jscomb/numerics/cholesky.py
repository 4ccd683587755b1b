"""Many small symmetric systems at once, the batch last: loops run over the unknowns."""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float


def solve(
    matrix: Float[Array, "f f m"],
    right: Float[Array, "f c m"],
    least: Float[Array, "f _"],
) -> Float[Array, "f c m"]:
    """Solve M systems of F unknowns; matrices and right sides are reduced together.

    Args:
        matrix: symmetric, positive definite but for rounding, shape [F,F,M].
        right: C right sides each, shape [F,C,M].
        least: > 0, what no pivot of the exact matrices is below (for a semidefinite
            matrix plus a ridge, the ridge), shape [F,M] or [F,1].

    Returns:
        the solutions, shape [F,C,M]; finite, also where rounding makes a pivot
        negative.

    Example:
        >>> matrix = jnp.array([[2.0, 1.0], [1.0, 2.0]])[..., None]
        >>> right = jnp.array([3.0, 3.0]).reshape(2, 1, 1)
        >>> print(solve(matrix, right, jnp.full((2, 1), 1e-6)).ravel().round(3))
        [1. 1.]
    """
    f = len(matrix)
    rest = jnp.concatenate([matrix, jnp.moveaxis(right, 1, 0)])
    columns, roots = [], []
    for k in range(f):
        root = lax.rsqrt(jnp.maximum(rest[0, 0], least[k]))
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
