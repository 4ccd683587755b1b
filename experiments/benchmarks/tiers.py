"""What does a tier of the default method cost, and which part of it?

A frame is mirrored until it is as large as asked. Every tier, in a process of its own:
the first run, which compiles, the second, the most memory that the process ever held,
and its cost in denoisings, runs of Open Image Denoise on the frame in the same process.
Of the last tier the share of each part: its estimates with those of both halves, the
weights, and the estimated error.
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
from experiments.common.tables import table
from experiments.common.timing import apart
from jscomb import ensemble, exr, metrics
from jscomb.frame import Frame
from jscomb.methods import METHODS, TIERS, combine_tier
from jscomb.methods._inputs import inputs, with_input
from jscomb.numerics.tiles import compiled
from tests.battery.rendering import mirrored


@dataclasses.dataclass(frozen=True)
class Config(Options):
    """What to measure.

    Attributes:
        frame: EXR file.
        sizes: widths and heights in pixels.
    """

    frame: tyro.conf.Positional[pathlib.Path]
    sizes: tuple[int, ...] = (512, 1024)


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


def run(config: Config) -> tuple[dict[tuple[int, str], Cost], dict[int, dict]]:
    """Measure all tiers at all sizes.

    Args:
        config: what to measure.

    Returns:
        costs by size and tier; seconds of the parts of the last tier by size.
    """
    sizes, tiers = config.sizes, [*TIERS]
    if config.quick:
        sizes, tiers = (96,), tiers[:1]
    found = {
        (size, tier): apart(cost, config.frame, size, tier)
        for size in tqdm(sizes, unit="size")
        for tier in tiers
    }
    return found, {s: apart(parts, config.frame, s, tiers[-1]) for s in sizes}


def report(result: tuple[dict[tuple[int, str], Cost], dict[int, dict]]) -> Report:
    """Say what tiers cost.

    Args:
        result: by `run`.

    Returns:
        a line a tier and size, and a line a part.
    """
    found, shares = result
    rows = [
        [size, tier, c.second / c.denoising, c.second, c.first, c.denoising, c.memory]
        for (size, tier), c in found.items()
    ]
    largest = max(size for size, _ in found)
    said = [
        f"{tier} {c.second / c.denoising:.3g}"
        for (size, tier), c in found.items()
        if size == largest
    ]
    answer = f"At {largest}x{largest}, in denoisings: {', '.join(said)}."
    header = [
        "size",
        "tier",
        "denoisings",
        "s",
        "first run s",
        "one denoising s",
        "MiB",
    ]
    of_parts = [
        [name, *(p[name] / sum(p.values()) for p in shares.values())]
        for name in next(iter(shares.values()))
    ]
    body = [table(header, rows), table(["part, its share", *shares], of_parts)]
    return Report(answer, "\n\n".join(body))


if __name__ == "__main__":
    main(Config, run, report)
