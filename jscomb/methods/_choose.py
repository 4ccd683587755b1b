"""The method of minimum estimated error, from half buffers."""

import functools
import time
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jscomb import metrics
from jscomb.frame import Frame, estimates_of
from jscomb.methods._inputs import (
    can_make,
    given_to,
    input_name,
    taken_by,
    with_input,
)
from jscomb.methods._table import CANDIDATES, METHODS
from jscomb.typing import Key

_EPSILON = 0.01  # of the relative L2 of normalised frames
_LIMIT = 2.0  # of the influence of a firefly on the choice


class Trial(NamedTuple):
    """A method that `choose` tried.

    Attributes:
        method: its name.
        change: estimated change of the relative L2 against the cheapest method; None if
            it could not be judged.
        seconds: of one half without compilation; 0 if not judged.
        reason: why it was skipped; else empty.
    """

    method: str
    change: metrics.Change | None
    seconds: float
    reason: str


class Choice(NamedTuple):
    """The method to combine a frame by.

    Attributes:
        method: a key of `METHODS`.
        trials: all that were tried, in order.
        halves: its images of each half, normalised radiance, [2,H,W,C]; None if none
            were made.
    """

    method: str
    trials: tuple[Trial, ...]
    halves: Float[Array, "2 h w c"] | None


def choose(
    key: Key,
    frame: Frame,
    *,
    biased: str | Sequence[str] | None = None,
    budget: float | None = None,
    methods: Sequence[str] = CANDIDATES,
) -> Choice:
    """Find the method of minimum estimated error for a frame.

    Decides on values, so not for `jit`. Takes about twice as long as all methods
    together, each of which is compiled when it is first used on a size of image. To
    judge one that needs halves takes four sub-buffers, and denoises the quarters.

    Args:
        key: of random probes, a typed key.
        frame: with half buffers, of itself and of the biased image.
        biased: as for `combine`.
        budget: seconds that a method may take for a half; None for any.
        methods: to choose from, the cheapest first.

    Returns:
        the method and the evidence for it. Without halves nothing can be judged: then
        `whitened`, or `denoised` for a frame without variance, and no trials.

    Raises:
        ValueError: if there is no such biased image or method, no method at all, or
            several estimates and no name.

    Example:
        >>> from jscomb.frame import Estimate, make_frame
        >>> noise = jax.random.normal(jax.random.key(0), (2, 32, 32, 3))
        >>> y = jnp.ones((2, 32, 32, 3))
        >>> frame = make_frame(
        ...     1 + noise / 4, variance=y[0] / 32, estimates={"y": Estimate(y[0], y)}
        ... )
        >>> found = choose(jax.random.key(0), frame, methods=["denoised", "whitened"])
        >>> print(found.method)
        denoised

    Source: ours.
    """
    if not methods or not set(methods) <= METHODS.keys():
        raise ValueError(f"methods {list(methods)}: there are {', '.join(METHODS)}")
    frame = frame.normalised()
    name = input_name(frame, biased=biased)
    frame = with_input(key, frame, name)
    if frame.sub_buffers < 2 or frame.estimates[name].halves is None:
        known = not METHODS["whitened"].needs.missing(frame)
        return Choice("whitened" if known else "denoised", (), None)
    cheapest, *others = methods
    make = functools.partial(_halves, key, frame, name)
    x = jnp.stack([half.color for half in frame.halves()])
    y, _ = make(cheapest)
    made, trials = {cheapest: y}, []
    for method in others:
        if reason := _unfit(method, frame, name):
            trials.append(Trial(method, None, 0.0, reason))
            continue
        made[method], seconds = make(method)
        change = metrics.rel_l2_change(
            made[method], y, x, epsilon=_EPSILON, limit=_LIMIT
        )
        late = budget is not None and seconds > budget
        reason = f"takes {seconds:.2g} s of {budget:.2g}" if late else ""
        trials.append(Trial(method, change, seconds, reason))
    best = _best(trials) or cheapest
    return Choice(best, tuple(trials), made[best])


def _best(trials: Sequence[Trial]) -> str | None:
    """The method of minimum error among those within budget that surely lower it."""
    judged = {t.method: t.change for t in trials if t.change and not t.reason}
    sure = {m: float(sum(change)) for m, change in judged.items() if change.helps}
    return min(sure, key=lambda method: sure[method], default=None)


def _unfit(method: str, frame: Frame, name: str) -> str:
    """Why a method cannot be judged with this biased image; else empty."""
    chosen = METHODS[method]
    if chosen.denoiser not in (None, name):
        return f"{method} does not take {name}"
    if missing := chosen.needs.missing_for_halves(frame):
        return f"{method} needs {missing}"
    alone = chosen.takes == "one estimate" and chosen.needs.halves
    if alone and not can_make(name, frame):
        return f"{method} needs {name} of quarters, which only a denoiser can make"
    return ""


def _halves(
    key: Key, frame: Frame, name: str, method: str
) -> tuple[Float[Array, "2 h w c"], float]:
    """A method's images of both halves, and the seconds of one."""
    images, seconds = [], 0.0
    for half in frame.halves():
        start = time.perf_counter()
        half, given = given_to(key, half, method, taken_by(method, name))
        image = METHODS[method].image(key, half, *estimates_of(half, given))
        images.append(jax.block_until_ready(image))
        seconds = time.perf_counter() - start  # the second half without compilation
    return jnp.stack(images), seconds
