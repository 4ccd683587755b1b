r"""Uncorrelated kernels: weights that follow the data and yet hardly bias the result.

Layout: images [H,W,C], linear radiance; channels are combined separately, by the same
gamma. Sub-averages are means of disjoint samples, equally many, stacked on the first
axis: [B,H,W,C]. Notation, for a pixel c and another i in its window:

    y, z     independent and correlated estimates (common random numbers: the noise of
             neighbours is alike), both unbiased, independent of each other
    z^j      a sub-average, j = 1 ... B;  y, z without j: means of all of them
    n        samples a pixel in each sub-average
    D_ci z   difference z_c - z_i
    |O_c|    number of valid pixels in the window without c
    gamma    how fast weights fall with the differences' noise, per squared radiance

    u_c = y_c + sum_{i != c} k_i (D_ci z - D_ci y)                                   (5)
    k_i = exp(-gamma n (D_ci z^1 - D_ci z^2)^2) / |O_c|                              (8)

Where two pixels' noise is alike their difference is known well, and y_c is drawn
towards y_i + D_ci z. A kernel that stays the same when a constant is added to all
D_ci z^j, and when all change sign, is *admissible*: it is uncorrelated with their mean
where the noise is symmetric, and u is unbiased (theorem 2). Skewed noise leaves a bias
that falls faster with n than the noise, so that u is consistent.

Source: J. Back, B. Hua, T. Hachisuka, B. Moon, "Input-Dependent Uncorrelated Weighting
for Monte Carlo Denoising", 2023 (IDU; eq. numbers above).
"""

from jscomb.uncorrelated.combination import combine as combine
from jscomb.uncorrelated.combination import combine_crosswise as combine_crosswise
from jscomb.uncorrelated.combination import combine_decorrelated as combine_decorrelated
from jscomb.uncorrelated.combination import combine_uniform as combine_uniform
from jscomb.uncorrelated.combination import combine_with as combine_with
from jscomb.uncorrelated.kernels import Admissibility as Admissibility
from jscomb.uncorrelated.kernels import admissibility as admissibility
from jscomb.uncorrelated.kernels import variance_kernel as variance_kernel
from jscomb.uncorrelated.selection import MULTIPLES as MULTIPLES
from jscomb.uncorrelated.selection import UNIT as UNIT
from jscomb.uncorrelated.selection import Combined as Combined
from jscomb.uncorrelated.selection import combine_frames as combine_frames
from jscomb.uncorrelated.selection import relative_variances as relative_variances
from jscomb.uncorrelated.selection import select_gamma as select_gamma
