r"""Non-local means: the mean of pixels whose surroundings look the same.

Layout: images [H,W,C]. Notation:

    u      guide, of which patches are compared, any unit
    v      its variance, unit of u squared
    p, q   a pixel, and another in its window
    k      strength; larger calls more alike

    d2_pq = ((u_p - u_q)^2 - (v_p + min(v_p, v_q))) / (k^2 (v_p + v_q))
    w_pq  = exp(-(mean of d2 over the patch and the channels)+)

The noise that both pixels have is taken off their difference, so that it does not make
them look different. Weights are defined for any pair of halves: with the guide from the
other half the result is linear in the image, and does not follow its noise.

Sources:
    A. Buades, B. Coll, J.-M. Morel, "A non-local algorithm for image denoising", 2005.
    F. Rousselle, M. Manzi, M. Zwicker, "Robust denoising using feature and color
    information", 2013 (the distance).
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jscomb.numerics.guards import check_same_shape, divide, finite
from jscomb.numerics.tiles import Grid, Planes
from jscomb.numerics.weights import Weights, weighted_mean
from jscomb.numerics.windows import check_window
from jscomb.typing import Image

# A single pixel's distance at most: finite where the variance is 0, yet enough to keep
# two patches apart that differ in one channel of one pixel.
_FARTHEST = 1e6


def denoise(
    image: Image,
    guide: Float[Array, "h w _"],
    variance: Float[Array, "h w _"],
    *,
    window: int = 21,
    patch: int = 7,
    strength: float = 0.5,
) -> Image:
    """Replace each pixel by the mean of those that look the same in the guide.

    Pure, and differentiable in every array.

    Args:
        image: any unit, shape [H,W,C]; the guide itself, or of the other half.
        guide: u, shape [H,W,G].
        variance: v of the guide, at least zero, shape [H,W,G].
        window: width in pixels of the window that is searched, odd.
        patch: width in pixels of the patches that are compared, odd.
        strength: k > 0.

    Returns:
        the mean, shape [H,W,C]. Pixels that are not finite in some input take no part;
        there the result is the image where it is finite, else 0.

    Raises:
        ValueError: while tracing, if shapes differ, a width is even or `strength` is
            not positive.

    Example:
        >>> image = jnp.array([0.9, 1.1, 4.9, 5.1]).reshape(1, 4, 1)
        >>> v = jnp.full_like(image, 0.01)
        >>> y = denoise(image, image, v, window=5, patch=1, strength=2.0)
        >>> print([f"{value:.2f}" for value in y.ravel()])
        ['0.99', '1.01', '4.99', '5.01']
    """
    if image.shape[:2] != guide.shape[:2]:
        raise ValueError(f"guide has shape {guide.shape}, image has {image.shape}")
    alike = weights(guide, variance, patch=patch, strength=strength)
    return weighted_mean(image, alike, window=window)


def weights(
    guide: Float[Array, "h w g"],
    variance: Float[Array, "h w g"],
    *,
    patch: int = 7,
    strength: float = 0.5,
) -> Weights:
    """Weights w_pq for a regression, or any other weighted mean.

    Args:
        guide: u, shape [H,W,G].
        variance: v, at least zero, shape [H,W,G].
        patch: width in pixels of the patches, odd.
        strength: k > 0.

    Returns:
        the weights; those of invalid pixels have no meaning.

    Raises:
        ValueError: while tracing, if shapes differ, `patch` is even or `strength` is
            not positive.

    Example:
        >>> from jscomb.numerics.weights import weighted_mean
        >>> image = jnp.array([1.0, 3.0, 5.0, 7.0]).reshape(1, 4, 1)
        >>> guide = jnp.array([0.0, 0.0, 1.0, 1.0]).reshape(1, 4, 1)
        >>> alike = weights(guide, jnp.full_like(guide, 0.01), patch=1)
        >>> mean = weighted_mean(image, alike, window=3)
        >>> print([f"{value:.2f}" for value in mean.ravel()])
        ['2.00', '2.00', '6.00', '6.00']

    Source: Rousselle et al. 2013.
    """
    check_same_shape(guide=guide, variance=variance)
    if not strength > 0:
        raise ValueError(f"strength must be positive, got {strength}")
    halo = check_window(patch) // 2
    valid = finite(guide, variance).astype(guide.dtype)
    # Where not valid the planes are 0, and so is the last.
    image = jnp.concatenate([guide, variance, jnp.where(valid > 0, valid, jnp.nan)], -1)

    def function(planes: Planes, grid: Grid) -> Float[Array, "m n"]:
        return _tile_weights(planes, grid, patch, strength)

    return Weights(image, function, halo)


def _tile_weights(
    planes: Planes, grid: Grid, patch: int, strength: float
) -> Float[Array, "m n"]:
    """Weights of all pixels of a tile's neighbourhood for each centre.

    One row of offsets at a time: distances of the tile's pixels, and `halo` around
    them, to those at the offsets; mean over the patch; then from offsets to places.
    """
    r, halo = grid.reach, patch // 2
    offsets, inner = 2 * r + 1, grid.step + 2 * halo
    centre = planes[:, r : r + inner, r : r + inner, None]
    columns = jnp.arange(inner)[:, None] + jnp.arange(offsets)[None]
    shares = []
    for dy in range(offsets):
        moved = planes[:, dy : dy + inner][:, :, columns]
        distance, known = _distance(centre, moved, strength)
        total, count = (_patch_sum(i, patch) for i in (distance, known))
        mean = divide(total, count, where=count > 0, otherwise=_FARTHEST)
        shares.append(jnp.exp(-jnp.maximum(mean, 0.0)))
    w = _place(jnp.stack(shares))  # [offset row, row, column, near column]
    w = _place(jnp.transpose(w, (2, 3, 1, 0)))  # [column, near column, row, near row]
    n = grid.width(r)
    w = jnp.transpose(w, (2, 0, 3, 1)).reshape(grid.step**2, n * n)
    rows, columns = grid.places
    return w[rows * grid.step + columns]


def _distance(
    p: Float[Array, "k h w 1"], q: Float[Array, "k h w o"], strength: float
) -> tuple[Float[Array, "h w o"], Float[Array, "h w o"]]:
    """d2 of each pair, mean over the channels, and 1 where both are valid, else 0."""
    channels = len(p) // 2
    u_p, u_q, v_p, v_q = p[:channels], q[:channels], p[channels:-1], q[channels:-1]
    known = p[-1] * q[-1]
    difference = jnp.square(u_p - u_q) - (v_p + jnp.minimum(v_p, v_q))
    noise = strength**2 * (v_p + v_q)
    near = (noise * _FARTHEST > difference) & (noise > 0)
    far = jnp.where(difference > 0, _FARTHEST, jnp.zeros_like(difference))
    d2 = divide(difference, noise, where=near, otherwise=far)
    return jnp.mean(d2, axis=0) * known, known


def _patch_sum(values: Float[Array, "h w o"], patch: int) -> Float[Array, "_ _ o"]:
    """Sums over the patches that lie inside: two small matrix products."""
    inner = values.shape[0]
    start = np.arange(inner - patch + 1)[:, None]
    at = np.arange(inner)[None]
    band = jnp.asarray((start <= at) & (at < start + patch), values.dtype)
    return jnp.einsum("ph,qw,hwo->pqo", band, band, values, precision="highest")


def _place(w: Float[Array, "a b t o"]) -> Float[Array, "a b t n"]:
    """From offsets [.., t, o] to places [.., t, t + o], 0 elsewhere.

    Row t is to be moved t places to the right: in memory that is one place more for
    each row, which is what a row longer by one does.
    """
    *outer, count, offsets = w.shape
    n = count + offsets - 1
    longer = jnp.pad(w, [(0, 0)] * (w.ndim - 1) + [(0, count)])
    flat = longer.reshape(*outer, count * (n + 1))
    return flat[..., : count * n].reshape(*outer, count, n)
