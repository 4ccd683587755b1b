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
