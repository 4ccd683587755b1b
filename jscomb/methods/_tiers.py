"""The default method, in three tiers of cost: as many estimates as a budget allows."""

import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jscomb import ensemble, metrics
from jscomb.denoisers import oidn
from jscomb.frame import Estimate, Frame
from jscomb.methods._inputs import (
    given_to,
    inputs,
    of_shared_size,
    tell,
    with_input,
    with_inputs,
)
from jscomb.methods._table import METHODS
from jscomb.numerics.tiles import compiled, cut
from jscomb.typing import Key

_CROP = 256  # pixels along the side of the part whose denoising is timed


class Tier(NamedTuple):
    """What a budget pays for.

    Attributes:
        summary: what it does, in one line.
        bases: what its ensemble is made of beside the frame's own estimates; a single
            one is not combined with others but refined.
        denoisings: measured cost, in runs of Open Image Denoise on the frame.
    """

    summary: str
    bases: tuple[str, ...]
    denoisings: float


# A narrow search takes a third of the time; what it costs an ensemble in error is
# measured by experiments.ensemble.searching.
_FEW = (
    *("oidn", "path-tracing", "oidn-demodulated", "nonlocal-means-narrow"),
    *("whitened", "multi-scale"),
)

TIERS: dict[str, Tier] = {
    "fast": Tier("`multi-scale` with one denoised image", ("oidn",), 1.5),
    "balanced": Tier("ensemble of a few estimates", _FEW, 9.0),
    "best": Tier(
        "ensemble of more denoisers and combiners",
        (*_FEW, "bilateral", "oidn-clean", "pd", "double-shrinkage"),
        60.0,
    ),
}
"""By name, the cheapest first."""


class Combined(NamedTuple):
    """The default method's result, and how it came about.

    Attributes:
        estimate: in the frame's unit. Both halves share the weights of an ensemble;
            None of a single image.
        tier: a key of `TIERS`, or "denoised" for a frame that allows none.
        bases: names of the estimates that it is made of.
        skipped: why others are not among them, by name.
        reason: why not the tier that was asked for; else empty.
        error: estimated relative L2 and its map; None without halves.
    """

    estimate: Estimate
    tier: str
    bases: tuple[str, ...]
    skipped: dict[str, str]
    reason: str
    error: metrics.ErrorEstimate | None


def combine_tier(
    key: Key,
    frame: Frame,
    *,
    tier: str | None = None,
    biased: str | Sequence[str] | None = None,
    budget: float | None = None,
    progress: Callable[[str], None] | None = None,
) -> Combined:
    """Combine a frame by the default method, and estimate the result's error.

    The weights of an ensemble are of minimum error as the half buffers estimate it, so
    that nothing is run twice to choose. Without half buffers there is nothing to weigh
    by: then "fast", which needs the variance; without that, the denoised image.

    Args:
        key: of random probes, a typed key.
        frame: in any unit.
        tier: a key of `TIERS`; None for the best within the budget.
        biased: names of the estimates and denoisers to combine in place of the tier's;
            one name alone is combined with the noisy image.
        budget: seconds, without compilation; decides by the time of denoising a part of
            the frame. None for any.
        progress: called with what is about to be made ("making pd", "combining 10
            estimates"), once all before is computed; None to compute without waiting.

    Returns:
        the estimate, its error, and what it is made of.

    Raises:
        ValueError: if there is no such tier or estimate.
        ImportError: if Open Image Denoise is needed and missing.

    Example:
        >>> from jscomb.frame import make_frame
        >>> x = 2 + jax.random.normal(jax.random.key(0), (2, 48, 48, 3)) / 4
        >>> y = jnp.full((2, 48, 48, 3), 2.1)
        >>> frame = make_frame(x, estimates={"y": Estimate(y[0], y)})
        >>> names = ["y", "path-tracing"]
        >>> made = combine_tier(jax.random.key(0), frame, tier="best", biased=names)
        >>> print(made.bases, f"{made.error.mean:.3f}")
        ('y', 'path-tracing') 0.002
    """
    whole = frame.normalised()
    tier, reason = _within(whole, tier, budget)
    if len(TIERS[tier].bases) > 1:
        wanted = biased or [*whole.estimates, *TIERS[tier].bases]
        wanted = [wanted, "path-tracing"] if isinstance(wanted, str) else wanted
        names, skipped = inputs(whole, biased=wanted)
        if whole.sub_buffers > 1 and set(names) - {"path-tracing"}:
            made = _ensemble(key, whole, names, progress)
            made = made._replace(tier=tier, skipped=skipped, reason=reason)
            return _scaled(made, frame, whole)
        reason = f"{tier}: no estimate has halves"
        if whole.sub_buffers < 2:
            reason = f"{tier} needs half buffers, to weigh its estimates by"
    made = _single(key, whole, biased, progress)
    return _scaled(made._replace(reason=made.reason or reason), frame, whole)


def _within(frame: Frame, tier: str | None, budget: float | None) -> tuple[str, str]:
    """The tier, and why it is not the one that was asked for or the best."""
    order = [*TIERS]
    tier = tier or order[-1]
    if tier not in order:
        raise ValueError(f"no tier {tier!r}; there are {', '.join(order)}")
    if budget is None or oidn.NEEDS.missing(frame):
        return tier, ""
    seconds = _seconds(frame)
    cheapest, *others = order[: order.index(tier) + 1]
    affordable = [t for t in others if TIERS[t].denoisings * seconds <= budget]
    chosen = affordable[-1] if affordable else cheapest
    if chosen == tier:
        return tier, ""
    expected = TIERS[tier].denoisings * seconds
    return chosen, f"{tier} takes about {expected:.2g} s of {budget:.2g}"


def _seconds(frame: Frame) -> float:
    """Seconds of denoising a frame, from a part of it."""
    height, width = frame.color.shape[:2]
    bare = frame._replace(estimates={}, reference=None)
    small = cut(bare, _CROP, _CROP).merged(1)
    times = []
    for _ in range(2):
        start = time.perf_counter()
        jax.block_until_ready(oidn.denoise_frame(small))
        times.append(time.perf_counter() - start)
    return min(times) * height * width / small.color[..., 0].size


def _ensemble(
    key: Key,
    frame: Frame,
    names: Sequence[str],
    progress: Callable[[str], None] | None,
) -> Combined:
    """Of estimates by name, with weights that both halves share."""
    frame = with_inputs(key, frame, names, progress=progress)
    tell(progress, f"combining {len(names)} estimates", frame)
    height, width = frame.color.shape[:2]
    frame = of_shared_size(frame)
    estimates = {name: frame.estimates[name] for name in names}
    weights = ensemble.weigh_frame(frame, estimates)
    bases = ensemble.stack_estimates(estimates)
    image, *halves = (compiled(ensemble.average)(y, weights) for y in bases)
    unbiased = jnp.stack([half.color for half in frame.halves()])
    made = Estimate(image, jnp.stack(halves))
    spread = compiled(ensemble.spread)(bases.biased, weights)
    error = compiled(metrics.estimate_error)(*made, unbiased, spread)
    made, error = cut((made, error), height, width)
    return Combined(made, "", tuple(names), {}, "", error)


def _single(
    key: Key,
    frame: Frame,
    biased: str | Sequence[str] | None,
    progress: Callable[[str], None] | None,
) -> Combined:
    """Of one denoised image of the frame as a whole, since halves would cost twice."""
    names = [biased] if isinstance(biased, str) else list(biased or frame.estimates)
    name = "oidn" if not names or "oidn" in names else names[0]
    alone = frame.merged(1)
    if frame.buffers.variance is None and frame.sub_buffers > 1:  # from their spread
        buffers = alone.buffers._replace(variance=frame.variance[None])
        alone = alone._replace(buffers=buffers)
    missing = METHODS["multi-scale"].needs.missing(alone)
    method, tier = ("denoised", "denoised") if missing else ("multi-scale", "fast")
    if name not in alone.estimates:
        tell(progress, f"making {name}", alone)
    alone = with_input(key, alone, name)
    tell(progress, f"combining by {method}", alone)
    height, width = alone.color.shape[:2]
    alone, given = given_to(key, of_shared_size(alone), method, name)
    image = cut(METHODS[method].image(key, alone, *given), height, width)
    reason = f"fast needs {missing}" if missing else ""
    return Combined(Estimate(image), tier, (name,), {}, reason, None)


def _scaled(made: Combined, frame: Frame, whole: Frame) -> Combined:
    """The result in the frame's unit."""
    if frame.unit is not None:
        return made
    assert whole.unit is not None
    return made._replace(estimate=made.estimate.scaled(whole.unit))
