"""What does a network cost, compared with its convolutions alone?

On random images: seconds a megapixel of each network with its combiner, and the time
that its convolutions would take at the rate of one large convolution of 3x3 in the same
run (64 channels to 64), by counting their operations. Memory is what the compiled
program needs beside its arguments and results.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np

from experiments.common.command import Options, main
from experiments.common.report import Report
from experiments.common.tables import table
from experiments.common.timing import medians
from jscomb.learning import networks, recipes
from jscomb.learning.recipes import RECIPES

BASES = 6  # of the ensemble
CHANNELS = 64  # of the convolution that sets the ceiling

_OF_BASE = "base", "difference", "weight", "error"
_INPUTS = {
    "njs": ("unbiased", "biased_a", "biased_b", "variance"),
    "dsc": ("prior", "unbiased", "biased", "variance", "mse"),
    "pd": ("unbiased", "biased", "variance", "sure"),
    "neural-ensemble": (
        *("unbiased", "variance", "albedo", "normal", "depth"),
        *(f"{name}{k}" for k in range(BASES) for name in _OF_BASE),
    ),
}
_CHANNELS = {"depth": 1, "weight": 1, "error": 2}  # of an input; others have three


@dataclasses.dataclass(frozen=True)
class Config(Options):
    """What to time.

    Attributes:
        size: width and height in pixels.
        repeats: timed calls of each function.
    """

    size: int = 1024
    repeats: int = 5


class Cost(NamedTuple):
    """Of one network and its combiner.

    Attributes:
        seconds: a megapixel.
        operations: of its convolutions, a pixel.
        share: of the time that its convolutions take at the ceiling's rate.
        memory: bytes a pixel beside arguments and results.
    """

    seconds: float
    operations: float
    share: float
    memory: float


def operations(network: object) -> float:
    """Count the multiplications and additions of a network's convolutions.

    Args:
        network: one of `learning.networks`.

    Returns:
        the number a pixel; levels below the first count by their share of the pixels.
    """
    total = 0.0
    for path, leaf in jax.tree.leaves_with_path(network):
        names = jax.tree_util.keystr(path, simple=True, separator="/").split("/")
        if "kernel" not in names:
            continue
        level = 0
        if "down" in names:
            level = int(names[names.index("down") + 1])
        elif "up" in names:
            level = 1 - int(names[names.index("up") + 1])  # of three, coarsest first
        total += 2 * np.prod(leaf.shape) / 4**level
    return total


def inputs_of(method: str, size: int) -> dict[str, jax.Array]:
    """Return random inputs of a method.

    Args:
        method: njs, dsc, pd or neural-ensemble.
        size: width and height in pixels.

    Returns:
        images by name.
    """
    names = _INPUTS[method]
    keys = jax.random.split(jax.random.key(0), len(names))
    channels = _CHANNELS | ({"variance": 1, "mse": 1} if method == "dsc" else {})
    width = lambda name: channels.get(recipes.kind(name), 3)
    return {
        name: jax.random.uniform(key, (size, size, width(name)))
        for key, name in zip(keys, names, strict=True)
    }


def run(config: Config) -> dict[str, Cost]:
    """Time everything.

    Args:
        config: how large.

    Returns:
        the costs by method and size of the network, and "ceiling", whose operations
        are those a second.
    """
    size, repeats = (64, 1) if config.quick else (config.size, config.repeats)
    image = jax.random.uniform(jax.random.key(1), (size, size, CHANNELS))
    single = networks.Convolution(jax.random.key(2), CHANNELS, CHANNELS)
    convolve = jax.jit(lambda convolution, image: convolution(image))
    calls: dict[str, Callable] = {"ceiling": functools.partial(convolve, single, image)}
    counts, memory = {"ceiling": operations(single)}, {"ceiling": 0.0}
    for method in _INPUTS:
        recipe, inputs = RECIPES[method], inputs_of(method, size)
        for kind in ("light",) if config.quick else ("light", "full"):
            network, name = recipe.make(jax.random.key(3), size=kind), method + " "
            name += kind
            compiled = jax.jit(recipe.combine).lower(network, inputs).compile()
            used = compiled.memory_analysis().temp_size_in_bytes
            memory[name] = used / size**2
            often = BASES if method == "neural-ensemble" else 1
            counts[name] = often * operations(network)
            calls[name] = functools.partial(compiled, network, inputs)
    times = medians(calls, repeats)
    rate = counts["ceiling"] * size**2 / times["ceiling"]
    costs = {
        name: Cost(
            seconds * 1e6 / size**2,
            counts[name],
            counts[name] * size**2 / rate / seconds,
            memory[name],
        )
        for name, seconds in times.items()
    }
    return costs | {"ceiling": costs["ceiling"]._replace(operations=rate)}


def report(costs: dict[str, Cost]) -> Report:
    """Say what was found.

    Args:
        costs: by `run`.

    Returns:
        the cost of every network.
    """
    rate = costs["ceiling"].operations
    rows = {name: cost for name, cost in costs.items() if name != "ceiling"}

    def span(kind: str) -> str:
        some = [cost for name, cost in rows.items() if name.endswith(kind)]
        seconds = [cost.seconds for cost in some]
        shares = [cost.share for cost in some]
        return (
            f"{kind} {min(seconds):.2f} to {max(seconds):.2f} s a megapixel, "
            f"{min(shares):.2f} to {max(shares):.2f} of it convolutions at the "
            f"ceiling's rate, below {max(cost.memory for cost in some):.0f} MB a "
            "megapixel"
        )

    kinds = dict.fromkeys(name.rpartition(" ")[2] for name in rows)
    answer = f"Networks, {'; '.join(map(span, kinds))}."
    header = "network", "s a megapixel", "kFLOP a pixel", "share", "MB a megapixel"
    cells = [
        [name, cost.seconds, cost.operations / 1e3, cost.share, cost.memory]
        for name, cost in rows.items()
    ]
    ceiling = f"The ceiling: {rate / 1e9:.0f} GFLOP/s."
    return Report(answer, f"{table(header, cells)}\n\n{ceiling}")


if __name__ == "__main__":
    main(Config, run, report)
