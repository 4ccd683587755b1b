"""The search that both exact solvers share: which of N weights are positive.

From feasible weights towards the minimum over the free ones, until one of them becomes
zero and is fixed there; at the minimum the fixed weight with the steepest descent is
freed. The function never rises, so no set is visited twice and the search ends, at the
latest where rounding fixes a weight that was just freed.
"""

import functools
import operator
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jscomb.numerics.guards import divide
from jscomb.numerics.tiles import by_device

Flat = Float[Array, "n m"]  # weights of M problems
Free = Bool[Array, "n m"]

_STEPS = 16  # for each base; needed only where rounding decides


def _at_once() -> int:
    """Problems at a time: those that fit into a cache."""
    return by_device(cpu=4096, accelerator=2**20)


def in_chunks(function: Callable[..., Flat], *arrays: Array) -> Flat:
    """Solve M problems, on the last axis of the arrays, some thousands at a time.

    They fit into the cache, and only they wait for the slowest among them.
    """
    count, size = arrays[0].shape[-1], _at_once()
    pieces = -(-count // size)
    if pieces <= 1:
        return function(*arrays)

    def pieces_of(array: Array) -> Array:
        ends = [(0, 0)] * (array.ndim - 1) + [(0, pieces * size - count)]
        padded = jnp.pad(array, ends)
        return jnp.moveaxis(padded.reshape(*array.shape[:-1], pieces, size), -2, 0)

    each = lax.map(lambda piece: function(*piece), tuple(map(pieces_of, arrays)))
    return jnp.moveaxis(each, 0, 1).reshape(each.shape[1], -1)[:, :count]


def solve_where(
    needed: Bool[Array, " m"], solve: Callable[..., Flat], w: Flat, *arrays: Array
) -> Flat:
    """Return the weights w, solved anew where it is needed.

    The needed problems are packed into blocks, so that the others do not wait for them;
    where at most an eighth is needed, there is room for no more.

    Args:
        needed: problems to solve, shape [M].
        solve: of arrays and weights of some thousand problems, the weights.
        w: the weights of the others, shape [N,M].
        arrays: what defines the problems, M on the last axis.
    """
    count = len(needed)
    place = jnp.cumsum(needed, dtype=jnp.int32)  # of the needed ones, from 1
    needs = place[-1]
    block = min(_at_once(), count)

    def with_room_for(most: int) -> Callable[..., Flat]:
        room = -(-most // block) * block

        def packed(array: Array, index: Array) -> Array:
            some = jnp.take(array, index, axis=-1, mode="clip")
            return jnp.moveaxis(some.reshape(*some.shape[:-1], -1, block), -2, 0)

        def solved(piece: tuple) -> Flat:
            first, *some = piece
            return lax.cond(first < needs, solve, lambda *some: some[-1], *some)

        @jax.checkpoint  # or what a derivative needs were kept of both sizes
        def solve_all(w: Flat, *arrays: Array) -> Flat:
            nth = jnp.arange(room, dtype=jnp.int32)
            index = jnp.searchsorted(place, nth + 1)
            index = jnp.where(nth < needs, index, count + nth)  # unique; dropped
            pieces = [packed(array, index) for array in (*arrays, w)]
            each = lax.map(solved, (nth[::block], *pieces))
            flat = jnp.moveaxis(each, 0, 1).reshape(len(w), -1)
            return w.at[:, index].set(flat, mode="drop", unique_indices=True)

        return solve_all

    few = -(-count // 8)
    return lax.cond(needs <= few, with_room_for(few), with_room_for(count), w, *arrays)


def minimum_weight(w: Flat) -> float:
    """Return how far below zero rounding may move a weight of zero.

    Such a weight stays free: on the line between two others a third base has no
    weight, but may make room for a fourth.
    """
    return -32 * float(jnp.finfo(w.dtype).eps)


def sums_to_one(w: Flat) -> Bool[Array, " m"]:
    """Return False for problems so far from convex that their minimum is lost."""
    return jnp.abs(jnp.sum(w, axis=0) - 1) < 0.5


def search(
    minimise: Callable[[Free], tuple[Flat, Flat]],
    start: Flat,
    free: Free,
    active: Bool[Array, " m"],
) -> tuple[Flat, Free]:
    """Minimise convex quadratic functions of nonnegative weights.

    Args:
        minimise: from the free weights to the minimum over them, 0 elsewhere, and the
            derivative with respect to each weight there; a fixed one is freed if it is
            negative.
        start: feasible weights, shape [N,M]; the result if a minimum is lost.
        free: the weights that are not fixed at zero there, shape [N,M].
        active: problems to solve; the others return their start.

    Returns:
        the weights, and which of them are free.
    """
    n, minimum_free = len(start), minimum_weight(start)
    number, start_free = jnp.arange(n)[:, None], free

    def unfinished(state: tuple) -> Array:
        step, *_, active = state
        return (step < _STEPS * n) & jnp.any(active)

    def advance(state: tuple) -> tuple:
        step, w, free, fresh, active = state
        minimum, slope = minimise(free)
        solved = sums_to_one(minimum) & jnp.all(jnp.isfinite(slope), axis=0)
        blocking = free & (minimum < minimum_free)
        reach = divide(w, w - minimum, where=blocking, otherwise=jnp.inf)
        share = jnp.minimum(jnp.min(reach, axis=0, keepdims=True), 1.0)
        fixed = blocking & (reach <= share)
        moved = jnp.where(fixed, 0.0, jnp.maximum(w + share * (minimum - w), 0.0))
        slope = jnp.where(free, jnp.inf, slope)
        arrived, steepest = share >= 1, jnp.argmin(slope, axis=0, keepdims=True)
        freed = arrived & (slope < 0) & (number == steepest)
        moves, given_up = (active & solved)[None], (active & ~solved)[None]
        done = (arrived[0] & ~jnp.any(freed, axis=0)) | jnp.any(fresh & fixed, axis=0)
        after, free_after = jnp.where(moves, moved, w), (free & ~fixed) | freed
        return (
            step + 1,
            jnp.where(given_up, start, after),
            jnp.where(given_up, start_free, jnp.where(moves, free_after, free)),
            freed,
            active & solved & ~done,
        )

    state = (0, start, free, jnp.zeros_like(free), active)
    _, w, free, _, _ = lax.while_loop(unfinished, advance, state)
    return w, free


def shared_by_equals(
    w: Sequence[Float[Array, " m"]], equal: Sequence[Sequence[Bool[Array, " m"]]]
) -> Flat:
    """Return weights averaged over equal bases; each equals itself."""

    def mean(equal_to: Sequence[Array]) -> Array:
        count = functools.reduce(operator.add, [s.astype(w[0].dtype) for s in equal_to])
        own = [jnp.where(*each, 0.0) for each in zip(equal_to, w, strict=True)]
        return functools.reduce(operator.add, own) / count

    return jnp.stack([mean(equal_to) for equal_to in equal])
