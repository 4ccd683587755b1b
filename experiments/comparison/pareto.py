"""Which combiner, at what cost?

Of what `comparison.sweep` measured. Cost: combining, and the denoised images that it
takes, in units of the time of one denoising by Open Image Denoise in the same run.
Error: relative L2 divided by that of the better of path tracing and the denoised image;
geometric mean over scenes, seeds averaged before. On the front is what nothing cheaper
is as good as; costs within a tenth are equal. A combiner that was told the variance
times a factor is another setting.
"""

import dataclasses
import pathlib
from typing import NamedTuple

import matplotlib.pyplot as plt
import numpy as np
import tyro
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from experiments.common import tables
from experiments.common.command import Options, main
from experiments.common.errors import geometric_mean
from experiments.common.report import Report
from experiments.comparison.sweep import Record, results

INPUTS = ("path tracing", "oidn")
_TIMES = ", variance x "
_WORST = 1.6  # of the plot
_EQUAL = 1.1  # times on a shared machine differ as much


@dataclasses.dataclass(frozen=True)
class Config(Options):
    """What to read.

    Attributes:
        results: lines of `experiments.comparison.sweep`.
        metric: a metric of theirs that every seed has.
        combiners: whose points or curves to draw; all by default.
    """

    results: tyro.conf.Positional[pathlib.Path]
    metric: str = "relative L2"
    combiners: tuple[str, ...] = ()


class Row(NamedTuple):
    """A combiner.

    Attributes:
        errors: ratio to the better input by sample count, geometric mean over scenes.
        mean: of all cases, geometric.
        worst: of all cases.
        cost: in denoisings, median over cases.
        front: whether nothing cheaper is as good.
    """

    errors: dict[int, float]
    mean: float
    worst: float
    cost: float
    front: bool = False


def rows_of(records: list[Record], metric: str) -> dict[str, Row]:
    """A row for every combiner that was measured in every case.

    Args:
        records: by `sweep`, of any cases.
        metric: a metric of theirs.

    Returns:
        rows by combiner.

    Raises:
        ValueError: if an input was not measured in some case.
    """
    cases: dict[tuple[str, int], dict[str, Record]] = {}
    for record in records:
        case = cases.setdefault((record["scene"], record["spp"]), {})
        case[_setting(record)] = record
    for case, found in cases.items():
        if missing := set(INPUTS) - found.keys():
            raise ValueError(f"{case} has no results of {', '.join(sorted(missing))}")
    names = [
        n for n in next(iter(cases.values())) if all(n in c for c in cases.values())
    ]
    rows = {}
    for name in names:
        ratios, costs = {}, []
        for case, found in cases.items():
            of = lambda n, found=found: float(np.mean(found[n]["errors"][metric]))
            ratios[case] = of(name) / min(of(i) for i in INPUTS)
            seconds = found[name]["seconds"]
            unit = found["oidn"]["seconds"]["denoising"]
            costs.append((seconds["denoising"] + seconds["combining"]) / unit)
        above = {case: max(ratio, 1e-12) for case, ratio in ratios.items()}
        by_spp = {
            spp: geometric_mean(v for (_, s), v in above.items() if s == spp)
            for spp in sorted({spp for _, spp in cases})
        }
        mean, worst = geometric_mean(above.values()), max(ratios.values())
        rows[name] = Row(by_spp, mean, worst, float(np.median(costs)))
    return _with_front(rows)


def _setting(record: Record) -> str:
    """The combiner, and what the variance was multiplied by."""
    name, scale = record["combiner"], record["scale"]
    return name if scale == 1 or name in INPUTS else f"{name}{_TIMES}{scale:g}"


def _with_front(rows: dict[str, Row]) -> dict[str, Row]:
    """Mark what nothing cheaper is as good as."""
    better = lambda a, b: (
        (a.cost <= _EQUAL * b.cost and a.mean < b.mean)
        or (_EQUAL * a.cost < b.cost and a.mean <= b.mean)
    )
    return {
        name: row._replace(front=not any(better(r, row) for r in rows.values()))
        for name, row in rows.items()
    }


def draw(
    rows: dict[str, Row], metric: str, *, combiners: tuple[str, ...] = ()
) -> Figure:
    """Cost against error, the front marked.

    Of settings with another variance only those on the front have names. What is worse
    than `_WORST` is drawn there, with its error.

    Args:
        rows: by `rows_of`.
        metric: what the error is.
        combiners: whose points to draw; all by default.

    Returns:
        the plot.
    """
    figure, axes = plt.subplots(figsize=(9, 6), layout="constrained")
    shown = {
        name: row
        for name, row in rows.items()
        if name != "path tracing" and name.split(_TIMES)[0] in (combiners or rows)
    }
    front = sorted((r for r in shown.values() if r.front), key=lambda row: row.cost)
    axes.plot([r.cost for r in front], [r.mean for r in front], "C1--", zorder=1)
    beside = []
    for name, row in shown.items():
        place = row.cost, min(row.mean, _WORST)
        named = row.front or _TIMES not in name
        color = "C1" if row.front else "C0" if named else "0.8"
        axes.plot(*place, "o" if row.mean < _WORST else "^", color=color)
        name += "" if row.mean < _WORST else f" ({row.mean:.1f})"
        if named and row.cost < 1.2:
            beside.append((place, name))
        elif named:
            axes.annotate(name, place, (4, 4), textcoords="offset points", fontsize=8)
    _annotate_beside(axes, beside)
    axes.axhline(1, color="0.7", zorder=0)
    dearest = max(row.cost for row in shown.values())
    axes.set(xscale="log", xlabel="cost in denoisings", xlim=(0.4, 2 * dearest))
    axes.set(ylabel=f"{metric} / that of the better input")
    return figure


def _annotate_beside(axes: Axes, points: list[tuple[tuple[float, float], str]]) -> None:
    """Names in a column to the left: many combiners cost hardly more than denoising."""
    for number, (place, name) in enumerate(sorted(points, key=lambda p: p[0][1])):
        axes.annotate(
            name,
            place,
            (0.02, (number + 1) / (len(points) + 1)),
            textcoords="axes fraction",
            fontsize=8,
            va="center",
            arrowprops={"arrowstyle": "-", "lw": 0.4, "color": "0.6"},
        )


@dataclasses.dataclass(frozen=True)
class Found:
    """Rows by combiner, and what was asked for."""

    rows: dict[str, Row]
    config: Config


def run(config: Config) -> Found:
    """Read what was measured.

    Args:
        config: what to read.

    Returns:
        a row for each combiner.

    Raises:
        ValueError: if there are no results, or an input is not among them.
    """
    records = results(config.results, quick=config.quick)
    return Found(rows_of(records, config.metric), config)


def report(found: Found) -> Report:
    """Say what is on the front.

    Args:
        found: by `run`.

    Returns:
        a line a combiner, and cost against error.
    """
    rows, metric = found.rows, found.config.metric
    front = sorted((n for n in rows if rows[n].front), key=lambda n: rows[n].cost)
    said = [
        f"{n} {rows[n].mean:.2f} (worst {rows[n].worst:.2f}) for {rows[n].cost:.2g}"
        for n in front
    ]
    answer = (
        f"{metric} divided by the better input's, geometric mean, for a cost in "
        f"denoisings; on the front: {'; '.join(said)}."
    )
    counts = list(next(iter(rows.values())).errors)
    body = tables.table(
        [f"{metric} / better input", *counts, "mean", "worst", "cost", "front"],
        [
            [n, *r.errors.values(), r.mean, r.worst, r.cost, "yes" if r.front else None]
            for n, r in rows.items()
        ],
    )
    plot = draw(rows, metric, combiners=found.config.combiners)
    return Report(answer, body, {"Cost against error": plot})


if __name__ == "__main__":
    main(Config, run, report)
