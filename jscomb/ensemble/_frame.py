"""Ensembles of a frame's estimates."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jscomb.ensemble._combine import Solver, average, filtered_weights
from jscomb.ensemble._estimate import SCALES
from jscomb.ensemble._evidence import Bases
from jscomb.ensemble._filter import Filter
from jscomb.ensemble._selection import select_bases
from jscomb.frame import (
    Estimate,
    Frame,
    Maker,
    Needs,
    estimates_of,
    halves_possible,
    with_halves,
)
from jscomb.numerics.tiles import compiled
from jscomb.typing import Key

NEEDS = Needs(halves=True)


class Stacked(NamedTuple):
    """The bases of an ensemble, as `combine` and `select_bases` take them.

    Attributes:
        biased: made from the full frame, radiance, [N,H,W,C].
        biased_a: made from half a, same shape.
        biased_b: made from half b, same shape.
    """

    biased: Bases
    biased_a: Bases
    biased_b: Bases


def stack_estimates(estimates: Mapping[str, Estimate]) -> Stacked:
    """Stack estimates and their halves.

    Args:
        estimates: with halves, all of one shape, by name.

    Returns:
        the stacks, in the order of the names.

    Raises:
        ValueError: names the estimate that has no halves, or another shape than the
            first.

    Example:
        >>> y = jnp.ones((4, 5, 3))
        >>> stacked = stack_estimates({"oidn": Estimate(y, jnp.stack([y, y]))})
        >>> print(*(images.shape for images in stacked))
        (1, 4, 5, 3) (1, 4, 5, 3) (1, 4, 5, 3)
    """
    if not estimates:
        raise ValueError("an ensemble needs at least one estimate, got none")
    first, *_ = estimates
    shape = estimates[first].image.shape
    for name, (image, halves) in estimates.items():
        if halves is None:
            raise ValueError(
                f"an ensemble needs estimates with halves: {name!r} has none"
            )
        if image.shape != shape:
            raise ValueError(
                f"estimate {name!r} has shape {image.shape}, {first!r} has {shape}"
            )
        if halves.shape != (2, *shape):
            raise ValueError(
                f"estimate {name!r} has halves of shape {halves.shape}, expected "
                f"{(2, *shape)}"
            )
    full, halves = (jnp.stack(i) for i in zip(*estimates.values(), strict=True))
    return Stacked(full, halves[:, 0], halves[:, 1])


def combine_frame(
    frame: Frame,
    estimates: Mapping[str, Estimate | Maker],
    *,
    solver: Solver = "multi-scale",
    filter: bool | Filter = False,
    select: bool = False,
    solver_key: Key | None = None,
    windows: Sequence[int] = SCALES,
    shared: bool = True,
    block: int = 4,
) -> Estimate:
    """Combine any number of estimates by the weights of minimum estimated error.

    Args:
        frame: with half buffers; in any unit.
        estimates: with halves, or functions that make them from a frame, by name. If
            all are functions and the frame has four sub-buffers, the halves of the
            result are independent: each has weights of its own, from quarters.
            Otherwise both halves share the weights of the full frame.
        solver: see `solve_weights`.
        filter: smooth the weights by `filter_weights`, guided by the frame's features;
            a `Filter` has other options than the paper's.
        select: drop the estimates that do not lower the error (`select_bases`); decides
            on values, so not for `jit`.
        solver_key: of the iterative solver, a typed key.
        windows: of "multi-scale".
        shared: of "multi-scale", one weight for all channels.
        block: of "multi-scale", see `solve_weights`.

    Returns:
        the ensemble, radiance in the frame's unit.

    Raises:
        ValueError: if frame or estimates have no halves, shapes differ, or as
            `solve_weights`.

    Example:
        >>> import jax
        >>> from jscomb.frame import make_frame
        >>> x = 2 + 0.1 * jax.random.normal(jax.random.key(0), (2, 8, 8, 1))
        >>> y = jnp.full((2, 8, 8, 1), 2.01)
        >>> estimates = {"good": Estimate(y[0], y), "bad": Estimate(3 * y[0], 3 * y)}
        >>> made = combine_frame(make_frame(x), estimates)
        >>> print(f"{made.image.mean():.2f}", made.halves.shape)
        2.01 (2, 8, 8, 1)

    Source: ED section 4; the multi-scale weights are ours.
    """
    frame.require("ensemble", NEEDS)

    def combined(part: Frame, given: Mapping[str, Estimate]) -> Estimate:
        """With both halves by the same weights."""
        bases = stack_estimates(given)
        a, b = part.halves()
        if select:
            kept = np.array(select_bases(*bases[1:], a.color, b.color).kept)
            bases = Stacked(*(images[kept] for images in bases))
        weights = _weigh(
            part,
            bases,
            solver=solver,
            filter=filter,
            solver_key=solver_key,
            windows=tuple(windows),
            shared=shared,
            block=block,
        )
        image, *halves = (compiled(average)(y, weights) for y in bases)
        return Estimate(image, jnp.stack(halves))

    given = dict(estimates)
    if halves_possible(frame, given, needs=NEEDS):
        image_of = lambda part, given: combined(part, given).image
        return with_halves(frame, image_of, given, needs=NEEDS)
    return combined(frame, estimates_of(frame, given))


def weigh_frame(frame: Frame, estimates: Mapping[str, Estimate]) -> Bases:
    """Solve for the multi-scale weights of a frame's estimates.

    Args:
        frame: with half buffers; in any unit.
        estimates: with halves, by name.

    Returns:
        the weights that `combine_frame` takes by default, in the order of the names,
        shape [N,H,W,C].

    Raises:
        ValueError: if frame or estimates have no halves, or shapes differ.

    Example:
        >>> from jscomb.frame import make_frame
        >>> x = jnp.full((2, 8, 8, 1), 2.0)
        >>> estimates = {"low": Estimate(x[0] - 1, x - 1), "high": Estimate(x[0], x)}
        >>> print(weigh_frame(make_frame(x), estimates)[:, 0, 0, 0])
        [0. 1.]

    Source: ours.
    """
    frame.require("ensemble", NEEDS)
    options = {"solver": "multi-scale", "filter": False, "windows": SCALES}
    bases = stack_estimates(estimates)
    return _weigh(frame, bases, **options, shared=True, block=4, solver_key=None)


def _weigh(
    frame: Frame, bases: Stacked, *, solver_key: Key | None, **options: Any
) -> Bases:
    """The weights of a frame's bases."""
    a, b = frame.halves()
    known = not Needs(variance=True).missing(a)
    return compiled(filtered_weights, **options)(
        *bases,
        a.color,
        b.color,
        variance_a=a.variance if known else None,
        variance_b=b.variance if known else None,
        albedo=frame.albedo,
        normal=frame.normal,
        solver_key=solver_key,
    )
