"""How alike is the noise of neighbouring pixels under common random numbers?

Renders single samples of each scene with independent numbers, with common ones, and
with common ones in tiles. For horizontal and vertical neighbours:

    correlation   of their noise: median over pairs of pixels, and over the whole frame,
                  where the noisiest decide
    ratio         Var[difference] over the sum of both variances, likewise: the less,
                  the more the difference is worth. Independent pixels have 1.

and whether both kinds have one mean: the difference of the frames' means in units of
its standard error over passes, and the mean square of that of single pixels, which is 1
in expectation, or less where the noise is heavy-tailed.
"""

import dataclasses
import pathlib
from typing import NamedTuple

import numpy as np
import tyro
from tqdm import tqdm

from experiments.common.command import Options, main
from experiments.common.report import Report
from experiments.common.tables import table
from jscomb.rendering import SCENES, Launcher, Moments, Pass, Settings


@dataclasses.dataclass(frozen=True)
class Config(Options):
    """What to render.

    Attributes:
        scenes: names of own scenes, or XML files.
        size: width and height in pixels.
        passes: single samples a pixel of each kind.
        tile: width in pixels of the tiles.
    """

    scenes: tyro.conf.Positional[tuple[str, ...]] = SCENES
    size: int = 192
    passes: int = 256
    tile: int = 16


class Noise(NamedTuple):
    """Moments of single samples, running sums in float64 (Welford).

    Attributes:
        image: of the samples.
        across: of the difference of horizontal neighbours.
        down: of the difference of vertical neighbours.
        means: mean over the frame of each pass, [passes].
    """

    image: Moments
    across: Moments
    down: Moments
    means: np.ndarray


def noise(config: Config, scene: str, options: dict) -> Noise:
    """Render all passes of one kind."""
    launch = Launcher(scene, Settings(size=config.size, **options))
    seeds = range(len(options) * 10**6, len(options) * 10**6 + config.passes)
    moments, means = [Moments()] * 3, []
    for seed in tqdm(seeds, desc=scene, leave=False):
        image = launch(Pass("", 1, seed, "path"))
        each = image, np.diff(image, axis=1), np.diff(image, axis=0)
        moments = [m.add(i) for m, i in zip(moments, each, strict=True)]
        means.append(image.mean())
    return Noise(*moments, np.array(means))


def likeness(found: Noise) -> dict[str, float]:
    """Correlation of neighbours, and the variance of their difference."""
    v = found.image.squares
    pairs = ((found.across.squares, v[:, 1:], v[:, :-1]),
             (found.down.squares, v[1:], v[:-1]))  # fmt: skip
    d, a, b = (np.concatenate([p[k].ravel() for p in pairs]) for k in range(3))
    some = (a > 0) & (b > 0)
    d, a, b = d[some], a[some], b[some]
    covariance = (a + b - d) / 2
    return {
        "correlation, median": float(np.median(covariance / np.sqrt(a * b))),
        "correlation, frame": float(covariance.sum() / np.sqrt(a * b).sum()),
        "ratio, median": float(np.median(d / (a + b))),
        "ratio, frame": float(d.sum() / (a + b).sum()),
    }


def agreement(found: Noise, independent: Noise) -> dict[str, float]:
    """Whether two kinds have one mean."""
    error = lambda means: means.var(ddof=1) / len(means)
    away = found.means.mean() - independent.means.mean()
    image, other = found.image, independent.image
    variance = image.variance_of_mean + other.variance_of_mean
    some = variance > 0
    square = (image.mean - other.mean)[some] ** 2 / variance[some]
    return {
        "frame's mean, standard errors": float(
            away / (error(found.means) + error(independent.means)) ** 0.5
        ),
        "pixels, mean square": float(square.mean()),
    }


def run(config: Config) -> dict[str, dict[str, float]]:
    """Render and measure everything.

    Args:
        config: what to render.

    Returns:
        the numbers by "scene, kind".
    """
    chosen = config.scenes
    if config.quick:
        config = dataclasses.replace(config, size=32, passes=32)
        chosen = chosen[:1]
    tiles = {"numbers": "common", "tile": config.tile}
    rows = {}
    for scene in chosen:
        path = pathlib.Path(scene)
        name = path.parent.name if path.suffix == ".xml" else scene
        independent = noise(config, scene, {})
        rows[f"{name}, independent"] = likeness(independent)
        for kind, options in (("common", {"numbers": "common"}), ("tiles", tiles)):
            found = noise(config, scene, options)
            rows[f"{name}, {kind}"] = likeness(found) | agreement(found, independent)
    return rows


def report(rows: dict[str, dict[str, float]]) -> Report:
    """Say what was found.

    Args:
        rows: by `run`.

    Returns:
        every scene with all kinds of numbers.
    """
    common = [row for name, row in rows.items() if name.endswith(", common")]

    def span(column: str) -> str:
        each = [row[column] for row in common]
        return f"{min(each):.2f} to {max(each):.2f}"

    answer = (
        "Under common random numbers the variance of neighbours' difference is "
        f"{span('ratio, median')} of the sum of both variances (median over pixels, "
        f"{len(common)} scenes); over whole frames, where the noisiest decide, "
        f"{span('ratio, frame')}."
    )
    columns = list(list(rows.values())[-1])
    cells = [[name, *(row.get(c) for c in columns)] for name, row in rows.items()]
    return Report(answer, table(["numbers", *columns], cells))


if __name__ == "__main__":
    main(Config, run, report)
