"""The general solver that the others are tested against: jaxopt's OSQP, float64."""

import warnings

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jscomb.numerics.simplex._plane import Points, Targets, Weights, plane
from jscomb.numerics.simplex._quadratic import Matrix, objective_of


def reference(
    points_a: Points, points_b: Points, target_a: Targets, target_b: Targets
) -> Weights:
    """Solve the least squares of `hull` by a general solver. Slow.

    Where the minimum is not unique the weights are any of the best.

    Args:
        points_a: of each base, from half a, any unit, float64, shape [N,...].
        points_b: from half b, same shape.
        target_a: from half a, same unit, shape [...].
        target_b: from half b, same shape.

    Returns:
        the weights, shape [N,...].

    Raises:
        ValueError: while tracing, if there is no base, shapes differ or the numbers are
            not float64.

    Example:
        >>> with jax.enable_x64(True):
        ...     points, target = jnp.array([0.0, 4.0]), jnp.array(1.0)
        ...     print(reference(points, points, target, target).round(3))
        [0.75 0.25]
    """
    u, c = plane(points_a, points_b, target_a, target_b)
    matrix = jnp.sum(u[:, None] * u[None], axis=2)
    linear = jnp.sum(u * c[None], axis=1)
    return _solve(matrix, linear).reshape(points_a.shape)


def reference_quadratic(matrix: Matrix) -> Weights:
    """Minimise w'Mw of `quadratic` by a general solver.

    Args:
        matrix: M, any unit, float64, shape [N,N,...].

    Returns:
        the weights, shape [N,...].

    Raises:
        ValueError: while tracing, if the matrix is not square, N is 0 or the numbers
            are not float64.

    Example:
        >>> with jax.enable_x64(True):
        ...     matrix = jnp.array([[1.0, 0.0], [0.0, 3.0]])
        ...     print(reference_quadratic(matrix).round(3))
        [0.75 0.25]
    """
    objective = objective_of(matrix)
    return _solve(objective.matrix, objective.linear).reshape(matrix.shape[1:])


def _solve(matrix: Float[Array, "n n m"], linear: Float[Array, "n m"]) -> Array:
    """Minimise w'Kw / 2 + r.w on the simplex, for each problem."""
    with warnings.catch_warnings():  # on import, that it is no longer developed
        warnings.simplefilter("ignore", DeprecationWarning)
        from jaxopt import OSQP  # slow to import, and only tests need it

    n = len(linear)
    if linear.dtype != jnp.float64:
        raise ValueError(
            f"the reference needs float64, got {linear.dtype}: enable jax_enable_x64"
        )
    # Its conjugate gradients diverge on nearly singular problems.
    solver = OSQP(tol=1e-9, eq_qp_solve="lu")
    ones, bound = jnp.ones((1, n)), (-jnp.eye(n), jnp.zeros(n))

    def one(matrix: Array, linear: Array) -> Array:
        solution = solver.run(
            params_obj=(matrix, linear),
            params_eq=(ones, jnp.ones(1)),
            params_ineq=bound,
        )
        return solution.params.primal

    last = lambda array: jnp.moveaxis(array, -1, 0)
    return jnp.moveaxis(jax.vmap(one)(last(matrix), last(linear)), 0, -1)
