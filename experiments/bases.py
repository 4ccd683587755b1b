"""The bases of the ensemble experiments: six real denoisers, each with halves."""

from collections.abc import Callable

import jax

from jscomb.denoisers import bilateral, nonlocal_means, of_parts, oidn, rdfc, smoothing
from jscomb.frame import Estimate, Frame

_means = jax.jit(nonlocal_means.denoise)
_gaussian = jax.jit(smoothing.gaussian)

BASES: dict[str, Callable[[Frame], Estimate]] = {
    "oidn": lambda frame: frame.estimates.get("oidn") or oidn.denoise_frame(frame),
    "oidn, no features": lambda frame: oidn.denoise_frame(frame, features=False),
    "bilateral": bilateral.denoise_frame,
    "gaussian": lambda frame: of_parts(
        frame, lambda part: _gaussian(part.color), variance=False
    ),
    "non-local means": lambda frame: of_parts(
        frame, lambda part: _means(part.color, part.color, part.variance)
    ),
    "rdfc": rdfc.denoise_frame,
}


def bases_of(frame: Frame) -> dict[str, Estimate]:
    """The bases of a frame and of its halves, in the order of `BASES`.

    Args:
        frame: with halves and variances; its own `oidn` is taken if it has one.

    Returns:
        the biased images, with halves.
    """
    return {name: make(frame) for name, make in BASES.items()}


def unbiased_of(frame: Frame) -> Estimate:
    """The unbiased image as one more base."""
    return of_parts(frame, lambda part: part.color, variance=False)
