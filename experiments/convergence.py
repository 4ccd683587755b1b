"""How fast does each combiner's error fall, and does a bad biased image harm it?

    python -m experiments.convergence RESULTS.jsonl --plot FILE.svg

Of what `experiments.sweep` measured: the slope of log error against log samples (-1 is
unbiased), by least squares over the sample counts, and the ratio to path tracing at the
last one (NJS figures 1, 8, 11, 13, 14, 16). With `--biased` frames of the sweep's work
folder are combined with a severely biased image instead: path tracing, blurred by a
15x15 box (figures 5, 6); a combiner that dominates stays below path tracing. Give these
results a file of their own: other experiments would average over both.
"""

import dataclasses
import pathlib
import sys

import matplotlib.pyplot as plt
import numpy as np
import tyro

from experiments import sweep
from experiments.combiners import combiners
from experiments.sweep import Record
from jscomb.denoisers import smoothing
from jscomb.frame import Frame, with_halves
from jscomb.numerics.tiles import compiled

BOX = 15  # pixels


@dataclasses.dataclass(frozen=True)
class Config:
    """What to read and write.

    Attributes:
        results: lines of `experiments.sweep`.
        metric: a metric of theirs that every seed has.
        biased: the sweep's work folder, to measure dominance on its frames; what is
            missing in the results is measured first.
        plot: picture to write.
        combiners: whose curves to draw; all by default.
        quick: measure the quick sweep first; with `biased`, on its frames too.
    """

    results: tyro.conf.Positional[pathlib.Path]
    metric: str = "relative L2"
    biased: pathlib.Path | None = None
    plot: pathlib.Path | None = None
    combiners: tuple[str, ...] = ()
    quick: bool = False


def blurred(frame: Frame) -> Frame:
    """The frame with path tracing blurred by a box in place of `oidn`.

    Args:
        frame: with halves.

    Returns:
        the same frame otherwise.
    """
    box = compiled(smoothing.box, window=BOX)
    return frame.with_estimate("oidn", with_halves(frame, lambda part: box(part.color)))


def measure_blurred(config: Config) -> None:
    """Add results with the blurred image to the lines.

    Args:
        config: with `biased`.
    """
    assert config.biased is not None
    swept = sweep.Config(config.biased, config.results, quick=config.quick)
    names = tuple(n for n in swept.combiners if combiners()[n].traced or n == "njs")
    if config.quick:
        names = ("path tracing", "oidn", "whitened")
    swept = dataclasses.replace(swept, combiners=names)
    sweep.run(
        swept,
        change=lambda case: case._replace(
            scene=f"{case.scene} blurred", frames=[blurred(f) for f in case.frames]
        ),
    )


def curves(
    records: list[Record], metric: str
) -> dict[str, dict[str, tuple[np.ndarray, np.ndarray]]]:
    """Sample counts and errors.

    Args:
        records: by `sweep`.
        metric: a metric of theirs.

    Returns:
        sample counts, ascending, and mean errors of all seeds, by combiner, by scene.
    """
    points: dict[str, dict[str, dict[int, float]]] = {}
    for record in records:
        if record["scale"] == 1:
            of = points.setdefault(record["scene"], {})
            error = float(np.mean(record["errors"][metric]))
            of.setdefault(record["combiner"], {})[record["spp"]] = error
    return {
        scene: {
            name: (np.array(sorted(each)), np.array([each[s] for s in sorted(each)]))
            for name, each in of.items()
        }
        for scene, of in points.items()
    }


def slope(spp: np.ndarray, errors: np.ndarray) -> float:
    """Of log error against log samples, by least squares.

    Args:
        spp: samples a pixel.
        errors: positive.

    Returns:
        the slope; NaN of a single point.
    """
    if len(spp) < 2:
        return float("nan")
    return float(np.polyfit(np.log(spp), np.log(np.maximum(errors, 1e-12)), 1)[0])


def draw(
    found: dict,
    path: pathlib.Path,
    metric: str,
    *,
    combiners: tuple[str, ...] = (),
    along: str = "samples a pixel",
) -> None:
    """Log-log curves, a panel for each scene.

    Args:
        found: abscissae and errors by combiner, by scene.
        path: picture to write.
        metric: what the error is.
        combiners: whose curves to draw; all by default.
        along: what the abscissae are.
    """
    columns = min(3, len(found))
    lines = -(-len(found) // columns)
    figure, axes = plt.subplots(
        lines,
        columns,
        figsize=(4.6 * columns, 4 * lines),
        squeeze=False,
        layout="constrained",
    )
    for ax in axes.flat[len(found) :]:
        ax.axis("off")
    for ax, (scene, of_scene) in zip(axes.flat, found.items(), strict=False):
        for number, name in enumerate(combiners or of_scene):
            style = ("-", "--", ":")[number // 10 % 3]
            lw = 2 if number < 2 else 1
            ax.loglog(*of_scene[name], style, label=name, lw=lw)
        ax.set(title=scene, xlabel=along, ylabel=metric)
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside right upper")
    figure.savefig(path, dpi=120)
    plt.close(figure)


def main() -> None:
    """Print slopes and ratios, and draw the curves."""
    config = tyro.cli(Config, description=__doc__)
    try:
        if config.biased is not None:
            measure_blurred(config)
        found = curves(sweep.results(config.results, quick=config.quick), config.metric)
    except (ValueError, OSError, ImportError, RuntimeError) as error:
        sys.exit(f"convergence: {' '.join(str(error).split())}")
    for scene, of_scene in found.items():
        print(f"\n| {scene} | slope | error / path tracing, at each count |")
        _, of_x = of_scene["path tracing"]
        for name, (spp, errors) in of_scene.items():
            ratios = " ".join(f"{r:.3f}" for r in errors / of_x)
            print(f"| {name} | {slope(spp, errors):+.2f} | {ratios} |")
    if config.plot is not None:
        draw(found, config.plot, config.metric, combiners=config.combiners)


if __name__ == "__main__":
    main()
