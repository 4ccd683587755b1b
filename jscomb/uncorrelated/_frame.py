"""Uncorrelated kernels on two frames of one scene."""

import jax.numpy as jnp
from jax.core import Tracer

from jscomb.frame import Estimate, Frame, Needs
from jscomb.numerics.tiles import compiled
from jscomb.typing import Image, Scalar
from jscomb.uncorrelated._combine import combine
from jscomb.uncorrelated._estimate import select_gamma

NEEDS = Needs(normalised=True)
"""What uncorrelated kernels need of both frames, beside samples and sub-buffers."""

_NAME = "uncorrelated"
_QUARTERS = 4  # that gamma is selected by
_ROUNDING = 1e-6  # a unit is computed by differently fused programs


def combine_frame(
    independent: Frame, correlated: Frame, *, window: int = 15
) -> Estimate:
    """Select gamma for two frames of one scene, and combine them.

    Args:
        independent: normalised, with samples, and sub-buffers in a multiple of four.
        correlated: of common random numbers; the same samples, size and unit.
        window: width of the windows in pixels, odd.

    Returns:
        the combination of all samples, normalised radiance; its halves are None unless
        each half has sub-buffers in a multiple of four.

    Raises:
        ValueError: if a frame lacks what is needed, the frames' samples, units or sizes
            differ, or `window` is even.

    Example:
        >>> import numpy as np
        >>> from jscomb.frame import make_frame
        >>> rng = np.random.default_rng(0)
        >>> y = rng.normal(1, 0.2, (4, 8, 8, 1))
        >>> z = rng.normal(1, 0.2, (4, 1, 1, 1)) + 0 * y  # the same noise everywhere
        >>> y, z = (make_frame(i, samples=64).normalised(1.0) for i in (y, z))
        >>> found = combine_frame(y, z, window=5)
        >>> print(f"{y.color.std():.3f} {found.image.std():.3f}")
        0.088 0.020

    Source: IDU section 4.2.
    """
    image = _combined(independent, correlated, window)
    if any(f.sub_buffers % (2 * _QUARTERS) for f in (independent, correlated)):
        return Estimate(image)
    pairs = zip(independent.halves(), correlated.halves(), strict=True)
    return Estimate(image, jnp.stack([_combined(y, z, window) for y, z in pairs]))


def _combined(independent: Frame, correlated: Frame, window: int) -> Image:
    """The combination of two halves, with gamma by quarters."""
    samples = _checked_samples(independent, correlated)
    gamma = select_gamma_frame(independent, correlated, window=window)
    y, z = (f.merged(2).buffers.color for f in (independent, correlated))
    return compiled(combine, window=window)(y, z, gamma, samples / 2)


def select_gamma_frame(
    independent: Frame, correlated: Frame, *, window: int = 15
) -> Scalar:
    """Select gamma for two frames of one scene.

    Args:
        independent: as for `combine_frame`.
        correlated: as for `combine_frame`.
        window: width of the windows in pixels, odd.

    Returns:
        gamma, per squared normalised radiance.

    Raises:
        ValueError: as `combine_frame`.

    Example:
        >>> import numpy as np
        >>> from jscomb.frame import make_frame
        >>> rng = np.random.default_rng(0)
        >>> y, z = rng.normal(1, 0.2, (2, 4, 8, 8, 1))
        >>> y, z = (make_frame(i, samples=64).normalised(1.0) for i in (y, z))
        >>> print(f"{select_gamma_frame(y, z, window=5):.2f}")
        0.50

    Source: IDU section 4.2.
    """
    samples = _checked_samples(independent, correlated)
    y, z = (f.merged(_QUARTERS).buffers.color for f in (independent, correlated))
    return compiled(select_gamma, window=window)(y, z, samples / _QUARTERS)


def _checked_samples(independent: Frame, correlated: Frame) -> Scalar:
    """The samples of both frames; raise unless the frames can be combined."""
    independent.require(_NAME, NEEDS)
    y, z = independent, correlated
    if z.unit is None or y.unit is None or _differ(y.unit, z.unit):
        raise ValueError(
            f"{_NAME} needs both frames in one unit: call "
            "correlated.normalised(independent.unit)"
        )
    for name, frame in (("independent", y), ("correlated", z)):
        if frame.sub_buffers % _QUARTERS:
            raise ValueError(
                f"{_NAME} needs sub-buffers in a multiple of {_QUARTERS}, {name} has "
                f"{frame.sub_buffers}"
            )
    if y.samples is None or z.samples is None:
        name = "independent" if y.samples is None else "correlated"
        raise ValueError(
            f"{_NAME} needs the samples a pixel of {name}: make_frame(..., samples=)"
        )
    if _differ(y.samples, z.samples):
        raise ValueError(
            f"{_NAME} needs frames of equally many samples: independent has "
            f"{y.samples}, correlated {z.samples}"
        )
    return y.samples


def _differ(first: Scalar, second: Scalar) -> bool:
    """Whether two numbers differ by more than rounding; not checked while tracing."""
    if isinstance(first - second, Tracer):
        return False
    return not jnp.isclose(first, second, rtol=_ROUNDING, atol=0)
