"""The command `jscomb`: render, combine, compare, view and describe frames, and train.

Errors of the input are one line on standard error and exit status 2; Ctrl-C is one line
and status 130, also while the package is still being imported.
"""

import atexit
import gc
import importlib
import io
import os
import sys
from importlib import metadata
from typing import TYPE_CHECKING, Any

from jscomb import cache
from jscomb.cli._interrupting import ends_on_interrupt

if TYPE_CHECKING:
    from jscomb.cli._rendering import render_file
    from jscomb.cli._training import (
        Run,
        prepare,
        split_files,
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
    if sys.argv[1:] == ["--version"]:
        print(f"jscomb {metadata.version('jscomb')}, JAX {metadata.version('jax')}")
        return
    if isinstance(sys.stdout, io.TextIOWrapper):  # names that it cannot show
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        with ends_on_interrupt():
            _use_compilation_cache()
            collect_rarely()
            parsing = importlib.import_module("jscomb.cli._parsing")
            parsing.parse()()
            sys.stdout.flush()
    except BrokenPipeError:  # the reader of our output has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    except (ValueError, OSError, ImportError, RuntimeError) as error:
        print("jscomb:", " ".join(str(error).split()), file=sys.stderr)
        sys.exit(2)


def __getattr__(name: str) -> Any:
    """Import what is asked for first; slow to import, and Ctrl-C must be seen."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    room = "_rendering" if name == "render_file" else "_training"
    return getattr(importlib.import_module(f"{__name__}.{room}"), name)


def collect_rarely() -> None:
    """Look rarely for garbage in cycles, and never at the end.

    Tracing makes millions of objects, hardly one of them in a cycle.
    """
    gc.set_threshold(100_000, 20, 50)
    atexit.register(gc.freeze)


def _use_compilation_cache() -> None:
    """Keep compiled programs in the user's cache, so the second run starts fast.

    JAX reads this when it is imported, in other processes too.
    """
    # JAX 0.10.1 complains about every program that it finds there, of a processor that
    # lacks a preference of the compiler; all run. A process that has imported JAX hands
    # on JAX's own level, 1, to those that it starts.
    if os.environ.get("TF_CPP_MIN_LOG_LEVEL", "1") == "1":
        os.environ["TF_CPP_MIN_LOG_LEVEL"] = "3"
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(cache.folder() / "xla"))
