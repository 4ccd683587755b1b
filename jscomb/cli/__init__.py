"""The command `jscomb`: render, combine, compare and describe frames, and train.

Errors of the input are one line on standard error and exit status 2.
"""

import contextlib
import functools
import io
import os
import re
import sys
from collections.abc import Callable
from typing import Any

import jax
import tyro

from jscomb import cache, methods, rendering
from jscomb.cli._combining import combine
from jscomb.cli._interrupting import ends_on_interrupt
from jscomb.cli._rendering import render, render_file
from jscomb.cli._showing import compare, demo, info
from jscomb.cli._training import (
    Run,
    prepare,
    split_files,
    train,
    train_files,
    with_bases,
)

__all__ = [
    "Run",
    "main",
    "prepare",
    "render_file",
    "split_files",
    "train_files",
    "with_bases",
]


def main() -> None:
    """Run the command; the entry point of `jscomb`."""
    _use_compilation_cache()
    try:
        with ends_on_interrupt():
            _parse()()
            sys.stdout.flush()
    except BrokenPipeError:  # the reader of our output has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    except (ValueError, OSError, ImportError, RuntimeError) as error:
        print("jscomb:", " ".join(str(error).split()), file=sys.stderr)
        sys.exit(2)


def _parse() -> Callable[[], None]:
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
                    for c in (demo, render, combine, compare, info, train)
                },
                prog="jscomb",
                args=_as_combine(sys.argv[1:]),
                description="Combine unbiased and biased Monte Carlo renderings.",
            )
    except SystemExit as end:
        if not end.code:
            raise  # --help
        text = re.sub(r"\x1b\[[0-9;]*m|[^\x00-\x7f]", " ", said.getvalue())
        raise ValueError(text.replace("-" * 8, "")) from None


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
    if arguments and (names[0] or os.path.exists(arguments[0])):
        if names[0] not in ("h", "help") and len(arguments) > 1:
            raise ValueError(f"did you mean: jscomb combine {' '.join(arguments)}")
    return arguments


def _use_compilation_cache() -> None:
    """Keep compiled programs in the user's cache, so the second run starts fast."""
    if jax.__version_info__ < (0, 10, 2):
        return  # it would warn about every program that it finds there
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        programs = str(cache.folder() / "xla")
        jax.config.update("jax_compilation_cache_dir", programs)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
