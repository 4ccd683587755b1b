"""How far need non-local means search, as one of the estimates of `balanced`?

Relative L2, less the reference's noise, of the tiers' ensembles with windows of several
widths over that with the widest, and without the filter; and seconds of the filter on
the frame and its halves. The width is chosen by `balanced` on the first folder
(`archives`): the narrowest that costs at most one per cent of error. It is judged on
the others.
"""

import dataclasses
import pathlib

import jax
import tyro

from experiments.common import errors
from experiments.common.command import Options, main
from experiments.common.errors import Row
from experiments.common.report import Report
from experiments.common.timing import medians
from experiments.ensemble.bases import measured
from jscomb import ensemble
from jscomb.denoisers import nonlocal_means
from jscomb.frame import Estimate, Frame
from jscomb.methods import TIERS
from jscomb.methods._inputs import inputs, with_inputs

FILTER, WITHOUT = "nonlocal-means", "without"
ENSEMBLES = "balanced", "best"
WIDTHS = 7, 9, 11, 13, 15, 17, 21
_WIDEST = str(WIDTHS[-1])
_COST = 1.01  # of error, at most


@dataclasses.dataclass(frozen=True)
class Config(Options):
    """What to measure.

    Attributes:
        folders: of NumPy archives or EXR frames; the first sets the width.
        results: file that results are kept in; None to keep none.
    """

    folders: tyro.conf.Positional[tuple[pathlib.Path, ...]]
    results: pathlib.Path | None = None


def measure(frame: Frame) -> dict[str, float]:
    """Errors of the ensembles of one normalised frame by width, and seconds."""
    of = lambda width: nonlocal_means.denoise_frame(frame, window=width)
    filtered = {str(width): {FILTER: of(width)} for width in WIDTHS}
    estimates, row = frame.estimates, {}
    for tier in ENSEMBLES:
        wanted = [name for name in TIERS[tier].bases if not name.startswith(FILTER)]
        names, _ = inputs(frame, biased=wanted)
        held = frame._replace(estimates=estimates)
        estimates = with_inputs(jax.random.key(0), held, names).estimates
        rest = {name: estimates[name] for name in names}
        for name, more in {WITHOUT: {}, **filtered}.items():
            row[f"{tier} {name}"] = _error(frame, rest | more)
    seconds = medians({width: lambda w=width: of(w) for width in WIDTHS}, 3)
    return row | {f"{width} s": time for width, time in seconds.items()}


def _error(frame: Frame, estimates: dict[str, Estimate]) -> float:
    """Relative L2 of an ensemble."""
    weights = ensemble.weigh_frame(frame, estimates)
    bases = ensemble.stack_estimates(estimates)
    return errors.relative_l2(ensemble.average(bases.biased, weights), frame)


def run(config: Config) -> dict[str, Row]:
    """Measure every frame.

    Args:
        config: what to measure.

    Returns:
        errors and seconds by "folder/scene samples".

    Raises:
        ValueError: if a folder holds no frame.
    """
    return measured(config.folders, measure, results=config.results, quick=config.quick)


def of_tier(rows: dict[str, Row], tier: str) -> dict[str, Row]:
    """Errors by width over those with the widest window, of one ensemble.

    Args:
        rows: by `run`.
        tier: of `ENSEMBLES`.

    Returns:
        ratios by "folder/scene samples".
    """
    names = WITHOUT, *map(str, WIDTHS)
    return {
        frame: {n: row[f"{tier} {n}"] / row[f"{tier} {_WIDEST}"] for n in names}
        for frame, row in rows.items()
    }


def report(rows: dict[str, Row]) -> Report:
    """Say what a narrow window costs and saves.

    Args:
        rows: by `run`.

    Returns:
        errors over those with the widest window, of the frames that chose the width
        and of the others.
    """
    first = next(iter(rows)).partition("/")[0]
    chosen = {n: row for n, row in rows.items() if n.partition("/")[0] == first}
    others = {n: row for n, row in rows.items() if n not in chosen}
    mean = lambda each, n: errors.geometric_mean(row[n] for row in each.values())
    said = lambda each, n: (
        f"{mean(each, n):.3f} (worst {max(r[n] for r in each.values()):.2f})"
    )
    setting = of_tier(chosen, "balanced")
    width = next(w for w in WIDTHS if mean(setting, str(w)) <= _COST)
    time = {str(w): mean(rows, f"{w} s") / mean(rows, f"{_WIDEST} s") for w in WIDTHS}
    answer = (
        f"Of {len(chosen)} frames a window of {width} pixels is the narrowest that "
        f"keeps the mean error within {_COST - 1:.0%} of that of {_WIDEST} pixels, "
        f"{said(setting, str(width))}"
    )
    parts = {f"`balanced`, {len(chosen)} frames that chose": setting}
    for tier in ENSEMBLES if others else ():
        judged = of_tier(others, tier)
        parts[f"`{tier}`, {len(others)} other frames"] = judged
        answer += (
            f"; on {len(others)} others `{tier}` has {said(judged, str(width))} of its "
            f"error, without the filter {said(judged, WITHOUT)}"
        )
    answer += f". The filter takes {time[str(width)]:.2f} of the time."
    body = "\n\n".join(
        errors.means(
            each,
            [WITHOUT, *map(str, WIDTHS)],
            lambda row: 1.0,
            title=title,
            beside={"time": lambda n: f"{time[n]:.2f}" if n in time else ""},
        )
        for title, each in parts.items()
    )
    return Report(answer, f"{body}\n")


if __name__ == "__main__":
    main(Config, run, report)
