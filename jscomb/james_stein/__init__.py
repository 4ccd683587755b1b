r"""James-Stein combination of an unbiased and a biased rendering (NJS).

Layout: images [H,W,C], linear radiance; channels are shrunk separately. Notation:

    x    unbiased rendering (path traced)
    y    biased rendering (denoised, photon mapped), any image at all
    v    variance of the mean x at each pixel, squared radiance
    s2   the variance assumed for a whole window
    c    centre of a window, i a pixel in it, p the number of its pixels
    eta  the share of x - y that survives in a window, in [0, 1]

In each window the positive-part James-Stein rule keeps

    eta_c = (1 - (p-2) s2_c / sum_i (x_i - y_i)^2)+            one variance a window
    eta_c = (1 - (p-2) / sum_i (x_i - y_i)^2 / v_i)+           whitened

of the difference; every pixel takes the mean share of all windows that contain it,

    x^_i = y_i + mean_c(eta_c) (x_i - y_i).

For p >= 3, Gaussian noise and a y that does not depend on x, each window's result has
a lower expected squared error than x, whatever y is: summed over the window for equal
variances, and in units of the variance for the whitened rule, which needs no equality.
In plain squared error the whitened rule can be worse than x under unequal variances:
where y is off at the one noisy pixel of a window, all its pixels say that y is right.
Both are about a window's sum. A single pixel can lose, and so can a relative error,
which weighs dark pixels more: beside a noisy light that y spreads it loses much.
A denoised y does depend on x, and path-traced noise is not Gaussian, so in practice
neither is a guarantee: at low sample counts a good denoiser alone is often better.
The divergence of the denoiser, D_i = (J Sigma)_ii, corrects for the dependence:

    eta_c = (1 - sum_i (v_i - D_i) / sum_i (x_i - y_i)^2)+

has the minimum expected error by Stein's lemma (whitened: each i over v_i).

A window of fewer than three pixels cannot shrink and keeps x, and so does one without
any variance. The whitened sum excludes pixels of variance 0.

`combine_bands` shrinks what is left in bands of spatial scale.
`cross_regression` makes a better biased image from two half buffers and a biased image
of each; `worth_regressing` estimates whether it helps. `neural_combine` has a network
that chooses the variances. Functions of frames end in `_frame`, and `regress`.

Sources:
    J. Gu, J. Iglesias-Guitian, B. Moon, "Neural James-Stein Combiner for Unbiased and
    Biased Renderings", 2022 (NJS; eq. numbers in the functions).
    W. James, C. Stein, "Estimation with quadratic loss", 1961.
    A. Baranchik, "Multiple regression and estimation of the mean of a multivariate
    normal distribution", 1964 (the positive part).
"""

from jscomb.james_stein._bands import (
    combine_bands,
    reach_of_bands,
    strength_for,
)
from jscomb.james_stein._combine import combine, combine_dual, reach
from jscomb.james_stein._estimate import guide_noise, risk, risk_bound, worth_regressing
from jscomb.james_stein._frame import (
    BANDS_NEEDS,
    NEEDS,
    NEURAL_NEEDS,
    Regressed,
    combine_frame,
    neural_combine_frame,
    neural_inputs,
    plan_bands,
    plan_frame,
    plan_neural,
    regress,
)
from jscomb.james_stein._neural import (
    Parameters,
    Rule,
    combine_inputs,
    neural_combine,
    neural_combine_dual,
    rule_of,
)
from jscomb.james_stein._regression import cross_regression
from jscomb.numerics.variances import robust_variance, smooth_variance

__all__ = [
    "BANDS_NEEDS",
    "NEEDS",
    "NEURAL_NEEDS",
    "Parameters",
    "Regressed",
    "Rule",
    "combine",
    "combine_bands",
    "combine_dual",
    "combine_frame",
    "combine_inputs",
    "cross_regression",
    "guide_noise",
    "neural_combine",
    "neural_combine_dual",
    "neural_combine_frame",
    "neural_inputs",
    "plan_bands",
    "plan_frame",
    "plan_neural",
    "reach",
    "reach_of_bands",
    "regress",
    "risk",
    "risk_bound",
    "robust_variance",
    "rule_of",
    "smooth_variance",
    "strength_for",
    "worth_regressing",
]
