"""Select the gamma of minimum variance, from four pairs of sub-averages or more."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from jscomb.numerics.guards import weighted_ratio
from jscomb.numerics.tiles import (
    Grid,
    Planes,
    Region,
    fold_rows,
    sum_over_tiles,
    tile_side,
)
from jscomb.numerics.windows import check_window, window_mean, window_sum
from jscomb.typing import Scalar
from jscomb.uncorrelated._kernels import rate_of
from jscomb.uncorrelated._pairs import (
    Guides,
    Pairs,
    Samples,
    SubAverages,
    check_samples,
    make_pairs,
)

UNIT = 0.0005
"""Unit of gamma, per squared normalised radiance."""

PAPER_MULTIPLES = 20, 50, 100, 200, 400, 1000, 2000, 3000, 4000, 5000
"""The paper's candidates of gamma, in units: from 0.01 to 2.5."""

MULTIPLES = 1, 2, 5, 10, *PAPER_MULTIPLES
"""Candidates of gamma, in units; those below 0.01 weigh almost equally."""


def select_gamma(
    independent: SubAverages,
    correlated: SubAverages,
    samples: Samples,
    *,
    window: int = 15,
    unit: Scalar | float = UNIT,
    multiples: Sequence[int] = MULTIPLES,
    epsilon: Scalar | float = 0.01,
    stride: int = 4,
    crosswise: bool = False,
    guides: Guides = "correlated",
) -> Scalar:
    """Return the gamma whose result has the minimum estimated relative variance.

    The defaults are for normalised radiance; `select_gamma_frame` is for frames.

    Args:
        independent: y^1, ..., y^2B, an even number of at least four sub-averages,
            linear radiance, shape [2B,H,W,C].
        correlated: z^1, ..., z^2B, linear radiance, shape [2B,H,W,C].
        samples: n, samples a pixel in each sub-average, at least 1.
        window: width of the windows in pixels, odd.
        unit: of gamma, per squared radiance.
        multiples: candidates in units; whole, positive.
        epsilon: > 0, squared radiance; limits the weight of dark pixels.
        stride: every so many rows are judged.
        crosswise: for `combine_crosswise`.
        guides: as for `combine`.

    Returns:
        gamma, per squared radiance.

    Raises:
        ValueError: as `relative_variances`.

    Example:
        >>> import numpy as np
        >>> rng = np.random.default_rng(0)
        >>> y = jnp.asarray(rng.normal(1, 0.2, (4, 8, 8, 1)))
        >>> z = y + jnp.asarray(rng.normal(0, 0.1, (4, 8, 8, 1)))
        >>> gamma = select_gamma(y, z, 16, window=3, multiples=(20, 5000))
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
        guides=guides,
    )
    best = jnp.asarray(multiples, variances.dtype)[jnp.argmin(variances)]
    return best * jnp.asarray(unit, best.dtype)


def relative_variances(
    independent: SubAverages,
    correlated: SubAverages,
    samples: Samples,
    *,
    window: int = 15,
    unit: Scalar | float = UNIT,
    multiples: Sequence[int] = MULTIPLES,
    epsilon: Scalar | float = 0.01,
    stride: int = 4,
    crosswise: bool = False,
    guides: Guides = "correlated",
) -> Float[Array, " candidates"]:
    """Estimate twice the relative variance of a combination of two pairs, per gamma.

    The results u^a of pairs {1, 3, ...} and u^b of pairs {2, 4, ...} differ by noise
    alone, so the estimate is the mean of (u^a - u^b)^2 / (m^2 + epsilon), with m the
    window mean of y. All candidates are powers of one exponential.

    Args:
        independent: y^1, ..., y^2B, an even number of at least four sub-averages,
            linear radiance, shape [2B,H,W,C].
        correlated: z^1, ..., z^2B, linear radiance, shape [2B,H,W,C].
        samples: n, samples a pixel in each sub-average, at least 1.
        window: width of the windows in pixels, odd.
        unit: of gamma, per squared radiance.
        multiples: candidates in units; whole, positive.
        epsilon: > 0, squared radiance; limits the weight of dark pixels.
        stride: every so many rows are judged. Errors of a combination are similar over
            a window, so a few rows suffice.
        crosswise: the kernel of a is applied to b and vice versa.
        guides: as for `combine`.

    Returns:
        the means over valid pixels and channels, shape [candidates]; 0 if there are
        none.

    Raises:
        ValueError: if shapes differ, there are not four sub-averages, `samples` or
            `stride` is less than 1, a multiple is not whole and positive, or `window`
            is even.

    Example:
        >>> import numpy as np
        >>> rng = np.random.default_rng(0)
        >>> y = jnp.asarray(rng.normal(1, 0.2, (4, 8, 8, 1)))
        >>> z = y + jnp.asarray(rng.normal(0, 0.1, (4, 8, 8, 1)))
        >>> found = relative_variances(y, z, 16, window=3, multiples=(20, 5000))
        >>> print([f"{v:.4f}" for v in found])
        ['0.0352', '0.0325']

    Source: IDU section 4.2.
    """
    squares, counted = _relative(
        independent,
        correlated,
        samples,
        window=window,
        unit=unit,
        multiples=multiples,
        epsilon=epsilon,
        stride=stride,
        crosswise=crosswise,
        guides=guides,
    )
    count = independent.shape[-1] * jnp.maximum(jnp.sum(counted), 1)
    return jnp.sum(squares, axis=(1, 2)) / count


def select_gamma_map(
    independent: SubAverages,
    correlated: SubAverages,
    samples: Samples,
    *,
    region: int = 65,
    window: int = 15,
    unit: Scalar | float = UNIT,
    multiples: Sequence[int] = MULTIPLES,
    epsilon: Scalar | float = 0.01,
    stride: int = 4,
    guides: Guides = "correlated",
) -> Float[Array, "h w 1"]:
    """Return the gamma of minimum estimated relative variance around each pixel.

    Args:
        independent: y^1, ..., y^2B, as for `select_gamma`, shape [2B,H,W,C].
        correlated: z^1, ..., z^2B, linear radiance, shape [2B,H,W,C].
        samples: n, samples a pixel in each sub-average, at least 1.
        region: width in pixels of the square around a pixel that is judged, odd.
        window: width of the windows in pixels, odd.
        unit: of gamma, per squared radiance.
        multiples: candidates in units; whole, positive.
        epsilon: > 0, squared radiance; limits the weight of dark pixels.
        stride: every so many rows are judged.
        guides: as for `combine`.

    Returns:
        gamma, per squared radiance, shape [H,W,1].

    Raises:
        ValueError: as `relative_variances`, or if `region` is even.

    Example:
        >>> import numpy as np
        >>> rng = np.random.default_rng(0)
        >>> y, z = jnp.asarray(rng.normal(1, 0.2, (2, 4, 8, 8, 1)))
        >>> gamma = select_gamma_map(y, z, 16, region=5, window=3)
        >>> print(gamma.shape)
        (8, 8, 1)

    Source: ours; IDU section 4.2 has one for the image.
    """
    squares, counted = _relative(
        independent,
        correlated,
        samples,
        window=window,
        unit=unit,
        multiples=multiples,
        epsilon=epsilon,
        stride=stride,
        crosswise=False,
        guides=guides,
    )
    total = window_sum(jnp.moveaxis(squares, 0, -1), region)
    variances = weighted_ratio(total, window_sum(counted, region))
    best = jnp.argmin(variances, axis=-1, keepdims=True)
    known = jnp.asarray(multiples, variances.dtype)
    return known[best] * jnp.asarray(unit, known.dtype)


def _relative(
    independent: SubAverages,
    correlated: SubAverages,
    samples: Samples,
    *,
    window: int,
    unit: Scalar | float,
    multiples: Sequence[int],
    epsilon: Scalar | float,
    stride: int,
    crosswise: bool,
    guides: Guides,
) -> tuple[Planes, Float[Array, "h w 1"]]:
    """Weighted squares of each multiple, summed over channels, and where they count."""
    pairs = make_pairs(independent, correlated)
    check_samples(samples)
    count = len(pairs.y)
    if count < 4 or count % 2:
        raise ValueError(
            "gamma is selected from an even number of sub-averages, at least 4; got "
            f"{count}"
        )
    if stride < 1:
        raise ValueError(f"stride must be at least 1, got {stride}")
    if not multiples or any(m != int(m) or m < 1 for m in multiples):
        raise ValueError(f"multiples must be whole and positive, got {multiples}")
    a, b = pairs.some(slice(0, None, 2)), pairs.some(slice(1, None, 2))
    of_kernels = (b, a) if crosswise else (a, b)
    spreads = [_contrasts(of, guides) for of in of_kernels]
    rate = rate_of(unit, samples, pairs.y.dtype)
    valid = pairs.valid.astype(rate.dtype)
    level = jnp.square(window_mean(pairs.mean, window, mask=pairs.valid))
    weight = valid / (level + jnp.asarray(epsilon, rate.dtype))
    others = window_sum(valid, window) - 1
    share = weighted_ratio(valid, others)
    # The channels of a and b side by side, so that one sum gives their difference.
    excess = jnp.concatenate([a.excess, -b.excess], -1)
    near = [excess, valid, *jnp.concatenate(spreads, -1)]
    here = [a.mean - b.mean, share, weight]
    squares = _squares(near, here, rate, multiples, window=window, stride=stride)
    judged = jnp.arange(len(valid)) % stride == 0
    return squares, jnp.where(judged[:, None, None], valid, 0.0)


def _contrasts(pairs: Pairs, guides: Guides) -> SubAverages:
    """Images whose squared differences sum to the square of `variance_kernel`.

    Orthogonal contrasts of B sub-averages: of two, their difference.
    """
    count = len(pairs.y)
    helmert = np.tril(np.ones((count, count)), -1)[1:]
    helmert -= np.diag(np.arange(1.0, count), 1)[:-1]
    helmert *= np.sqrt(2 / (count - 1)) / np.linalg.norm(helmert, axis=1, keepdims=True)
    parts = pairs.guides(guides)
    parts = parts.reshape(-1, count, *parts.shape[1:])
    spread = jnp.einsum("kb,pbhwc->pkhwc", jnp.asarray(helmert, parts.dtype), parts)
    return spread.reshape(-1, *parts.shape[2:])


def _squares(
    near: Sequence[Array],
    here: Sequence[Array],
    rate: Scalar,
    multiples: Sequence[int],
    *,
    window: int,
    stride: int,
) -> Planes:
    """Weight times (u^a - u^b)^2, summed over channels, for each multiple.

    `near` are the excess, the mask and guides, read all over the windows, `here` images
    that are read at their centres.
    """
    reach = check_window(window) // 2
    tile = stride * -(-tile_side(*here[0].shape[:2]) // stride)
    rows, columns = slice(reach, reach + tile, stride), slice(reach, reach + tile)

    def squares(excess: Planes, *planes: Planes) -> Planes:
        """The squares of one tile."""
        at_centre, guides = planes[-len(here) :], planes[: -len(here)]
        s_c, _, *g_c = (p[:, rows, columns] for p in (excess, *guides))

        def exponentials(near: list[Planes]) -> list[Planes]:
            """The exponentials of a row of the window."""
            found = []
            for dx in range(window):
                valid_i, *g_i = (p[:, :tile:stride, dx : dx + tile] for p in near)
                each = zip(g_c, g_i, strict=True)
                square = sum(jnp.square(c - i) for c, i in each)
                found.append(valid_i * jnp.exp(-rate * square))
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

        # XLA would otherwise recompute the exponentials for every sum. So the loop
        # carries them, and computes those of a row one turn ahead.
        ahead = [jnp.roll(p, -1, axis=1) for p in guides]
        totals = [jnp.zeros_like(s_c) for _ in multiples]
        start = totals, exponentials([*guides])
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
    return sum_over_tiles(squares, regions, Grid(tile, 1, reach, 1), reach=0)


def powers(base: Array, exponents: Sequence[int]) -> list[Array]:
    """Whole, positive powers of one array by few products."""
    known = {1: base}

    def power(exponent: int) -> Array:
        if exponent not in known:
            sums = (k for k in known if exponent - k in known)
            half = exponent // 2
            first = next(sums, half if exponent % 2 == 0 else 1)
            known[exponent] = power(first) * power(exponent - first)
        return known[exponent]

    return [power(exponent) for exponent in exponents]
