"""Combine independent and correlated estimates by weights that cause no bias.

Every function here is pure, and differentiable in every array and in gamma.
"""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jscomb.numerics.guards import safe_sqrt, weighted_ratio
from jscomb.numerics.medians import median_of
from jscomb.numerics.tiles import (
    Grid,
    Planes,
    Region,
    fold_rows,
    sum_over_tiles,
    tile_side,
)
from jscomb.numerics.windows import check_window, window_mean, window_sum
from jscomb.typing import Image, Scalar
from jscomb.uncorrelated._kernels import Kernel, variance_kernel
from jscomb.uncorrelated._pairs import (
    Gamma,
    Guides,
    Pairs,
    Samples,
    SubAverages,
    check_rate,
    make_pairs,
    mean,
)


def combine(
    independent: SubAverages,
    correlated: SubAverages,
    gamma: Gamma,
    samples: Samples,
    *,
    window: int = 15,
    guides: Guides = "correlated",
) -> Image:
    """Combine independent and correlated estimates of one image.

    Scale-equivariant if gamma is divided by s^2 where radiance is multiplied by s.

    Args:
        independent: y^1, ..., y^B, at least two sub-averages, linear radiance, shape
            [B,H,W,C].
        correlated: z^1, ..., z^B, linear radiance, shape [B,H,W,C].
        gamma: at least zero, per squared radiance; 0 weights all pixels equally. One
            number, or that of each centre, shape [H,W,1].
        samples: n, samples a pixel in each sub-average, at least 1.
        window: width of the windows in pixels, odd.
        guides: weights by differences of z, of y ("independent"), or by the sum of the
            squares of "both".

    Returns:
        u, linear radiance, shape [H,W,C]; at an invalid pixel the first finite of the
        mean y, y^1, y^2 and the same of z, else 0.

    Raises:
        ValueError: if shapes differ, there are less than two sub-averages, gamma is
            negative, `samples` is less than 1 or `window` is even.

    Example:
        >>> y, z = jnp.array([0.0, 1.0, 5.0]), jnp.array([3.0, 3.0, 7.0])
        >>> two = lambda image: jnp.stack([image.reshape(1, 3, 1)] * 2)
        >>> u = combine(two(y), two(z), gamma=1.0, samples=8, window=3)
        >>> print([f"{v:.3f}" for v in u.ravel()])
        ['1.000', '0.500', '5.000']

    Source: IDU eq. 5, 8; section 4.1 for kernels of y or of both.
    """
    pairs = make_pairs(independent, correlated)
    check_rate(gamma, samples)
    count = len(pairs.y)
    if count < 2:
        raise ValueError(f"combine needs at least 2 sub-averages, got {count}")
    scale = None
    if jnp.ndim(gamma):
        gamma, scale = 1.0, safe_sqrt(jnp.asarray(gamma))
    kernel = _of_each(variance_kernel(gamma, samples), count)
    image = _drawn(pairs, kernel, pairs.guides(guides), window, scale)
    return jnp.where(pairs.valid, image, pairs.instead)


def _of_each(kernel: Kernel, count: int) -> Kernel:
    """The product of the weights by z and by y, if there are both."""

    def product(*differences: Array) -> Array:
        weights = kernel(*differences[:count])
        others = differences[count:]
        return weights * kernel(*others) if others else weights

    return product


def combine_median(
    independent: SubAverages,
    correlated: SubAverages,
    gamma: Gamma,
    samples: Samples,
    *,
    window: int = 15,
    guides: Guides = "correlated",
) -> Image:
    """Return the median of the combinations of P pairs of sub-averages.

    A firefly is in the sub-averages of one pair, so it does not reach the median of
    three combinations or more. Unbiased where `combine` is, since the combinations are
    then symmetric about the truth; where noise is skewed the median is darker.

    Args:
        independent: y^1, ..., y^2P, linear radiance, shape [2P,H,W,C].
        correlated: z^1, ..., z^2P, linear radiance, shape [2P,H,W,C].
        gamma: as for `combine`.
        samples: n, samples a pixel in each sub-average, at least 1.
        window: width of the windows in pixels, odd.
        guides: as for `combine`.

    Returns:
        the median, linear radiance, shape [H,W,C]; at a pixel invalid in a pair as in
        `combine`.

    Raises:
        ValueError: as `combine`, or if the number of sub-averages is odd.

    Example:
        >>> y = jnp.ones((6, 3, 3, 1)).at[0, 1, 1].set(1e6)
        >>> print(combine_median(y, jnp.ones_like(y), 1.0, 8, window=3)[1, 1])
        [1.]

    Source: ours.
    """
    pairs = make_pairs(independent, correlated)
    if len(pairs.y) % 2 or not len(pairs.y):
        raise ValueError(
            f"combine_median needs an even number of sub-averages, got {len(pairs.y)}"
        )

    def one(pair: tuple[SubAverages, SubAverages]) -> Image:
        return combine(*pair, gamma, samples, window=window, guides=guides)

    y, z = (i.reshape(-1, 2, *i.shape[1:]) for i in (independent, correlated))
    return median_of(lax.map(one, (y, z)))


def combine_with(
    kernel: Kernel,
    independent: SubAverages,
    correlated: SubAverages,
    *,
    window: int = 15,
    guides: Guides = "correlated",
) -> Image:
    """Combine with any kernel; `admissibility` tests whether it causes bias.

    Args:
        kernel: from B arrays of one shape, D_ci z^1, ..., D_ci z^B in linear radiance,
            to weights in [0, 1] of that shape, elementwise.
        independent: y^1, ..., y^B, linear radiance, shape [B,H,W,C].
        correlated: z^1, ..., z^B, linear radiance, shape [B,H,W,C].
        window: width of the windows in pixels, odd.
        guides: the kernel gets differences of z, of y ("independent"), or of "both", 2B
            arrays, those of z first. Of both it must not change when one constant is
            added to those of z and another to those of y.

    Returns:
        u, linear radiance, shape [H,W,C]; at an invalid pixel as in `combine`.

    Raises:
        ValueError: if shapes differ or `window` is even.

    Example:
        >>> y, z = jnp.array([0.0, 1.0, 5.0]), jnp.array([3.0, 3.0, 7.0])
        >>> two = lambda image: jnp.stack([image.reshape(1, 3, 1)] * 2)
        >>> even = lambda first, second: jnp.full_like(first, 0.5)
        >>> u = combine_with(even, two(y), two(z), window=3)
        >>> print([f"{v:.3f}" for v in u.ravel()])
        ['0.500', '0.750', '5.000']

    Source: IDU eq. 5, theorem 2.
    """
    pairs = make_pairs(independent, correlated)
    image = _drawn(pairs, kernel, pairs.guides(guides), window)
    return jnp.where(pairs.valid, image, pairs.instead)


def combine_uniform(
    independent: SubAverages, correlated: SubAverages, *, window: int = 15
) -> Image:
    """Combine with equal weights: always unbiased, whatever the noise.

    Args:
        independent: y^1, ..., y^B, linear radiance, shape [B,H,W,C].
        correlated: z^1, ..., z^B, linear radiance, shape [B,H,W,C].
        window: width of the windows in pixels, odd.

    Returns:
        the image, linear radiance, shape [H,W,C]; at an invalid pixel as in `combine`.

    Raises:
        ValueError: if shapes differ or `window` is even.

    Example:
        >>> y, z = jnp.array([0.0, 1.0, 5.0]), jnp.array([3.0, 3.0, 7.0])
        >>> two = lambda image: jnp.stack([image.reshape(1, 3, 1)] * 2)
        >>> u = combine_uniform(two(y), two(z), window=3)
        >>> print([f"{v:.3f}" for v in u.ravel()])
        ['0.500', '0.667', '5.000']

    Source: IDU section 3, k_i = k_c = 1 / (|O_c| + 1).
    """
    pairs = make_pairs(independent, correlated)
    common = window_mean(pairs.excess, window, mask=pairs.valid)
    return jnp.where(pairs.valid, mean(pairs.z) - common, pairs.instead)


def combine_crosswise(
    independent: Float[Array, "4 h w c"],
    correlated: Float[Array, "4 h w c"],
    gamma: Scalar | float,
    samples: Samples,
    *,
    window: int = 15,
) -> Image:
    """Combine with weights from other samples: always unbiased, at half the benefit.

    The kernel of the first two pairs is applied to the other two and vice versa, and
    the two results are averaged.

    Args:
        independent: y^1, ..., y^4, linear radiance, shape [4,H,W,C].
        correlated: z^1, ..., z^4, linear radiance, shape [4,H,W,C].
        gamma: at least zero, per squared radiance.
        samples: n, samples a pixel in each sub-average, at least 1.
        window: width of the windows in pixels, odd.

    Returns:
        the image, linear radiance, shape [H,W,C]; at an invalid pixel as in `combine`.

    Raises:
        ValueError: if shapes differ, there are not four sub-averages, `samples` is less
            than 1 or `window` is even.

    Example:
        >>> y, z = jnp.array([0.0, 1.0, 5.0]), jnp.array([3.0, 3.0, 7.0])
        >>> four = lambda image: jnp.stack([image.reshape(1, 3, 1)] * 4)
        >>> u = combine_crosswise(four(y), four(z), gamma=1.0, samples=8, window=3)
        >>> print([f"{v:.3f}" for v in u.ravel()])
        ['1.000', '0.500', '5.000']

    Source: IDU section 5 (cross-weighting).
    """
    pairs = make_pairs(independent, correlated, count=4)
    kernel = variance_kernel(gamma, samples)
    first, second = pairs.some(slice(2)), pairs.some(slice(2, 4))
    image = _drawn(first, kernel, second.z, window)
    image = (image + _drawn(second, kernel, first.z, window)) / 2
    return jnp.where(pairs.valid, image, pairs.instead)


def combine_decorrelated(
    independent: Float[Array, "4 h w c"],
    correlated: Float[Array, "4 h w c"],
    gamma: Scalar | float,
    samples: Samples,
    *,
    window: int = 15,
) -> Image:
    """Combine where each z^j was made from y^j, as by L2 reconstruction.

    One image of each pair is used: y^1, y^2 with z^3, z^4 and vice versa; the two
    results are averaged.

    Args:
        independent: y^1, ..., y^4, linear radiance, shape [4,H,W,C].
        correlated: z^1, ..., z^4, for example by `numerics.poisson.reconstruct`, linear
            radiance, shape [4,H,W,C].
        gamma: at least zero, per squared radiance.
        samples: n, samples a pixel in each sub-average, at least 1.
        window: width of the windows in pixels, odd.

    Returns:
        the image, linear radiance, shape [H,W,C]; at a pixel invalid in a pair as in
        `combine`.

    Raises:
        ValueError: if shapes differ, there are not four sub-averages, `samples` is less
            than 1 or `window` is even.

    Example:
        >>> y, z = jnp.array([0.0, 1.0, 5.0]), jnp.array([3.0, 3.0, 7.0])
        >>> four = lambda image: jnp.stack([image.reshape(1, 3, 1)] * 4)
        >>> u = combine_decorrelated(four(y), four(z), gamma=1.0, samples=8, window=3)
        >>> print([f"{v:.3f}" for v in u.ravel()])
        ['1.000', '0.500', '5.000']

    Source: IDU section 5 (L2 reconstruction).
    """
    make_pairs(independent, correlated, count=4)
    first = combine(independent[:2], correlated[2:], gamma, samples, window=window)
    second = combine(independent[2:], correlated[:2], gamma, samples, window=window)
    return (first + second) / 2


def _drawn(
    pairs: Pairs,
    kernel: Kernel,
    guides: SubAverages,
    window: int,
    scale: Float[Array, "h w 1"] | None = None,
) -> Image:
    """Result of some pairs, with weights from the guides, times each centre's scale."""
    pull = _pull(pairs, kernel, guides, window, scale)
    others = window_sum(pairs.valid.astype(pull.dtype), window) - 1
    return pairs.mean + weighted_ratio(pull, others)


def _pull(
    pairs: Pairs,
    kernel: Kernel,
    guides: SubAverages,
    window: int,
    scale: Float[Array, "h w 1"] | None,
) -> Image:
    """Sum over i of kernel(D_ci guides) (s_c - s_i), with s = z - y."""
    reach = check_window(window) // 2
    excess = jnp.moveaxis(pairs.excess, -1, 0)
    valid = jnp.moveaxis(pairs.valid, -1, 0).astype(excess.dtype)
    each = jnp.moveaxis(guides, -1, 1)
    tile = tile_side(*excess.shape[1:])
    centre = slice(reach, reach + tile)

    def pull(*planes: Planes) -> Planes:
        """The sum for one tile."""
        near, scales = planes[: 2 + len(each)], planes[2 + len(each) :]
        s_c, _, *g_c = (planes[:, centre, centre] for planes in near)

        def add_row(total: Planes, moved: list[Planes]) -> Planes:
            for dx in range(window):
                s_i, valid_i, *g_i = (p[:, :tile, dx : dx + tile] for p in moved)
                differences = [c - i for c, i in zip(g_c, g_i, strict=True)]
                for of_centre in scales:
                    differences = [of_centre * d for d in differences]
                total = total + valid_i * kernel(*differences) * (s_c - s_i)
            return total

        return fold_rows(add_row, jnp.zeros_like(s_c), near, window)

    regions = [Region(planes, reach) for planes in (excess, valid, *each)]
    if scale is not None:
        regions.append(Region(jnp.moveaxis(scale, -1, 0), 0))
    grid = Grid(tile, 1, reach, 2)
    return jnp.moveaxis(sum_over_tiles(pull, regions, grid, reach=0), 0, -1)
