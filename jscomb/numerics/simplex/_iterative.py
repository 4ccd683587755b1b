"""The paper's solver: blend in one base after the other, in closed form."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jscomb.numerics.simplex._active_set import Flat
from jscomb.numerics.simplex._plane import Points, Targets, Weights, plane, share_within
from jscomb.numerics.simplex._quadratic import Matrix, objective_of, share_along
from jscomb.typing import Key


def iterative(
    key: Key,
    points_a: Points,
    points_b: Points,
    target_a: Targets,
    target_b: Targets,
    *,
    steps: int = 1024,
    tolerance: float = 1e-6,
    patience: int = 3,
) -> Weights:
    """Solve the least squares of `hull` by blending in one base at a time.

    Starts at random weights; each cycle takes every base once, in a random order that
    all problems share. Where the optimum mixes three or more bases, even thousands of
    steps are not exact. Not differentiable.

    Args:
        key: a typed key, for the start and the orders.
        points_a: of each base, from half a, any unit, shape [N,...].
        points_b: from half b, same shape.
        target_a: from half a, same unit, shape [...].
        target_b: from half b, same shape.
        steps: maximum number of blends.
        tolerance: largest change of a weight in a cycle without progress.
        patience: cycles in a row without progress after which to stop.

    Returns:
        the weights, shape [N,...].

    Raises:
        ValueError: while tracing, if there is no base or shapes differ.

    Example:
        >>> points, target = jnp.array([0.0, 4.0]), jnp.array(1.0)
        >>> w = iterative(jax.random.key(0), points, points, target, target)
        >>> print([f"{share:.3f}" for share in w])
        ['0.750', '0.250']

    Source: ED section 4.1.2; relative where the authors' program compares with 1e-6.
    """
    u, c = plane(points_a, points_b, target_a, target_b)

    def share(w: Flat, base: Array) -> Float[Array, " m"]:
        now = jnp.sum(w[:, None] * u, axis=0)
        d = u[base] - now
        along = -jnp.sum((now + c) * d, axis=0)
        return share_within(along, jnp.sum(d * d, axis=0), 0.5)

    w = _cycles(key, share, (len(u), u.shape[2]), u.dtype, steps, tolerance, patience)
    return w.reshape(points_a.shape)


def iterative_quadratic(
    key: Key,
    matrix: Matrix,
    *,
    steps: int = 1024,
    tolerance: float = 1e-6,
    patience: int = 3,
) -> Weights:
    """Minimise w'Mw of `quadratic` by blending in one base at a time.

    Args:
        key: a typed key, for the start and the orders.
        matrix: M, any unit, shape [N,N,...].
        steps: maximum number of blends.
        tolerance: largest change of a weight in a cycle without progress.
        patience: cycles in a row without progress after which to stop.

    Returns:
        the weights, shape [N,...].

    Raises:
        ValueError: while tracing, if the matrix is not square or N is 0.

    Example:
        >>> matrix = jnp.array([[1.0, 0.0], [0.0, 3.0]])
        >>> w = iterative_quadratic(jax.random.key(0), matrix)
        >>> print([f"{share:.3f}" for share in w])
        ['0.750', '0.250']

    Source: ED section 4.1.2, for any matrix.
    """
    objective = objective_of(matrix)
    share = lambda w, base: share_along(objective, w, base)
    shape, dtype = objective.linear.shape, matrix.dtype
    w = _cycles(key, share, shape, dtype, steps, tolerance, patience)
    return w.reshape(matrix.shape[1:])


def _cycles(
    key: Key,
    share: Callable[[Flat, Array], Float[Array, " m"]],
    shape: tuple[int, ...],
    dtype: jnp.dtype,
    steps: int,
    tolerance: float,
    patience: int,
) -> Flat:
    """Blend until nothing moves; `share` returns the share of one base that is best."""
    n, _ = shape
    of_start, of_orders = jax.random.split(key)
    w = jax.random.uniform(of_start, shape, dtype)
    w = w / jnp.sum(w, axis=0, keepdims=True)

    def unfinished(state: tuple) -> Array:
        cycle, quiet, _ = state
        return (cycle * n < steps) & (quiet < patience)

    def advance(state: tuple) -> tuple:
        cycle, quiet, w = state
        order = jax.random.permutation(jax.random.fold_in(of_orders, cycle), n)

        def blend(w: Flat, base: Array) -> tuple[Flat, None]:
            s = share(w, base)[None]
            chosen = (jnp.arange(n) == base).astype(dtype)[:, None]
            return (1 - s) * w + s * chosen, None

        after, _ = lax.scan(blend, w, order)
        still = jnp.max(jnp.abs(after - w)) <= tolerance
        return cycle + 1, jnp.where(still, quiet + 1, 0), after

    _, _, w = lax.while_loop(unfinished, advance, (0, 0, w))
    return w
