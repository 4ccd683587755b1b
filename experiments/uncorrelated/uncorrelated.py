"""What are uncorrelated kernels worth on rendered scenes, and what do they cost?

    python -m experiments.uncorrelated.uncorrelated SCENES REFERENCES OUT

Every SCENES/NAME/scene.xml with a REFERENCES/NAME.npz (see `frames`) is rendered into
OUT: four sub-averages of independent and four of common random numbers, and four more
independent ones for the methods that have no use for common numbers, so that all spend
the same. Two tables:

    error    relative L2, less the reference's noise, of each method divided by that of
             path tracing with all samples independent; and of every gamma chosen.
    windows  that of uncorrelated kernels for several windows, with the time of choosing
             gamma and of combining, divided by that of as many exponentials as the
             combination has to make (one for each pixel, neighbour and channel).
"""

import dataclasses
import functools
import json
import pathlib
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from tqdm import tqdm

from experiments.common.timing import medians
from jscomb import exr, uncorrelated
from jscomb.cli import render_file
from jscomb.frame import Frame, Reference
from jscomb.metrics import rel_l2
from jscomb.numerics.poisson import reconstruct
from jscomb.rendering import Settings
from jscomb.typing import Image

SAMPLES = 64, 256  # of each kind
COMMON_SEED = 1_000_000
_EXPONENTIALS = 256, 64 * 64 * 3  # turns, and numbers in cache


@dataclasses.dataclass(frozen=True)
class Config:
    """What to render and to measure.

    Attributes:
        scenes: folder of folders with a Mitsuba scene.xml each.
        references: folder of archives with references of the same names.
        out: folder for the frames and the results.
        repeats: timed calls of each function.
        size: side of the image that is timed.
        windows: widths in pixels.
        quick: only the first scene, with few samples, and the first window.
    """

    scenes: tyro.conf.Positional[pathlib.Path]
    references: tyro.conf.Positional[pathlib.Path]
    out: tyro.conf.Positional[pathlib.Path]
    repeats: int = 5
    size: int = 512
    windows: tuple[int, ...] = (7, 11, 15, 21)
    quick: bool = False


def frame_pair(
    scene: str, samples: int, size: tuple[int, int], out: pathlib.Path
) -> tuple[Frame, Frame]:
    """Frames of independent and common random numbers, rendered if they are not there.

    Args:
        scene: name of an own scene, or an XML file.
        samples: samples a pixel of common numbers; there are twice as many independent.
        size: height and width in pixels.
        out: folder for them.

    Returns:
        eight sub-buffers and four, of equally many samples.
    """
    name = pathlib.Path(scene).parent.name if scene.endswith(".xml") else scene
    height, width = size
    each = []
    for kind, buffers, seed in (("independent", 8, 0), ("common", 4, COMMON_SEED)):
        path = out / f"{name}-{samples}-{kind}.exr"
        settings = Settings(
            spp=samples * buffers // 4,
            width=width,
            height=height,
            buffers=buffers,
            numbers=kind,
            seed=seed,
        )
        if not path.exists():
            render_file(scene, path, settings, denoise=kind == "independent")
        each.append(exr.read_frame(path))
    return each[0], each[1]


def first_half(frame: Frame) -> Frame:
    """The first half of a frame's sub-buffers: what is combined."""
    return frame.halves()[0]


def with_gradients(independent: Image, correlated: Image) -> Image:
    """L2 reconstruction from differences of correlated estimates."""
    differences = (jnp.diff(correlated, axis=axis) for axis in (1, 0))
    return reconstruct(independent, *differences)


def measure(
    independent: Frame,
    correlated: Frame,
    reference: Reference,
    windows: tuple[int, ...],
) -> dict:
    """Errors of all methods, and every gamma."""
    every = independent.normalised()
    z_frame = correlated.normalised(every.unit)
    r, noise = (i / every.unit for i in reference)
    y_frame = first_half(every)
    y, z, n = y_frame.buffers.color, z_frame.buffers.color, y_frame.samples / 4
    images = {
        "path tracing": every.color,
        "oidn": every.estimates["oidn"].image,
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
    gammas["uncorrelated, all rows judged"] = select(y, z, n, stride=1)
    solve = jax.jit(jax.vmap(with_gradients))
    images["L2"] = solve(y_frame.color[None], z_frame.color[None])[0]
    z_l2 = solve(y, z)
    gammas["L2, uncorrelated"] = select(y, z_l2, n)
    images["L2, uncorrelated"] = jax.jit(uncorrelated.combine_decorrelated)(
        y, z_l2, gammas["L2, uncorrelated"], n
    )
    error = lambda image: float(rel_l2(image, r, half_difference=noise))
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
    config.out.mkdir(parents=True, exist_ok=True)
    kept = config.out / "results.json"
    found = json.loads(kept.read_text()) if kept.exists() else {}
    todo = [(path, samples) for samples in SAMPLES for path in paths]
    windows = config.windows
    if config.quick:
        todo, windows = [(paths[0], 8)], windows[:1]
    for path, samples in tqdm(todo, unit="frame"):
        name = f"{path.parent.name} {samples}"
        if name in found:
            continue
        with np.load(config.references / f"{path.parent.name}.npz") as data:
            both = data["reference"], data["reference_half_difference"]
        reference = Reference(*map(jnp.asarray, both))
        size = reference.image.shape[:2]
        frames = frame_pair(str(path), samples, size, config.out)
        found[name] = measure(*frames, reference, windows)
        kept.write_text(json.dumps(found, indent=1))
    size, repeats = (64, 1) if config.quick else (config.size, config.repeats)
    return {"frames": found, "speed": speed(size, windows, repeats)}


def main() -> None:
    """Print the tables."""
    found = run(tyro.cli(Config, description=__doc__))
    rows = found["frames"]
    methods = next(iter(rows.values()))["error"]
    print("| error / path tracing |", " | ".join(rows), "| mean |")
    print("| --- " * (len(rows) + 2) + "|")
    for method in methods:
        each = [r["error"][method] / r["error"]["path tracing"] for r in rows.values()]
        cells = " | ".join(f"{ratio:.3f}" for ratio in each)
        print(f"| {method} | {cells} | {np.exp(np.mean(np.log(each))):.3f} |")
    for kind in ("gamma", "error by gamma"):
        print(f"\n| {kind} |", " | ".join(rows), "|")
        print("| --- " * (len(rows) + 1) + "|")
        for name in next(iter(rows.values()))[kind]:
            cells = " | ".join(f"{r[kind][name]:.4g}" for r in rows.values())
            print(f"| {name} | {cells} |")
    columns = list(next(iter(found["speed"].values())))
    print(
        "\n| window |", " | ".join(columns), "|\n" + "| --- " * (len(columns) + 1) + "|"
    )
    for name, row in found["speed"].items():
        print(f"| {name} |", " | ".join(f"{row[c]:.3g}" for c in columns), "|")


if __name__ == "__main__":
    main()
