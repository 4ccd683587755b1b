"""Double shrinkage of a normalised frame and an estimate of another integrator."""

import warnings
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from jscomb.double_shrinkage._combine import combine, factors
from jscomb.double_shrinkage._estimate import (
    biased_error,
    dependence,
    limit_prior,
    prior_error,
    unbiased_error,
)
from jscomb.double_shrinkage._neural import Network, combine_inputs
from jscomb.double_shrinkage._prior import blend_prior
from jscomb.features import select, stack
from jscomb.frame import Estimate, Frame, Maker, Needs, with_halves
from jscomb.numerics.tiles import Local, compiled, network_plan
from jscomb.typing import Image

NEEDS = Needs(variance=True, halves=True, normalised=True)
"""What double shrinkage needs of a frame; its estimate needs halves, too."""

_NAME = "double_shrinkage"
_RIDGE = 0.05
_WITHOUT_HALVES = (
    f"{_NAME} needs an estimate with halves: make it from each half frame, too "
    "(jscomb.frame.with_halves)"
)

Halves = Float[Array, "2 h w c"]


class Inputs(NamedTuple):
    """The arguments of `combine`: `combine(*inputs)` is the combination.

    Attributes:
        prior: p, normalised radiance, not finite at invalid pixels, [H,W,C].
        unbiased: u, normalised radiance, [H,W,C].
        biased: b, normalised radiance, [H,W,C].
        variance: v, estimated variance of u, [H,W,C].
        mse: m, estimated mean squared error of b, [H,W,C].
        prior_mse: eta^2, estimated mean squared error of p, [H,W,C].
    """

    prior: Image
    unbiased: Image
    biased: Image
    variance: Image
    mse: Image
    prior_mse: Image


def combine_frame(
    frame: Frame, estimate: Estimate | Maker, *, window: int = 51, stride: int = 2
) -> Estimate:
    """Combine a frame with an estimate of another integrator, without a network.

    Not for `jit`: features that are constant over the frame are excluded.

    Args:
        frame: normalised, with half buffers.
        estimate: with halves that are independent of each other and of the frame; or a
            maker, with which the result has halves, given four sub-buffers.
        window: width of the prior's windows in pixels, odd.
        stride: pixels between their centres.

    Returns:
        the combination, normalised radiance; its halves are None without a maker or
        with fewer than four sub-buffers.

    Raises:
        ValueError: if the frame lacks what `NEEDS` names, the estimate has no halves,
            `window` is even, or `stride` does not fit it.

    Example:
        >>> import numpy as np
        >>> from jscomb.frame import make_frame
        >>> x = np.random.default_rng(0).normal(1, 0.5, (2, 16, 16, 1))
        >>> y = jnp.full((2, 16, 16, 1), 1.2)
        >>> frame = make_frame(x, variance=0 * x + 0.25).normalised(1.0)
        >>> image = combine_frame(frame, Estimate(y[0], y), window=11).image
        >>> for each in (frame.color, y[0], image):
        ...     print(f"{jnp.sqrt(jnp.mean((each - 1) ** 2)):.3f}")
        0.364
        0.200
        0.114

    Source: DSC, with `prior_error` and `biased_error` in place of its network, and the
    prior of the first blend.
    """
    frame.require(_NAME, NEEDS)

    def combined(part: Frame, given: Estimate) -> Image:
        return compiled(combine)(
            *make_inputs(part, given, window=window, stride=stride)
        )

    return with_halves(frame, combined, estimate, needs=NEEDS)


def make_inputs(
    frame: Frame, estimate: Estimate, *, window: int = 51, stride: int = 2
) -> Inputs:
    """Estimate the prior and all errors, from a frame and an estimate with halves.

    Args:
        frame: normalised, with half buffers.
        estimate: with halves.
        window: width of the prior's windows in pixels, odd.
        stride: pixels between their centres.

    Returns:
        what `combine_frame` combines.

    Raises:
        ValueError: as `combine_frame`.

    Example:
        >>> from jscomb.frame import make_frame
        >>> x, y = jnp.ones((2, 4, 4, 1)), jnp.full((2, 4, 4, 1), 1.2)
        >>> frame = make_frame(x, variance=0.01 + 0 * x).normalised()
        >>> inputs = make_inputs(frame, Estimate(y[0], y), window=3, stride=1)
        >>> print(f"{inputs.mse[0, 0, 0]:.2f} {inputs.variance[0, 0, 0]:.3f}")
        0.04 0.005
    """
    frame.require(_NAME, NEEDS)
    if estimate.halves is None:
        raise ValueError(_WITHOUT_HALVES)
    features = stack(frame)
    needed = select([features])
    u, b = frame.color, estimate.image
    p, v, m, eta = compiled(_estimated, window=window, stride=stride)(
        u,
        b,
        jnp.stack([half.color for half in frame.halves()]),
        estimate.halves,
        frame.variance,
        needed.of(features),
        jnp.asarray(needed.ridge(_RIDGE), features.dtype),
    )
    return Inputs(p, u, b, v, m, eta)


def _estimated(
    u: Image,
    b: Image,
    u_halves: Halves,
    b_halves: Halves,
    variance: Image,
    features: Float[Array, "h w f"],
    ridge: Float[Array, " f"],
    *,
    window: int,
    stride: int,
) -> tuple[Image, Image, Image, Image]:
    """p, v, m and eta^2.

    The prior is fitted to the blend, not to both integrators: where one fails, at a
    firefly or at photons' blotches, it fails as a target, whatever its weights.
    """
    v = unbiased_error(u, b, variance)
    m = biased_error(*u_halves, *b_halves)
    first = factors(v, m, jnp.zeros_like(v))
    p = blend_prior(
        first.blend(u, b),
        _over_channels(first.error),
        features,
        window=window,
        stride=stride,
        ridge=ridge,
    )
    p = limit_prior(p, u, b, v)
    return p, v, m, prior_error(p, u, b, v, m)


def _over_channels(errors: Image) -> Float[Array, "h w 1"]:
    """Mean over channels."""
    return jnp.mean(errors, axis=-1, keepdims=True)


def neural_inputs(
    frame: Frame, estimate: Estimate, *, window: int = 51, stride: int = 2
) -> dict[str, Image]:
    """Return what the network combines, by name, for use and for training.

    Args:
        frame: normalised, with half buffers.
        estimate: with halves.
        window: width of the prior's windows in pixels, odd.
        stride: pixels between their centres.

    Returns:
        prior, unbiased and biased, [H,W,C]; variance (`unbiased_error`) and mse
        (`biased_error`), means over channels, [H,W,1].

    Example:
        >>> from jscomb.frame import make_frame
        >>> x = jnp.ones((2, 4, 4, 3))
        >>> frame = make_frame(x, variance=x).normalised()
        >>> inputs = neural_inputs(frame, Estimate(x[0], x), window=3, stride=1)
        >>> print({name: image.shape[-1] for name, image in inputs.items()})
        {'prior': 3, 'unbiased': 3, 'biased': 3, 'variance': 1, 'mse': 1}
    """
    made = make_inputs(frame, estimate, window=window, stride=stride)
    return {
        "prior": made.prior,
        "unbiased": made.unbiased,
        "biased": made.biased,
        "variance": _over_channels(made.variance),
        "mse": _over_channels(made.mse),
    }


def plan_neural(
    network: Network, frame: Frame, estimate: Estimate, *, stride: int = 2
) -> Local:
    """Return the network's combination of a frame, to apply whole or by crops.

    Args:
        network: a pytree; the halo comes from its `reach`, the distance that it sees,
            and the width `window` of its kernels, and crops start at multiples of its
            `multiple`.
        frame: normalised, with half buffers.
        estimate: with halves.
        stride: pixels between the centres of the prior's windows.

    Returns:
        `combine_inputs` of the network, and the frame's `neural_inputs`; its halo is
        None if the network has no reach.

    Warns:
        UserWarning: if the network's attribute `serves` says that it was trained on
            another kind of biased image, denoised or independent.

    Example:
        >>> import jax
        >>> from jscomb.frame import make_frame
        >>> from jscomb.learning.networks import ShrinkageNetwork
        >>> network = ShrinkageNetwork(jax.random.key(0), size="light")
        >>> x = jnp.ones((2, 4, 4, 3))
        >>> frame = make_frame(x, variance=x).normalised()
        >>> print(plan_neural(network, frame, Estimate(x[0], x)).whole().shape)
        (4, 4, 3)
    """
    inputs = neural_inputs(frame, estimate, stride=stride)
    _warn_of_use(network, frame, estimate)
    return network_plan(combine_inputs, network, inputs)


def depends(frame: Frame, estimate: Estimate) -> bool:
    """Return whether an estimate was made from the samples of a frame, by its noise.

    Args:
        frame: with half buffers.
        estimate: with halves.

    Returns:
        True for a denoised image, False for one of another integrator.

    Raises:
        ValueError: if either has no halves.

    Example:
        >>> import jax
        >>> from jscomb.frame import make_frame
        >>> x = jax.random.normal(jax.random.key(0), (2, 64, 64, 3))
        >>> print(depends(make_frame(x), Estimate(0.1 * x[0], 0.1 * x)))
        True
    """
    frame.require(_NAME, Needs(halves=True))
    if estimate.halves is None:
        raise ValueError(_WITHOUT_HALVES)
    halves = [half.color for half in frame.halves()]
    return bool(compiled(dependence)(*halves, *estimate.halves).certain)


def _warn_of_use(network: Network, frame: Frame, estimate: Estimate) -> None:
    """Warn of a biased image of the kind that the network was not trained on."""
    serves = getattr(network, "serves", "any")
    if serves == "any":
        return
    found = "denoised" if depends(frame, estimate) else "independent"
    if found != serves:
        warnings.warn(
            f"this network combines {serves} images, but the noise of the biased image "
            f"says that it is {found}: expect a larger error",
            stacklevel=2,
        )


def neural_combine_frame(
    network: Network, frame: Frame, estimate: Estimate | Maker, *, stride: int = 2
) -> Estimate:
    """Combine a frame with an estimate of another integrator by a network.

    Args:
        network: as for `plan_neural`, such as `learning.networks.ShrinkageNetwork`.
        frame: normalised, with half buffers.
        estimate: as for `combine_frame`.
        stride: pixels between the centres of the prior's windows.

    Returns:
        the combination, as `combine_frame`.

    Example:
        >>> import jax
        >>> from jscomb.frame import make_frame
        >>> from jscomb.learning.networks import ShrinkageNetwork
        >>> network = ShrinkageNetwork(jax.random.key(0), size="light")
        >>> x = jnp.ones((4, 4, 4, 3))
        >>> frame = make_frame(x, variance=x).normalised()
        >>> maker = lambda part: with_halves(part, lambda half: half.color)
        >>> print(neural_combine_frame(network, frame, maker).halves.shape)
        (2, 4, 4, 3)

    Source: DSC section 4.3.
    """
    frame.require(_NAME, NEEDS)

    def combined(part: Frame, given: Estimate) -> Image:
        return plan_neural(network, part, given, stride=stride).whole()

    return with_halves(frame, combined, estimate, needs=NEEDS)
