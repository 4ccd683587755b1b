"""Which weights of a quadratic function are positive, by principal pivots.

A problem is a table of what each weight, if it is free, or the derivative along it, if
it is fixed at zero, becomes where the others change: y_i = q_i + T_ij v_j. Exchanging
y_p and v_p costs N^2 operations, where to solve for all free weights anew costs N^3.
Rounding adds up in the table, so its weights are not used, and the set is to be tested.
"""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jscomb.numerics.simplex._active_set import Flat, Free, minimum_weight

_PIVOTS = 3  # for each base; a third of them are needed


def free_by_pivots(
    matrix: Float[Array, "n n m"],
    linear: Flat,
    tolerance: Flat,
    best: Free,
) -> Free:
    """Return which weights are free at the minimum of w'Kw / 2 + r.w, of sum one.

    Exchanges what most violates its bound, a weight or a derivative that is below zero,
    until nothing does or, in rare problems, the pivots are used up.

    Args:
        matrix: K, of which row and column of the best base are equal, [N,N,M].
        linear: r, zero for the best base, [N,M].
        tolerance: of a derivative, [N,M].
        best: the base that is free at first, [N,M].
    """
    n = len(best)
    both = best[:, None] & best[None]
    of_best = jnp.sum(jnp.where(both, matrix, 0.0), axis=(0, 1))
    # All weights but the best base's are fixed, and it is one less their sum.
    table = jnp.where(best[:, None], -1.0, matrix - of_best[None, None])
    table = jnp.where(both, 0.0, jnp.where(best[None], 1.0, table))
    value = jnp.where(best, 1.0, linear)
    # Closer than what decides later, so that rounding does not undo it.
    slack = tolerance / 4, jnp.full_like(tolerance, -minimum_weight(linear) / 4)

    def unfinished(state: tuple) -> Array:
        step, *_, active = state
        return (step < _PIVOTS * n) & jnp.any(active)

    def exchange(state: tuple) -> tuple:
        step, table, value, free, active = state
        excess = value + jnp.where(free, slack[1], slack[0])
        worst = jnp.arange(n)[:, None] == jnp.argmin(excess, axis=0, keepdims=True)
        active &= jnp.any(worst & (excess < 0), axis=0)
        chosen = worst & active[None]
        column = jnp.sum(jnp.where(chosen[None], table, 0.0), axis=1)
        pivot = jnp.sum(jnp.where(chosen, column, 0.0), axis=0)
        # Of opposite sign where one of both is free.
        like = free == jnp.any(chosen & free, axis=0)[None]
        row = jnp.where(like, column, -column)
        unit = chosen.astype(table.dtype)
        inverse = jnp.where(active, 1 / jnp.where(active, pivot, 1.0), 0.0)
        share = (column + unit) * inverse[None]
        moved = jnp.sum(jnp.where(chosen, value, 0.0), axis=0)
        return (
            step + 1,
            table - share[:, None] * (row - unit)[None],
            value - share * moved[None],
            free ^ chosen,
            active,
        )

    state = 0, table, value, best, jnp.ones(best.shape[1:], bool)
    _, _, _, free, _ = lax.while_loop(unfinished, exchange, state)
    return free
