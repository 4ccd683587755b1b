"""Mathematics shared by the combiners; nothing here knows about a paper."""

from jscomb.numerics import (
    cholesky,
    convolution,
    guards,
    kernels,
    luminance,
    medians,
    poisson,
    regression,
    simplex,
    sure,
    tiles,
    weights,
    windows,
)

__all__ = [
    "cholesky",
    "convolution",
    "guards",
    "kernels",
    "luminance",
    "medians",
    "poisson",
    "regression",
    "simplex",
    "sure",
    "tiles",
    "weights",
    "windows",
]
