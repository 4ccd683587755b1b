"""Combine unbiased and biased Monte Carlo renderings into one better image, in JAX.

A frame and its estimates are read, combined and written::

    import jax
    import jscomb

    frame = jscomb.read_frame("frame.exr")
    estimate = jscomb.combine(jax.random.key(0), frame)
    jscomb.exr.write_image("combined.exr", estimate.image)

Each paper is one package of pure functions: `james_stein`, `ensemble`,
`double_shrinkage`, `progressive`, `uncorrelated`. Each has `combine` for arrays and
`combine_frame` for frames. `methods` lists everything by name, and `guide` has pages on
how to choose among them, on files, on large frames and on research.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jscomb import (
        denoisers,
        double_shrinkage,
        ensemble,
        exr,
        features,
        frame,
        guide,
        james_stein,
        learning,
        methods,
        metrics,
        numerics,
        progressive,
        rendering,
        uncorrelated,
    )
    from jscomb.exr import read_frame
    from jscomb.frame import Estimate, Frame, make_frame
    from jscomb.methods import combine

__all__ = [
    "Estimate",
    "Frame",
    "combine",
    "denoisers",
    "double_shrinkage",
    "ensemble",
    "exr",
    "features",
    "frame",
    "guide",
    "james_stein",
    "learning",
    "make_frame",
    "methods",
    "metrics",
    "numerics",
    "progressive",
    "read_frame",
    "rendering",
    "uncorrelated",
]

__version__ = "0.1.0"

_NAMES = {
    "Estimate": "jscomb.frame",
    "Frame": "jscomb.frame",
    "combine": "jscomb.methods",
    "make_frame": "jscomb.frame",
    "read_frame": "jscomb.exr",
}


def __getattr__(name: str) -> Any:
    """Import a room when it is asked for first: JAX is slow to import."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module = importlib.import_module(_NAMES.get(name, f"{__name__}.{name}"))
    found = getattr(module, name) if name in _NAMES else module
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    """Names that are imported when asked for, too."""
    return sorted({*globals(), *__all__})
