r"""Double shrinkage: blend two integrators, then pull the blend towards a prior.

Layout: images [H,W,C], linear radiance. Errors are squared radiance, [H,W,1] for all
channels or [H,W,C]. Notation:

    u, b    unbiased and biased image, of independent samples
    v       variance of the mean u
    m       mean squared error of b: its variance plus its squared bias
    p       prior, a smooth image
    eta^2   mean squared error of p: its expected squared distance from the truth

    x1 = k1 b + (1 - k1) u,   k1 = v / (v + m),    with error s = v m / (v + m)
    x  = k2 p + (1 - k2) x1,  k2 = s / (s + eta^2)                           (9, 10)

This is the posterior mean of the truth where all errors are Gaussian. The first step
favours the better of two integrators, the second removes noise that both have left.

The prior is a windowed regression on features, of u and b together, where the weights
of each come from the other (`radiance_prior`). Without a network, eta^2 comes from
`prior_error`, and m from halves (`biased_error`) or from passes with different radii
(`radius_bias`). `combine_frame` does all this for a frame.

Source: C. Zhou et al., "DSCombiner: Double Shrinkage for Combining Biased and
Unbiased Monte Carlo Renderings", 2025 (DSC; eq. numbers above).
"""

from jscomb.double_shrinkage._combine import Factors, combine, factors
from jscomb.double_shrinkage._estimate import (
    Dependence,
    biased_error,
    dependence,
    limit_prior,
    prior_error,
    radius_bias,
    unbiased_error,
)
from jscomb.double_shrinkage._frame import (
    NEEDS,
    Inputs,
    combine_frame,
    depends,
    make_inputs,
    neural_combine_frame,
    neural_inputs,
    plan_neural,
)
from jscomb.double_shrinkage._neural import Filters, combine_inputs, neural_combine
from jscomb.double_shrinkage._prior import blend_prior, radiance_prior

__all__ = [
    "NEEDS",
    "Dependence",
    "Factors",
    "Filters",
    "Inputs",
    "biased_error",
    "blend_prior",
    "combine",
    "combine_frame",
    "combine_inputs",
    "dependence",
    "depends",
    "factors",
    "limit_prior",
    "make_inputs",
    "neural_combine",
    "neural_combine_frame",
    "neural_inputs",
    "plan_neural",
    "prior_error",
    "radiance_prior",
    "radius_bias",
    "unbiased_error",
]
