"""Double shrinkage of a whole frame."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jscomb.double_shrinkage.errors import biased_error, confidence, unbiased_error
from jscomb.double_shrinkage.prior import blend_prior
from jscomb.double_shrinkage.shrinkage import combine, factors
from jscomb.features import select, stack
from jscomb.frame import Frame
from jscomb.typing import Image, Scalar

_RIDGE = 0.05


class Combined(NamedTuple):
    """What `combine_frame` made.

    Attributes:
        image: the combination, linear radiance, [H,W,C].
        prior: linear radiance, not finite at invalid pixels, [H,W,C].
        biased_share: k1, [H,W,C].
        prior_share: k2, how much of the result is the prior's, [H,W,C].
        variance: v, estimated for the unbiased image, squared radiance, [H,W,C].
        mse: m, estimated mean squared error of the biased image, likewise.
        confidence: eta^2, likewise.
    """

    image: Image
    prior: Image
    biased_share: Image
    prior_share: Image
    variance: Image
    mse: Image
    confidence: Image


def combine_frame(
    frame: Frame, name: str, *, window: int = 51, stride: int = 2
) -> Combined:
    """Combine a frame with a biased image of another integrator, without a network.

    Errors come from the frame's variance and from the halves of both; features that
    tell nothing are left out, which depends on values, so it is not for `jit`.

    Args:
        frame: with sub-buffers, and a biased image that has halves independent of them.
        name: of the biased image.
        window: width of the prior's windows in pixels, odd.
        stride: pixels between their centres.

    Returns:
        the combination and what it was made of.

    Raises:
        ValueError: if the frame has no such image, or no halves, or `window` is even,
            or `stride` does not fit it.

    Example:
        >>> import numpy as np
        >>> from jscomb.frame import Estimate, make_frame
        >>> x = np.random.default_rng(0).normal(1, 0.5, (2, 16, 16, 1))
        >>> y = jnp.full((2, 16, 16, 1), 1.2)
        >>> frame = make_frame(x, variance=0 * x + 0.25, estimates={"y": Estimate(y[0], y)})
        >>> image = combine_frame(frame, "y", window=11).image
        >>> for made in (frame.color, y[0], image):
        ...     print(f"{jnp.sqrt(jnp.mean((made - 1) ** 2)):.3f}")
        0.364
        0.200
        0.114

    Source: DSC, with `confidence` and `biased_error` for its network's part, and the
    prior of the first blend.
    """
    halves = frame.estimates[name].halves if name in frame.estimates else None
    if halves is None:
        has = [n for n, image in frame.estimates.items() if image.halves is not None]
        raise ValueError(f"no biased image {name!r} with halves; there are {has}")
    a, b = frame.halves()
    features = stack(frame)
    needed = select([features])
    return _combined(
        jnp.stack([frame.color, a.color, b.color]),
        jnp.stack([frame.estimates[name].image, *halves]),
        frame.variance,
        needed.of(features),
        jnp.asarray(needed.ridge(_RIDGE), features.dtype),
        frame.median_luminance,
        window=window,
        stride=stride,
    )


def _in_units(
    unbiased: Float[Array, "3 h w c"],
    biased: Float[Array, "3 h w c"],
    variance: Image,
    features: Float[Array, "h w f"],
    ridge: Float[Array, " f"],
    exposure: Scalar,
    *,
    window: int,
    stride: int,
) -> Combined:
    """The same of full images and halves, worked out at an exposure of one.

    The prior is the blend's, in place of both integrators': where one of them fails, in
    a firefly or in photons' blotches, it fails as a target, whatever its weights.
    """
    (u, *u_halves), (b, *b_halves) = (i / exposure for i in (unbiased, biased))
    v = unbiased_error(u, b, variance / jnp.square(exposure))
    m = biased_error(*u_halves, *b_halves)
    one = lambda errors: jnp.mean(errors, axis=-1, keepdims=True)
    first = factors(v, m, jnp.zeros_like(v))
    blend, error = first.blend(u, b), one(first.error)
    p = blend_prior(blend, error, features, window=window, stride=stride, ridge=ridge)
    eta = confidence(p, u, b, v, m)
    share, square = factors(v, m, eta), jnp.square(exposure)
    return Combined(
        exposure * combine(p, u, b, v, m, eta),
        exposure * p,
        share.biased,
        share.prior,
        square * v,
        square * m,
        square * eta,
    )


# Called with values, a loop over tiles would be compiled anew each time.
_combined = jax.jit(_in_units, static_argnames=("window", "stride"))
