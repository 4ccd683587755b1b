r"""Ensemble denoising: for every pixel the weights of N biased images of least error.

Layout: images [H,W,C], linear radiance; stacks of bases [N,H,W,C]. Notation:

    y_i       base i: any denoiser's image, or the unbiased image itself
    y_i^a     the same denoiser run on half a alone; likewise b
    x_a, x_b  unbiased half buffers
    w         weights of the bases, at least zero, of sum one
    M         error matrix, M_ij = E[(y_i - truth) (y_j - truth)], so that the ensemble
              sum_i w_i y_i has the expected squared error w'Mw

Half b is independent of y^a, so x_b stands for the truth there:

    <M>^a_ij = x_a x_b - x_b (y_i^a + y_j^a) + y_i^a y_j^a,
    <M>      = (<M>^a + <M>^b) / 2,

unbiased for the error of the half's denoised images, which is what weights are found
for. A number added to all elements changes no weights.

One pixel's `<M>` is hardly more than noise, and its exact optimum follows the noise: it
is worse than the best base. What `combine` does with `solver="multi-scale"` is better:
the mean of `<M>` over windows, each window's as far as both halves agree on how it
differs from the next larger window's, up to the whole frame's. With many samples
weights are local, with few there is almost one for the frame.

Consistent if one base is: its error vanishes as samples grow, and so does the least.

Sources:
    S. Zheng, F. Zheng, K. Xu, L.-Q. Yan, "Ensemble Denoising for Monte Carlo
    Renderings", 2021 (ED; eq. numbers below). The scales are ours.
"""

from jscomb.ensemble.bases import Stacked as Stacked
from jscomb.ensemble.bases import stack_bases as stack_bases
from jscomb.ensemble.errors import error_matrix as error_matrix
from jscomb.ensemble.errors import mse_matrix as mse_matrix
from jscomb.ensemble.errors import true_matrix as true_matrix
from jscomb.ensemble.selection import Selected as Selected
from jscomb.ensemble.selection import select_bases as select_bases
from jscomb.ensemble.weighting import average as average
from jscomb.ensemble.weighting import combine as combine
from jscomb.ensemble.weighting import filter_weights as filter_weights
from jscomb.ensemble.weighting import one_hot as one_hot
from jscomb.ensemble.weighting import solve_weights as solve_weights
