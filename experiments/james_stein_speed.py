"""Does James-Stein cost more than the window sums that it cannot do without?

    python -m experiments.james_stein_speed

Times `james_stein.combine`, bare and as the command runs it (with the pooling of the
variance), against two bare separable 15x15 window sums of the same image in the same
run, and `jscomb demo` from the start of the process to its end, the
second time. Medians; times of one machine mean nothing on another, ratios do.
"""

import dataclasses
import functools
import os
import pathlib
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable

import jax
import tyro

from experiments.rendering import UNTRAINED, of_images
from experiments.timing import medians
from jscomb import james_stein
from jscomb.numerics.windows import window_sum


@dataclasses.dataclass(frozen=True)
class Config:
    """What to time.

    Attributes:
        size: width and height of the images in pixels.
        repeats: timed calls of each function; they take turns.
        quick: small images and few calls, no demo.
    """

    size: int = 1024
    repeats: int = 31
    quick: bool = False


def run(config: Config) -> dict[str, float]:
    """Time everything.

    Args:
        config: what to time.

    Returns:
        median seconds by name.
    """
    size, repeats = (128, 3) if config.quick else (config.size, config.repeats)
    x, y, v = jax.random.uniform(jax.random.key(0), (3, size, size, 3))
    functions: dict[str, Callable] = {
        "two window sums": lambda x, y, v: (window_sum(x, 15), window_sum(y, 15)),
        "combine": james_stein.combine,
        "combine, whitened": lambda *i: james_stein.combine(*i, whiten=True),
        **{f"command, {name}": of_images(name) for name in UNTRAINED},
        "combine and its gradient": lambda *i: jax.grad(
            lambda *i: james_stein.combine(*i).sum(), argnums=(0, 1, 2)
        )(*i),
    }
    calls = {n: functools.partial(jax.jit(f), x, y, v) for n, f in functions.items()}
    seconds = medians(calls, repeats)
    if not config.quick:
        with tempfile.TemporaryDirectory() as folder:
            for name in ("jscomb demo, first", "jscomb demo, second"):
                seconds[name] = _seconds_of_demo(pathlib.Path(folder))
    return seconds


def _seconds_of_demo(folder: pathlib.Path) -> float:
    """Wall time of the command from process start to end, compiled programs kept."""
    environment = os.environ | {"JAX_COMPILATION_CACHE_DIR": str(folder / "cache")}
    command = [sys.executable, "-m", "jscomb", "demo", "--out", str(folder / "demo")]
    start = time.perf_counter()
    subprocess.run(command, check=True, capture_output=True, env=environment)
    return time.perf_counter() - start


def main() -> None:
    """Print the table."""
    found = run(tyro.cli(Config, description=__doc__))
    ceiling = found["two window sums"]
    for name, seconds in found.items():
        demo = name.startswith("jscomb")
        ratio = "" if demo else f"{seconds / ceiling:>9.2f} x the window sums"
        print(f"{name:<28}{1e3 * seconds:>10.2f} ms{ratio}")


if __name__ == "__main__":
    main()
