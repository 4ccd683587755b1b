"""What does each public function cost, and how does that grow with the image?

On the bundled frame, mirrored until it is as large as asked: seconds, the time that the
function's arithmetic takes at the rates of the same run (matrix products, other
arithmetic, exponentials; or a copy of its arguments and results if that is longer), the
ratio of the two, the most memory that its program needs beside its arguments, the power
of the number of pixels that time grows by, and seconds of compilation, also of the
gradient at the smaller size. With an earlier package each function's seconds by it and
by this one are measured in turns, in a process each. The plot shows arithmetic a second
over arithmetic a byte, below the machine's rates. What has been measured is kept, and a
second run goes on from there.
"""

import concurrent.futures
import contextlib
import dataclasses
import functools
import math
import multiprocessing
import os
import pathlib
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from tqdm import tqdm

import jscomb
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
NOISE = 2.0  # by which times of a short function that is the same may differ


@dataclasses.dataclass(frozen=True)
class Config(Options):
    """What to measure.

    Attributes:
        results: file that costs are kept in; None to keep none.
        sizes: widths and heights in pixels, two.
        only: functions whose names begin so.
        before: folder that has an earlier package `jscomb` alone, as
            `pip install --no-deps --target FOLDER` makes it.
    """

    results: pathlib.Path | None = None
    sizes: tuple[int, int] = (1024, 2048)
    only: str = ""
    before: pathlib.Path | None = None


class Cost(NamedTuple):
    """Of a function at one size.

    Attributes:
        seconds: median of a call.
        ceiling: seconds at the rates of the run.
        memory: bytes that the program needs beside arguments and results.
        compiling: seconds, tracing included.
        compiling_gradient: likewise, of the results' sum; None where there is none.
        operations: of its arithmetic.
        moved: bytes of its arguments and results.
    """

    seconds: float
    ceiling: float
    memory: int
    compiling: float
    compiling_gradient: float | None
    operations: float
    moved: float


class Found(NamedTuple):
    """What was measured.

    Attributes:
        costs: by function and size.
        before: seconds of the earlier package and of this one at the larger size, by
            function; None where it has no such function, or it took other arguments.
        rates: of the machine.
    """

    costs: dict[str, dict[int, Cost]]
    before: dict[str, tuple[float | None, float]]
    rates: Work


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
    best: Work,
    *,
    backwards: bool,
) -> Cost:
    """One function at one size.

    Args:
        function: to compile and call.
        r: what it is given.
        best: the machine's rates.
        backwards: compile its gradient too.

    Returns:
        its cost.
    """
    program, compiling = _compiled(function, r)
    seconds = _seconds(program, r)
    memory = program.memory_analysis().temp_size_in_bytes
    work = work_of(function, r)
    compiling_gradient = None
    if backwards:
        compiling_gradient = _compiled(jax.grad(_total(function)), r)[1]
    cost = seconds, work.seconds(best), memory, compiling, compiling_gradient
    return Cost(*cost, operations=sum(work[:3]), moved=work.moved)


def _compiled(function: Callable[[Rendering], Any], r: Rendering) -> tuple[Any, float]:
    """A function's program, and seconds of tracing and compiling it."""
    start = time.perf_counter()
    program = jax.jit(function).lower(r).compile()
    return program, time.perf_counter() - start


def _seconds(program: Callable[[Rendering], Any], r: Rendering) -> float:
    """The median of some calls after the first, or that if it is long."""
    start = time.perf_counter()
    jax.block_until_ready(program(r))
    seconds = time.perf_counter() - start
    if seconds < LONG:
        repeats = min(7, math.ceil(LONG / 2 / seconds))
        seconds = medians({"": lambda: program(r)}, repeats)[""]
    return seconds


def _total(function: Callable[[Rendering], Any]) -> Callable[[Rendering], jax.Array]:
    """The sum of all that a function returns, to differentiate."""
    return lambda r: sum(map(jnp.sum, jax.tree.leaves(function(r))))


def rendering(size: int, *, quick: bool) -> Rendering:
    """The bundled frame.

    Args:
        size: width and height in pixels, to which it is mirrored.
        quick: of its corner.

    Returns:
        what functions are given.
    """
    small = rendering_of(exr.read_frame(exr.bundled()["cornell-glass-64"]))
    if quick:
        small = Rendering(*(i[:32, :32] for i in small[:-1]), small.unit)
    return mirrored(small, size)


def seconds_here(name: str, size: int, quick: bool) -> float | None:
    """Measure a function by this process's package.

    Args:
        name: of the function.
        size: width and height in pixels.
        quick: as of `rendering`.

    Returns:
        seconds; None if the package has no such function, or it took other arguments.
    """
    r = rendering(size, quick=quick)
    try:
        program, _ = _compiled(functions()[name], r)
    except (AttributeError, TypeError, ValueError):
        return None
    return _seconds(program, r)


@contextlib.contextmanager
def process_of(folder: pathlib.Path) -> Iterator[concurrent.futures.Executor]:
    """A process that imports `jscomb` from a folder.

    Args:
        folder: that has the package.

    Yields:
        what runs functions there.
    """
    context = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(1, mp_context=context) as process:
        sys.path.insert(0, str(folder))  # a new process begins with its parent's
        process.submit(os.getpid).result()
        sys.path.remove(str(folder))
        yield process


def run(config: Config) -> Found:
    """Measure what has not been measured.

    Args:
        config: what.

    Returns:
        what was measured.
    """
    sizes = (32, 64) if config.quick else config.sizes
    found = functions(quick=config.quick)
    forwards = {n for n, each in catalogue.solvers().items() if not each.backwards}
    kept, costs, before = Results(config.results), {}, {}
    wanted = [name for name in found if name.startswith(config.only)]
    best = Work(*kept.get("rates", lambda: rates(repeats=3)))
    for size in sizes:
        r = rendering(size, quick=config.quick)
        for name in tqdm(wanted, unit="function", desc=f"{size}x{size}"):
            backwards = name not in forwards and size == sizes[0]
            of = functools.partial(measure, backwards=backwards)
            make = functools.partial(of, found[name], r, best)
            cost = kept.get(f"{name}, {size}", make)
            costs.setdefault(name, {})[size] = Cost(*cost)
    if config.before:
        here = pathlib.Path(jscomb.__file__).parents[1]
        with process_of(config.before) as earlier, process_of(here) as present:

            def in_turns(*given: Any) -> list[float | None]:
                processes = earlier, present
                return [p.submit(seconds_here, *given).result() for p in processes]

            for name in tqdm(wanted, unit="function", desc="before"):
                make = functools.partial(in_turns, name, sizes[-1], config.quick)
                before[name] = kept.get(f"{name}, {sizes[-1]}, in turns", make)
    return Found(costs, before, best)


class Row(NamedTuple):
    """One line of the table, per pixel of the larger size.

    Attributes:
        name: of the function.
        change: seconds by this package over those by the earlier one, if any.
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
    change: float | None
    seconds: float
    ceiling: float
    ratio: float
    memory_small: float
    memory_large: float
    growth: float
    compiling: float
    compiling_gradient: float | None


def row(name: str, costs: dict[int, Cost], change: float | None) -> Row:
    """One line of the table.

    Args:
        name: of the function.
        costs: at two sizes, the smaller first.
        change: seconds by this package over those by the earlier one, if any.

    Returns:
        its cells.
    """
    (small, first), (large, last) = costs.items()
    pixels = large**2
    return Row(
        f"`{name}`",
        change,
        1e6 * last.seconds / pixels,
        1e6 * last.ceiling / pixels,
        last.seconds / last.ceiling,
        first.memory / small**2,
        last.memory / pixels,
        math.log(last.seconds / first.seconds) / math.log(pixels / small**2),
        first.compiling,
        first.compiling_gradient,
    )


def roofline(found: Found) -> Figure:
    """Plot arithmetic a second over arithmetic a byte of arguments and results.

    Args:
        found: by `run`.

    Returns:
        the plot, with the names of what is farthest below the machine's rates.
    """
    last = {name: [*costs.values()][-1] for name, costs in found.costs.items()}
    last = {name: cost for name, cost in last.items() if cost.operations}
    x = np.array([cost.operations / cost.moved for cost in last.values()])
    y = np.array([cost.operations / cost.seconds for cost in last.values()])
    rooms = [name.partition(".")[0] for name in last]
    figure, axes = plt.subplots(figsize=(10, 6))
    for number, room in enumerate(dict.fromkeys(rooms)):
        own, color = [each == room for each in rooms], plt.colormaps["tab20"](number)
        axes.scatter(x[own], y[own], color=color, s=20, label=room)
    grid = np.geomspace(min(x) / 2, max(x) * 2, 100)
    for kind in ("products", "operations", "exponentials"):
        roof = np.minimum(grid * found.rates.moved, getattr(found.rates, kind))
        axes.plot(grid, roof, "k-", lw=0.8)
        axes.text(grid[-1], roof[-1], kind, ha="right", va="bottom", fontsize=8)
    slowest = sorted(last, key=lambda n: last[n].seconds / last[n].ceiling)[-8:]
    for name in slowest:
        at = [*last].index(name)
        axes.annotate(name, (x[at], y[at]), fontsize=7, xytext=(4, -3),
                      textcoords="offset points")  # fmt: skip
    axes.set(xscale="log", yscale="log", xlabel="operations a byte",
             ylabel="operations a second")  # fmt: skip
    axes.legend(fontsize=7, ncols=2, loc="lower right")
    return figure


def report(found: Found) -> Report:
    """Say what was found.

    Args:
        found: by `run`.

    Returns:
        a line a function, and the plot.
    """
    costs, before, _ = found
    changes = {name: now / then for name, (then, now) in before.items() if then}
    rows = [row(name, cost, changes.get(name)) for name, cost in costs.items()]
    ratios = sorted(each.ratio for each in rows)
    growth = [each.growth for each in rows]
    slowest = max(rows, key=lambda each: each.ratio)
    answer = (
        f"Half of {len(rows)} functions take at most {ratios[len(rows) // 2]:.1f} "
        f"times as long as their arithmetic or a copy of their images, all at most "
        f"{ratios[-1]:.0f} times ({slowest.name}); time grows as the pixels to a power "
        f"of {min(growth):.2f} to {max(growth):.2f}."
    )
    if changes:
        faster = sum(change < 1 / NOISE for change in changes.values())
        slower = sum(change > NOISE for change in changes.values())
        answer += (
            f" Of {len(changes)} that were there before {faster} take less than "
            f"{1 / NOISE:.2f} of the time, {slower} more than {NOISE:.2f} times."
        )
    sizes = list(next(iter(costs.values())))
    memory = [f"B/pixel at {size}" for size in sizes]
    header = (
        "function",
        "of the time before",
        "s/Mpx",
        "ceiling",
        "ratio",
        *memory,
        "growth",
    )
    header = *header, "compiling, s", "gradient compiling, s"
    body = table(header, rows)
    return Report(answer, body, {"arithmetic a second": roofline(found)})


if __name__ == "__main__":
    main(Config, run, report)
