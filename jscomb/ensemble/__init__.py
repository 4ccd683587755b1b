r"""Ensemble denoising: the weights of N biased images of minimum error (ED).

Layout: images [H,W,C], linear radiance; stacks of bases [N,H,W,C]. Notation:

    y_i       base i: any denoiser's image, or the unbiased image itself
    y_i^a     the same denoiser run on half a alone; y_i^b on half b
    x_a, x_b  unbiased half buffers
    w         weights of the bases, at least zero, of sum one
    M         error matrix, M_ij = E[(y_i - truth) (y_j - truth)], so that the ensemble
              sum_i w_i y_i has the expected squared error w'Mw

Half b is independent of y^a, so x_b stands for the truth there:

    <M>^a_ij = x_a x_b - x_b (y_i^a + y_j^a) + y_i^a y_j^a,
    <M>      = (<M>^a + <M>^b) / 2,

unbiased for the error of the half's denoised images, which the weights minimise. A
number added to all elements does not change the weights.

One pixel's `<M>` is hardly more than noise, and its exact optimum follows the noise: it
is worse than the best base. `solver="multi-scale"` is better: it averages `<M>` over
windows, and takes each window's mean as far as both halves agree on how it differs
from that of the next larger window, up to the whole frame. With many samples weights
are local, with few there is almost one weight a base for the frame. A pixel whose half
buffer is noisy has less weight in these means; weights vary slowly, so they are solved
for in blocks of 4x4 pixels and interpolated.

The paper's figure 7 has slightly less error with weights of each channel than with one
weight a base (there of single pixels); multi-scale weights are one by default, since
`<M>` averaged over channels is less noisy, and of each channel with `shared=False`.

Consistent if one base is: its error vanishes as samples grow, and so does the minimum.

A network can correct these weights pixel by pixel (`neural_combine`): it sees the
bases, x, its variance, the features and the error matrix, and gives each base a factor.
Bases are alike to it: any number, in any order.

Weights learn from both halves. So the halves of an ensemble are independent only where
each half has halves of its own (four sub-buffers, and bases that can be made from a
quarter); with two sub-buffers both halves share the weights of the full frame.

Sources:
    S. Zheng, F. Zheng, K. Xu, L.-Q. Yan, "Ensemble Denoising for Monte Carlo
    Renderings", 2021 (ED; eq. numbers below). The scales are ours.
"""

from jscomb.ensemble._combine import (
    average,
    combine,
    one_hot,
    solve_weights,
    spread,
)
from jscomb.ensemble._estimate import (
    error_matrix,
    mse_matrix,
    selection_errors,
    true_matrix,
)
from jscomb.ensemble._filter import Filter, filter_weights
from jscomb.ensemble._frame import (
    NEEDS,
    Stacked,
    combine_frame,
    stack_estimates,
    weigh_frame,
)
from jscomb.ensemble._neural import (
    NEURAL_NEEDS,
    Candidates,
    candidates,
    combine_inputs,
    neural_combine,
    neural_combine_frame,
    neural_inputs,
    neural_weights,
    plan_neural_weights,
)
from jscomb.ensemble._selection import Selected, select_bases

__all__ = [
    "NEEDS",
    "NEURAL_NEEDS",
    "Candidates",
    "Filter",
    "Selected",
    "Stacked",
    "average",
    "candidates",
    "combine",
    "combine_frame",
    "combine_inputs",
    "error_matrix",
    "filter_weights",
    "mse_matrix",
    "neural_combine",
    "neural_combine_frame",
    "neural_inputs",
    "neural_weights",
    "one_hot",
    "plan_neural_weights",
    "select_bases",
    "selection_errors",
    "solve_weights",
    "spread",
    "stack_estimates",
    "true_matrix",
    "weigh_frame",
]
