"""Which bases lower a frame's error."""

import functools
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jscomb.ensemble._evidence import (
    Bases,
    Matrix,
    check_bases,
    evidence_of,
    pooled,
    unpacked,
)
from jscomb.numerics import simplex
from jscomb.typing import Image

_ROUNDING = 1e-6


class Selected(NamedTuple):
    """The bases that an ensemble needs.

    Attributes:
        kept: their numbers, ascending.
        errors: estimated relative error of the ensemble, in excess of the plain
            average's, with all bases, and after each was dropped.
    """

    kept: tuple[int, ...]
    errors: tuple[float, ...]


def select_bases(
    biased_a: Bases,
    biased_b: Bases,
    unbiased_a: Image,
    unbiased_b: Image,
    *,
    window: int = 31,
) -> Selected:
    """Drop bases without which the estimated error of the whole frame does not rise.

    Weights from one half's errors are judged by the other's, which exposes a base that
    only fits noise. Drops one base at a time, the one with the maximum gain. Decides
    on values, so it is not for `jit`.

    Args:
        biased_a: y^a, each base made from half a, radiance, shape [N,H,W,C].
        biased_b: y^b, made from half b.
        unbiased_a: x_a, shape [H,W,C].
        unbiased_b: x_b, same shape.
        window: width in pixels that errors are averaged over, odd.

    Returns:
        the bases that remain, and the estimated errors on the way.

    Raises:
        ValueError: if shapes differ or there is no base.

    Example:
        >>> x = jnp.full((4, 4, 1), 2.0)
        >>> y = jnp.stack([x + 1.0, x + 0.1])
        >>> print(select_bases(y, y, x, x).kept)
        (1,)

    Source: ours.
    """
    check_bases(biased_a, biased_b, unbiased_a, unbiased_b)
    halves = _halves(biased_a, biased_b, unbiased_a, unbiased_b, window=window)
    kept = list(range(len(biased_a)))
    errors = [_judged(halves, kept)]
    while len(kept) > 1:
        without = {i: _judged(halves, [k for k in kept if k != i]) for i in kept}
        worst = min(without, key=lambda i: without[i])
        # A base without weight changes the error by rounding only.
        if without[worst] > errors[-1] + _ROUNDING * abs(errors[-1]):
            break
        kept.remove(worst)
        errors.append(without[worst])
    return Selected(tuple(kept), tuple(errors))


@functools.partial(jax.jit, static_argnames="window")
def _halves(
    biased_a: Bases,
    biased_b: Bases,
    unbiased_a: Image,
    unbiased_b: Image,
    *,
    window: int,
) -> tuple[Matrix, Matrix, Matrix, Matrix]:
    """Windowed error matrices of each half, then those of single pixels."""
    images = biased_a, biased_b, unbiased_a, unbiased_b
    a, b, count = evidence_of(*images, shared=True)
    near = (pooled(half, count, window) for half in (a, b))
    n = len(biased_a)
    near_a, near_b, a, b = (unpacked(i, n) for i in (*near, a, b))
    return near_a, near_b, a, b


def _judged(halves: tuple[Matrix, ...], kept: Sequence[int]) -> float:
    """Error over the frame of weights from one half, estimated by the other."""
    some = np.array(kept)
    near_a, near_b, a, b = (m[some[:, None], some[None]] for m in halves)
    return float(_cross_error(near_a, b) + _cross_error(near_b, a)) / 2


@jax.jit
def _cross_error(near: Matrix, errors: Matrix) -> Array:
    """Mean over the frame of w'Mw with the weights of other matrices."""
    w = simplex.quadratic(near)
    return jnp.mean(jnp.sum(w[:, None] * w[None] * errors, axis=(0, 1)))
