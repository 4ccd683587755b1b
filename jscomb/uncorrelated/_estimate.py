"""How fast weights should fall: the gamma of least variance, from four pairs."""

import functools
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jscomb.frame import Frame
from jscomb.numerics.guards import divide
from jscomb.numerics.tiles import Grid, Planes, Region, fold_rows, sum_over_tiles
from jscomb.numerics.windows import check_window, window_mean, window_sum
from jscomb.typing import Image, Scalar
from jscomb.uncorrelated.combination import combine
from jscomb.uncorrelated.kernels import rate_of
from jscomb.uncorrelated.pairs import (
    Samples,
    SubAverages,
    check_samples,
    make_pairs,
    mean,
)

UNIT = 0.005  # of gamma; the paper's candidates are whole multiples of it
MULTIPLES = 2, 5, 10, 20, 40, 100, 200, 300, 400, 500
_TILE, _TILES = 64, 1


class Combined(NamedTuple):
    """What `combine_frames` made.

    Attributes:
        image: the combination, linear radiance, [H,W,C].
        gamma: that was chosen, per squared radiance.
        variances: estimated relative variance for each candidate, see
            `relative_variances`.
    """

    image: Image
    gamma: Scalar
    variances: Float[Array, " candidates"]


def select_gamma(
    independent: Float[Array, "4 h w c"],
    correlated: Float[Array, "4 h w c"],
    samples: Samples,
    *,
    window: int = 15,
    unit: Scalar | float = UNIT,
    multiples: Sequence[int] = MULTIPLES,
    epsilon: Scalar | float = 0.01,
    stride: int = 4,
    crosswise: bool = False,
) -> Scalar:
    """The candidate whose result has the least estimated relative variance.

    Candidates and epsilon are for frames of exposure one: see `combine_frames`.

    Args:
        independent: y^1, ..., y^4, linear radiance, shape [4,H,W,C].
        correlated: z^1, ..., z^4, linear radiance, shape [4,H,W,C].
        samples: n, samples a pixel in each sub-average, at least 1.
        window: width of the windows in pixels, odd.
        unit: of gamma, per squared radiance.
        multiples: the candidates are these times the unit; whole, positive.
        epsilon: > 0, squared radiance, what keeps the dark from deciding.
        stride: only every so many rows are judged.
        crosswise: for `combine_crosswise`.

    Returns:
        gamma, per squared radiance.

    Raises:
        ValueError: as `relative_variances`.

    Example:
        >>> import numpy as np
        >>> rng = np.random.default_rng(0)
        >>> y = jnp.asarray(rng.normal(1, 0.2, (4, 8, 8, 1)))
        >>> z = y + jnp.asarray(rng.normal(0, 0.1, (4, 8, 8, 1)))
        >>> gamma = select_gamma(y, z, 16, window=3, multiples=(2, 500))
        >>> print(f"{gamma:.2f}")
        2.50

    Source: IDU section 4.2.
    """
    variances = relative_variances(
        independent,
        correlated,
        samples,
        window=window,
        unit=unit,
        multiples=multiples,
        epsilon=epsilon,
        stride=stride,
        crosswise=crosswise,
    )
    return _best(variances, unit, multiples)


def _best(variances: Array, unit: Scalar | float, multiples: Sequence[int]) -> Scalar:
    """Gamma of the least variance."""
    best = jnp.asarray(multiples, variances.dtype)[jnp.argmin(variances)]
    return best * jnp.asarray(unit, best.dtype)


def relative_variances(
    independent: Float[Array, "4 h w c"],
    correlated: Float[Array, "4 h w c"],
    samples: Samples,
    *,
    window: int = 15,
    unit: Scalar | float = UNIT,
    multiples: Sequence[int] = MULTIPLES,
    epsilon: Scalar | float = 0.01,
    stride: int = 4,
    crosswise: bool = False,
) -> Float[Array, " candidates"]:
    """Twice the relative variance of a combination of two pairs, for each candidate.

    The results u^a of pairs {1, 3} and u^b of pairs {2, 4} differ by noise alone: the
    mean of (u^a - u^b)^2 / (m^2 + epsilon), m the window mean of y. All candidates
    share one exponential, as powers of it.

    Args:
        independent: y^1, ..., y^4, linear radiance, shape [4,H,W,C].
        correlated: z^1, ..., z^4, linear radiance, shape [4,H,W,C].
        samples: n, samples a pixel in each sub-average, at least 1.
        window: width of the windows in pixels, odd.
        unit: of gamma, per squared radiance.
        multiples: the candidates are these times the unit; whole, positive.
        epsilon: > 0, squared radiance.
        stride: only every so many rows are judged. Errors of a combination are alike
            over a window, so a few rows of it know nearly as much as all.
        crosswise: the kernel of a is applied to b and the other way round.

    Returns:
        the means over valid pixels and channels, shape [candidates]; 0 if none is.

    Raises:
        ValueError: if shapes differ, there are not four sub-averages, `samples` or
            `stride` is less than 1, a multiple is not whole and positive, or `window`
            is even.

    Example:
        >>> import numpy as np
        >>> rng = np.random.default_rng(0)
        >>> y = jnp.asarray(rng.normal(1, 0.2, (4, 8, 8, 1)))
        >>> z = y + jnp.asarray(rng.normal(0, 0.1, (4, 8, 8, 1)))
        >>> found = relative_variances(y, z, 16, window=3, multiples=(2, 500))
        >>> print([f"{v:.4f}" for v in found])
        ['0.0352', '0.0325']

    Source: IDU section 4.2.
    """
    pairs = make_pairs(independent, correlated, count=4)
    check_samples(samples)
    if stride < 1:
        raise ValueError(f"stride must be at least 1, got {stride}")
    if not multiples or any(m != int(m) or m < 1 for m in multiples):
        raise ValueError(f"multiples must be whole and positive, got {multiples}")
    a, b = pairs.some(slice(0, None, 2)), pairs.some(slice(1, None, 2))
    guides = [of.z[0] - of.z[1] for of in ((b, a) if crosswise else (a, b))]
    rate = rate_of(unit, samples, pairs.y.dtype)
    valid = pairs.valid.astype(rate.dtype)
    level = jnp.square(window_mean(pairs.mean, window, mask=pairs.valid))
    weight = valid / (level + jnp.asarray(epsilon, rate.dtype))
    others = window_sum(valid, window) - 1
    share = divide(valid, others, where=others > 0)
    # Both halves' channels side by side, so that one sum gives their difference.
    excess = jnp.concatenate([a.excess, -b.excess], -1)
    near = [excess, jnp.concatenate(guides, -1), valid]
    here = [a.mean - b.mean, share, weight]
    squares = _squares(near, here, rate, multiples, window=window, stride=stride)
    count = pairs.y.shape[-1] * jnp.maximum(jnp.sum(valid[::stride]), 1)
    return jnp.sum(squares, axis=(1, 2)) / count


def _squares(
    near: Sequence[Array],
    here: Sequence[Array],
    rate: Scalar,
    multiples: Sequence[int],
    *,
    window: int,
    stride: int,
) -> Planes:
    """Per pixel, weight (u^a - u^b)^2 summed over channels, for each multiple.

    Of images that are seen all over the windows, and others at their centres.
    """
    reach = check_window(window) // 2
    size = max(here[0].shape[:2])
    tile = stride * -(-min(_TILE, size) // stride)
    rows, columns = slice(reach, reach + tile, stride), slice(reach, reach + tile)

    def squares(
        excess: Planes, guide: Planes, valid: Planes, *at_centre: Planes
    ) -> Planes:
        """Of one tile."""
        s_c, g_c = excess[:, rows, columns], guide[:, rows, columns]

        def exponentials(near: list[Planes]) -> list[Planes]:
            """Of a row of the window."""
            found = []
            for dx in range(window):
                g_i, valid_i = (p[:, :tile:stride, dx : dx + tile] for p in near)
                found.append(valid_i * jnp.exp(-rate * jnp.square(g_c - g_i)))
            return found

        def add_row(
            carry: tuple[list[Planes], list[Planes]], near: list[Planes]
        ) -> tuple[list[Planes], list[Planes]]:
            totals, row = carry
            for dx, k in enumerate(row):
                away = s_c - near[0][:, :tile:stride, dx : dx + tile]
                each = zip(totals, powers(k, multiples), strict=True)
                totals = [total + power * away for total, power in each]
            return totals, exponentials(near[1:])

        # Left to itself XLA would work the exponentials out again for every sum. So
        # they travel through the loop, and a row's are made one turn ahead.
        ahead = [jnp.roll(planes, -1, axis=1) for planes in (guide, valid)]
        totals = [jnp.zeros_like(s_c) for _ in multiples]
        start = totals, exponentials([guide, valid])
        totals, _ = fold_rows(add_row, start, [excess, *ahead], window)
        difference, share, weight = (planes[:, ::stride] for planes in at_centre)
        c = len(difference)
        found = jnp.stack(
            [
                jnp.sum(weight * jnp.square(difference + share * (t[:c] + t[c:])), 0)
                for t in totals
            ]
        )
        between = (0, 0, 0), (0, stride - 1, stride - 1), (0, 0, 0)
        return lax.pad(found, jnp.zeros((), found.dtype), between)

    regions = [
        Region(jnp.moveaxis(image, -1, 0), around)
        for images, around in ((near, reach), (here, 0))
        for image in images
    ]
    return sum_over_tiles(squares, regions, Grid(tile, 1, reach, _TILES), reach=0)


def powers(base: Array, exponents: Sequence[int]) -> list[Array]:
    """Whole powers of one array by few products.

    Args:
        base: any shape.
        exponents: whole, positive.

    Returns:
        base to each of them.

    Example:
        >>> print([int(p) for p in powers(jnp.array(2), (1, 5, 10))])
        [2, 32, 1024]
    """
    known = {1: base}

    def power(exponent: int) -> Array:
        if exponent not in known:
            sums = (k for k in known if exponent - k in known)
            half = exponent // 2
            first = next(sums, half if exponent % 2 == 0 else 1)
            known[exponent] = power(first) * power(exponent - first)
        return known[exponent]

    return [power(exponent) for exponent in exponents]


def combine_frames(
    independent: Frame, correlated: Frame, *, window: int = 15
) -> Combined:
    """Choose gamma for two frames of one scene, and combine them.

    Args:
        independent: the frame whose pixels have random numbers of their own, with
            samples, and sub-buffers in a multiple of four.
        correlated: the same of common random numbers, as many and as large.
        window: width of the windows in pixels, odd.

    Returns:
        the combination of all samples, and what it was chosen by.

    Raises:
        ValueError: if the frames are not alike, have no samples, or their sub-buffers
            cannot be put together to four, or `window` is even.

    Example:
        >>> import numpy as np
        >>> from jscomb.frame import make_frame
        >>> rng = np.random.default_rng(0)
        >>> y = rng.normal(1, 0.2, (4, 8, 8, 1))
        >>> z = rng.normal(1, 0.2, (4, 1, 1, 1)) + 0 * y  # noise alike everywhere
        >>> y, z = (make_frame(images, samples=64) for images in (y, z))
        >>> found = combine_frames(y, z, window=5)
        >>> print(f"{y.color.std():.3f} {found.image.std():.3f}")
        0.088 0.020

    Source: IDU section 4.2.
    """
    (y, of_y), (z, of_z) = (
        _quarters(name, frame)
        for name, frame in (("independent", independent), ("correlated", correlated))
    )
    if of_y != of_z:
        raise ValueError(f"correlated has {of_z} samples, independent has {of_y}")
    return _combined(y, z, independent.median_luminance, of_y, window=window)


def _quarters(name: str, frame: Frame) -> tuple[SubAverages, Scalar]:
    """Four sub-averages of a frame, and its samples."""
    if frame.sub_buffers % 4:
        raise ValueError(
            f"{name} must have sub-buffers in a multiple of 4, got {frame.sub_buffers}"
        )
    if frame.samples is None:
        raise ValueError(f"{name}: how many samples it has is not known")
    return frame.merged(4).buffers.color, frame.samples


@functools.partial(jax.jit, static_argnames="window")
def _combined(
    y: SubAverages, z: SubAverages, exposure: Scalar, samples: Scalar, *, window: int
) -> Combined:
    """Gamma by quarters, then the combination of halves."""
    unit = UNIT / jnp.square(exposure)
    variances = relative_variances(
        y,
        z,
        samples / 4,
        window=window,
        unit=unit,
        epsilon=0.01 * jnp.square(exposure),
    )
    gamma = _best(variances, unit, MULTIPLES)
    y, z = (jnp.stack([mean(images[:2]), mean(images[2:])]) for images in (y, z))
    image = combine(y, z, gamma, samples / 2, window=window)
    return Combined(image, gamma, variances)
