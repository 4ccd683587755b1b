"""Progressive denoising of frames, without and with the network.

A denoiser is an argument: `denoise(color, frame)` returns a frame's colour denoised,
guided by the frame's features, and has forward derivatives in the colour, such as
`denoisers.oidn.denoise_color`.
"""

import functools
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp

from jscomb.frame import Estimate, Frame, Needs, with_halves
from jscomb.numerics.guards import safe_sqrt
from jscomb.numerics.sure import monte_carlo_sure
from jscomb.numerics.tiles import Local, compiled, network_plan
from jscomb.numerics.variances import robust_variance
from jscomb.numerics.windows import reach_of
from jscomb.progressive._combine import (
    BOUND_WINDOW,
    Noise,
    Width,
    bound_sigma,
    combine,
)
from jscomb.progressive._estimate import channel_variance, mixing
from jscomb.progressive._neural import Network, combine_inputs
from jscomb.typing import Image, Key, Variance

Denoise = Callable[[Image, Frame], Any]

_SLOPE_LIMIT = 1.0  # a denoiser averages: no pixel follows more than its own noise

NEEDS = Needs(variance=True, normalised=True)


def combine_frame(
    key: Key,
    denoise: Denoise,
    frame: Frame,
    *,
    bound: bool = True,
    width: Width = "relative",
) -> Estimate:
    """Denoise a frame, and mix by SURE without a network, whitened.

    Args:
        key: of SURE's probe, which the halves share.
        denoise: denoiser of a colour and its frame.
        frame: normalised, with variance.
        bound: lower the mixing where it is not consistent with the noise.
        width: of the bound, as for `bound_sigma`.

    Returns:
        the mix, normalised radiance.

    Raises:
        ValueError: if the frame has no variance or is not normalised.

    Example:
        >>> from jscomb.denoisers import smoothing
        >>> from jscomb.frame import make_frame
        >>> noisy = 1 + 0.3 * jax.random.normal(jax.random.key(0), (2, 32, 32, 1))
        >>> frame = make_frame(noisy, variance=0 * noisy + 0.09).normalised()
        >>> box = lambda color, frame: smoothing.box(color)
        >>> made = combine_frame(jax.random.key(1), box, frame)
        >>> print(made.image.std() < 0.3 * frame.color.std())
        True

    Source: PD eq. 9-18.
    """
    frame.require("progressive", NEEDS)
    mix = compiled(_mix, bound=bound, width=width)
    inputs = lambda part: neural_inputs(jax.random.clone(key), denoise, part)
    make = lambda part: mix(inputs(part))
    return with_halves(frame, make, needs=NEEDS)


def _mix(inputs: Mapping[str, Image], *, bound: bool, width: Width) -> Image:
    """Mix by whitened windows."""
    x, v, noise = (inputs[name] for name in ("unbiased", "variance", "noise"))
    sigma = bound_sigma(x, v, noise=noise, width=width)
    mix = functools.partial(mixing, whiten=True)
    return combine(**inputs, mix=mix, bound=bound, sigma=sigma)


def neural_combine_frame(
    key: Key,
    denoise: Denoise,
    network: Network,
    frame: Frame,
    *,
    width: Width = "relative",
) -> Estimate:
    """Denoise a frame, and mix by a network's alpha.

    Args:
        key: of SURE's probe.
        denoise: denoiser of a colour and its frame.
        network: such as `learning.networks.MixingNetwork`.
        frame: normalised, with variance.
        width: of the bound, as for `bound_sigma`.

    Returns:
        the mix, normalised radiance.

    Raises:
        ValueError: if the frame has no variance or is not normalised.

    Example:
        >>> from jscomb.denoisers import smoothing
        >>> from jscomb.frame import make_frame
        >>> from jscomb.learning.recipes import shipped
        >>> noisy = 1 + 0.3 * jax.random.normal(jax.random.key(0), (2, 32, 32, 3))
        >>> frame = make_frame(noisy, variance=0 * noisy + 0.09).normalised()
        >>> box = lambda color, frame: smoothing.box(color)
        >>> made = neural_combine_frame(jax.random.key(1), box, shipped("pd"), frame)
        >>> print(made.image.std() < 0.5 * frame.color.std())
        True

    Source: PD eq. 11-19; alpha in the form that the network was trained for.
    """
    frame.require("pd", NEEDS)
    plan = lambda part: plan_neural(
        jax.random.clone(key), denoise, network, part, width=width
    )
    make = lambda part: plan(part).whole()
    return with_halves(frame, make, needs=NEEDS)


def plan_neural(
    key: Key,
    denoise: Denoise,
    network: Network,
    frame: Frame,
    *,
    width: Width = "relative",
) -> Local:
    """Return `neural_combine_frame` as a local function of images, for crops.

    Args:
        key: of SURE's probe.
        denoise: denoiser of a colour and its frame.
        network: as in `neural_combine_frame`.
        frame: normalised, with variance.
        width: as in `neural_combine_frame`.

    Returns:
        the function, its images and how far it sees.

    Raises:
        ValueError: if the frame has no variance or is not normalised.

    Example:
        >>> from jscomb.frame import make_frame
        >>> from jscomb.learning.recipes import shipped
        >>> one = jnp.ones((4, 4, 3), jnp.float32)
        >>> frame = make_frame(one, variance=one).normalised()
        >>> same = lambda color, frame: color
        >>> plan = plan_neural(jax.random.key(0), same, shipped("pd"), frame)
        >>> print(list(plan.images))
        ['unbiased', 'biased', 'variance', 'sure', 'noise']
    """
    inputs = neural_inputs(key, denoise, frame)
    x, v, noise = (inputs[name] for name in ("unbiased", "variance", "noise"))
    sigma = compiled(bound_sigma, width=width)(x, v, noise=noise)
    around = reach_of(BOUND_WINDOW)
    more = {"sigma": sigma}
    return network_plan(combine_inputs, network, inputs, around=around, more=more)


def neural_inputs(key: Key, denoise: Denoise, frame: Frame) -> dict[str, Image]:
    """Denoise a frame with SURE: what a mixing is chosen by.

    Args:
        key: of SURE's probe.
        denoise: denoiser of a colour and its frame.
        frame: normalised, with variance.

    Returns:
        x, y, robust variance, SURE and the noise of the channels' mean, named as by
        `neural_combine`, in its order. Without half buffers nothing tells how alike the
        channels' noise is; then the most is assumed, that it is grey.

    Raises:
        ValueError: if the frame has no variance or is not normalised.

    Example:
        >>> from jscomb.frame import make_frame
        >>> one = jnp.ones((4, 4, 3))
        >>> frame = make_frame(one, variance=one).normalised()
        >>> half = lambda color, frame: color / 2
        >>> made = neural_inputs(jax.random.key(0), half, frame)
        >>> print(f"{made['sure'].mean():.2f}")  # (1/2 - 1)^2 + 2 * 1/2 - 1
        0.25
    """
    frame.require("pd", NEEDS)
    x, v = frame.color, robust_variance(frame.variance)
    one = lambda color: denoise(color, frame)
    y, s, _ = monte_carlo_sure(key, one, x, v, slope_limit=_SLOPE_LIMIT)
    if frame.sub_buffers > 1:
        a, b = (half.color for half in frame.halves())
        noise = compiled(channel_variance)(a, b, v)
    else:
        noise = compiled(_of_grey)(v)
    return {"unbiased": x, "biased": y, "variance": v, "sure": s, "noise": noise}


def _of_grey(variance: Variance) -> Noise:
    """Variance of the mean of channels that have one noise, [H,W,1]."""
    return jnp.square(jnp.mean(safe_sqrt(variance), axis=-1, keepdims=True))
