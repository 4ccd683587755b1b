r"""Double shrinkage: two integrators with unlike weaknesses, pulled towards a prior.

Layout: images [H,W,C], linear radiance. Errors are squared radiance, [H,W,1] for all
channels or [H,W,C]. Notation:

    u, b    unbiased and biased image, of independent samples
    v       variance of the mean u
    m       mean squared error of b: its variance and its squared bias
    p       prior, a smooth image
    eta^2   confidence: how far the truth lies from p; 0 for a prior that is right

    x1 = k1 b + (1 - k1) u,   k1 = v / (v + m),    of error s = v m / (v + m)
    x  = k2 p + (1 - k2) x1,  k2 = s / (s + eta^2)                           (9, 10)

which is the posterior mean of the truth where all errors are Gaussian. The first step
takes the better of two integrators, the second what noise both have left.

The prior is windowed regression on features, of u and b together, with weights for each
made of the other (`radiance_prior`). Without a network the confidence comes from
`confidence`, and the error of b from halves (`biased_error`) or from passes of unlike
radii (`radius_bias`). `combine_frame` does all that.

Source: C. Zhou et al., "DSCombiner: Double Shrinkage for Combining Estimate and Unbiased
Monte Carlo Renderings", 2025 (DSC; eq. numbers above).
"""

from jscomb.double_shrinkage.errors import biased_error as biased_error
from jscomb.double_shrinkage.errors import confidence as confidence
from jscomb.double_shrinkage.errors import radius_bias as radius_bias
from jscomb.double_shrinkage.errors import unbiased_error as unbiased_error
from jscomb.double_shrinkage.frames import Combined as Combined
from jscomb.double_shrinkage.frames import combine_frame as combine_frame
from jscomb.double_shrinkage.neural import Filters as Filters
from jscomb.double_shrinkage.neural import neural_combine as neural_combine
from jscomb.double_shrinkage.prior import blend_prior as blend_prior
from jscomb.double_shrinkage.prior import radiance_prior as radiance_prior
from jscomb.double_shrinkage.shrinkage import Factors as Factors
from jscomb.double_shrinkage.shrinkage import combine as combine
from jscomb.double_shrinkage.shrinkage import factors as factors
