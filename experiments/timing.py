"""Median times of functions that take turns, so that a busy machine is fair to all."""

import statistics
import time
from collections.abc import Callable

import jax


def medians(functions: dict[str, Callable], repeats: int) -> dict[str, float]:
    """Median seconds of each function of no argument; they take turns.

    Args:
        functions: by name.
        repeats: timed calls of each, after one to warm up.

    Returns:
        seconds by name.
    """
    times: dict[str, list[float]] = {name: [] for name in functions}
    for repeat in range(repeats + 1):
        for name, function in functions.items():
            start = time.perf_counter()
            jax.block_until_ready(function())
            if repeat:
                times[name].append(time.perf_counter() - start)
    return {name: statistics.median(each) for name, each in times.items()}
