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

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jscomb.numerics.guards import divide, finite
from jscomb.numerics.tiles import Grid, Planes, Region, sum_over_tiles
from jscomb.numerics.windows import check_window

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
    """
    reach = check_window(window) // 2
    if not sigma > 0:
        raise ValueError(f"sigma must be positive, got {sigma}")
    k, g, z = image.shape[-1], guide.shape[-1], noisy.shape[-1]
    grid = Grid(_TILE, 1, reach, _TILES)
    valid = finite(image, guide, noisy, variance)
    ones = jnp.ones_like(valid, image.dtype)
    stacked = jnp.concatenate([image, ones, guide, noisy, variance], axis=-1)
    planes = jnp.moveaxis(jnp.where(valid, stacked, 0.0), -1, 0)
    ends = k + 1, k + 1 + g, k + 1 + g + z

    def distance(p: Planes, q: Planes) -> Float[Array, "t t"]:
        """Of the guides; far from pixels that are not valid."""
        _, g_p, z_p, v_p = jnp.split(p, ends)
        taken, g_q, z_q, v_q = jnp.split(q, ends)
        square, noise = jnp.square(z_p - z_q), v_p + v_q
        known = _FARTHEST * noise > square
        far = jnp.where(square > 0, _FARTHEST, jnp.zeros_like(square))
        ratio = divide(square, noise, where=known, otherwise=far)
        total = jnp.sum(jnp.square(g_p - g_q), axis=0) + jnp.sum(ratio, axis=0)
        return jnp.where(taken[-1] > 0, total, _FARTHEST)

    def mean(near: Planes) -> Planes:
        """Sums over the windows of a tile: of the images and of the weights."""
        centre = near[:, reach : reach + _TILE, reach : reach + _TILE]

        @jax.checkpoint
        def add_row(total: Planes, row: Array) -> tuple[Planes, None]:
            strip = lax.dynamic_slice_in_dim(near, row, _TILE, axis=1)
            dy = (row - reach).astype(near.dtype)
            for column in range(window):
                q = lax.slice_in_dim(strip, column, column + _TILE, axis=2)
                away = (dy**2 + (column - reach) ** 2) / (2 * sigma**2)
                weight = jnp.exp(-(distance(centre, q) + away))
                total = total + weight[None] * q[: k + 1]
            return total, None

        total = jnp.zeros_like(centre[: k + 1])
        return lax.scan(add_row, total, jnp.arange(window))[0]

    sums = sum_over_tiles(mean, [Region(planes, reach)], grid, reach=0)
    sums = jnp.moveaxis(sums, 0, -1)
    weight = jnp.broadcast_to(sums[..., -1:], image.shape)
    return jnp.where(valid, divide(sums[..., :-1], weight, where=weight > 0), 0.0)
