r"""Uncorrelated kernels: weights that follow the data and yet hardly bias the result.

Layout: images [H,W,C], linear radiance; channels are combined separately, with one
gamma. Sub-averages are means of disjoint samples, equally many, stacked on the first
axis: [B,H,W,C]. Notation, for a pixel c and another i in its window:

    y, z     independent and correlated estimates (common random numbers: neighbours
             have similar noise), both unbiased, independent of each other
    z^j      a sub-average, j = 1 ... B;  y, z without j: means of all of them
    n        samples a pixel in each sub-average
    D_ci z   difference z_c - z_i
    |O_c|    number of valid pixels in the window without c
    gamma    how fast weights fall with the differences' noise, per squared radiance

    u_c = y_c + sum_{i != c} k_i (D_ci z - D_ci y)                                   (5)
    k_i = exp(-gamma n (D_ci z^1 - D_ci z^2)^2) / |O_c|                              (8)

Where two pixels have similar noise, their difference is accurate, and y_c is drawn
towards y_i + D_ci z. A kernel that stays the same when a constant is added to all
D_ci z^j, and when all change sign, is *admissible*: it is uncorrelated with their mean
where the noise is symmetric, and u is unbiased (theorem 2). Skewed noise leaves a bias
that falls faster with n than the noise, so that u is consistent.

Source: J. Back, B. Hua, T. Hachisuka, B. Moon, "Input-Dependent Uncorrelated Weighting
for Monte Carlo Denoising", 2023 (IDU; eq. numbers above).
"""

from jscomb.uncorrelated._combine import (
    combine,
    combine_crosswise,
    combine_decorrelated,
    combine_uniform,
    combine_with,
)
from jscomb.uncorrelated._estimate import (
    MULTIPLES,
    UNIT,
    relative_variances,
    select_gamma,
)
from jscomb.uncorrelated._frame import NEEDS, combine_frame, select_gamma_frame
from jscomb.uncorrelated._kernels import Admissibility, admissibility, variance_kernel

__all__ = [
    "MULTIPLES",
    "NEEDS",
    "UNIT",
    "Admissibility",
    "admissibility",
    "combine",
    "combine_crosswise",
    "combine_decorrelated",
    "combine_frame",
    "combine_uniform",
    "combine_with",
    "relative_variances",
    "select_gamma",
    "select_gamma_frame",
    "variance_kernel",
]
