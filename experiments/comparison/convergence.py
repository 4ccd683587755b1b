"""How fast does each combiner's error fall, and does a bad biased image harm it?

Of what `comparison.sweep` measured: the slope of log error against log samples (-1 is
unbiased), by least squares over the sample counts, and the ratio to path tracing at the
last one: curves as in NJS figure 1, of the combiners that the sweep measured, with Open
Image Denoise in place of the paper's denoisers. Not its ensembles first (figure 14),
NFOR's outputs for y* (16) or other integrators (18). With `--biased` frames of the
sweep's work folder are combined with a severely biased image instead: path tracing,
blurred by a 15x15 box (figures 5, 6); a combiner that dominates stays below path
tracing. Give these results a file of their own: other experiments would average over
both.
"""

import dataclasses
import pathlib

import matplotlib.pyplot as plt
import numpy as np
import tyro
from matplotlib.figure import Figure

from experiments.common.command import Options, main
from experiments.common.report import Report
from experiments.common.tables import table
from experiments.comparison import sweep
from experiments.comparison.combiners import combiners
from experiments.comparison.sweep import Record
from jscomb.denoisers import smoothing
from jscomb.frame import Frame, with_halves
from jscomb.numerics.tiles import compiled

BOX = 15  # pixels


@dataclasses.dataclass(frozen=True)
class Config(Options):
    """What to read.

    Attributes:
        results: lines of `experiments.comparison.sweep`.
        metric: a metric of theirs that every seed has.
        biased: the sweep's work folder, to measure dominance on its frames; what is
            missing in the results is measured first.
        scenes: with `biased`, as the sweep's.
        spp: with `biased`, as the sweep's.
        seeds: with `biased`, as the sweep's.
        combiners: whose curves to draw; all by default.
    """

    results: tyro.conf.Positional[pathlib.Path]
    metric: str = "relative L2"
    biased: pathlib.Path | None = None
    scenes: tuple[str, ...] = sweep.Config.scenes
    spp: tuple[int, ...] = sweep.Config.spp
    seeds: int = sweep.Config.seeds
    combiners: tuple[str, ...] = ()


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
    swept = sweep.Config(
        config.biased,
        config.results,
        scenes=config.scenes,
        spp=config.spp,
        seeds=config.seeds,
        quick=config.quick,
    )
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
    metric: str,
    *,
    combiners: tuple[str, ...] = (),
    along: str = "samples a pixel",
) -> Figure:
    """Log-log curves, a panel for each scene.

    Args:
        found: abscissae and errors by combiner, by scene.
        metric: what the error is.
        combiners: whose curves to draw; all by default.
        along: what the abscissae are.

    Returns:
        the plot.
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
    return figure


@dataclasses.dataclass(frozen=True)
class Found:
    """Curves by scene and combiner, and what was asked for."""

    curves: dict[str, dict[str, tuple[np.ndarray, np.ndarray]]]
    config: Config


def run(config: Config) -> Found:
    """Read what was measured; with `biased` measure what is missing first.

    Args:
        config: what to read.

    Returns:
        the curves.

    Raises:
        ValueError: if there are no results.
    """
    if config.biased is not None:
        measure_blurred(config)
    records = sweep.results(config.results, quick=config.quick)
    return Found(curves(records, config.metric), config)


def report(found: Found) -> Report:
    """Say how fast errors fall, and where they stay below path tracing's.

    Args:
        found: by `run`.

    Returns:
        a table a scene: slopes, and ratios to path tracing; and the curves.
    """
    body, below, slopes = [], 0, []
    for scene, of_scene in found.curves.items():
        counts, of_x = of_scene["path tracing"]
        rows = []
        for name, (spp, errors) in of_scene.items():
            rows.append([name, slope(spp, errors), *map(float, errors / of_x)])
            if name != "path tracing":
                slopes.append(slope(spp, errors))
                below += bool(np.all(errors < of_x))
        body.append(table([f"{scene}: error / path tracing", "slope", *counts], rows))
    tracing = [slope(*each["path tracing"]) for each in found.curves.values()]
    answer = (
        f"The {found.config.metric} falls as samples to the power of "
        f"{np.mean(tracing):.2f} for path tracing, {min(slopes):.2f} to "
        f"{max(slopes):.2f} for what combines; of "
        f"{len(slopes)} combiners and scenes {below} stay below path tracing at every "
        "sample count."
    )
    plot = draw(found.curves, found.config.metric, combiners=found.config.combiners)
    return Report(answer, "\n\n".join(body), {"Samples against error": plot})


if __name__ == "__main__":
    main(Config, run, report)
