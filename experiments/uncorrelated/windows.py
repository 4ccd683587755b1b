"""What windows should uncorrelated kernels have, and what do these cost?

The scenes of `error`, with its samples, on films of the reference's size and of half of
it in each direction: is it pixels or the share of the image that counts?

    windows  relative L2 of uncorrelated kernels, less the reference's noise, over that
             of path tracing with as many samples, all independent
    time     of choosing gamma and of combining, divided by that of as many exponentials
             as combining has to make (one for each pixel, neighbour and channel)
"""

import dataclasses
import functools
import pathlib
from collections.abc import Callable

import jax
import tyro
from tqdm import tqdm

from experiments.common.command import Options, main
from experiments.common.errors import geometric_mean, relative_l2
from experiments.common.report import Report
from experiments.common.results import Results
from experiments.common.tables import table
from experiments.common.timing import medians
from experiments.uncorrelated import rendered
from experiments.uncorrelated.error import SAMPLES
from jscomb import uncorrelated
from jscomb.frame import Frame

SHRINKS = {"the reference's size": 1, "half of it": 2}
_EXPONENTIALS = 256, 64 * 64 * 3  # turns, and numbers in cache


@dataclasses.dataclass(frozen=True)
class Config(Options):
    """What to render and to measure.

    Attributes:
        scenes: folder of folders with a Mitsuba scene.xml each.
        references: folder of archives with references of the same names.
        work: folder that keeps what is rendered, as of `error`, and the results.
        samples: samples a pixel of each kind, multiples of eight.
        windows: widths in pixels.
        repeats: timed calls of each function.
        size: side of the image that is timed.
    """

    scenes: tyro.conf.Positional[pathlib.Path]
    references: tyro.conf.Positional[pathlib.Path]
    work: tyro.conf.Positional[pathlib.Path]
    samples: tuple[int, ...] = SAMPLES
    windows: tuple[int, ...] = (5, 7, 11, 15, 21, 31)
    repeats: int = 3
    size: int = 256


def measure(
    every: Frame, z_frame: Frame, windows: tuple[int, ...]
) -> dict[str, dict[str, float]]:
    """Error by window, over path tracing's, and gamma, of a pair of frames."""
    y_frame, _ = every.halves()
    y, z = y_frame.merged(4), z_frame.merged(4)
    traced = relative_l2(every.color, every)
    found: dict[str, dict[str, float]] = {"error": {}, "gamma": {}}
    for window in windows:
        options = {"window": window}
        image = uncorrelated.combine_frame(y, z, **options).image
        gamma = uncorrelated.select_gamma_frame(y, z, **options)
        found["error"][f"{window}"] = relative_l2(image, every) / traced
        found["gamma"][f"{window}"] = float(gamma)
    return found


def speed(
    size: int, windows: tuple[int, ...], repeats: int
) -> dict[str, dict[str, float]]:
    """Seconds of each window's parts, and of the exponentials they need at least."""
    keys = jax.random.split(jax.random.key(0), 3)
    y, z = (jax.random.normal(key, (4, size, size, 3)) for key in keys[:2])
    turns, count = _EXPONENTIALS
    numbers = jax.random.uniform(keys[2], (count,))

    @jax.jit
    def exponentials(numbers: jax.Array) -> jax.Array:
        turn = lambda _, x: 0.999 * x + 1e-3 * jax.numpy.exp(-x)
        return jax.lax.fori_loop(0, turns, turn, numbers)

    calls: dict[str, Callable] = {"exponentials": lambda: exponentials(numbers)}
    combine = jax.jit(uncorrelated.combine, static_argnames="window")
    select = jax.jit(uncorrelated.select_gamma, static_argnames=("window", "stride"))
    uniform = jax.jit(uncorrelated.combine_uniform, static_argnames="window")
    for w in windows:
        of = functools.partial
        calls[f"{w} uniform"] = of(uniform, y[:2], z[:2], window=w)
        calls[f"{w} combine"] = of(combine, y[:2], z[:2], 1.0, 8.0, window=w)
        calls[f"{w} select"] = of(select, y, z, 8.0, window=w)
        calls[f"{w} select, all rows"] = of(select, y, z, 8.0, window=w, stride=1)
    found = medians(calls, repeats)
    one = found.pop("exponentials") / (turns * count)
    rows: dict[str, dict[str, float]] = {}
    for name, seconds in found.items():
        window, _, part = name.partition(" ")
        pairs = size**2 * int(window) ** 2
        row = rows.setdefault(window, {"exponential, ns": 1e9 * one})
        row[f"{part}, ns a pixel and neighbour"] = 1e9 * seconds / pairs
        row[f"{part} / exponentials"] = seconds / (3 * pairs * one)
    return rows


def run(config: Config) -> dict:
    """Render and measure everything.

    Args:
        config: what, and where to keep it.

    Returns:
        `films`: by film, errors and gammas by "scene samples"; `speed`: a row for each
        window.

    Raises:
        ValueError: if no scene has a reference.
    """
    paths = rendered.scene_files(config.scenes, config.references)
    todo, windows = rendered.named(paths, config.samples), config.windows
    size, repeats = config.size, config.repeats
    if config.quick:
        todo, windows = rendered.named(paths[:1], (8,)), windows[:2]
        size, repeats = 32, 1
    kept = Results(config.work / "windows.jsonl")
    config.work.mkdir(parents=True, exist_ok=True)

    def measured(path: pathlib.Path, samples: int, shrink: int) -> dict:
        reference = rendered.read_reference(path, config.references, shrink)
        pair = rendered.frame_pair(path, samples, reference, config.work)
        return measure(*pair, windows)

    films = {
        film: {
            name: kept.get(
                f"{name} {shrink} {windows}",
                functools.partial(measured, *each, shrink),
            )
            for name, each in tqdm(todo.items(), unit="frame", desc=film)
        }
        for film, shrink in SHRINKS.items()
    }
    times = kept.get(f"{size} {windows}", lambda: speed(size, windows, repeats))
    return {"films": films, "speed": times}


def report(found: dict) -> Report:
    """Say what was found.

    Args:
        found: by `run`.

    Returns:
        errors by film and window, the worst, and times.
    """
    films, times = found["films"], found["speed"]
    windows = list(times)
    mean = {
        film: {
            w: geometric_mean(row["error"][w] for row in rows.values()) for w in windows
        }
        for film, rows in films.items()
    }

    def said(film: str, errors: dict[str, float]) -> str:
        best = min(errors, key=lambda w: errors[w])
        each = ", ".join(f"{w}: {error:.3f}" for w, error in errors.items())
        return f"on a film of {film} the best are {best} pixels wide ({each})"

    default = times.get("15", next(iter(times.values())))
    combine, select = (default[f"{n} / exponentials"] for n in ("combine", "select"))
    answer = (
        "Windows by relative L2 over path tracing's, geometric mean of "
        f"{len(next(iter(films.values())))} frames: "
        f"{'; '.join(said(*each) for each in mean.items())}. Combining takes "
        f"{combine:.2f} times as long as its exponentials alone, choosing gamma "
        f"{select / combine:.1f} times as long as combining."
    )
    tables = []
    for film, rows in films.items():
        header = [f"error, {film}", *rows, "mean", "worst"]
        cells = []
        for w in windows:
            each = [row["error"][w] for row in rows.values()]
            cells.append([w, *each, geometric_mean(each), max(each)])
        tables.append(table(header, cells))
    columns = list(next(iter(times.values())))
    cells = [[w, *(row[c] for c in columns)] for w, row in times.items()]
    tables.append(table(["window", *columns], cells))
    return Report(answer, "\n\n".join(tables))


if __name__ == "__main__":
    main(Config, run, report)
