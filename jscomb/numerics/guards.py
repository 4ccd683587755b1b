"""The conventions for ugly input, said once: shapes, invalid pixels, division.

A pixel that is not finite in any input of a combiner is *invalid*: it takes no part in
any window, and the output there is the first finite of (biased, unbiased), else 0.
Images are `[H, W, C]`; a pixel is invalid with all its channels.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float

from jscomb.typing import Image, Mask


def check_same_shape(**images: Float[Array, "..."]) -> None:
    """Raise unless every image is `[H, W, C]` and of the first one's shape.

    Args:
        images: the arrays by the names that the caller's user knows.

    Returns:
        nothing.

    Raises:
        ValueError: while tracing; names the array that differs and both shapes.

    Example:
        >>> check_same_shape(x=jnp.zeros((2, 2, 3)), y=jnp.zeros((2, 2, 1)))
        Traceback (most recent call last):
            ...
        ValueError: y has shape (2, 2, 1), x has (2, 2, 3)
    """
    (first, image), *_ = images.items()
    if image.ndim != 3 or image.size == 0:
        raise ValueError(
            f"{first} must have shape [H, W, C], at least one pixel; got {image.shape}"
        )
    for name, other in images.items():
        if other.shape != image.shape:
            raise ValueError(
                f"{name} has shape {other.shape}, {first} has {image.shape}"
            )


def check_not_negative(**images: Float[Array, "..."]) -> None:
    """Raise if a value is negative; while tracing nothing is known, nothing raised.

    Args:
        images: the arrays by the names that the caller's user knows.

    Returns:
        nothing.

    Raises:
        ValueError: names the array and its least value.

    Example:
        >>> check_not_negative(variance=jnp.array([1.0, -0.5]))
        Traceback (most recent call last):
            ...
        ValueError: variance must be at least zero, its least is -0.5
    """
    for name, image in images.items():
        if isinstance(image, Tracer):
            continue
        least = np.nanmin(np.asarray(image), initial=0.0)  # jnp would be traced
        if least < 0:
            raise ValueError(f"{name} must be at least zero, its least is {least}")


def finite(*images: Float[Array, "h w _"]) -> Mask:
    """Pixels that are finite in every channel of every image.

    Args:
        images: any number of images of one size, their channels may differ.

    Returns:
        the mask, shape [H,W,1].

    Example:
        >>> import jax.numpy as jnp
        >>> print(finite(jnp.array([[[1.0, jnp.nan], [1.0, 2.0]]]))[..., 0])
        [[False  True]]
    """
    masks = [jnp.all(jnp.isfinite(i), axis=-1, keepdims=True) for i in images]
    return jnp.all(jnp.stack(masks), axis=0)


def first_finite(*images: Image) -> Image:
    """At each pixel the first image that is finite there, else 0.

    Args:
        images: candidates in the order of preference, shape [H,W,C] each.

    Returns:
        the image, finite everywhere, shape [H,W,C].

    Example:
        >>> y, x = jnp.array([[[1.0], [jnp.nan]]]), jnp.array([[[2.0], [2.0]]])
        >>> print(first_finite(y, x)[0, :, 0])
        [1. 2.]
    """
    result = jnp.zeros_like(images[0])
    for image in reversed(images):
        result = jnp.where(finite(image), image, result)
    return result


def divide(
    numerator: Float[Array, "*n"],
    denominator: Float[Array, "*n"],
    *,
    where: Bool[Array, "*n"],
    otherwise: Float[Array, "*n"] | float = 0.0,
) -> Float[Array, "*n"]:
    """A quotient whose value and derivatives are finite wherever the true ones are.

    The denominator is made safe before the division, and the derivative is written as
    -(n/d)/d, because -n/d^2 leaves the range of float32 below d = 1e-19.

    Args:
        numerator: n, any shape and unit.
        denominator: d, same shape; not zero where it is used.
        where: the elements to divide.
        otherwise: the value of all others; no derivative passes to n or d there.

    Returns:
        n/d or `otherwise`, same shape.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> n, d = jnp.array([1.0, 1.0]), jnp.array([4.0, 0.0])
        >>> print(divide(n, d, where=d > 0))
        [0.25 0.  ]
    """
    safe = jnp.where(where, denominator, jnp.ones_like(denominator))
    return jnp.where(where, _quotient(numerator, safe), otherwise)


@jax.custom_jvp
def _quotient(numerator: Array, denominator: Array) -> Array:
    """n/d with derivatives of every order that never square d."""
    return numerator / denominator


@_quotient.defjvp
def _quotient_jvp(
    primals: tuple[Array, Array], tangents: tuple[Array, Array]
) -> tuple[Array, Array]:
    """d(n/d) = (dn - (n/d) dd) / d."""
    (n, d), (dn, dd) = primals, tangents
    quotient = _quotient(n, d)
    return quotient, _quotient(dn - quotient * dd, d)
