"""The exact solver for any error matrix: averaged over windows, channels, seeds."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jscomb.numerics import cholesky
from jscomb.numerics.guards import divide
from jscomb.numerics.simplex._active_set import (
    Flat,
    Free,
    in_chunks,
    minimum_weight,
    search,
    shared_by_equals,
    sums_to_one,
)
from jscomb.numerics.simplex._pivots import free_by_pivots
from jscomb.numerics.simplex._plane import share_within

_LARGEST = 1e3  # affine weight: beyond, more is lost to rounding than gained

Matrix = Float[Array, "n n *batch"]
Weights = Float[Array, "n *batch"]


class Objective(NamedTuple):
    """w'Kw / 2 + r.w: w'Mw up to a constant, on weights that sum to one.

    Attributes:
        matrix: K, positive definite, [N,N,M].
        linear: r, [N,M].
        minimum_pivot: lower bound of the pivots of K, [N,M].
        tolerance: of a derivative, [N,M].
    """

    matrix: Float[Array, "n n m"]
    linear: Flat
    minimum_pivot: Flat
    tolerance: Flat


def quadratic(matrix: Matrix) -> Weights:
    """Minimise w'Mw exactly over weights that are at least zero and sum to one.

    Never worse than the best single base, where the search begins. Bases with equal
    rows of M get the same weight.

    Args:
        matrix: M, any unit, shape [N,N,...]; semidefinite on differences of weights,
            as estimates from halves are. Where rounding destroys that, the weights are
            feasible, and may be those of the best base alone.

    Returns:
        the weights, shape [N,...].

    Raises:
        ValueError: while tracing, if the matrix is not square or N is 0.

    Example:
        >>> import jax.numpy as jnp
        >>> w = quadratic(jnp.array([[1.0, 0.0], [0.0, 3.0]]))
        >>> print([f"{share:.3f}" for share in w])
        ['0.750', '0.250']

    Source: ours, for ED eq. 13.
    """
    _check(matrix)
    n, *batch = matrix.shape[1:]
    return in_chunks(_solve, matrix.reshape(n, n, -1)).reshape(n, *batch)


def _solve(matrix: Float[Array, "n n m"]) -> Flat:
    """Solve M problems."""
    matrix = _known(matrix)
    objective = _objective(matrix)
    found, free = _found(Objective(*lax.stop_gradient(tuple(objective))), _best(matrix))
    w, _ = _minimum(objective, free)
    feasible = jnp.all(w >= minimum_weight(w), axis=0)
    w = jnp.where(feasible[None], jnp.maximum(w, 0.0), found)
    w = _shared_by_equals(w, matrix)
    return w / jnp.sum(w, axis=0, keepdims=True)


def _found(objective: Objective, start: Free) -> tuple[Flat, Free]:
    """The weights, and which are free: by pivots, or where these fail by a search."""

    def minimise(free: Free) -> tuple[Flat, Flat]:
        w, level = _minimum(objective, free)
        slope = jnp.sum(objective.matrix * w[None], axis=1) + objective.linear
        return w, slope - level[None] + objective.tolerance

    def searched(w: Flat, free: Free, solved: Array) -> tuple[Flat, Free]:
        w = jnp.where(solved[None], w, start.astype(w.dtype))
        free = jnp.where(solved[None], free, start)
        w, free = search(minimise, w, free, ~solved)
        kept = sums_to_one(minimise(free)[0])
        return w, jnp.where(kept[None], free, start)

    free = free_by_pivots(
        objective.matrix, objective.linear, objective.tolerance, start
    )
    w, slope = minimise(free)
    least = jnp.where(free, w - minimum_weight(w), slope)
    solved = jnp.all(least >= 0, axis=0) & sums_to_one(w)
    at_once = lambda w, free, _: (w, free)
    return lax.cond(jnp.all(solved), at_once, searched, w, free, solved)


def affine(matrix: Matrix) -> Weights:
    """Minimise w'Mw over weights of either sign that sum to one.

    Bases that hardly differ, and more of them than a matrix has ranks, reach a small
    minimum by huge weights of either sign. Weights beyond 1000 are moved towards the
    best base alone, which also stands where rounding destroys the minimum; so no result
    has a larger w'Mw than the best base, but for rounding.

    Args:
        matrix: M, any unit, shape [N,N,...].

    Returns:
        the weights, of sum one and at most about 1000 in size, shape [N,...].

    Raises:
        ValueError: while tracing, if the matrix is not square or N is 0.

    Example:
        >>> import jax.numpy as jnp
        >>> w = affine(jnp.array([[1.0, 1.5], [1.5, 3.0]]))
        >>> print([f"{share:.3f}" for share in w])
        ['1.500', '-0.500']

    Source: ED eq. 19; a ridge instead of the pseudo-inverse, which takes the wrong
    limit where a combination without error exists.
    """
    _check(matrix)
    n, *batch = matrix.shape[1:]
    return in_chunks(_solve_affine, matrix.reshape(n, n, -1)).reshape(n, *batch)


def _solve_affine(matrix: Float[Array, "n n m"]) -> Flat:
    """Solve M problems without bounds."""
    matrix = _known(matrix)
    objective = _objective(matrix)
    fixed = Objective(*lax.stop_gradient(tuple(objective)))
    start = _best(matrix)
    w, _ = _minimum(fixed, jnp.ones_like(start))
    curved = jnp.sum(fixed.matrix * w[None], axis=1)
    value = jnp.sum(w * (curved / 2 + fixed.linear), axis=0)
    of_best = jnp.sum(jnp.where(start, _diagonal(fixed.matrix), 0.0), axis=0) / 2
    solved = sums_to_one(w) & (value <= of_best)
    w, _ = _minimum(objective, start | solved[None])
    w = w + jnp.where(start, 1 - jnp.sum(w, axis=0, keepdims=True), 0.0)
    size = lax.stop_gradient(jnp.max(jnp.abs(w), axis=0))
    share = divide(
        jnp.full_like(size, _LARGEST), size, where=size > _LARGEST, otherwise=1.0
    )
    alone = start.astype(w.dtype)
    w = alone + share[None] * (w - alone)
    return _shared_by_equals(w, matrix)


def _shared_by_equals(w: Flat, matrix: Float[Array, "n n m"]) -> Flat:
    """The weights averaged over bases of equal rows."""
    equal = jnp.all(matrix[:, None] == matrix[None], axis=2)
    return shared_by_equals(jnp.unstack(w), [jnp.unstack(row) for row in equal])


def _check(matrix: Matrix) -> None:
    """Raise unless the matrix is square."""
    if len(matrix) == 0 or matrix.shape[1] != len(matrix):
        raise ValueError(f"matrix must be [N,N,...] with N > 0, got {matrix.shape}")


def _diagonal(matrix: Matrix) -> Weights:
    """The diagonal of the first two axes, [N,...]."""
    return jnp.stack([matrix[i, i] for i in range(len(matrix))])


def _best(matrix: Float[Array, "n n m"]) -> Free:
    """Whether a base is the one of minimum error, the first of equals."""
    best = jnp.argmin(_diagonal(matrix), axis=0, keepdims=True)
    return jnp.arange(len(matrix))[:, None] == best


def objective_of(matrix: Matrix) -> Objective:
    """Return the objectives of matrices [N,N,...]; without unit."""
    _check(matrix)
    n = len(matrix)
    return _objective(_known(matrix.reshape(n, n, -1)))


def _objective(m: Float[Array, "n n m"]) -> Objective:
    """Errors relative to the best base b: K_ij = M_ij - M_ib - M_bj + M_bb.

    So differences of two good bases survive rounding, however large the error that all
    bases share and that of a bad base. The row and column of b are 0; a number added to
    all of K makes it definite.
    """
    n, diagonal, best = len(m), _diagonal(m), _best(m)
    column = jnp.sum(jnp.where(best[None], m, 0.0), axis=1)  # M_ib
    lowest = jnp.sum(jnp.where(best, diagonal, 0.0), axis=0)  # M_bb
    linear = column - lowest[None]
    k = m - column[:, None] - column[None] + lowest[None, None]
    own = jnp.maximum(lax.stop_gradient(_diagonal(k)), 0.0)
    mean = jnp.mean(own, axis=0)
    size = jnp.where(mean > 0, mean, 1.0)
    rounding = 16 * float(jnp.finfo(m.dtype).eps)
    parts = jnp.abs(diagonal) + 2 * jnp.abs(column) + jnp.abs(lowest)[None]
    lost = rounding * lax.stop_gradient(parts) / size[None]
    k, linear, own = k / size[None, None], linear / size[None], own / size[None]
    others = jnp.min(jnp.where(own > lost, own, 1.0), axis=0)
    ridge = lost + rounding * (own + others[None])
    eye = jnp.eye(n, dtype=bool)[..., None]
    k = k + others[None, None] + jnp.where(eye, ridge[:, None], 0.0)
    return Objective(k, linear, ridge, 4 * ridge)


def _known(matrix: Float[Array, "n n m"]) -> Float[Array, "n n m"]:
    """The matrices, 0 (equal bases) in problems with a number that is not finite."""
    known = jnp.all(jnp.isfinite(matrix), axis=(0, 1), keepdims=True)
    return jnp.where(known, matrix, 0.0)


def _minimum(objective: Objective, free: Free) -> tuple[Flat, Float[Array, " m"]]:
    """The free weights of minimum objective, and its derivative along their sum."""
    n, both = len(free), free[:, None] & free[None]
    eye = jnp.eye(n, dtype=bool)[..., None]
    k = jnp.where(both, objective.matrix, jnp.where(eye, 1.0, 0.0))
    ones = jnp.where(free, 1.0, 0.0).astype(k.dtype)
    linear = jnp.where(free, objective.linear, 0.0)
    right = jnp.stack([ones, linear], axis=1)
    per_level, shift = jnp.moveaxis(
        cholesky.solve(k, right, objective.minimum_pivot), 1, 0
    )
    level = (1 + jnp.sum(shift, axis=0)) / jnp.sum(per_level, axis=0)
    return level[None] * per_level - shift, level


def share_along(objective: Objective, w: Flat, base: Array) -> Float[Array, " m"]:
    """Return the share of one base in its best blend with an ensemble (ED eq. 29)."""
    chosen = (jnp.arange(len(w)) == base).astype(w.dtype)[:, None]
    d = chosen - w
    curved = jnp.sum(objective.matrix * d[None], axis=1)
    square = jnp.sum(d * curved, axis=0)
    slope = jnp.sum(objective.matrix * w[None], axis=1) + objective.linear
    along = -jnp.sum(d * slope, axis=0)
    return share_within(along, square, 0.0)
