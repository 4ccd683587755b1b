"""Losses that networks are trained on; `metrics.smape` is another.

Images [H,W,C], linear radiance, normalised. A reference is as noisy as its samples are
few. `relative_l2` takes its halves, and its derivative has the expectation of that with
the truth, however noisy they are; those of `log_l2` and `metrics.smape` do not.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jscomb.numerics.guards import check_same_shape
from jscomb.typing import Image, Scalar

__all__ = ["compress", "log_l2", "relative_l2"]


def relative_l2(
    image: Image, halves: Float[Array, "2 h w c"], *, epsilon: float = 0.01
) -> Scalar:
    """Return the squared error relative to the reference's squared radiance.

    Each half is the target for weights that are made of the other: the noise of target
    and weight is independent, so that it adds to the expected loss what does not depend
    on the image.

    Args:
        image: normalised radiance, shape [H,W,C].
        halves: of the reference, independent of each other and of the image.
        epsilon: added to the squared mean of the reference's channels.

    Returns:
        the mean over pixels and channels, and over both halves.

    Raises:
        ValueError: while tracing, if shapes differ.

    Example:
        >>> one = jnp.ones((2, 2, 2, 3))
        >>> print(f"{relative_l2(3 * one[0], one):.3f}")
        3.960

    Source: `metrics.rel_l2`; the two halves are ours.
    """
    a, b = halves
    check_same_shape(image=image, half=a)
    radiance = jnp.mean(halves, axis=-1, keepdims=True)
    weight_a, weight_b = 1 / (jnp.square(radiance) + epsilon)
    losses = jnp.square(image - a) * weight_b + jnp.square(image - b) * weight_a
    return jnp.mean(losses) / 2


def log_l2(image: Image, reference: Image, *, epsilon: float = 0.01) -> Scalar:
    """Return the relative squared error of signed logarithms.

    For references of small noise: the logarithm of a noisy one is too small.

    Args:
        image: normalised radiance, shape [H,W,C].
        reference: normalised radiance, shape [H,W,C].
        epsilon: added to the squared mean of the reference's channels, so that black
            pixels do not dominate.

    Returns:
        the mean over pixels and channels.

    Raises:
        ValueError: while tracing, if shapes differ.

    Example:
        >>> one = jnp.ones((2, 2, 3))
        >>> print(f"{log_l2(3 * one, one):.3f}")
        0.980

    Source: NJS eq. 14.
    """
    check_same_shape(image=image, reference=reference)
    found, truth = compress(image), compress(reference)
    weight = jnp.square(jnp.mean(truth, axis=-1, keepdims=True)) + epsilon
    return jnp.mean(jnp.square(found - truth) / weight)


def compress(image: Array) -> Array:
    """Return the signed logarithm of radiance.

    Args:
        image: normalised radiance, any shape.

    Returns:
        sign(v) log(1 + |v|), same shape.

    Example:
        >>> print(compress(jnp.array([-1.0, 0.0, 1e6])).round(2))
        [-0.69  0.   13.82]

    Source: NJS eq. 14.
    """
    return jnp.sign(image) * jnp.log1p(jnp.abs(image))
