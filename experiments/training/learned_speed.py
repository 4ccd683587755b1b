"""What does a network cost, compared with its convolutions alone?

    python -m experiments.training.learned_speed

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
import tyro

from experiments.common.timing import medians
from jscomb.learning import networks
from jscomb.learning.recipes import RECIPES

CHANNELS = 64  # of the convolution that sets the ceiling

_INPUTS = {
    "njs": ("unbiased", "biased_a", "biased_b", "variance"),
    "dsc": ("prior", "unbiased", "biased", "variance", "mse"),
    "pd": ("unbiased", "biased", "variance", "sure"),
}


@dataclasses.dataclass(frozen=True)
class Config:
    """What to time.

    Attributes:
        size: width and height in pixels.
        repeats: timed calls of each function.
        quick: small images, one call.
    """

    size: int = 1024
    repeats: int = 5
    quick: bool = False


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
        method: njs, dsc or pd.
        size: width and height in pixels.

    Returns:
        images by name.
    """
    names = _INPUTS[method]
    keys = jax.random.split(jax.random.key(0), len(names))
    one = {"variance", "mse"} if method == "dsc" else set()
    return {
        name: jax.random.uniform(key, (size, size, 1 if name in one else 3))
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
            network, name = recipe.network(jax.random.key(3), size=kind), method + " "
            name += kind
            compiled = jax.jit(recipe.combine).lower(network, inputs).compile()
            used = compiled.memory_analysis().temp_size_in_bytes
            memory[name] = used / size**2
            counts[name] = operations(network)
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


def main() -> None:
    """Print the table."""
    costs = run(tyro.cli(Config, description=__doc__))
    ceiling = costs.pop("ceiling")
    print(f"ceiling: {ceiling.operations / 1e9:.0f} GFLOP/s")
    print("| network | s a megapixel | kFLOP a pixel | share at ceiling | MB / Mpx |")
    print("| --- | --- | --- | --- | --- |")
    for name, cost in costs.items():
        print(f"| {name} | {cost.seconds:.2f} | {cost.operations / 1e3:.0f}", end="")
        print(f" | {cost.share:.2f} | {cost.memory:.0f} |")


if __name__ == "__main__":
    main()
