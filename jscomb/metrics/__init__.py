"""Errors of an image against a reference.

Layout: images [H,W,C], linear radiance. Errors are means over pixels and channels. A
pixel that is not finite makes the error NaN or infinite. A `mask` [H,W,1] selects the
pixels that count, usually `numerics.guards.finite(image, reference)`; report the number
of the others beside the error.
"""

from jscomb.metrics._display import (
    dssim,
    flip,
    flip_map,
    hdr_flip,
    hdr_flip_map,
    psnr,
    ssim,
    tone_map,
)
from jscomb.metrics._errors import (
    Change,
    mean_change,
    rel_l2,
    rel_l2_change,
    rel_l2_map,
    rmse,
    smape,
)
from jscomb.metrics._estimated import ErrorEstimate, estimate_error

__all__ = [
    "Change",
    "ErrorEstimate",
    "dssim",
    "estimate_error",
    "flip",
    "flip_map",
    "hdr_flip",
    "hdr_flip_map",
    "mean_change",
    "psnr",
    "rel_l2",
    "rel_l2_change",
    "rel_l2_map",
    "rmse",
    "smape",
    "ssim",
    "tone_map",
]
