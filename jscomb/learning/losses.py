"""Losses that networks are trained on; `metrics.smape` is another.

Images [H,W,C], linear radiance, normalised.
"""

import jax.numpy as jnp
from jaxtyping import Array

from jscomb.numerics.guards import check_same_shape
from jscomb.typing import Image, Scalar

__all__ = ["compress", "log_l2"]


def log_l2(image: Image, reference: Image, *, epsilon: float = 0.01) -> Scalar:
    """Return the relative squared error of signed logarithms.

    Noise of the reference only adds a constant, as long as it is small where it matters
    to the logarithm and to the weight.

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
