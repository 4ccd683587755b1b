"""With the same seconds, is it better to sample or to combine?

    python -m experiments.equal_time RESULTS.jsonl --plot FILE.svg

Of what `experiments.sweep` measured on rendered scenes. For each combiner the seconds
of a whole frame (sampling, denoising, combining) and its error, over the sample counts,
make a curve. Printed: how many times as long path tracing, and path tracing with a
denoiser, would take for the error that the combiner has at the median of its times, by
the power law between two counts; beyond the last count it is a lower bound, marked >.
"""

import sys

import numpy as np
import tyro

from experiments.convergence import draw
from experiments.pareto import INPUTS, Config
from experiments.sweep import Record, results

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


def main() -> None:
    """Print the table, and draw the curves."""
    config = tyro.cli(Config, description=__doc__)
    try:
        found = curves(results(config.results, quick=config.quick), config.metric)
    except (ValueError, OSError, ImportError, RuntimeError) as error:
        sys.exit(f"equal_time: {' '.join(str(error).split())}")
    for scene, of_scene in found.items():
        print(f"\n| {scene} | {' | '.join(INPUTS)} |")
        for name, factors in speedups(of_scene).items():
            cells = [f"{'>' if b else ''}{f:.1f}" for f, b in factors.values()]
            print(f"| {name} | {' | '.join(cells)} |")
    if config.plot is not None:
        chosen = {"combiners": config.combiners, "along": "seconds"}
        draw(found, config.plot, config.metric, **chosen)


if __name__ == "__main__":
    main()
