"""Do photon mapping's means agree with path tracing's as the radius shrinks?

Passes of one fixed radius each, for several radii, and as many path-traced passes. For
each radius: the difference of the frames' means, relative, with its standard error over
passes; and over the blocks that a grid cuts the frame into (those that hold a lamp left
out, whose edges are all noise) the largest relative difference, and the mean square of
differences in units of their standard errors, which is 1 where there is no bias.
"""

import dataclasses
from collections.abc import Callable

import numpy as np
import tyro
from tqdm import tqdm

from experiments.common.command import Options, main
from experiments.common.report import Report
from experiments.common.tables import table
from jscomb.rendering import PHOTONS, Launcher, Pass, Settings


@dataclasses.dataclass(frozen=True)
class Config(Options):
    """What to render.

    Attributes:
        scenes: names of own scenes, or XML files.
        radii: in the scene's unit.
        size: width and height in pixels.
        passes: of photons, for each radius.
        photons: in each pass.
        spp: samples a pixel of a path-traced pass; there are as many passes.
        blocks: along one side of the frame.
    """

    scenes: tyro.conf.Positional[tuple[str, ...]] = ("cornell-box", "cornell-glass")
    radii: tuple[float, ...] = (0.16, 0.08, 0.04, 0.02)
    size: int = 64
    passes: int = 64
    photons: int = 200_000
    spp: int = 64
    blocks: int = 8


def block_means(image: np.ndarray, blocks: int) -> np.ndarray:
    """Means over channels and over blocks, [blocks,blocks]."""
    side = image.shape[0] // blocks
    cut = image[: side * blocks, : side * blocks].mean(axis=-1)
    return cut.reshape(blocks, side, blocks, side).mean(axis=(1, 3))


def compare(photons: np.ndarray, traced: np.ndarray) -> dict[str, float]:
    """Means of passes [P,B,B] of both kinds against each other."""
    frame = [i.mean(axis=(1, 2)) for i in (photons, traced)]
    error = lambda i: i.var(axis=0, ddof=1) / len(i)
    level = traced.mean(axis=0)
    dark = level < 3 * np.median(level)
    away = photons.mean(axis=0) - level
    noise = np.sqrt(error(photons) + error(traced))
    some = dark & (noise > 0)
    return {
        "frame": (frame[0].mean() - frame[1].mean()) / frame[1].mean(),
        "its error": sum(map(error, frame)) ** 0.5 / frame[1].mean(),
        "worst block": abs(away / level)[some].max(),
        "blocks, mean square": ((away / noise)[some] ** 2).mean(),
    }


def run(config: Config) -> dict[str, dict[str, float]]:
    """Render and compare everything.

    Args:
        config: what to render.

    Returns:
        a row for each "scene, radius".
    """
    radii = config.radii
    if config.quick:
        config = dataclasses.replace(config, size=16, passes=8, photons=5000, blocks=4)
        radii = radii[:1]
    rows = {}
    for scene in config.scenes:
        settings = Settings(size=config.size, photons=config.photons, radius=radii[0])
        launch = Launcher(scene, settings)

        def means(make: Callable[[int], np.ndarray], name: str = scene) -> np.ndarray:
            numbers = tqdm(range(config.passes), desc=name, leave=False)
            return np.stack([block_means(make(k), config.blocks) for k in numbers])

        traced = means(lambda k, f=launch: f(Pass("", config.spp, k, "path")))
        for radius in radii:
            first = Pass("", 1, 10**8, PHOTONS, radius / radii[0])
            photons = means(
                lambda k, f=launch, p=first: f(p._replace(seed=p.seed + k))[..., :3]
            )
            rows[f"{scene}, {radius:g}"] = compare(photons, traced)
    return rows


def report(rows: dict[str, dict[str, float]]) -> Report:
    """Say what was found.

    Args:
        rows: by `run`.

    Returns:
        the differences of every scene and radius.
    """
    columns = list(next(iter(rows.values())))
    away = [abs(row["frame"]) / row["its error"] for row in rows.values()]
    last = [name.rpartition(", ") for name in rows]
    least = min(float(radius) for *_, radius in last)
    small = {n: r for n, r in rows.items() if float(n.rpartition(", ")[2]) == least}
    blocks = ", ".join(
        f"{row['blocks, mean square']:.2f} ({name.rpartition(', ')[0]})"
        for name, row in small.items()
    )
    answer = (
        f"The frame's mean is within {max(away):.1f} standard errors of path tracing's "
        f"at all radii of {len(small)} scenes; that of blocks differs, at the smallest "
        f"radius, by a mean square of {blocks} in units of its variance."
    )
    cells = [[name, *(row[c] for c in columns)] for name, row in rows.items()]
    return Report(answer, table(["scene, radius", *columns], cells))


if __name__ == "__main__":
    main(Config, run, report)
