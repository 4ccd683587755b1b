"""Is any public function slow on an accelerator by construction?

No accelerator takes part: programs are traced as they would be there and lowered for
CUDA. Counted is what runs one after another and cannot overlap: primitives that compute
(XLA fuses many of them) times the steps of the loops that they are in, first with the
sizes that suit a processor's cache, then with those for accelerators; how much each
of these has to do; and calls of the host. A while loop counts as one step, the larger
branch as taken.
"""

import dataclasses
import itertools
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple
from unittest import mock

import jax
from jax.extend import core
from tqdm import tqdm

from experiments.benchmarks.performance import functions
from experiments.benchmarks.work import LAYOUT, inside, work_of
from experiments.common.command import Options, main
from experiments.common.report import Report
from experiments.common.tables import table
from jscomb import exr
from tests.battery.rendering import Rendering, mirrored, rendering_of


@dataclasses.dataclass(frozen=True)
class Config(Options):
    """What to trace.

    Attributes:
        size: width and height in pixels.
        only: functions whose names begin so.
    """

    size: int = 1024
    only: str = ""


class Program(NamedTuple):
    """What one function does there.

    Attributes:
        on_cpu: primitives in a row, with a processor's sizes.
        steps: with an accelerator's.
        operations: of one of these, in the mean.
        callbacks: calls of the host.
    """

    on_cpu: int
    steps: int
    operations: float
    callbacks: int


def primitives(jaxpr: core.Jaxpr) -> Iterator[tuple[str, int]]:
    """What runs, and how often.

    Args:
        jaxpr: a program.

    Yields:
        names of primitives that compute, and the steps of the loops that they are in.
    """
    for equation in jaxpr.eqns:
        name = equation.primitive.name
        branches = [list(primitives(each)) for each in inside(equation)]
        if name == "cond":
            branches = [max(branches, key=lambda each: sum(n for _, n in each))]
        times = equation.params.get("length", 1)
        for inner, count in itertools.chain(*branches):
            yield inner, times * count
        if not branches and name not in LAYOUT:
            yield name, 1


def traced(function: Callable[[Rendering], Any], r: Rendering) -> list[tuple[str, int]]:
    """The primitives of a function's program."""
    return list(primitives(jax.make_jaxpr(function)(r).jaxpr))


def as_on_accelerators(
    function: Callable[[Rendering], Any], r: Rendering
) -> tuple[list[tuple[str, int]], float]:
    """The same where sizes are an accelerator's, and all operations.

    It is also lowered, which fails if CUDA has no form of a primitive.
    """
    with mock.patch.object(jax, "default_backend", return_value="gpu"):
        jax.jit(function).trace(r).lower(lowering_platforms=("cuda",))
        work = work_of(function, r)
        return traced(function, r), sum(work._replace(moved=0.0))


def run(config: Config) -> dict[str, Program]:
    """Trace every function twice.

    Args:
        config: which, and how large a frame.

    Returns:
        counts by function.
    """
    size = 256 if config.quick else config.size
    found = functions(quick=config.quick)
    wanted = {n: f for n, f in found.items() if n.startswith(config.only)}
    r = mirrored(rendering_of(exr.read_frame(exr.bundled()["cornell-glass-64"])), size)
    programs = {}
    for name, function in tqdm(wanted.items(), unit="function"):
        jax.clear_caches()  # of what was traced with the other sizes
        on_cpu = sum(count for _, count in traced(function, r))
        jax.clear_caches()
        there, operations = as_on_accelerators(function, r)
        steps = sum(count for _, count in there)
        callbacks = sum(count for primitive, count in there if "callback" in primitive)
        programs[name] = Program(on_cpu, steps, operations / max(1, steps), callbacks)
    jax.clear_caches()
    return programs


def report(programs: dict[str, Program]) -> Report:
    """Say what was found.

    Args:
        programs: by `run`.

    Returns:
        a line a function, those with the most steps first.
    """
    order = sorted(programs.items(), key=lambda each: -each[1].steps)
    longest, most = order[0]
    hosts = [f"`{name}`" for name, each in order if each.callbacks]
    fewer = sum(each.steps < each.on_cpu for each in programs.values())
    answer = (
        f"All {len(order)} functions lower for CUDA; "
        f"{', '.join(hosts) or 'none'} call{'s' if len(hosts) < 2 else ''} the host. "
        f"The sizes for accelerators shorten {fewer} programs; the longest, "
        f"`{longest}`, has {most.steps} primitives in a row of "
        f"{most.operations:.2g} operations each."
    )
    header = "function", "in a row, CPU's sizes", "accelerator's", "operations", "host"
    rows = [[f"`{name}`", *each] for name, each in order]
    return Report(answer, table(header, rows))


if __name__ == "__main__":
    main(Config, run, report)
