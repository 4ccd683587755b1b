"""The neural James-Stein combiner's two stages, each without and with its network.

`cross_regression` makes a better biased image out of two half buffers and a biased
image of each; `combine` shrinks the unbiased image towards a biased one. Each stands by
itself. `regress` runs the first on a whole frame, where the frame's halves say that it
pays.

Source:
    J. Gu, J. Iglesias-Guitian, B. Moon, "Neural James-Stein Combiner for Unbiased and
    Estimate Renderings", 2022 (NJS).
"""

from jscomb.james_stein.neural import Parameters as Parameters
from jscomb.james_stein.neural import neural_combine as neural_combine
from jscomb.james_stein.regression import Regressed as Regressed
from jscomb.james_stein.regression import cross_regression as cross_regression
from jscomb.james_stein.regression import guide_noise as guide_noise
from jscomb.james_stein.regression import regress as regress
from jscomb.james_stein.regression import worth_regressing as worth_regressing
from jscomb.james_stein.shrinkage import combine as combine
from jscomb.james_stein.shrinkage import combine_dual as combine_dual
from jscomb.james_stein.shrinkage import risk as risk
from jscomb.james_stein.shrinkage import robust_variance as robust_variance
from jscomb.james_stein.shrinkage import smooth_variance as smooth_variance
