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

With more than two sub-averages the square is the mean over all pairs of them. Kernels
of the differences of y, or of both, are as good by the same theorem.

Where two pixels have similar noise, their difference is accurate, and y_c is drawn
towards y_i + D_ci z. A kernel that stays the same when a constant is added to all
D_ci z^j, and when all change sign, is *admissible*: it is uncorrelated with their mean
where the noise is symmetric, and u is unbiased (theorem 2). Skewed noise leaves a bias;
by the central limit theorem it vanishes, so that u is consistent. Its square falls
faster with n than the variance only where every sub-average has sampled the tail of the
noise; a rare bright path that most have missed leaves bias and noise that fall alike.

The theorem is for a fixed gamma; one that is selected from the same samples depends on
them a little.

Source: J. Back, B. Hua, T. Hachisuka, B. Moon, "Input-Dependent Uncorrelated Weighting
for Monte Carlo Denoising", 2023 (IDU; eq. numbers above).
"""

from jscomb.uncorrelated._combine import (
    combine,
    combine_crosswise,
    combine_decorrelated,
    combine_median,
    combine_uniform,
    combine_with,
)
from jscomb.uncorrelated._estimate import (
    MULTIPLES,
    PAPER_MULTIPLES,
    UNIT,
    relative_variances,
    select_gamma,
    select_gamma_map,
)
from jscomb.uncorrelated._frame import NEEDS, combine_frame, select_gamma_frame
from jscomb.uncorrelated._kernels import (
    Admissibility,
    admissibility,
    median_kernel,
    variance_kernel,
)

__all__ = [
    "MULTIPLES",
    "NEEDS",
    "PAPER_MULTIPLES",
    "UNIT",
    "Admissibility",
    "admissibility",
    "combine",
    "combine_crosswise",
    "combine_decorrelated",
    "combine_frame",
    "combine_median",
    "combine_uniform",
    "combine_with",
    "median_kernel",
    "relative_variances",
    "select_gamma",
    "select_gamma_frame",
    "select_gamma_map",
    "variance_kernel",
]
