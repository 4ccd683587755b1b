"""The command line, parsed into a call to make."""

import contextlib
import functools
import io
import os
import re
import sys
from collections.abc import Callable
from typing import Any

import tyro

from jscomb import methods, rendering
from jscomb.cli._combining import combine
from jscomb.cli._demo import demo
from jscomb.cli._rendering import render
from jscomb.cli._showing import info
from jscomb.cli._training import train
from jscomb.cli._viewing import compare, view


def parse() -> Callable[[], None]:
    """Parse the command line into a call to make; a wrong one is a `ValueError`."""

    def later(command: Callable) -> Callable:
        @functools.wraps(command)
        def bind(*args: Any, **kwargs: Any) -> Callable[[], None]:
            return lambda: command(*args, **kwargs)

        doc = (command.__doc__ or "").replace("{methods}", listed(methods.METHODS))
        doc = doc.replace("{tiers}", listed(methods.TIERS))
        bind.__doc__ = doc.replace("{scenes}", ", ".join(rendering.SCENES))
        return bind

    listed = lambda table: "; ".join(f"{n} ({m.summary})" for n, m in table.items())
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            return tyro.extras.subcommand_cli_from_dict(
                {
                    c.__name__: later(c)
                    for c in (demo, render, combine, compare, view, info, train)
                },
                prog="jscomb",
                args=_as_combine(sys.argv[1:]),
                description="Combine unbiased and biased Monte Carlo renderings. "
                "--version prints the version.",
            )
    except SystemExit as end:
        if not end.code:
            raise  # --help
        text = re.sub(r"\x1b\[[0-9;]*m|[^\x00-\x7f]", " ", said.getvalue())
        text = " ".join(text.replace("-" * 8, "").split())
        # The heading of its message is the message's first words, too.
        raise ValueError(re.sub(r"^(\w+ \w+) (?=\1)", "", text)) from None


# What denoisers call their options, and what they are called here.
_DENOISERS = {"hdr": "", "alb": "--albedo", "nrm": "--normal", "output": "--out"}


def _as_combine(arguments: list[str]) -> list[str]:
    """A command as Open Image Denoise's own tool takes it, as one of ours."""
    names = [re.sub("^--?", "", a) if a.startswith("-") else "" for a in arguments]
    if "hdr" in names:
        words = [
            _DENOISERS.get(name, argument) if name else argument
            for name, argument in zip(names, arguments, strict=True)
        ]
        rest = [word for word in words if word]
        return rest if rest[:1] == ["combine"] else ["combine", *rest]
    is_command = bool(arguments) and not names[0] and not os.path.exists(arguments[0])
    if len(arguments) > 1 and not is_command and names[0] not in ("h", "help"):
        raise ValueError(f"did you mean: jscomb combine {' '.join(arguments)}")
    return arguments
