"""Is double shrinkage as fast as its regression and its memory traffic allow?

    python -m experiments.double_shrinkage.double_shrinkage_speed

On random images with eleven features. The prior's time is divided by that of its parts
timed alone (`james_stein.parts`): three kinds of weights, twice the products of
features and their matrix product, once the predictions' product. The rest is divided by
reading the same images once and writing one, and what pools over windows also by the
bare window sums that it cannot do without.
"""

import dataclasses
import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import tyro

from experiments.common.timing import medians
from experiments.james_stein import parts as regression_parts
from experiments.james_stein.parts import PARTS
from jscomb import double_shrinkage
from jscomb.numerics.windows import window_sum

WINDOW = 15


@dataclasses.dataclass(frozen=True)
class Config:
    """What to time.

    Attributes:
        size: width and height in pixels of the rest.
        prior_size: of the prior.
        repeats: timed calls of each function.
        quick: small images, one call.
    """

    size: int = 1024
    prior_size: int = 512
    repeats: int = 7
    quick: bool = False


def calls_of_prior(size: int) -> dict[str, Callable]:
    """The prior, at strides of 1 and 2, and its parts."""
    keys = jax.random.split(jax.random.key(1), 3)
    u, b = (jax.random.uniform(k, (size, size, 3)) for k in keys[:2])
    f = jax.random.uniform(keys[2], (size, size, regression_parts.FEATURES))
    one = jnp.full((size, size, 1), 0.05)
    prior = jax.jit(double_shrinkage.radiance_prior, static_argnames="stride")
    parts = regression_parts.parts(size)
    return {name: parts[name] for name in PARTS} | {
        f"prior, stride {s}": functools.partial(prior, u, b, one, one, f, stride=s)
        for s in (1, 2)
    }


def calls_of_rest(size: int) -> dict[str, Callable]:
    """The other functions, and the bounds that they are held against."""
    images = [
        jax.random.uniform(key, (size, size, 3)) + 0.1
        for key in jax.random.split(jax.random.key(2), 6)
    ]

    def stream(count: int) -> Callable:
        add = jax.jit(lambda *given: sum(given[1:], start=given[0]))
        return functools.partial(add, *images[:count])

    sums = jax.jit(lambda *given: [window_sum(i, WINDOW) for i in given])
    functions = {
        "combine": (double_shrinkage.combine, 6),
        "biased_error": (double_shrinkage.biased_error, 4),
        "confidence": (double_shrinkage.confidence, 5),
    }
    return {
        **{f"{n} images": stream(n) for n in (4, 5, 6)},
        "two window sums": functools.partial(sums, *images[:2]),
        "three window sums": functools.partial(sums, *images[:3]),
        **{
            name: functools.partial(jax.jit(function), *images[:count])
            for name, (function, count) in functions.items()
        },
    }


def run(config: Config) -> dict[str, float]:
    """Time everything.

    Args:
        config: what.

    Returns:
        ratios by name.
    """
    size, prior_size, repeats = config.size, config.prior_size, config.repeats
    if config.quick:
        size, prior_size, repeats = 64, 64, 1
    t = medians(calls_of_prior(prior_size), repeats)
    weights, products, moments, predictions = (
        t[name] for name in regression_parts.PARTS
    )
    parts = 3 * weights + 2 * (products + moments) + predictions
    s = medians(calls_of_rest(size), repeats)
    return {
        "prior / its parts": t["prior, stride 1"] / parts,
        "prior, stride 1 / stride 2": t["prior, stride 1"] / t["prior, stride 2"],
        "combine / six images": s["combine"] / s["6 images"],
        "biased_error / three window sums": s["biased_error"] / s["three window sums"],
        "biased_error / four images": s["biased_error"] / s["4 images"],
        "confidence / two window sums": s["confidence"] / s["two window sums"],
        "confidence / five images": s["confidence"] / s["5 images"],
    }


def main() -> None:
    """Print the table."""
    print("| what | ratio |\n| --- | --- |")
    for name, ratio in run(tyro.cli(Config, description=__doc__)).items():
        print(f"| {name} | {ratio:.2f} |")


if __name__ == "__main__":
    main()
