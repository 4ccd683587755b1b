"""With the same seconds, is it better to sample or to combine?

Of what `comparison.sweep` measured on rendered scenes. For each combiner the seconds
of a whole frame (sampling, denoising, combining) and its error, over the sample counts,
make a curve. Printed: how many times as long path tracing, and path tracing with a
denoiser, would take for the error that the combiner has at the median of its times, by
the power law between two counts; beyond the last count it is a lower bound, marked >.
"""

import dataclasses

import numpy as np

from experiments.common.command import main
from experiments.common.report import Report
from experiments.common.tables import table
from experiments.comparison.convergence import draw
from experiments.comparison.pareto import INPUTS, Config
from experiments.comparison.sweep import Record, results

Curve = tuple[np.ndarray, np.ndarray]


def curves(records: list[Record], metric: str) -> dict[str, dict[str, Curve]]:
    """Seconds and errors, ascending in seconds, by scene and combiner.

    Args:
        records: by `sweep`; archives have no time of sampling and are left out.
        metric: a metric of theirs.

    Returns:
        curves by combiner, by scene.

    Raises:
        ValueError: if nothing was rendered.
    """
    points: dict[str, dict[str, list[tuple[float, float]]]] = {}
    for record in records:
        seconds = record["seconds"]
        if record["scale"] != 1 or seconds["sampling"] is None:
            continue
        total = sum(seconds[part] for part in ("sampling", "denoising", "combining"))
        scene = points.setdefault(record["scene"], {})
        error = float(np.mean(record["errors"][metric]))
        scene.setdefault(record["combiner"], []).append((total, error))
    if not points:
        raise ValueError("no results of rendered scenes")
    return {
        scene: {name: _curve(each) for name, each in of_scene.items()}
        for scene, of_scene in points.items()
    }


def _curve(points: list[tuple[float, float]]) -> Curve:
    """Two arrays."""
    seconds, errors = np.array(sorted(points)).T
    return seconds, errors


def time_for(curve: Curve, error: float) -> tuple[float, bool]:
    """Seconds that a curve needs for an error.

    Args:
        curve: seconds and errors.
        error: to reach.

    Returns:
        the seconds, and whether they are only a lower bound: the curve does not reach
        the error.
    """
    seconds, errors = (np.log(each) for each in curve)
    falling = np.minimum.accumulate(errors)  # noise may let it rise somewhere
    if np.log(error) < falling[-1]:
        return float(np.exp(seconds[-1])), True
    found = np.interp(-np.log(error), -falling, seconds)
    return float(np.exp(found)), False


def speedups(of_scene: dict[str, Curve]) -> dict[str, dict[str, tuple[float, bool]]]:
    """How much longer each input takes for a combiner's error.

    Args:
        of_scene: curves by combiner.

    Returns:
        factor and whether it is a lower bound, by input, by combiner.
    """
    found = {}
    for name, (seconds, errors) in of_scene.items():
        middle = len(seconds) // 2
        found[name] = {}
        for given in INPUTS:
            needed, bound = time_for(of_scene[given], float(errors[middle]))
            found[name][given] = needed / float(seconds[middle]), bound
    return found


@dataclasses.dataclass(frozen=True)
class Found:
    """Curves by scene and combiner, and what was asked for."""

    curves: dict[str, dict[str, Curve]]
    config: Config


def run(config: Config) -> Found:
    """Read what was measured.

    Args:
        config: what to read.

    Returns:
        the curves.

    Raises:
        ValueError: if there are no results, or none of rendered scenes.
    """
    records = results(config.results, quick=config.quick)
    return Found(curves(records, config.metric), config)


def report(found: Found) -> Report:
    """Say how much longer the inputs take for a combiner's error.

    Args:
        found: by `run`.

    Returns:
        a table a scene, and the curves.
    """
    body, gained, every = [], {}, 0
    for scene, of_scene in found.curves.items():
        factors = speedups(of_scene)
        rows = [
            [name, *(f"{'>' if bound else ''}{f:.1f}" for f, bound in each.values())]
            for name, each in factors.items()
        ]
        body.append(table([f"{scene}: longer by", *INPUTS], rows))
        every += 1
        for name, each in factors.items():
            if name not in INPUTS and each["oidn"][0] > 1:
                gained[name] = gained.get(name, 0) + 1
    said = ", ".join(f"{name} in {number}" for name, number in gained.items())
    answer = (
        f"For the error at the median of its times, path tracing with a denoiser takes "
        f"longer than these, of {every} scenes: {said or 'none'}."
    )
    chosen = {"combiners": found.config.combiners, "along": "seconds"}
    plot = draw(found.curves, found.config.metric, **chosen)
    return Report(answer, "\n\n".join(body), {"Seconds against error": plot})


if __name__ == "__main__":
    main(Config, run, report)
