"""Processes in which something may crash, hang, or take all memory."""

import multiprocessing
import pathlib
import resource
from collections.abc import Callable
from typing import Any, NamedTuple


class Reply(NamedTuple):
    """What came of an attempt.

    Attributes:
        value: what the function returned.
        error: the exception; None if there was none.
        failure: crash or hang; empty if there was an answer.
    """

    value: Any = None
    error: BaseException | None = None
    failure: str = ""


class Worker:
    """A process that tries functions, one after another, and may die of them."""

    def __init__(self, prepare: Callable[[], None], headroom: int, seconds: float):
        """Start it.

        Args:
            prepare: of a module; called first, without limits.
            headroom: bytes that all else may take beside what the process then has.
            seconds: that an attempt may take.
        """
        self.arguments, self.seconds = (prepare, headroom), seconds
        self._start()

    def _start(self) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipe, other = context.Pipe()
        arguments = other, *self.arguments
        self.process = context.Process(target=_serve, args=arguments, daemon=True)
        self.process.start()
        other.close()
        assert self.pipe.recv() == "ready"

    def send(self, function: Callable, *arguments: Any) -> None:
        """Begin.

        Args:
            function: of a module.
            arguments: its arguments.
        """
        self.pipe.send((function, arguments))

    def receive(self) -> Reply:
        """Wait for the end, which may be a violent one.

        Returns:
            what came of it.
        """
        failure = "hang"
        try:
            if self.pipe.poll(self.seconds):
                return Reply(*self.pipe.recv())
        except EOFError:
            failure = "crash"
        self.close()
        self._start()
        return Reply(failure=failure)

    def attempt(self, function: Callable, *arguments: Any) -> Reply:
        """Begin, and wait.

        Args:
            function: of a module.
            arguments: its arguments.

        Returns:
            what came of it.
        """
        self.send(function, *arguments)
        return self.receive()

    def close(self) -> None:
        """End the process."""
        self.process.kill()
        self.process.join()
        self.pipe.close()


def _serve(pipe: Any, prepare: Callable[[], None], headroom: int) -> None:
    """What a worker does."""
    prepare()
    pages = int(pathlib.Path("/proc/self/statm").read_text().split()[0])
    limit = pages * resource.getpagesize() + headroom
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    pipe.send("ready")
    while True:
        function, arguments = pipe.recv()
        try:
            answer = function(*arguments), None
        except Exception as error:
            # Only what is printed of it matters; not every exception can be pickled.
            kind = type(error) if isinstance(error, OSError | ValueError) else Exception
            memory = isinstance(error, MemoryError) or "into memory" in str(error)
            answer = None, (MemoryError if memory else kind)(str(error))
        pipe.send(answer)
