"""The command of an experiment or a tool: options, report, one line for an error."""

import dataclasses
import inspect
import pathlib
import shlex
import sys
from collections.abc import Callable
from typing import Any, TypeVar

import tyro

from experiments.common.report import Report, write

Config = TypeVar("Config", bound="Options")
Result = TypeVar("Result")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Options:
    """What every experiment can be told; a configuration adds its own.

    Attributes:
        quick: a short version on small input, which shows that the command runs.
        report: folder whose RESULTS.md takes the report, with its plots; by default the
            report is only printed.
    """

    quick: bool = False
    report: pathlib.Path | None = None


def main(
    config: type[Config],
    run: Callable[[Config], Result],
    report: Callable[[Result], Report],
) -> None:
    """Run an experiment from the command line.

    Args:
        config: its options, a frozen dataclass.
        run: measure.
        report: what the result says.

    Raises:
        SystemExit: with one line, if the input is bad or a package is missing.
    """
    name, doc = _described(run)
    options, found = _called(config, name, doc, lambda options: report(run(options)))
    print(f"{found.answer}\n\n{found.body}")
    if options.report is not None:
        command = shlex.join(["python", "-m", name, *without_folders(sys.argv[1:])])
        write(options.report, name, doc, command, found)


def without_folders(words: list[str]) -> list[str]:
    """Shorten absolute paths to their names, or whose folder it was would be told.

    Args:
        words: of a command.

    Returns:
        the words, with the last folder too of paths that share a name.
    """
    names = [pathlib.Path(word).name for word in words]

    def shown(word: str, name: str) -> str:
        if not word.startswith("/"):
            return word
        parts = 2 if names.count(name) > 1 else 1
        return "/".join(pathlib.Path(word).parts[-parts:])

    return [shown(*each) for each in zip(words, names, strict=True)]


def tool(config: type, run: Callable[[Any], object]) -> None:
    """Run a program that answers no question from the command line.

    Args:
        config: its options, a frozen dataclass.
        run: do it.

    Raises:
        SystemExit: with one line, if the input is bad or a package is missing.
    """
    _called(config, *_described(run), run)


def _described(run: Callable) -> tuple[str, str]:
    """Name and docstring of the module of a function."""
    module = inspect.getmodule(run)
    assert module is not None
    assert module.__spec__ is not None
    assert module.__doc__ is not None
    return module.__spec__.name, module.__doc__


def _called(
    config: type, name: str, doc: str, run: Callable[[Any], Result]
) -> tuple[Any, Result]:
    """The options, and what comes of them; bad input is one line."""
    try:
        options = tyro.cli(config, prog=f"python -m {name}", description=doc)
        return options, run(options)
    except (ValueError, OSError, ImportError, RuntimeError) as error:
        sys.exit(f"{name}: {' '.join(str(error).split())}")
