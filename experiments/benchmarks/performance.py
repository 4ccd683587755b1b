"""What does each public function cost, and how does that grow with the image?

On the bundled frame, mirrored until it is as large as asked: seconds, the time that the
function's arithmetic takes at the rates of the same run (matrix products, other
arithmetic, exponentials; or a copy of its arguments and results if that is longer), the
ratio of the two, the most memory that its program needs beside its arguments, the power
of the number of pixels that time grows by, and seconds of compilation, also of the
gradient. What has been measured is kept, and a second run goes on from there.
"""

import dataclasses
import functools
import math
import pathlib
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from tqdm import tqdm

from experiments.benchmarks.work import Work, rates, work_of
from experiments.common.command import Options, main
from experiments.common.report import Report
from experiments.common.results import Results
from experiments.common.tables import table
from experiments.common.timing import medians
from jscomb import exr
from tests.battery import catalogue, parts
from tests.battery.rendering import Rendering, mirrored, rendering_of

LONG = 1.5  # seconds after which a warm-up makes no difference


@dataclasses.dataclass(frozen=True)
class Config(Options):
    """What to measure.

    Attributes:
        results: file that costs are kept in; None to keep none.
        sizes: widths and heights in pixels, two.
        only: functions whose names begin so.
    """

    results: pathlib.Path | None = None
    sizes: tuple[int, int] = (1024, 2048)
    only: str = ""


class Cost(NamedTuple):
    """Of a function at one size.

    Attributes:
        seconds: median of a call.
        ceiling: seconds at the rates of the run.
        memory: bytes that the program needs beside arguments and results.
        compiling: seconds, tracing included.
        compiling_gradient: likewise, of the results' sum; None where there is none.
    """

    seconds: float
    ceiling: float
    memory: int
    compiling: float
    compiling_gradient: float | None


def functions(*, quick: bool = False) -> dict[str, Callable[[Rendering], Any]]:
    """All of them.

    Args:
        quick: a few.

    Returns:
        functions of a rendering by the public name.
    """
    entries = catalogue.combiners() | catalogue.denoisers() | catalogue.solvers()
    found = {name: entry.function for name, entry in entries.items()} | parts.parts()
    few = ("james_stein.combine", "windows.window_sum", "smoothing.box")
    return {name: found[name] for name in few} if quick else found


def measure(
    function: Callable[[Rendering], Any],
    r: Rendering,
    best: Callable[[], Work],
    *,
    backwards: bool,
) -> Cost:
    """One function at one size.

    Args:
        function: to compile and call.
        r: what it is given.
        best: the machine's rates, measured when they are first needed.
        backwards: whether it has a gradient to compile.

    Returns:
        its cost; the median of some calls after the first, or that if it is long.
    """
    program, compiling = _compiled(function, r)
    start = time.perf_counter()
    jax.block_until_ready(program(r))
    seconds = time.perf_counter() - start
    if seconds < LONG:
        repeats = min(7, math.ceil(LONG / 2 / seconds))
        seconds = medians({"": lambda: program(r)}, repeats)[""]
    memory = program.memory_analysis().temp_size_in_bytes
    ceiling = work_of(function, r).seconds(best())
    compiling_gradient = None
    if backwards:
        compiling_gradient = _compiled(jax.grad(_total(function)), r)[1]
    return Cost(seconds, ceiling, memory, compiling, compiling_gradient)


def _compiled(function: Callable[[Rendering], Any], r: Rendering) -> tuple[Any, float]:
    """A function's program, and seconds of tracing and compiling it."""
    start = time.perf_counter()
    program = jax.jit(function).lower(r).compile()
    return program, time.perf_counter() - start


def _total(function: Callable[[Rendering], Any]) -> Callable[[Rendering], jax.Array]:
    """The sum of all that a function returns, to differentiate."""
    return lambda r: sum(map(jnp.sum, jax.tree.leaves(function(r))))


def run(config: Config) -> dict[str, dict[int, Cost]]:
    """Measure what has not been measured.

    Args:
        config: what.

    Returns:
        costs by function and size.
    """
    sizes = (32, 64) if config.quick else config.sizes
    found = functions(quick=config.quick)
    forwards = {n for n, each in catalogue.solvers().items() if not each.backwards}
    kept, costs = Results(config.results), {}
    wanted = [name for name in found if name.startswith(config.only)]
    best = functools.cache(lambda: rates(repeats=3))
    small = rendering_of(exr.read_frame(exr.bundled()["cornell-glass-64"]))
    if config.quick:
        small = Rendering(*(i[:32, :32] for i in small[:-1]), small.unit)
    for size in sizes:
        r = mirrored(small, size)
        for name in tqdm(wanted, unit="function", desc=f"{size}x{size}"):
            backwards = name not in forwards
            make = functools.partial(measure, found[name], r, best, backwards=backwards)
            cost = kept.get(f"{name}, {size}", make)
            costs.setdefault(name, {})[size] = Cost(*cost)
    return costs


class Row(NamedTuple):
    """One line of the table, per pixel of the larger size.

    Attributes:
        name: of the function.
        seconds: a megapixel.
        ceiling: seconds of its arithmetic or of a copy, a megapixel.
        ratio: of both.
        memory_small: bytes a pixel at the smaller size.
        memory_large: bytes a pixel at the larger.
        growth: the power of the pixels that the time grows as.
        compiling: seconds.
        compiling_gradient: likewise.
    """

    name: str
    seconds: float
    ceiling: float
    ratio: float
    memory_small: float
    memory_large: float
    growth: float
    compiling: float
    compiling_gradient: float | None


def row(name: str, costs: dict[int, Cost]) -> Row:
    """One line of the table.

    Args:
        name: of the function.
        costs: at two sizes, the smaller first.

    Returns:
        its cells.
    """
    (small, first), (large, last) = costs.items()
    pixels = large**2
    return Row(
        f"`{name}`",
        1e6 * last.seconds / pixels,
        1e6 * last.ceiling / pixels,
        last.seconds / last.ceiling,
        first.memory / small**2,
        last.memory / pixels,
        math.log(last.seconds / first.seconds) / math.log(pixels / small**2),
        first.compiling,
        first.compiling_gradient,
    )


def report(costs: dict[str, dict[int, Cost]]) -> Report:
    """Say what was found.

    Args:
        costs: by `run`.

    Returns:
        a line a function.
    """
    rows = [row(name, cost) for name, cost in costs.items()]
    ratios = sorted(each.ratio for each in rows)
    growth = [each.growth for each in rows]
    slowest = max(rows, key=lambda each: each.ratio)
    answer = (
        f"Half of {len(rows)} functions take at most {ratios[len(rows) // 2]:.1f} "
        f"times as long as their arithmetic or a copy of their images, all at most "
        f"{ratios[-1]:.0f} times ({slowest.name}); time grows as the pixels to a power "
        f"of {min(growth):.2f} to {max(growth):.2f}."
    )
    sizes = list(next(iter(costs.values())))
    memory = [f"B/pixel at {size}" for size in sizes]
    header = "function", "s/Mpx", "ceiling", "ratio", *memory, "growth"
    header = *header, "compiling, s", "gradient compiling, s"
    return Report(answer, table(header, rows))


if __name__ == "__main__":
    main(Config, run, report)
