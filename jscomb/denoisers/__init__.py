"""Denoisers: each has `denoise` on arrays and `denoise_frame(frame) -> Estimate`.

All but `oidn` are scale-equivariant and take any frame; `oidn` takes normalised ones.
`kernel_predicting` needs a network; `black_box` makes a denoiser of any function of
NumPy arrays. `NEEDS` of a module is what its `denoise_frame` needs of a frame. The
estimate has halves where each half has what is needed. Local denoisers have `reach`,
the distance in pixels that their results depend on.
"""

from jscomb.denoisers import (
    bilateral,
    kernel_predicting,
    nfor,
    nonlocal_means,
    oidn,
    rdfc,
    smoothing,
)
from jscomb.denoisers._black_box import BlackBox, black_box

__all__ = [
    "BlackBox",
    "bilateral",
    "black_box",
    "kernel_predicting",
    "nfor",
    "nonlocal_means",
    "oidn",
    "rdfc",
    "smoothing",
]
