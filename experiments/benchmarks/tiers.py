"""What does a tier of the default method cost, and which part of it?

A frame is mirrored until it is as large as asked. Every tier, in a process of its own:
the first run, which compiles, the second, the most memory that the process ever held,
and its cost in denoisings, runs of Open Image Denoise on the frame in the same process.
Beside it what rendering 64 samples a pixel of the frame's scene takes, at the smallest
size, scaled by the pixels. Of the last tier the share of each part, at the two smallest
sizes: its estimates with those of both halves, the weights, and the estimated error.
"""

import dataclasses
import pathlib
import resource
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import tyro
from tqdm import tqdm

from experiments.common.command import Options, main
from experiments.common.report import Report
from experiments.common.results import Results
from experiments.common.tables import table
from experiments.common.timing import apart
from jscomb import ensemble, exr, metrics
from jscomb.frame import Frame
from jscomb.methods import METHODS, TIERS, combine_tier
from jscomb.methods._inputs import inputs, with_input
from jscomb.numerics.tiles import compiled
from jscomb.rendering import Settings, render
from tests.battery.rendering import mirrored

SAMPLES = 64  # a pixel, of the rendering that tiers are compared with


@dataclasses.dataclass(frozen=True)
class Config(Options):
    """What to measure.

    Attributes:
        frame: EXR file.
        results: file that costs are kept in; None to keep none.
        scene: of the frame, as `jscomb render` takes it; None to render nothing.
        sizes: widths and heights in pixels.
        largest: of each tier, the largest size that the memory suffices for.
    """

    frame: tyro.conf.Positional[pathlib.Path]
    results: pathlib.Path | None = None
    scene: str | None = None
    sizes: tuple[int, ...] = (512, 1024, 2048, 4096)
    largest: tuple[int, ...] = (4096, 2048, 2048)


class Cost(NamedTuple):
    """What a tier costs at one size.

    Attributes:
        denoising: seconds of one denoising.
        first: seconds of the first run.
        second: of the second.
        memory: mebibytes, of the whole process.
    """

    denoising: float
    first: float
    second: float
    memory: float


class Found(NamedTuple):
    """What was measured.

    Attributes:
        costs: by size and tier.
        parts: seconds of each part of the last tier, by size.
        rendering: seconds of 64 samples of a megapixel, if a scene was given.
    """

    costs: dict[tuple[int, str], Cost]
    parts: dict[int, dict[str, float]]
    rendering: float | None


def seconds(make: Callable[[], Any]) -> float:
    """Of one run."""
    start = time.perf_counter()
    jax.block_until_ready(make())
    return time.perf_counter() - start


def bare(path: pathlib.Path, size: int) -> Frame:
    """The normalised frame without estimates and reference."""
    frame = exr.read_frame(path)._replace(estimates={}, reference=None)
    return mirrored(frame, size).normalised()


def denoising(frame: Frame) -> float:
    """Seconds of one denoising of the frame, the faster of two."""
    alone, key = frame.merged(1), jax.random.key(0)
    runs = [seconds(lambda: METHODS["oidn"].image(key, alone)) for _ in range(3)]
    return min(runs[1:])


def cost(path: pathlib.Path, size: int, tier: str) -> Cost:
    """Measure a tier in this process."""
    frame = bare(path, size)
    one = denoising(frame)
    make = lambda: combine_tier(jax.random.key(0), frame, tier=tier).estimate.image
    first, second = (seconds(make) for _ in range(2))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return Cost(one, first, second, peak)


def parts(path: pathlib.Path, size: int, tier: str) -> dict[str, float]:
    """Seconds of every part of a tier, each after a run that compiles."""
    frame, key = bare(path, size), jax.random.key(0)
    names, _ = inputs(frame, biased=[*TIERS[tier].bases])
    found = {}
    full = frame
    for name in names:  # in their order: combiners take `oidn`
        for _ in range(2):
            start = time.perf_counter()
            made = with_input(key, full, name)
            jax.block_until_ready(made.estimates[name].image)
            found[name] = time.perf_counter() - start
        full = made
    estimates = {name: full.estimates[name] for name in names}
    x = jnp.stack([half.color for half in frame.halves()])
    for _ in range(2):
        start = time.perf_counter()
        weights = jax.block_until_ready(ensemble.weigh_frame(frame, estimates))
        found["weights"] = time.perf_counter() - start
        start = time.perf_counter()
        bases = ensemble.stack_estimates(estimates)
        image, *halves = (compiled(ensemble.average)(y, weights) for y in bases)
        spread = compiled(ensemble.spread)(bases.biased, weights)
        error = compiled(metrics.estimate_error)(image, jnp.stack(halves), x, spread)
        jax.block_until_ready(error)
        found["mean and estimated error"] = time.perf_counter() - start
    return found


def rendering(scene: str, size: int) -> float:
    """Seconds a megapixel of 64 samples; the renderer's programs are there already."""
    settings = Settings(spp=SAMPLES, size=size)
    render(scene, dataclasses.replace(settings, spp=2))
    return seconds(lambda: render(scene, settings).color) / (size / 1000) ** 2


def run(config: Config) -> Found:
    """Measure all tiers at all sizes.

    Args:
        config: what to measure.

    Returns:
        costs, parts of the last tier, and the time of rendering.
    """
    sizes, tiers = config.sizes, dict(zip(TIERS, config.largest, strict=True))
    if config.quick:
        sizes, tiers = (96,), {"fast": 96}
    kept, costs, parts_of, rendered = Results(config.results), {}, {}, None

    def measured(function: Callable, *arguments: Any) -> Any:
        key = " ".join(map(str, (function.__name__, *arguments)))
        return kept.get(key, lambda: apart(function, *arguments))

    for size in tqdm(sizes, unit="size"):
        for tier, largest in tiers.items():
            if size <= largest:
                of = measured(cost, config.frame, size, tier)
                costs[size, tier] = Cost(*of)
        if size in sizes[:2]:
            parts_of[size] = measured(parts, config.frame, size, [*tiers][-1])
    if config.scene:
        rendered = measured(rendering, config.scene, sizes[0])
    return Found(costs, parts_of, rendered)


def report(found: Found) -> Report:
    """Say what tiers cost.

    Args:
        found: by `run`.

    Returns:
        a line a tier and size, and a line a part.
    """
    costs, shares, rendered = found
    rows = [
        [
            *(size, tier, c.second / c.denoising, c.second, c.first, c.denoising),
            rendered and rendered * (size / 1000) ** 2,
            c.memory,
        ]
        for (size, tier), c in costs.items()
    ]
    sizes = [size for size, _ in costs]
    largest = max(size for size in sizes if sizes.count(size) == sizes.count(sizes[0]))
    said = [
        f"{tier} {c.second / c.denoising:.3g}"
        for (size, tier), c in costs.items()
        if size == largest
    ]
    answer = f"At {largest}x{largest}, in denoisings: {', '.join(said)}."
    header = ["size", "tier", "denoisings", "s", "first run s", "one denoising s"]
    header += [f"rendering {SAMPLES} samples s", "MiB"]
    of_parts = [
        [name, *(p[name] / sum(p.values()) for p in shares.values())]
        for name in next(iter(shares.values()))
    ]
    body = [table(header, rows), table(["part, its share", *shares], of_parts)]
    return Report(answer, "\n\n".join(body))


if __name__ == "__main__":
    main(Config, run, report)
