"""Fair times and memory: functions that take turns, or have a process of their own."""

import concurrent.futures
import multiprocessing
import statistics
import time
from collections.abc import Callable
from typing import Any

import jax


def medians(functions: dict[Any, Callable], repeats: int) -> dict[Any, float]:
    """Median seconds of each function of no argument; they take turns.

    Args:
        functions: by name.
        repeats: timed calls of each, after one to warm up.

    Returns:
        seconds by name.
    """
    times: dict[Any, list[float]] = {name: [] for name in functions}
    for repeat in range(repeats + 1):
        for name, function in functions.items():
            start = time.perf_counter()
            jax.block_until_ready(function())
            if repeat:
                times[name].append(time.perf_counter() - start)
    return {name: statistics.median(each) for name, each in times.items()}


def apart(function: Callable, *arguments: Any) -> Any:
    """A function's result from a process of its own.

    Args:
        function: of a module.
        arguments: its arguments, such as can be pickled.

    Returns:
        what it returns; what it raises is raised here.
    """
    context = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(1, mp_context=context) as pool:
        return pool.submit(function, *arguments).result()
