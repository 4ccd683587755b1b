"""What does each public function cost, and how does that grow with the image?

    python -m experiments.benchmarks.performance --results RESULTS.jsonl

On the bundled frame, mirrored until it is as large as asked: seconds, the time that the
function's arithmetic takes at the rates of the same run (matrix products, other
arithmetic, exponentials; or a copy of its arguments and results if that is longer), the
ratio of the two, the most memory that its program needs beside its arguments, the power
of the number of pixels that time grows by, and seconds of compilation. What has been
measured is kept, and a second run goes on from there.
"""

import dataclasses
import json
import math
import pathlib
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import tyro
from tqdm import tqdm

from experiments.benchmarks.work import Work, rates, work_of
from experiments.common.timing import medians
from jscomb import exr
from tests.battery import catalogue, parts
from tests.battery.rendering import Rendering, mirrored, rendering_of

LONG = 1.5  # seconds after which a warm-up makes no difference


@dataclasses.dataclass(frozen=True)
class Config:
    """What to measure.

    Attributes:
        results: JSON lines, one a function and size; None to keep nothing.
        sizes: widths and heights in pixels, two.
        only: functions whose names begin so.
        quick: two small sizes, few functions.
    """

    results: pathlib.Path | None = None
    sizes: tuple[int, int] = (1024, 2048)
    only: str = ""
    quick: bool = False


class Cost(NamedTuple):
    """Of a function at one size.

    Attributes:
        seconds: median of a call.
        ceiling: seconds at the rates of the run.
        memory: bytes that the program needs beside arguments and results.
        compiling: seconds, tracing included.
    """

    seconds: float
    ceiling: float
    memory: int
    compiling: float


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


def measure(function: Callable[[Rendering], Any], r: Rendering, best: Work) -> Cost:
    """One function at one size.

    Args:
        function: to compile and call.
        r: what it is given.
        best: the machine's rates.

    Returns:
        its cost; the median of some calls after the first, or that if it is long.
    """
    start = time.perf_counter()
    program = jax.jit(function).lower(r).compile()
    compiling = time.perf_counter() - start
    start = time.perf_counter()
    jax.block_until_ready(program(r))
    seconds = time.perf_counter() - start
    if seconds < LONG:
        repeats = min(7, math.ceil(LONG / 2 / seconds))
        seconds = medians({"": lambda: program(r)}, repeats)[""]
    memory = program.memory_analysis().temp_size_in_bytes
    ceiling = work_of(function, r).seconds(best)
    return Cost(seconds, ceiling, memory, compiling)


def run(config: Config) -> dict[str, dict[int, Cost]]:
    """Measure what has not been measured.

    Args:
        config: what.

    Returns:
        costs by function and size.
    """
    sizes = (32, 64) if config.quick else config.sizes
    found = functions(quick=config.quick)
    known: dict[str, dict[int, Cost]] = {}
    if config.results is not None and config.results.exists():
        for line in config.results.read_text().splitlines():
            name, size, *cost = json.loads(line)
            known.setdefault(name, {})[size] = Cost(*cost)
    wanted = [name for name in found if name.startswith(config.only)]
    missing = [(n, s) for s in sizes for n in wanted if s not in known.get(n, {})]
    if missing:
        frame = exr.read_frame(exr.bundled()["cornell-glass-64"])
        small = rendering_of(frame)
        if config.quick:
            small = Rendering(*(i[:32, :32] for i in small[:-1]), small.unit)
        best = rates(repeats=3)
    for size in sizes:
        here = [name for name, at in missing if at == size]
        if not here:
            continue
        r = mirrored(small, size)
        for name in tqdm(here, unit="function", desc=f"{size}x{size}"):
            cost = measure(found[name], r, best)
            known.setdefault(name, {})[size] = cost
            if config.results is not None:
                with config.results.open("a") as lines:
                    print(json.dumps([name, size, *cost]), file=lines)
    return {name: {size: known[name][size] for size in sizes} for name in wanted}


def row(name: str, costs: dict[int, Cost]) -> str:
    """One line of the table.

    Args:
        name: of the function.
        costs: at two sizes, the smaller first.

    Returns:
        a line of Markdown, per pixel of the larger size.
    """
    (small, first), (large, last) = costs.items()
    pixels = large**2
    growth = math.log(last.seconds / first.seconds) / math.log(pixels / small**2)
    cells = [
        f"{1e6 * last.seconds / pixels:.3g}",
        f"{1e6 * last.ceiling / pixels:.2g}",
        f"{last.seconds / last.ceiling:.2g}",
        f"{first.memory / small**2:.0f}, {last.memory / pixels:.0f}",
        f"{growth:.2f}",
        f"{first.compiling:.1f}",
    ]
    return f"| `{name}` | {' | '.join(cells)} |"


def main() -> None:
    """Print the table."""
    config = tyro.cli(Config, description=__doc__)
    table = run(config)
    print("| function | s/Mpx | ceiling | ratio | B/pixel | growth | compiling: s |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for name, costs in table.items():
        print(row(name, costs))


if __name__ == "__main__":
    main()
