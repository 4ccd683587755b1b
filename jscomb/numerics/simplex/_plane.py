"""Bases as points of the plane of two halves: coordinates, segments and areas.

A point is a pair of arrays with an element for each problem, so that XLA keeps all in
registers; stacked, a part of one array would be computed for each base again.
"""

import functools
from collections.abc import Sequence

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jscomb.numerics.guards import divide

Points = Float[Array, "n *batch"]
Targets = Float[Array, " *batch"]
Weights = Float[Array, "n *batch"]
Point = tuple[Array, Array] | Float[Array, "2 m"]  # both coordinates of M problems


def plane(
    points_a: Points, points_b: Points, target_a: Targets, target_b: Targets
) -> tuple[Float[Array, "n 2 m"], Float[Array, "2 m"]]:
    """Return `coordinates` as arrays, u [N,2,M] and c [2,M]."""
    u, c = coordinates(points_a, points_b, target_a, target_b)
    return stacked(u), jnp.stack(c)


def stacked(u: Sequence[Point]) -> Float[Array, "n 2 m"]:
    """Return points as one array."""
    return jnp.stack([jnp.stack(point) for point in u])


def coordinates(
    points_a: Points, points_b: Points, target_a: Targets, target_b: Targets
) -> tuple[list[Point], Point]:
    """Return u_i = p_i - mean and c = mean - t, divided by the largest coordinate of u.

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
    (u_a, c_a), (u_b, c_b) = _centred(points_a, target_b), _centred(points_b, target_a)
    size = functools.reduce(jnp.maximum, map(jnp.abs, lax.stop_gradient(u_a + u_b)))
    known = jnp.isfinite(size + jnp.abs(c_a) + jnp.abs(c_b))
    scale = divide(jnp.ones_like(size), size, where=size > 0, otherwise=1.0)
    scale = lax.stop_gradient(jnp.where(known, scale, 0.0))

    def point(x: Array, y: Array) -> Point:
        x, y = (jnp.where(scale > 0, each * scale, 0.0) for each in (x, y))
        return x, y

    return [point(*each) for each in zip(u_a, u_b, strict=True)], point(c_a, c_b)


def _centred(points: Points, target: Targets) -> tuple[list[Array], Array]:
    """Each point less the mean, and the mean less the target, of one half."""
    p = [point.ravel() for point in jnp.unstack(points)]
    u = [each - p[0] for each in p]  # exactly 0 where all are the same, unlike p - mean
    offset = sum(u) / len(u)
    return [each - offset for each in u], p[0] - target.ravel() + offset


def share_of(first: Point, second: Point, c: Point) -> Float[Array, " m"]:
    """Return the share of the second end at the point of a segment nearest to -c.

    One half if both ends are equal. Source: ED eq. 29.
    """
    along, square = segment(first, second, c)
    return share_within(along, square, 0.5)


def segment(
    first: Point, second: Point, c: Point
) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
    """Return d.(t - p) from the first end p to the target, and the square of d."""
    x, y = second[0] - first[0], second[1] - first[1]
    square = x * x + y * y
    return -((first[0] + c[0]) * x + (first[1] + c[1]) * y), square


def cross(first: Point, second: Point, c: Point) -> Float[Array, " m"]:
    """Return the cross product of both ends seen from the target; c may be large."""
    x, y = second[0] - first[0], second[1] - first[1]
    return first[0] * y - first[1] * x + c[0] * y - c[1] * x


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
