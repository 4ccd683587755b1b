"""The cross-bilateral filter of weights."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from jscomb.ensemble._evidence import Bases
from jscomb.numerics.guards import (
    check_same_shape,
    divide,
    finite,
    safe_sqrt,
    weighted_ratio,
    zero_invalid,
)
from jscomb.numerics.weights import bilateral_weights, weighted_mean
from jscomb.numerics.windows import window_mean
from jscomb.typing import Image, Variance

Guide = Float[Array, "h w _"]


class Filter(NamedTuple):
    """Options of `filter_weights`; the paper's by default.

    Attributes:
        blur: standard deviation of the variance's blur in pixels; 0 for none.
        clip: limit of filtered weights in standard deviations; None for none.
        standardise: standardise the normal.
    """

    blur: float = 0.0
    clip: float | None = None
    standardise: bool = False


def filter_weights(
    weights: Bases,
    combined: Image,
    variance: Variance,
    *,
    albedo: Guide | None = None,
    normal: Guide | None = None,
    radius: int = 7,
    sigma: float = 3.0,
    sigma_radiance: float = 2.0,
    sigma_albedo: float = 0.25,
    sigma_normal: float = 0.15,
    blur: float = 0.0,
    clip: float | None = None,
    standardise: bool = False,
) -> Bases:
    """Smooth weights where image and features are smooth.

    Args:
        weights: of the bases, shape [N,H,W,C].
        combined: z, the ensemble with these weights, radiance, shape [H,W,C].
        variance: of z, squared radiance, shape [H,W,C].
        albedo: shape [H,W,3]; optional, as is the normal.
        normal: shape [H,W,3].
        radius: of the windows, in pixels.
        sigma: standard deviation of the distance, in pixels.
        sigma_radiance: of z, in units of its noise.
        sigma_albedo: of the albedo.
        sigma_normal: of the normal.
        blur: standard deviation in pixels of a Gaussian that the variance is blurred
            by, over 9x9 pixels for 2; 0 for none.
        clip: to how many standard deviations from their mean over the window filtered
            weights are limited; None for any.
        standardise: subtract the mean of each channel of the normal, and divide it by
            its standard deviation over the image, before `sigma_normal` applies.

    Returns:
        the filtered weights, shape [N,H,W,C]; unchanged at pixels that are not finite
        in some guide.

    Raises:
        ValueError: while tracing, if shapes differ or `sigma` is not positive.

    Example:
        >>> row = lambda *values: jnp.tile(jnp.array(values)[None, :, None], 3)
        >>> w, edge = row(0.0, 0.4, 0.6, 1.0), row(0.0, 0.0, 1.0, 1.0)
        >>> z = jnp.ones_like(w)
        >>> found = filter_weights(w[None], z, z, albedo=edge, radius=1, sigma=100.0)
        >>> print([f"{share:.2f}" for share in found[0, 0, :, 0]])
        ['0.20', '0.20', '0.80', '0.80']

    Source: ED eq. 32-34, with the constants of section 4.2. Blur, clip and
    standardisation are in the authors' program, not in the paper.
    """
    n, h, w, c = weights.shape
    check_same_shape(combined=combined, variance=variance)
    if normal is not None and standardise:
        normal = _standardised(normal)
    if blur > 0:
        variance = _blurred(variance, blur)
    scaled = [
        image / (2**0.5 * s)
        for image, s in ((albedo, sigma_albedo), (normal, sigma_normal))
        if image is not None
    ]
    for name, image in (("weights", weights[0]), *(("a guide", i) for i in scaled)):
        if image.shape[:2] != combined.shape[:2]:
            raise ValueError(f"{name} has {image.shape}, combined {combined.shape}")
    none = jnp.zeros((h, w, 0), combined.dtype)
    guide = jnp.concatenate([none, *scaled], axis=-1)
    flat = jnp.moveaxis(weights, 0, 2).reshape(h, w, n * c)
    alike = bilateral_weights(
        guide, combined / (2**0.5 * sigma_radiance), variance, sigma=sigma
    )
    filtered = weighted_mean(flat, alike, window=2 * radius + 1)
    if clip is not None:
        filtered = _clipped(filtered, clip, window=2 * radius + 1, bases=n)
    return jnp.moveaxis(filtered.reshape(h, w, n, c), 2, 0)


def _blurred(variance: Variance, sigma: float) -> Variance:
    """The variance under a Gaussian that ends at two standard deviations."""
    valid, clean = zero_invalid(variance)
    blurred = window_mean(clean, 2 * round(2 * sigma) + 1, mask=valid, sigma=sigma)
    return jnp.where(finite(variance), blurred, variance)


def _standardised(guide: Guide) -> Guide:
    """Each channel with mean 0 and standard deviation 1 over its finite pixels."""
    valid, clean = zero_invalid(guide)
    over = {"axis": (0, 1), "keepdims": True}
    count = jnp.maximum(jnp.sum(valid, **over), 1).astype(guide.dtype)
    centred = guide - jnp.sum(clean, **over) / count
    square = jnp.sum(jnp.where(valid, jnp.square(centred), 0.0), **over) / count
    scale = jnp.broadcast_to(safe_sqrt(square), guide.shape)
    known = jnp.where(finite(guide), guide, jnp.nan)
    return jnp.where(finite(guide), divide(centred, scale, where=scale > 0), known)


def _clipped(
    weights: Float[Array, "h w _"], limit: float, *, window: int, bases: int
) -> Float[Array, "h w _"]:
    """Weights near their mean over the window, of sum one again in every channel."""
    mean = window_mean(weights, window)
    spread = safe_sqrt(
        jnp.maximum(window_mean(jnp.square(weights), window) - jnp.square(mean), 0.0)
    )
    clipped = jnp.clip(weights, mean - limit * spread, mean + limit * spread)
    each = clipped.reshape(*weights.shape[:2], bases, -1)
    total = jnp.broadcast_to(jnp.sum(each, axis=2, keepdims=True), each.shape)
    return weighted_ratio(each, total).reshape(weights.shape)
