"""What are uncorrelated kernels worth on rendered scenes, and what do they cost?

Every SCENES/NAME/scene.xml with a REFERENCES/NAME.npz (`archives`) is rendered: four
sub-averages of independent and four of common random numbers, and four more independent
ones for the methods that have no use for common numbers, so that all spend the same.

    error    relative L2, less the reference's noise, of each method divided by that of
             path tracing with all samples independent; and of every gamma chosen.
    windows  that of uncorrelated kernels for several windows, with the time of choosing
             gamma and of combining, divided by that of as many exponentials as the
             combination has to make (one for each pixel, neighbour and channel).
"""

import dataclasses
import functools
import pathlib
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from tqdm import tqdm

from experiments.common.command import Options, main
from experiments.common.errors import geometric_mean, relative_l2
from experiments.common.report import Report
from experiments.common.results import Results
from experiments.common.tables import table
from experiments.common.timing import medians
from jscomb import rendering, uncorrelated
from jscomb.denoisers import oidn
from jscomb.frame import Frame, Reference
from jscomb.numerics.poisson import reconstruct
from jscomb.rendering import Settings
from jscomb.typing import Image

SAMPLES = 64, 256  # of each kind
COMMON_SEED = 1_000_000
_EXPONENTIALS = 256, 64 * 64 * 3  # turns, and numbers in cache


@dataclasses.dataclass(frozen=True)
class Config(Options):
    """What to render and to measure.

    Attributes:
        scenes: folder of folders with a Mitsuba scene.xml each.
        references: folder of archives with references of the same names.
        work: folder that keeps what is rendered, and the results.
        repeats: timed calls of each function.
        size: side of the image that is timed.
        windows: widths in pixels.
    """

    scenes: tyro.conf.Positional[pathlib.Path]
    references: tyro.conf.Positional[pathlib.Path]
    work: tyro.conf.Positional[pathlib.Path]
    repeats: int = 5
    size: int = 512
    windows: tuple[int, ...] = (7, 11, 15, 21)


FORMS = {
    "of y": {"guides": "independent"},
    "of both": {"guides": "both"},
    "a gamma a region": {"region": 65},
}


def frame_pair(
    scene: pathlib.Path, samples: int, reference: Reference, work: pathlib.Path
) -> tuple[Frame, Frame]:
    """Frames of independent and common random numbers, or what a run has left of them.

    Args:
        scene: the XML file.
        samples: samples a pixel of common numbers; there are twice as many independent.
        reference: of the scene; says the size.
        work: folder for them.

    Returns:
        eight sub-buffers with the reference, and four, of equally many samples.
    """
    height, width, _ = reference.image.shape
    each = []
    for kind, buffers, seed in (("independent", 8, 0), ("common", 4, COMMON_SEED)):
        settings = Settings(
            spp=samples * buffers // 4,
            width=width,
            height=height,
            buffers=buffers,
            numbers=kind,
            seed=seed,
        )
        partial = work / f"{scene.parent.name}-{samples}-{kind}.npz"
        each.append(rendering.render(f"{scene}", settings, partial=partial))
    return each[0]._replace(reference=reference), each[1]


def first_half(frame: Frame) -> Frame:
    """The first half of a frame's sub-buffers: what is combined."""
    return frame.halves()[0]


def with_gradients(independent: Image, correlated: Image) -> Image:
    """L2 reconstruction from differences of correlated estimates."""
    differences = (jnp.diff(correlated, axis=axis) for axis in (1, 0))
    return reconstruct(independent, *differences)


def measure(independent: Frame, correlated: Frame, windows: tuple[int, ...]) -> dict:
    """Errors of all methods, and every gamma."""
    every = independent.normalised()
    z_frame = correlated.normalised(every.unit)
    y_frame = first_half(every)
    assert y_frame.samples is not None
    y, z, n = y_frame.buffers.color, z_frame.buffers.color, y_frame.samples / 4
    images = {
        "path tracing": every.color,
        "oidn": oidn.denoise_frame(every).image,
        "common numbers": z_frame.color,
        "both": (y_frame.color + z_frame.color) / 2,
        "uniform": uncorrelated.combine_uniform(y, z),
    }
    gammas = {}
    select = jax.jit(uncorrelated.select_gamma, static_argnames=("stride", "crosswise"))
    gammas["crosswise"] = select(y, z, n, crosswise=True)
    images["crosswise"] = jax.jit(uncorrelated.combine_crosswise)(
        y, z, gammas["crosswise"], n
    )
    for window in windows:
        name = f"uncorrelated {window}x{window}"
        images[name] = uncorrelated.combine_frame(y_frame, z_frame, window=window).image
        gammas[name] = uncorrelated.select_gamma_frame(y_frame, z_frame, window=window)
    for name, form in FORMS.items():
        made = uncorrelated.combine_frame(y_frame, z_frame, **form)
        images[f"uncorrelated, {name}"] = made.image
    gammas["uncorrelated, all rows judged"] = select(y, z, n, stride=1)
    solve = jax.jit(jax.vmap(with_gradients))
    images["L2"] = solve(y_frame.color[None], z_frame.color[None])[0]
    z_l2 = solve(y, z)
    gammas["L2, uncorrelated"] = select(y, z_l2, n)
    images["L2, uncorrelated"] = jax.jit(uncorrelated.combine_decorrelated)(
        y, z_l2, gammas["L2, uncorrelated"], n
    )
    error = functools.partial(relative_l2, frame=every)
    halves = [jnp.mean(i.reshape(2, 2, *i.shape[1:]), axis=1) for i in (y, z)]
    combine = jax.jit(uncorrelated.combine)
    by_gamma = {
        f"{m * uncorrelated.UNIT:g}": error(
            combine(*halves, m * uncorrelated.UNIT, 2 * n)
        )
        for m in uncorrelated.MULTIPLES
    }
    return {
        "error": {name: error(image) for name, image in images.items()},
        "gamma": {name: float(gamma) for name, gamma in gammas.items()},
        "error by gamma": by_gamma,
    }


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
        turn = lambda _, x: 0.999 * x + 1e-3 * jnp.exp(-x)
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
        row = rows.setdefault(f"{window}x{window}", {"exponential, ns": 1e9 * one})
        row[f"{part}, ns a pixel and neighbour"] = 1e9 * seconds / pairs
        row[f"{part} / exponentials"] = seconds / (3 * pairs * one)
    return rows


def run(config: Config) -> dict:
    """Render and measure everything.

    Args:
        config: what, and where to keep it.

    Returns:
        `frames`: errors and gammas by "scene samples"; `speed`: a row for each window.

    Raises:
        ValueError: if no scene has a reference.
    """
    paths = sorted(config.scenes.glob("*/scene.xml"))
    paths = [p for p in paths if (config.references / f"{p.parent.name}.npz").exists()]
    if not paths:
        raise ValueError(
            f"no scene in {config.scenes} has an archive in {config.references}"
        )
    kept, found = Results(config.work / "results.jsonl"), {}
    todo = [(path, samples) for samples in SAMPLES for path in paths]
    windows = config.windows
    if config.quick:
        todo, windows = [(paths[0], 8)], windows[:1]
    config.work.mkdir(parents=True, exist_ok=True)

    def measured(path: pathlib.Path, samples: int) -> dict:
        with np.load(config.references / f"{path.parent.name}.npz") as data:
            both = data["reference"], data["reference_half_difference"]
        reference = Reference(*map(jnp.asarray, both))
        return measure(*frame_pair(path, samples, reference, config.work), windows)

    for path, samples in tqdm(todo, unit="frame"):
        name = f"{path.parent.name} {samples}"
        make = functools.partial(measured, path, samples)
        found[name] = kept.get(f"{name} {windows}", make)
    size, repeats = (64, 1) if config.quick else (config.size, config.repeats)
    return {"frames": found, "speed": speed(size, windows, repeats)}


def report(found: dict) -> Report:
    """Say what was found.

    Args:
        found: by `run`.

    Returns:
        errors, gammas and times.
    """
    rows, times = found["frames"], found["speed"]
    ratios = {
        method: [r["error"][method] / r["error"]["path tracing"] for r in rows.values()]
        for method in next(iter(rows.values()))["error"]
    }
    windows = [f"uncorrelated {window}" for window in times]
    span = lambda each: (
        f"{geometric_mean(each):.2f} ({min(each):.2f} to {max(each):.2f})"
    )
    said = ", ".join(
        f"{span(ratios[w])} with windows of {window}"
        for w, window in zip(windows, times, strict=True)
    )
    default = times.get("15x15", next(iter(times.values())))
    combine, select = (default[f"{n} / exponentials"] for n in ("combine", "select"))
    answer = (
        f"At equal samples uncorrelated kernels have, of path tracing's relative L2 "
        f"(geometric mean of {len(rows)} frames), {said}; Open Image Denoise has "
        f"{geometric_mean(ratios['oidn']):.2f}. Combining takes {combine:.2f} times as "
        f"long as its exponentials alone, choosing gamma {select / combine:.1f} times "
        "as long as combining."
    )
    tables = [
        table(
            ["error / path tracing", *rows, "mean"],
            [[m, *each, geometric_mean(each)] for m, each in ratios.items()],
        )
    ]
    for kind in ("gamma", "error by gamma"):
        names = next(iter(rows.values()))[kind]
        cells = [[name, *(r[kind][name] for r in rows.values())] for name in names]
        tables.append(table([kind, *rows], cells))
    columns = list(next(iter(times.values())))
    cells = [[w, *(row[c] for c in columns)] for w, row in times.items()]
    tables.append(table(["window", *columns], cells))
    return Report(answer, "\n\n".join(tables))


if __name__ == "__main__":
    main(Config, run, report)
