"""Kinds of weights: how alike two pixels are."""

import functools

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jscomb.numerics.guards import (
    check_image,
    check_same_shape,
    divide,
    zero_invalid,
)
from jscomb.numerics.weights._pairs import Pairs, Weights
from jscomb.typing import Scalar

# Distance of a noisy guide beyond which a weight is 0 in any precision.
_MAXIMUM = 1e4


def gaussian_weights(
    guide: Float[Array, "h w g"], bandwidth: Float[Array, "h w 1"] | Scalar | float
) -> Weights:
    """Return weights exp(-|g_i - g_c|^2 / h).

    Args:
        guide: g, shape [H,W,G].
        bandwidth: h > 0, unit of the guide squared: one number, or shape [H,W,1] for
            the mean of both pixels' values. Where h is not positive pixels are invalid.

    Returns:
        the weights.

    Raises:
        ValueError: if the bandwidth is a number that is not positive, or its shape is
            not [H,W,1].

    Example:
        >>> from jscomb.numerics.weights import weighted_mean
        >>> image = jnp.array([1.0, 3.0, 5.0, 7.0]).reshape(1, 4, 1)
        >>> guide = jnp.array([0.0, 0.0, 1.0, 1.0]).reshape(1, 4, 1)
        >>> mean = weighted_mean(image, gaussian_weights(guide, 0.01), window=3)
        >>> print(mean[0, :, 0])
        [2. 2. 6. 6.]

    Source: NJS eq. 11 (one bandwidth), DSC eq. 12 (one a pixel).
    """
    if isinstance(bandwidth, int | float) and not bandwidth > 0:
        raise ValueError(f"bandwidth must be positive, got {bandwidth}")
    check_image(guide=guide)
    h = jnp.asarray(bandwidth, guide.dtype)
    if h.ndim and h.shape != (*guide.shape[:2], 1):
        raise ValueError(f"bandwidth has shape {h.shape}, guide has {guide.shape}")
    h = jnp.where(h > 0, h, jnp.nan)
    if h.ndim == 0:  # divide once a pixel, not once a weight
        return Weights(guide / jnp.sqrt(h), _gaussian_pair)
    return Weights(jnp.concatenate([guide, h], axis=-1), _gaussian_pair_bandwidth)


def noise_free_weights(
    guide: Float[Array, "h w g"],
    variance: Float[Array, "h w 1"],
    *,
    epsilon: float,
) -> Weights:
    """Return weights exp(-(|g_i - g_c|^2 - G (v_i + v_c)) / (v_i + v_c + eps)).

    Gaussian weights of a distance minus what noise alone contributes to it: in a mean
    over windows, noisier pixels count up to exp(G) times as much.

    Args:
        guide: g, shape [H,W,G].
        variance: v of the guide, mean over its channels, its unit squared, at least
            zero, shape [H,W,1].
        epsilon: > 0, in the same unit.

    Returns:
        the weights.

    Raises:
        ValueError: if the variance's shape is not [H,W,1].

    Example:
        >>> from jscomb.numerics.weights import weighted_mean
        >>> image = jnp.array([1.0, 3.0]).reshape(1, 2, 1)
        >>> variance = jnp.array([0.0, 1.0]).reshape(1, 2, 1)
        >>> noisy = noise_free_weights(0 * image, variance, epsilon=1e-3)
        >>> mean = weighted_mean(image, noisy, window=3)
        >>> print([f"{value:.2f}" for value in mean.ravel()])  # (1 + 3 e) / (1 + e), 2
        ['2.46', '2.00']

    Source: DSC eq. 17, for colours: the paper has one channel.
    """
    gaussian = gaussian_weights(guide, 2 * variance + epsilon)
    channels = guide.shape[-1]

    def pair(p: Pairs, q: Pairs) -> Array:
        bandwidth = _mean_of_both(p[-1], q[-1])  # v_i + v_c + eps
        return gaussian.pair(p, q) * jnp.exp(channels * (1 - epsilon / bandwidth))

    return gaussian._replace(pair=pair)


def feature_weights(
    features: Float[Array, "h w f"], *, strength: float = 0.6, minimum: float = 1e-3
) -> Weights:
    """Return weights exp(-max_f (f_i - f_c)^2 / (k^2 max(minimum, |grad f_c|^2))).

    The gradient allows for slopes, such as depth along a floor, that are no edges.

    Args:
        features: f, with a range of about one, shape [H,W,F], F at least 1.
        strength: k > 0; a larger one tolerates larger differences.
        minimum: > 0, lower bound of the squared gradient.

    Returns:
        the weights.

    Raises:
        ValueError: if `strength` or `minimum` is not positive.

    Example:
        >>> from jscomb.numerics.weights import weighted_mean
        >>> image = jnp.array([1.0, 3.0, 5.0, 7.0]).reshape(1, 4, 1)
        >>> albedo = jnp.array([0.0, 0.0, 1.0, 1.0]).reshape(1, 4, 1)
        >>> mean = weighted_mean(image, feature_weights(albedo), window=3)
        >>> print([f"{value:.2f}" for value in mean.ravel()])
        ['2.00', '2.00', '6.00', '6.00']

    Source: Rousselle et al. 2013, "Robust denoising using feature and color
    information", eq. 6 to 8, for features without noise.
    """
    if not (strength > 0 and minimum > 0):
        raise ValueError(f"{strength=} and {minimum=} must be positive")
    check_image(features=features)
    slope = jnp.maximum(sum(_square_slope(features, axis) for axis in (0, 1)), minimum)
    scale = strength**2 * slope
    return Weights(jnp.concatenate([features, scale], axis=-1), _feature_pair)


def bilateral_weights(
    guide: Float[Array, "h w g"],
    noisy: Float[Array, "h w z"],
    variance: Float[Array, "h w z"],
    *,
    sigma: float,
) -> Weights:
    """Return weights exp(-|p - q|^2 / 2 s^2 - |g_p - g_q|^2 - sum d_pq).

    Here d_pq = (z_p - z_q)^2 / (v_p + v_q) for each noisy channel, and p, q are places.

    Args:
        guide: g, divided by sqrt(2) times its standard deviation, shape [H,W,G]; G may
            be 0.
        noisy: z, a guide with noise, divided as g, shape [H,W,Z]; Z may be 0.
        variance: v of z before that division, at least zero, shape [H,W,Z].
        sigma: s > 0, standard deviation of the spatial term in pixels.

    Returns:
        the weights.

    Raises:
        ValueError: if `sigma` is not positive, or noisy and variance differ in shape.

    Example:
        >>> from jscomb.numerics.weights import weighted_mean
        >>> image = jnp.array([1.0, 3.0, 5.0, 7.0]).reshape(1, 4, 1)
        >>> edge = jnp.array([0.0, 0.0, 9.0, 9.0]).reshape(1, 4, 1)
        >>> none = edge[..., :0]
        >>> near = bilateral_weights(edge, none, none, sigma=100.0)
        >>> mean = weighted_mean(image, near, window=3)
        >>> print([f"{value:.2f}" for value in mean.ravel()])
        ['2.00', '2.00', '6.00', '6.00']

    Source: J. Kopf et al., "Joint bilateral upsampling", 2007; T.-M. Li et al.,
    "SURE-based optimization for adaptive sampling and reconstruction", 2012 (the noisy
    guide); ED eq. 32-34.
    """
    if not sigma > 0:
        raise ValueError(f"sigma must be positive, got {sigma}")
    check_image(guide=guide, noisy=noisy)
    if noisy.shape != variance.shape:
        raise ValueError(f"variance has shape {variance.shape}, noisy {noisy.shape}")
    # Integers, which float32 holds exactly; scaled, large ones would be rounded.
    place = jnp.asarray(np.moveaxis(np.indices(guide.shape[:2]), 0, -1), guide.dtype)
    parts = np.cumsum([2, guide.shape[-1], noisy.shape[-1]])

    def pair(p: Pairs, q: Pairs) -> Array:
        at_p, g_p, z_p, v_p = jnp.split(p, parts)
        at_q, g_q, z_q, v_q = jnp.split(q, parts)
        distance = _square_distance(at_p, at_q) / (2 * sigma**2)
        distance += _square_distance(g_p, g_q)
        for z, y, v, w in zip(z_p, z_q, v_p, v_q, strict=True):
            distance += normalised_distance(jnp.square(z - y), v + w, maximum=_MAXIMUM)
        return jnp.exp(-distance)

    return Weights(jnp.concatenate([place, guide, noisy, variance], axis=-1), pair)


def minimum_of(first: Weights, second: Weights) -> Weights:
    """Return the minimum of two weights: pixels must be alike in both ways.

    Args:
        first: weights on an image [H,W,*].
        second: weights on an image of the same size.

    Returns:
        the minimum, with the larger halo.

    Raises:
        ValueError: while tracing, if the sizes differ.

    Example:
        >>> from jscomb.numerics.weights import weighted_mean
        >>> image = jnp.array([1.0, 3.0, 5.0, 7.0]).reshape(1, 4, 1)
        >>> step = lambda at: gaussian_weights(jnp.where(image > at, 1.0, 0.0), 0.01)
        >>> print(weighted_mean(image, minimum_of(step(2), step(4)), window=3)[0, :, 0])
        [1. 3. 6. 6.]
    """
    check_same_shape(first=first.image[..., :1], second=second.image[..., :1])
    split, halo = first.image.shape[-1], max(first.halo, second.halo)

    def inner(planes: Pairs, needed: int) -> Pairs:
        """Cut a wider halo down to the one needed."""
        spare = halo - needed
        rows, columns = (slice(spare, n - spare) for n in planes.shape[1:3])
        return planes[:, rows, columns]

    def pair(p: Pairs, q: Pairs) -> Array:
        one = first.pair(*(inner(i[:split], first.halo) for i in (p, q)))
        other = second.pair(*(inner(i[split:], second.halo) for i in (p, q)))
        return jnp.minimum(one, other)

    image = jnp.concatenate([first.image, second.image], axis=-1)
    return Weights(image, pair, halo)


def normalised_distance(square: Array, noise: Array, *, maximum: float) -> Array:
    """Return a squared distance divided by its noise.

    Args:
        square: squared distance, any shape; may be negative once the noise's part is
            subtracted.
        noise: its variance, at least zero, same shape and unit.
        maximum: upper bound; also the result of a positive distance without noise.

    Returns:
        the ratio, same shape.

    Example:
        >>> square, noise = jnp.array([4.0, 4.0, 0.0]), jnp.array([2.0, 0.0, 0.0])
        >>> print(normalised_distance(square, noise, maximum=9.0))
        [2. 9. 0.]
    """
    near = (maximum * noise > square) & (noise > 0)
    far = jnp.where(square > 0, maximum, jnp.zeros_like(square))
    return divide(square, noise, where=near, otherwise=far)


def _gaussian_pair(p: Pairs, q: Pairs) -> Array:
    """Return exp(-|p - q|^2)."""
    return jnp.exp(-_square_distance(p, q))


def _gaussian_pair_bandwidth(p: Pairs, q: Pairs) -> Array:
    """Return exp(-|p - q|^2 / h), h the mean of both pixels' last planes."""
    square = _square_distance(p[:-1], q[:-1])
    return jnp.exp(-square / _mean_of_both(p[-1], q[-1]))


def _mean_of_both(p: Array, q: Array) -> Array:
    """Average each pair's values; positive, also where they are 0."""
    p, q = (jnp.where(i > 0, i, 1.0) for i in (p, q))
    return (p + q) / 2


def _feature_pair(p: Pairs, q: Pairs) -> Array:
    """Return exp(-max (f_p - f_q)^2 / s_p) of planes f, then s > 0."""
    (f_p, scale), (f_q, _) = jnp.split(p, 2), jnp.split(q, 2)
    scale = jnp.where(scale > 0, scale, 1.0)  # 0 outside the image
    pairs = zip(f_p, f_q, scale, strict=True)
    distances = [jnp.square(one - other) / s for one, other, s in pairs]
    return jnp.exp(-functools.reduce(jnp.maximum, distances))


def _square_slope(features: Float[Array, "h w f"], axis: int) -> Float[Array, "h w f"]:
    """Return the squared central difference along an axis.

    Instead of a neighbour that is invalid or beyond the border the pixel itself counts.
    """
    size = features.shape[axis]
    valid, clean = zero_invalid(features)

    def at(step: int) -> Array:
        near = np.clip(np.arange(size) + step, 0, size - 1)
        there, moved = (jnp.take(i, near, axis=axis) for i in (valid, clean))
        return jnp.where(there, moved, clean)

    return jnp.square((at(1) - at(-1)) / 2)


def _square_distance(p: Pairs, q: Pairs) -> Array:
    """Return |p - q|^2; not expanded into products, which would cancel.

    Plane by plane: a sum over an axis would not be vectorised.
    """
    zero = jnp.zeros((), p.dtype)
    pairs = zip(p, q, strict=True)
    return sum((jnp.square(one - other) for one, other in pairs), start=zero)
