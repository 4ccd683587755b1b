"""The exact solver in the plane, where every base is a point of two halves."""

import itertools

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jscomb.numerics import cholesky
from jscomb.numerics.guards import divide, safe_sqrt
from jscomb.numerics.simplex._active_set import (
    Flat,
    in_chunks,
    search,
    shared_by_equals,
)

Points = Float[Array, "n *batch"]
Targets = Float[Array, " *batch"]
Weights = Float[Array, "n *batch"]
Pair = Float[Array, "2 *batch"]  # points or weights of two bases
Plane = Float[Array, "2 m"]  # a point of the plane for each problem


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
    u, c = plane(points_a, points_b, target_a, target_b)
    share = share_of(u[0], u[1], c)
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
    u, c = plane(points_a, points_b, target_a, target_b)
    if len(u) == 1:
        return jnp.ones_like(points_a)
    return in_chunks(_nearest, u, c).reshape(points_a.shape)


def _nearest(u: Float[Array, "n 2 m"], c: Plane) -> Flat:
    """Weights of the point of the hull that is nearest to the target."""
    w, minimum = _nearest_edge(u, c)
    if len(u) > 2:
        around = _fan_triangle(u, c)
        found = jnp.sum(around, axis=0) > 0
        excess = _excess(jnp.sum(around[:, None] * u, axis=0), c)
        # Also where a segment inside the hull hits the target.
        rounding = 8 * float(jnp.finfo(u.dtype).eps) * (1 + jnp.sum(jnp.abs(c), axis=0))
        inside = found & (excess <= minimum + rounding)
        if len(u) > 3:
            around = _nearest_uniform(u, c, around, inside)
        w = jnp.where(inside[None], around, w)
    return shared_by_equals(w, jnp.all(u[:, None] == u[None], axis=2))


def plane(
    points_a: Points, points_b: Points, target_a: Targets, target_b: Targets
) -> tuple[Float[Array, "n 2 m"], Plane]:
    """Return u_i = p_i - mean [N,2,M] and c = mean - t [2,M], divided by the largest u.

    The target may be a firefly, far from all points, and must not round differences of
    points. Both are 0 in problems with a number that is not finite.
    """
    n, *batch = points_a.shape
    if n == 0:
        raise ValueError("an ensemble needs at least one base, got 0")
    for name, array, shape in (
        ("points_b", points_b, points_a.shape),
        ("target_a", target_a, tuple(batch)),
        ("target_b", target_b, tuple(batch)),
    ):
        if array.shape != shape:
            raise ValueError(
                f"{name} has shape {array.shape}, expected {shape}: points_a has "
                f"{points_a.shape}"
            )
    p = jnp.stack([points_a, points_b], axis=1).reshape(n, 2, -1)
    t = jnp.stack([target_b, target_a]).reshape(2, -1)
    known = jnp.all(jnp.isfinite(p), axis=(0, 1)) & jnp.all(jnp.isfinite(t), axis=0)
    p, t = jnp.where(known[None, None], p, 0.0), jnp.where(known[None], t, 0.0)
    u = p - p[:1]  # exactly 0 where all points are the same, unlike p - mean
    offset = jnp.mean(u, axis=0)
    u = u - offset[None]
    size = jnp.max(jnp.abs(lax.stop_gradient(u)), axis=(0, 1))
    scale = divide(jnp.ones_like(size), size, where=size > 0, otherwise=1.0)
    return u * scale[None, None], (p[0] - t + offset) * scale[None]


def share_of(first: Plane, second: Plane, c: Plane) -> Float[Array, " m"]:
    """Return the share of the second end at the point of a segment nearest to -c.

    One half if both ends are equal. Source: ED eq. 29.
    """
    d = second - first
    square = jnp.sum(d * d, axis=0)
    along = -jnp.sum((first + c) * d, axis=0)
    return share_within(along, square, 0.5)


def share_within(
    along: Float[Array, " m"], square: Float[Array, " m"], otherwise: float
) -> Float[Array, " m"]:
    """Return along / square between 0 and 1; `otherwise` where the square is 0.

    The ends have no derivative: that of a huge quotient would not be finite.
    """
    inside = (along > 0) & (along < square)
    share = divide(along, square, where=inside)
    end = jnp.where(square > 0, jnp.where(along > 0, 1.0, 0.0), otherwise)
    return jnp.where(inside, share, end.astype(share.dtype))


def _excess(z: Plane, c: Plane) -> Float[Array, " m"]:
    """|z + c|^2 - |c|^2, precise for a far target; without derivatives."""
    return lax.stop_gradient(jnp.sum(z * (z + 2 * c), axis=0))


def _nearest_edge(
    u: Float[Array, "n 2 m"], c: Plane
) -> tuple[Flat, Float[Array, " m"]]:
    """Weights of the point nearest to the target on all pairs' segments; its excess."""
    n, _, m = u.shape
    minimum = jnp.full(m, jnp.inf, u.dtype)
    share = jnp.zeros_like(minimum)
    first = second = jnp.zeros(m, int)
    for i, j in itertools.combinations(range(n), 2):
        s = share_of(u[i], u[j], c)
        excess = _excess(u[i] + s[None] * (u[j] - u[i]), c)
        better = excess < minimum
        minimum = jnp.where(better, excess, minimum)
        share = jnp.where(better, s, share)
        first, second = (
            jnp.where(better, k, old) for k, old in ((i, first), (j, second))
        )
    number = jnp.arange(n)[:, None]
    w = jnp.where(number == second[None], share[None], 0.0)
    return jnp.where(number == first[None], 1 - share[None], w), minimum


def _fan_triangle(u: Float[Array, "n 2 m"], c: Plane) -> Flat:
    """Weights of a triangle around the target, of sum one; 0 where there is none.

    Triangles of the first point and any two others cover the hull. The largest one
    around the target rounds least.
    """
    n, _, m = u.shape

    def cross(i: int, j: int) -> Array:
        """Cross product of p_i and p_j, p = u + c, where c may be large."""
        d = u[j] - u[i]
        return u[i, 0] * d[1] - u[i, 1] * d[0] + c[0] * d[1] - c[1] * d[0]

    with_first = [cross(0, j) for j in range(n)]
    largest, w = jnp.zeros(m, u.dtype), jnp.zeros((n, m), u.dtype)
    for j, k in itertools.combinations(range(1, n), 2):
        corners = {0: cross(j, k), j: -with_first[k], k: with_first[j]}
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
    u: Float[Array, "n 2 m"], c: Plane, start: Flat, inside: Bool[Array, " m"]
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
    u: Float[Array, "n 2 m"], c: Plane
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
