"""Work in fresh processes, for libraries that keep what they once compiled."""

import concurrent.futures
import multiprocessing
from collections.abc import Callable, Iterator, Sequence
from typing import TypeVar

Task = TypeVar("Task")
Result = TypeVar("Result")


def in_fresh_processes(
    function: Callable[[Task], Result], tasks: Sequence[Task], *, each: int = 1
) -> Iterator[Result]:
    """Apply a function to tasks in order, in a new process after every few.

    Not by the executor's own `max_tasks_per_child`: in Python 3.11 it was seen to wait
    for ever for the next process.

    Args:
        function: of one task; importable.
        tasks: what to do.
        each: tasks of one process.

    Yields:
        the results.

    Raises:
        RuntimeError: if a process crashed.
    """
    context = multiprocessing.get_context("spawn")
    for first in range(0, len(tasks), each):
        with concurrent.futures.ProcessPoolExecutor(1, mp_context=context) as process:
            yield from process.map(function, tasks[first : first + each])
