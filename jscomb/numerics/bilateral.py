r"""Cross-bilateral filter: window means weighed by how alike the pixels of guides are.

Layout: images [H,W,C]. Notation, for a pixel p and another q in its window:

    g       guide, in units of its standard deviation times the root of 2
    z, v    noisy guide and its variance; z is in units of sigma_z times the root of 2

    k_pq = exp(-|p - q|^2 / (2 sigma^2) - |g_p - g_q|^2
               - sum_channels (z_p - z_q)^2 / (v_p + v_q))

The weights depend on no pair of images but the guides, so many images are filtered at
the price of one exponential a pair.

Sources:
    J. Kopf et al., "Joint bilateral upsampling", 2007; T.-M. Li et al., "SURE-based
    optimization for adaptive sampling and reconstruction", 2012 (the noisy guide);
    ED eq. 32-34.
"""

from collections.abc import Sequence

import jax.numpy as jnp
from jaxtyping import Array, Float

from jscomb.numerics.guards import divide, finite
from jscomb.numerics.tiles import Grid, Planes, Region, fold_rows, sum_over_tiles
from jscomb.numerics.windows import check_window

Plane = Float[Array, "_ _"]

# A distance beyond which a weight is 0 in any precision.
_FARTHEST = 1e4
_TILE, _TILES = 64, 2


def bilateral_mean(
    image: Float[Array, "h w k"],
    guide: Float[Array, "h w g"],
    noisy: Float[Array, "h w z"],
    variance: Float[Array, "h w z"],
    *,
    window: int,
    sigma: float,
) -> Float[Array, "h w k"]:
    """Mean over the window of each pixel, weighed by the guides.

    Pure, and differentiable in every array.

    Args:
        image: any unit, shape [H,W,K].
        guide: g, scaled, shape [H,W,G]; G may be 0.
        noisy: z, scaled, shape [H,W,Z]; Z may be 0.
        variance: v of the unscaled z, at least zero, shape [H,W,Z].
        window: width of the windows in pixels, odd.
        sigma: > 0, standard deviation in pixels of the distance's share.

    Returns:
        the means, shape [H,W,K]. Pixels that are not finite in some input take no part,
        and are 0.

    Raises:
        ValueError: while tracing, if `window` is even or `sigma` is not positive.

    Example:
        >>> image = jnp.array([1.0, 3.0, 5.0, 7.0]).reshape(1, 4, 1)
        >>> edge = jnp.array([0.0, 0.0, 9.0, 9.0]).reshape(1, 4, 1)
        >>> none = edge[..., :0]
        >>> mean = bilateral_mean(image, edge, none, none, window=3, sigma=100.0)
        >>> print([f"{value:.2f}" for value in mean.ravel()])
        ['2.00', '2.00', '6.00', '6.00']
    """
    reach = check_window(window) // 2
    if not sigma > 0:
        raise ValueError(f"sigma must be positive, got {sigma}")
    tile = min(_TILE, max(image.shape[:2]))
    grid = Grid(tile, 1, reach, _TILES)
    valid = finite(image, guide, noisy, variance)
    ones = jnp.ones_like(valid, image.dtype)
    # Where not valid the ones are 0 as well, so those pixels are not counted.
    regions = [
        Region(jnp.moveaxis(jnp.where(valid, planes, 0.0), -1, 0), reach)
        for planes in (jnp.concatenate([image, ones], -1), guide, noisy, variance)
    ]

    def mean(*near: Planes) -> Planes:
        """Sums over the windows of a tile: of the images and of the weights."""
        middle = slice(reach, reach + tile)
        centre = [planes[:, middle, middle] for planes in near]

        def add_row(
            carry: tuple[Planes, Array], moved: list[Planes]
        ) -> tuple[Planes, Array]:
            total, dy = carry
            for dx in range(window):
                q = [planes[:, :tile, dx : dx + tile] for planes in moved]
                away = (dy**2 + (dx - reach) ** 2) / (2 * sigma**2)
                weight = jnp.exp(-(_distance(centre[1:], q[1:]) + away))
                total = total + weight[None] * q[0]
            return total, dy + 1

        start = jnp.zeros_like(centre[0]), jnp.asarray(-reach, image.dtype)
        return fold_rows(add_row, start, near, window)[0]

    sums = sum_over_tiles(mean, regions, grid, reach=0)
    sums = jnp.moveaxis(sums, 0, -1)
    weight = jnp.broadcast_to(sums[..., -1:], image.shape)
    return jnp.where(valid, divide(sums[..., :-1], weight, where=weight > 0), 0.0)


def _distance(p: Sequence[Planes], q: Sequence[Planes]) -> Plane | float:
    """What the guides of p and q make of their weight: -log k_pq but for |p - q|^2.

    Plane by plane: a sum over an axis would not be vectorised.
    """
    (g_p, z_p, v_p), (g_q, z_q, v_q) = p, q
    square, noise = jnp.square(z_p - z_q), v_p + v_q
    known = _FARTHEST * noise > square
    far = jnp.where(square > 0, _FARTHEST, jnp.zeros_like(square))
    ratio = divide(square, noise, where=known, otherwise=far)
    return sum([*jnp.square(g_p - g_q), *ratio])
