"""Double shrinkage's time beside that of its regression and its memory traffic."""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp

from experiments.common.timing import medians
from experiments.james_stein import parts as regression_parts
from jscomb import double_shrinkage
from jscomb.numerics.windows import window_sum

WINDOW = 15


def calls_of_prior(size: int) -> dict[str, Callable]:
    """The prior, at strides of 1 and 2, and its parts."""
    keys = jax.random.split(jax.random.key(1), 3)
    u, b = (jax.random.uniform(k, (size, size, 3)) for k in keys[:2])
    f = jax.random.uniform(keys[2], (size, size, regression_parts.FEATURES))
    one = jnp.full((size, size, 1), 0.05)
    prior = jax.jit(double_shrinkage.radiance_prior, static_argnames="stride")
    parts = regression_parts.parts(size)
    return {name: parts[name] for name in regression_parts.PARTS} | {
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
        "prior error": (double_shrinkage.prior_error, 5),
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


def ratios(size: int, repeats: int) -> dict[str, float]:
    """Time everything.

    Args:
        size: width and height in pixels; the prior has half of it.
        repeats: timed calls of each function.

    Returns:
        ratios by name.
    """
    t, s = (
        medians(calls, repeats)
        for calls in (calls_of_prior(size // 2), calls_of_rest(size))
    )
    weights, products, moments, predictions = (t[n] for n in regression_parts.PARTS)
    parts = 3 * weights + 2 * (products + moments) + predictions
    return {
        "prior / its parts": t["prior, stride 1"] / parts,
        "prior, stride 1 / stride 2": t["prior, stride 1"] / t["prior, stride 2"],
        "combine / six images": s["combine"] / s["6 images"],
        "biased_error / three window sums": s["biased_error"] / s["three window sums"],
        "biased_error / four images": s["biased_error"] / s["4 images"],
        "prior error / two window sums": s["prior error"] / s["two window sums"],
        "prior error / five images": s["prior error"] / s["5 images"],
    }
