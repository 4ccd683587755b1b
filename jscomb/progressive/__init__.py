r"""Progressive denoising: mix a rendering with its denoised image, consistently (PD).

Layout: images [H,W,C], linear radiance; channels are mixed separately. Notation:

    x      unbiased rendering (path traced), y its denoised image
    v      variance of the mean x at each pixel, squared radiance
    s      SURE, the estimated squared error of y, see `numerics.sure`; of either sign
    alpha  mixing, in [0, 1]: the result is z = x + alpha (y - x)
    beta   1 - alpha

The minimum expected error of z, with D the divergence of the denoiser times v, is at

    alpha = (v - D) / (y - x)^2,    beta = (s - D) / (y - x)^2                   (9, 10)

and D = (s - (y - x)^2 + v) / 2 by the definition of SURE, so that both are the same:

    alpha = (v - s + (y - x)^2) / (2 (y - x)^2).

In one pixel that is noise; numerator and denominator are summed over a window, which
makes it James-Stein's rule for a y that depends on x.

The bound lowers alpha where a weighted mean of z over a neighbourhood is farther from
that of x than the noise explains. As samples grow v falls, and wherever y is biased
alpha goes to zero: z is consistent whatever y is. The paper takes the channels' noise
as independent; `channel_variance` estimates how alike it is.

Source: A. Firmino, J. Frisvad, H. Jensen, "Progressive Denoising of Monte Carlo
Rendered Images", 2022 (PD; eq. numbers above and in the functions).
"""

from jscomb.progressive._combine import bound_mixing, bound_sigma, combine
from jscomb.progressive._estimate import channel_variance, mixing, risk
from jscomb.progressive._frame import (
    NEEDS,
    combine_frame,
    neural_combine_frame,
    neural_inputs,
    plan_neural,
)
from jscomb.progressive._neural import (
    FORMS,
    activation,
    combine_inputs,
    direct_activation,
    neural_combine,
)

__all__ = [
    "FORMS",
    "NEEDS",
    "activation",
    "bound_mixing",
    "bound_sigma",
    "channel_variance",
    "combine",
    "combine_frame",
    "combine_inputs",
    "direct_activation",
    "mixing",
    "neural_combine",
    "neural_combine_frame",
    "neural_inputs",
    "plan_neural",
    "risk",
]
