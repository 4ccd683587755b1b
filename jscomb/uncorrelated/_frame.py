"""Uncorrelated kernels on a frame and a correlated rendering of the same scene."""

from typing import NamedTuple

import jax.numpy as jnp
from jax.core import Tracer
from jaxtyping import Array, Float

from jscomb.frame import Estimate, Frame, Needs
from jscomb.numerics.tiles import compiled
from jscomb.typing import Image, Scalar
from jscomb.uncorrelated._combine import combine, combine_median
from jscomb.uncorrelated._estimate import select_gamma, select_gamma_map
from jscomb.uncorrelated._pairs import Guides, SubAverages

NEEDS = Needs(halves=True, normalised=True)
"""What uncorrelated kernels need of a frame, beside samples and four sub-buffers."""

_NAME = "uncorrelated"
_ROUNDING = 1e-6  # a unit is computed by differently fused programs


class _Options(NamedTuple):
    """Arguments of `combine_frame`."""

    window: int
    sub_averages: int
    guides: Guides
    region: int | None
    median: bool

    def check(self) -> None:
        """Raise unless the sub-averages fit."""
        count = self.sub_averages
        if count < 2 or (self.median and count % 2):
            kind = "even and at least" if self.median else "at least"
            raise ValueError(f"sub_averages must be {kind} 2, got {count}")


def combine_frame(
    independent: Frame,
    correlated: Frame | Estimate,
    *,
    window: int = 15,
    sub_averages: int = 2,
    guides: Guides | None = None,
    region: int | None = None,
    median: bool = False,
) -> Estimate:
    """Select gamma for two renderings of one scene, and combine them.

    Args:
        independent: normalised, with samples, and sub-buffers in a multiple of four, or
            of twice `sub_averages`.
        correlated: of common random numbers; the same samples, size and unit. Or an
            estimate of the frame by such numbers, with halves.
        window: width of the windows in pixels, odd.
        sub_averages: B, that all samples are averaged to.
        guides: as for `combine`; None for "correlated" of a frame. Of an estimate,
            whose halves are not enough to select gamma by, "independent".
        region: width in pixels of the square around a pixel that gamma is selected for
            (`select_gamma_map`), odd; None for one gamma of the frame.
        median: take the median of the combinations of two sub-averages each
            (`combine_median`), against fireflies.

    Returns:
        the combination of all samples, normalised radiance. Each half has its own gamma
        where it has sub-buffers enough, else that of the frame.

    Raises:
        ValueError: if a frame lacks what is needed, has less than a sample in each
            sub-buffer, the frames' samples, units or sizes differ, or `window` is even.

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

    Source: IDU section 4.2; regions and medians are ours.
    """
    guides = guides or _usual_guides(correlated)
    options = _Options(window, sub_averages, guides, region, median)
    gamma = _selected(independent, correlated, options)
    image = _combined(independent, correlated, gamma, options)
    halves = independent.halves(), _halves_of(correlated)
    if any(_sub_buffers(i) % sub_averages for i in (*halves[0], *halves[1])):
        return Estimate(image)
    wanted = 2 * _selecting(sub_averages)
    own = isinstance(correlated, Frame) and not any(
        frame.sub_buffers % wanted for frame in (independent, correlated)
    )
    made = []
    for y, z in zip(*halves, strict=True):
        of_half = _selected(y, z, options) if own else gamma
        made.append(_combined(y, z, of_half, options))
    return Estimate(image, jnp.stack(made))


def select_gamma_frame(
    independent: Frame,
    correlated: Frame | Estimate,
    *,
    window: int = 15,
    sub_averages: int = 2,
    guides: Guides | None = None,
    region: int | None = None,
) -> Scalar | Float[Array, "h w 1"]:
    """Select gamma for two renderings of one scene.

    Args:
        independent: as for `combine_frame`.
        correlated: as for `combine_frame`.
        window: width of the windows in pixels, odd.
        sub_averages: as for `combine_frame`.
        guides: as for `combine_frame`.
        region: as for `combine_frame`.

    Returns:
        gamma, per squared normalised radiance; with a region of each pixel, [H,W,1].

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
    guides = guides or _usual_guides(correlated)
    options = _Options(window, sub_averages, guides, region, median=False)
    return _selected(independent, correlated, options)


def _usual_guides(correlated: Frame | Estimate) -> Guides:
    """The paper's, unless there are not sub-averages enough."""
    return "independent" if isinstance(correlated, Estimate) else "correlated"


def _selecting(sub_averages: int) -> int:
    """How many sub-averages gamma is selected by."""
    return 2 * max(sub_averages, 2)


def _selected(y: Frame, z: Frame | Estimate, options: _Options) -> Array:
    """Gamma of a frame, or of each pixel."""
    options.check()
    count = 4 if options.median else _selecting(options.sub_averages)
    samples = _checked_samples(y, z, options, count) / count
    given = y.merged(count).buffers.color, _sub_averages(z, count), samples
    shared = {"window": options.window, "guides": options.guides}
    if options.region is None:
        return compiled(select_gamma, **shared)(*given)
    return compiled(select_gamma_map, region=options.region, **shared)(*given)


def _combined(y: Frame, z: Frame | Estimate, gamma: Array, options: _Options) -> Image:
    """The combination of all sub-averages."""
    count = options.sub_averages
    assert y.samples is not None
    function = combine_median if options.median else combine
    return compiled(function, window=options.window, guides=options.guides)(
        y.merged(count).buffers.color,
        _sub_averages(z, count),
        gamma,
        y.samples / count,
    )


def _sub_averages(correlated: Frame | Estimate, count: int) -> SubAverages:
    """So many sub-averages; those of an estimate in turn, which have its mean."""
    if isinstance(correlated, Frame):
        return correlated.merged(count).buffers.color
    image, halves = correlated
    some = image[None] if halves is None else halves
    return jnp.concatenate([some] * count)[:count]


def _halves_of(correlated: Frame | Estimate) -> tuple[Frame | Estimate, ...]:
    """The two halves of a rendering."""
    if isinstance(correlated, Frame):
        return correlated.halves()
    return correlated.half(0), correlated.half(1)


def _sub_buffers(correlated: Frame | Estimate) -> int:
    """Of a frame; of an estimate, whose image may stand for all, none."""
    return correlated.sub_buffers if isinstance(correlated, Frame) else 0


def _checked_samples(
    independent: Frame, correlated: Frame | Estimate, options: _Options, count: int
) -> Scalar:
    """The samples of both; raise unless they can be combined."""
    independent.require(_NAME, NEEDS)
    y, z = independent, correlated
    if isinstance(z, Estimate):
        if z.halves is None or options.guides != "independent":
            raise ValueError(
                f"{_NAME} needs an estimate with halves, and guides 'independent'; "
                f"got {'none' if z.halves is None else repr(options.guides)}"
            )
    elif z.unit is None or y.unit is None or _differ(y.unit, z.unit):
        raise ValueError(
            f"{_NAME} needs both frames in one unit: call "
            "correlated.normalised(independent.unit)"
        )
    named = {"independent": y} | ({"correlated": z} if isinstance(z, Frame) else {})
    for name, frame in named.items():
        if frame.sub_buffers % count:
            raise ValueError(
                f"{_NAME} needs sub-buffers in a multiple of {count}, {name} has "
                f"{frame.sub_buffers}"
            )
        if frame.samples is None:
            raise ValueError(
                f"{_NAME} needs the samples a pixel of {name}: make_frame(..., "
                "samples=)"
            )
        fewest = frame.samples / frame.sub_buffers
        if not isinstance(fewest, Tracer) and fewest < 1:
            raise ValueError(
                f"{_NAME} needs at least one sample in each sub-buffer, {name} has "
                f"{frame.samples} in {frame.sub_buffers}"
            )
    assert y.samples is not None
    if isinstance(z, Frame) and _differ(y.samples, z.samples):
        raise ValueError(
            f"{_NAME} needs frames of equally many samples: independent has "
            f"{y.samples}, correlated {z.samples}"
        )
    return y.samples


def _differ(first: Scalar, second: Scalar | None) -> bool:
    """Whether two numbers differ by more than rounding; not checked while tracing."""
    assert second is not None
    if isinstance(first - second, Tracer):
        return False
    return not jnp.isclose(first, second, rtol=_ROUNDING, atol=0)
