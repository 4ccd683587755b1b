"""How the windows of a tile weigh their pixels.

A weight is a function of a tile's neighbourhood, so that no more than a batch of tiles'
weights exists at a time. `denoisers.nonlocal_means` has another kind.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from jscomb.numerics.tiles import Grid, Planes, flat
from jscomb.typing import Scalar


class Weights(NamedTuple):
    """How each window weighs its pixels.

    Attributes:
        image: what the weights are made from, [H,W,K].
        function: planes of a tile's neighbourhood, [K,n,n], to weights [M,N] of its
            centres and pixels, finite and at least zero whatever the planes hold. The
            grid tells where the centres are.
        halo: pixels around the neighbourhood that `function` sees besides.
    """

    image: Float[Array, "h w k"]
    function: Callable[[Planes, Grid], Float[Array, "m n"]]
    halo: int = 0


def gaussian_weights(
    guide: Float[Array, "h w g"], bandwidth: Float[Array, "h w 1"] | Scalar | float
) -> Weights:
    """Weights exp(-|g_i - g_c|^2 / h).

    Args:
        guide: g, shape [H,W,G].
        bandwidth: h > 0, unit of the guide squared: one number, or shape [H,W,1] for
            the mean of both pixels' values. Elsewhere pixels are invalid.

    Returns:
        the weights.

    Raises:
        ValueError: if the bandwidth is a number that is not positive, or its shape is
            not [H,W,1].

    Source: NJS eq. 11 (one bandwidth), DSC eq. 12 (one a pixel).
    """
    if isinstance(bandwidth, int | float) and not bandwidth > 0:
        raise ValueError(f"bandwidth must be positive, got {bandwidth}")
    h = jnp.asarray(bandwidth, guide.dtype)
    if h.ndim and h.shape != (*guide.shape[:2], 1):
        raise ValueError(f"bandwidth has shape {h.shape}, guide has {guide.shape}")
    h = jnp.where(h > 0, h, jnp.nan)
    if h.ndim == 0:  # divided by once a pixel, not once a weight
        return Weights(guide / jnp.sqrt(h), _gaussian)
    return Weights(jnp.concatenate([guide, h], axis=-1), _gaussian_of_both)


def _gaussian(planes: Planes, grid: Grid) -> Float[Array, "m n"]:
    """exp(-|p_i - p_c|^2)."""
    return jnp.exp(-_square_distance(planes, grid))


def _gaussian_of_both(planes: Planes, grid: Grid) -> Float[Array, "m n"]:
    """The same with the mean of both pixels' bandwidths, the last plane."""
    h = jnp.where(planes[-1:] > 0, planes[-1:], 1.0)
    (near,), (centre,) = flat(h), grid.centres(h)
    square = _square_distance(planes[:-1], grid)
    return jnp.exp(-2 * square / (near[None] + centre[:, None]))


def _square_distance(planes: Planes, grid: Grid) -> Float[Array, "m n"]:
    """|p_i - p_c|^2; not expanded into products, which would cancel."""
    pairs = zip(flat(planes), grid.centres(planes), strict=True)
    zero = jnp.zeros((), planes.dtype)
    return sum((jnp.square(near[None] - c[:, None]) for near, c in pairs), start=zero)
