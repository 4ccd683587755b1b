"""The bases of the ensemble experiments: six real denoisers, each with halves."""

from jscomb.denoisers import bilateral, nonlocal_means, oidn, rdfc, smoothing
from jscomb.frame import Estimate, Frame, Maker, with_halves

BASES: dict[str, Maker] = {
    "oidn": lambda frame: frame.estimates.get("oidn") or oidn.denoise_frame(frame),
    "oidn, no features": lambda frame: oidn.denoise_frame(frame, features=False),
    "bilateral": bilateral.denoise_frame,
    "gaussian": smoothing.denoise_frame,
    "non-local means": nonlocal_means.denoise_frame,
    "rdfc": rdfc.denoise_frame,
}


def bases_of(frame: Frame) -> dict[str, Estimate]:
    """The bases of a frame and of its halves, in the order of `BASES`.

    Args:
        frame: normalised, with halves and variances; its own `oidn` is taken if it has
            one.

    Returns:
        the estimates, with halves.
    """
    return {name: make(frame) for name, make in BASES.items()}


def unbiased_of(frame: Frame) -> Estimate:
    """The unbiased image as one more base."""
    return with_halves(frame, lambda part: part.color)
