"""The exact solver in the plane, where every base is a point of two halves."""

import functools
import itertools
import operator
from collections.abc import Callable, Sequence

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, UInt32

from jscomb.numerics import cholesky
from jscomb.numerics.guards import divide, safe_sqrt
from jscomb.numerics.simplex._active_set import (
    Flat,
    search,
    shared_by_equals,
    solve_where,
)
from jscomb.numerics.simplex._plane import (
    Point,
    Points,
    Targets,
    Weights,
    coordinates,
    cross,
    segment,
    share_of,
    stacked,
)
from jscomb.numerics.tiles import in_one_pass

Pair = Float[Array, "2 *batch"]  # points or weights of two bases
Plane = Float[Array, "n 2 m"]  # the points of N bases
Pairs = UInt32[Array, " m"]  # two of N bases, i * N + j


def two(points_a: Pair, points_b: Pair, target_a: Targets, target_b: Targets) -> Pair:
    """Return the best weights of two bases, in closed form.

    Args:
        points_a: of both bases, from half a, any unit, shape [2,...].
        points_b: from half b, same shape.
        target_a: from half a, same unit, shape [...].
        target_b: from half b, same shape.

    Returns:
        the weights, shape [2,...]; one half each where the bases agree.

    Raises:
        ValueError: while tracing, if there are not two bases or shapes differ.

    Example:
        >>> import jax.numpy as jnp
        >>> print(two(jnp.array([0.0, 4.0]), jnp.array([0.0, 4.0]),
        ...           jnp.array(1.0), jnp.array(1.0)))
        [0.75 0.25]

    Source: ED eq. 29.
    """
    if len(points_a) != 2:
        raise ValueError(f"two takes 2 bases, got {len(points_a)}")
    (first, second), c = coordinates(points_a, points_b, target_a, target_b)
    share = share_of(first, second, c)
    return jnp.stack([1 - share, share]).reshape(points_a.shape)


def hull(
    points_a: Points, points_b: Points, target_a: Targets, target_b: Targets
) -> Weights:
    """Return the best weights of any number of bases, exactly.

    The ensemble of a pixel and channel is a point of the convex hull of the bases'
    points. For a target outside the hull the nearest point lies on an edge, a closed
    form for every pair. Inside, many weights reach the target; the ones nearest to
    uniform are unique and smooth. Bases at the same point get the same weight.

    Args:
        points_a: of each base, from half a, any unit, shape [N,...].
        points_b: from half b, same shape.
        target_a: from half a, same unit, shape [...].
        target_b: from half b, same shape.

    Returns:
        the weights, shape [N,...].

    Raises:
        ValueError: while tracing, if there is no base or shapes differ.

    Example:
        >>> import jax.numpy as jnp
        >>> a, b = jnp.array([0.0, 2.0, 0.0, 2.0]), jnp.array([0.0, 0.0, 2.0, 2.0])
        >>> print(hull(a, b, jnp.array(1.0), jnp.array(1.0)).round(3))
        [0.25 0.25 0.25 0.25]

    Source: ours, for the objective of ED eq. 14.
    """
    u, c = in_one_pass(coordinates, points_a, points_b, target_a, target_b)
    if len(u) == 1:
        return jnp.ones_like(points_a)
    pair, surrounded = in_one_pass(_nearest, u, c)
    share = in_one_pass(_share, u, c, pair)
    w = in_one_pass(_blend, u, pair, share)
    if len(u) > 2:
        w = solve_where(surrounded, _inside, w, stacked(u), jnp.stack(c))
    return w.reshape(points_a.shape)


def _nearest(u: Sequence[Point], c: Point) -> tuple[Pairs, Bool[Array, " m"]]:
    """The pair whose segment comes nearest; whether the hull may surround the target.

    It does not surround a target from which all other points are to the left of one, or
    at the same place.
    """
    n, (u, c) = len(u), lax.stop_gradient((u, c))
    distance = _distance_to(c)
    least, pair = jnp.full_like(c[0], jnp.inf), jnp.zeros(c[0].shape, jnp.uint32)
    rightmost = [jnp.ones(pair.shape, bool)] * n
    for i, j in itertools.combinations(range(n), 2):
        along, square = segment(u[i], u[j], c)
        share = jnp.clip(along / jnp.where(square > 0, square, 1.0), 0.0, 1.0)
        x, y = (
            start + share * (end - start) for start, end in zip(u[i], u[j], strict=True)
        )
        of_pair = distance(x, y)
        nearer = of_pair < least
        least = jnp.where(nearer, of_pair, least)
        pair = jnp.where(nearer, jnp.uint32(i * n + j), pair)
        turn, same = cross(u[i], u[j], c), square == 0
        rightmost[i] &= same | (turn > 0)
        rightmost[j] &= same | (turn < 0)
    return pair, ~functools.reduce(operator.or_, rightmost)


def _distance_to(c: Point) -> Callable[[Array, Array], Float[Array, " m"]]:
    """The squared distance of a point z from -c; of a far target what exceeds |c|^2.

    So that a small distance is precise, and a far target does not round those of points
    against each other: |z + c|^2 = (z + c).(z + c) or z.(z + 2 c) + |c|^2.
    """
    far = jnp.abs(c[0]) + jnp.abs(c[1]) > 4
    of_one, of_other = jnp.where(far, 0.0, 1.0), jnp.where(far, 2.0, 1.0)

    def distance(x: Array, y: Array) -> Array:
        of_x = (x + of_one * c[0]) * (x + of_other * c[0])
        return of_x + (y + of_one * c[1]) * (y + of_other * c[1])

    return distance


def _share(u: Sequence[Point], c: Point, pair: Pairs) -> Float[Array, " m"]:
    """The share of a pair's second base at the point that is nearest to the target."""

    def at(end: Array) -> Point:
        x, y = jnp.zeros_like(c[0]), jnp.zeros_like(c[1])
        for i, point in enumerate(u):
            x, y = (
                jnp.where(end == i, *each) for each in zip(point, (x, y), strict=True)
            )
        return x, y

    return share_of(at(pair // len(u)), at(pair % len(u)), c)


def _blend(u: Sequence[Point], pair: Pairs, share: Float[Array, " m"]) -> Flat:
    """The weights of all bases where a pair's second one has a share."""
    first, second = pair // len(u), pair % len(u)
    w = [
        jnp.where(first == i, 1 - share, jnp.where(second == i, share, 0.0))
        for i in range(len(u))
    ]
    return _shared_by_equals(w, u)


def _inside(u: Plane, c: Float[Array, "2 m"], w: Flat) -> Flat:
    """Weights that reach a target inside the hull; w where it is not."""
    around = _fan_triangle(u, c)
    found = jnp.sum(around, axis=0) > 0
    fixed = lax.stop_gradient((u, c, around, w))
    # Also where a segment inside the hull hits the target.
    inside = found & ~_farther(*fixed)
    if len(u) > 3:
        around = _nearest_uniform(u, c, around, inside)
    around = _shared_by_equals(jnp.unstack(around), jnp.unstack(u))
    return jnp.where(inside[None], around, w)


def _farther(
    u: Plane, c: Float[Array, "2 m"], w: Flat, than: Flat
) -> Bool[Array, " m"]:
    """Whether weights are farther from the target than others, beyond rounding."""
    distance = _distance_to(c)
    of_w, of_others = (
        distance(*jnp.sum(each[:, None] * u, axis=0)) for each in (w, than)
    )
    rounding = 8 * float(jnp.finfo(u.dtype).eps) * (1 + jnp.sum(jnp.abs(c), axis=0))
    return of_w > of_others + rounding


def _shared_by_equals(w: Sequence[Array], points: Sequence[Point]) -> Flat:
    """The weights averaged over bases at the same point."""
    same = [[(p[0] == q[0]) & (p[1] == q[1]) for q in points] for p in points]
    return shared_by_equals(w, same)


def _fan_triangle(u: Plane, c: Point) -> Flat:
    """Weights of a triangle around the target, of sum one; 0 where there is none.

    Triangles of the first point and any two others cover the hull. The largest one
    around the target rounds least.
    """
    n, _, m = u.shape
    with_first = [cross(u[0], u[j], c) for j in range(n)]
    largest, w = jnp.zeros(m, u.dtype), jnp.zeros((n, m), u.dtype)
    for j, k in itertools.combinations(range(1, n), 2):
        corners = {0: cross(u[j], u[k], c), j: -with_first[k], k: with_first[j]}
        area = sum(corners.values())
        sign = jnp.sign(area)
        around = jnp.stack([sign * corner >= 0 for corner in corners.values()])
        better = jnp.all(around, axis=0) & (jnp.abs(area) > largest)
        largest = jnp.where(better, jnp.abs(area), largest)
        these = [corners.get(i, jnp.zeros_like(area)) for i in range(n)]
        w = jnp.where(better[None], jnp.abs(jnp.stack(these)), w)
    # Sums to one, whatever the rounding of an area that almost vanishes.
    total = jnp.broadcast_to(jnp.sum(w, axis=0, keepdims=True), w.shape)
    return divide(w, total, where=total > 0)


def _nearest_uniform(
    u: Plane, c: Point, start: Flat, inside: Bool[Array, " m"]
) -> Flat:
    """The weights of minimum |w|^2 that reach a target inside the hull.

    Where positive they are affine in the points: w_i = (l.r_i)+, with r_i the point and
    a one. Returns the start where the points are too nearly on a line for that.
    """
    rows, target = _orthonormal(u, c)
    near = 1e3 * float(jnp.finfo(u.dtype).eps)

    def multipliers(rows: Array, target: Array, free: Array) -> Array:
        """The l for which the free weights reach the target."""
        free_rows = jnp.where(free[None], rows, 0.0)
        square = jnp.sum(free_rows[:, None] * free_rows[None], axis=2)
        minimum_pivot = jnp.full((3, 1), 1e-3 * near, u.dtype)
        return cholesky.solve(square, target[:, None], minimum_pivot)[:, 0]

    fixed_rows, fixed_target = lax.stop_gradient((rows, target))

    def minimise(free: Array) -> tuple[Flat, Flat]:
        found = multipliers(fixed_rows, fixed_target, free)
        affine = jnp.sum(found[:, None] * fixed_rows, axis=0)
        return jnp.where(free, affine, 0.0), near - affine

    fixed_start = lax.stop_gradient(start)
    free = (fixed_start > 0) | ~inside[None]
    _, free = search(minimise, fixed_start, free, inside)
    found = multipliers(rows, target, free)
    w = jnp.maximum(jnp.where(free, jnp.sum(found[:, None] * rows, axis=0), 0.0), 0.0)
    reached = jnp.abs(jnp.sum(w[None] * rows, axis=1) - target) < near
    reached = jnp.broadcast_to(jnp.all(reached, axis=0)[None], w.shape)
    total = jnp.broadcast_to(jnp.sum(w, axis=0, keepdims=True), w.shape)
    return divide(w, total, where=reached, otherwise=start)


def _orthonormal(
    u: Plane, c: Point
) -> tuple[Float[Array, "3 n m"], Float[Array, "3 m"]]:
    """Ones and both coordinates of the points as orthonormal rows; the target in them.

    A coordinate that is constant, or the second one of points on a line, becomes zeros.
    """
    n = len(u)
    swapped = jnp.sum(jnp.abs(u[:, 0]) - jnp.abs(u[:, 1]), axis=0) < 0
    x, y = (jnp.where(swapped[None], u[:, 1 - k], u[:, k]) for k in (0, 1))
    x_target, y_target = (-jnp.where(swapped, c[1 - k], c[k]) for k in (0, 1))
    one = jnp.full_like(x, n**-0.5)

    def unit(row: Array, along: Array, minimum: float) -> tuple[Array, Array]:
        square = jnp.sum(row * row, axis=0)
        some = square > minimum
        size = safe_sqrt(square)
        known = jnp.broadcast_to(some[None], row.shape)
        row = divide(row, jnp.broadcast_to(size[None], row.shape), where=known)
        return row, divide(along, size, where=some)

    first, first_target = unit(x, x_target, 0.0)
    slope = jnp.sum(first * y, axis=0)
    rest, rest_target = y - slope[None] * first, y_target - slope * first_target
    second, second_target = unit(rest, rest_target, float(jnp.finfo(u.dtype).eps) ** 2)
    rows = jnp.stack([one, first, second])
    return rows, jnp.stack([one[0], first_target, second_target])
