"""Guards against corrupt input: shapes, invalid pixels, divisions and square roots.

A pixel that is not finite in some input of a combiner is *invalid*, with all its
channels: every window excludes it, and the output there is the first finite of (biased,
unbiased), else 0. Layout: images [H,W,C].
"""

import functools
import operator
from collections.abc import Iterable

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float

from jscomb.typing import Image, Mask

__all__ = [
    "check_image",
    "check_not_negative",
    "check_same_shape",
    "check_static",
    "divide",
    "finite",
    "first_finite",
    "masked_mean",
    "repeat_channel",
    "safe_sqrt",
    "weighted_ratio",
    "zero_invalid",
]


def check_same_shape(**images: Float[Array, "..."]) -> None:
    """Raise unless all images have one shape [H,W,C].

    Args:
        images: arrays by the names that the user knows.

    Returns:
        nothing.

    Raises:
        ValueError: while tracing; names the array that differs and both shapes.

    Example:
        >>> check_same_shape(x=jnp.zeros((2, 2, 3)), y=jnp.zeros((2, 3, 3)))
        Traceback (most recent call last):
            ...
        ValueError: y has shape (2, 3, 3), x has (2, 2, 3)
    """
    (first, image), *_ = images.items()
    check_image(**{first: image})
    if image.size == 0:
        raise ValueError(
            f"{first} must have shape [H, W, C], at least one pixel; got {image.shape}"
        )
    for name, other in images.items():
        if other.shape != image.shape:
            repeat = f": jnp.broadcast_to({name}, {first}.shape) repeats its channel"
            one = other.shape == (*image.shape[:2], 1)
            what = f"{name} has shape {other.shape}, {first} has {image.shape}"
            raise ValueError(what + repeat * one)


def check_image(**images: Float[Array, "..."]) -> None:
    """Raise unless every array is one image [H,W,C]; a batch is told of `vmap`.

    Args:
        images: arrays by the names that the user knows.

    Returns:
        nothing.

    Raises:
        ValueError: while tracing; names the array and its shape.

    Example:
        >>> check_image(x=jnp.zeros((5, 2, 2, 3)))  # doctest: +ELLIPSIS
        Traceback (most recent call last):
            ...
        ValueError: x must have shape [H, W, C], got (5, 2, 2, 3): for a batch of ...
    """
    for name, image in images.items():
        if image.ndim != 3:
            batch = ": for a batch of images map the function by jax.vmap"
            what = f"{name} must have shape [H, W, C], got {image.shape}"
            raise ValueError(what + batch * (image.ndim == 4))


def repeat_channel(variance: Float[Array, "..."], image: Float[Array, "..."]) -> Array:
    """Return a variance with one channel for every channel of its image.

    Args:
        variance: [H,W,1], or of the image's shape.
        image: [H,W,C].

    Returns:
        the variance, [H,W,C]; unchanged if it is neither, for a check to say so.

    Example:
        >>> print(repeat_channel(jnp.ones((4, 5, 1)), jnp.ones((4, 5, 3))).shape)
        (4, 5, 3)
    """
    if image.ndim == 3 and variance.shape == (*image.shape[:2], 1):
        return jnp.broadcast_to(variance, image.shape)
    return variance


def check_static(**options: object) -> None:
    """Raise if an option that decides a program is traced, as by `vmap` over it.

    Args:
        options: by the names that the user knows.

    Returns:
        nothing.

    Raises:
        ValueError: names the option, and says which options are static.

    Example:
        >>> import jax
        >>> try:
        ...     jax.jit(lambda window: check_static(window=window))(3)
        ... except ValueError as error:
        ...     print(str(error)[:44])
        window is static: it must be a Python number
    """
    for name, option in options.items():
        if isinstance(option, Tracer):
            raise ValueError(
                f"{name} is static: it must be a Python number, not an array that vmap "
                "or jit traces. Static are the options that set shapes and loops "
                "(widths such as window and patch, stride, scales, probes) and those "
                "that choose (whiten, names); for several of them loop in Python. "
                "Images, scales of them, strengths and thresholds may be traced"
            )


def check_not_negative(**images: Float[Array, "..."]) -> None:
    """Raise if a value is negative; never while tracing, when values are unknown.

    Args:
        images: arrays by the names that the user knows.

    Returns:
        nothing.

    Raises:
        ValueError: names the array and its minimum.

    Example:
        >>> check_not_negative(variance=jnp.array([1.0, -0.5]))
        Traceback (most recent call last):
            ...
        ValueError: variance must be at least zero, its minimum is -0.5
    """
    for name, image in images.items():
        if isinstance(image, Tracer):
            continue
        minimum = np.nanmin(np.asarray(image), initial=0.0)  # jnp would be traced
        if minimum < 0:
            raise ValueError(f"{name} must be at least zero, its minimum is {minimum}")


def finite(*images: Float[Array, "h w _"]) -> Mask:
    """Return which pixels are finite in every channel of every image.

    Args:
        images: any number of images of one size; channels may differ.

    Returns:
        the mask, shape [H,W,1].

    Example:
        >>> print(finite(jnp.array([[[1.0, jnp.nan], [1.0, 2.0]]]))[..., 0])
        [[False  True]]
    """
    # Slices, unlike a reduction, are part of the loop that reads the mask.
    everywhere = jnp.ones((*images[0].shape[:-1], 1), bool)
    each = (
        jnp.isfinite(image[..., k : k + 1])
        for image in images
        for k in range(image.shape[-1])
    )
    return functools.reduce(operator.and_, each, everywhere)


def zero_invalid(*images: Float[Array, "..."]) -> tuple[Mask, *tuple[Array, ...]]:
    """Return which pixels are finite in every image, and the images with 0 elsewhere.

    Args:
        images: images [H,W,C] or stacks [N,H,W,C] of one size; channels may differ.

    Returns:
        the mask, shape [H,W,1], then the images.

    Example:
        >>> x, v = jnp.array([[[1.0], [2.0]]]), jnp.array([[[jnp.nan], [4.0]]])
        >>> valid, x, v = zero_invalid(x, v)
        >>> print(valid[0, :, 0], x[0, :, 0], v[0, :, 0])
        [False  True] [0. 2.] [0. 4.]
    """
    valid = finite(*(i for image in images for i in _images(image)))
    mask = lambda image: valid if image.ndim == 3 else valid[None]
    return valid, *(jnp.where(mask(image), image, 0.0) for image in images)


def _images(image: Array) -> Iterable[Array]:
    """Return the images of a stack, or the image alone."""
    return [image] if image.ndim == 3 else image


def first_finite(*images: Image) -> Image:
    """Return at each pixel the first image that is finite there, else 0.

    Args:
        images: in the order of preference, shape [H,W,C].

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
    """Return a quotient that is finite wherever the true one is; so its derivatives.

    The denominator is made safe before the division, and the derivative is written as
    -(n/d)/d, because -n/d^2 leaves the range of float32 below d = 1e-19.

    Args:
        numerator: n, any shape and unit.
        denominator: d, same shape; not zero where it is used.
        where: elements to divide, same shape.
        otherwise: value of all others; no derivative passes to n or d there.

    Returns:
        n/d or `otherwise`, same shape.

    Example:
        >>> n, d = jnp.array([1.0, 1.0]), jnp.array([4.0, 0.0])
        >>> print(divide(n, d, where=d > 0))
        [0.25 0.  ]
    """
    safe = jnp.where(where, denominator, jnp.ones_like(denominator))
    return jnp.where(where, _quotient(numerator, safe), otherwise)


@jax.custom_jvp
def _quotient(numerator: Array, denominator: Array) -> Array:
    """Return n/d; its derivatives of every order never square d."""
    return numerator / denominator


@_quotient.defjvp
def _quotient_jvp(
    primals: tuple[Array, Array], tangents: tuple[Array, Array]
) -> tuple[Array, Array]:
    """Return d(n/d) = (dn - (n/d) dd) / d."""
    (n, d), (dn, dd) = primals, tangents
    quotient = _quotient(n, d)
    return quotient, _quotient(dn - quotient * dd, d)


def weighted_ratio(
    total: Float[Array, "*n c"],
    weight: Float[Array, "*n _"],
    *,
    otherwise: Float[Array, "*n c"] | float = 0.0,
) -> Float[Array, "*n c"]:
    """Return total / weight where the weight is positive.

    Args:
        total: weighted sums, any unit, shape [...,C].
        weight: sums of the weights, at least zero, shape [...,C] or [...,1].
        otherwise: the value where the weight is 0.

    Returns:
        the weighted means, shape [...,C], with finite derivatives.

    Example:
        >>> total, weight = jnp.array([[6.0, 3.0]]), jnp.array([[2.0]])
        >>> print(weighted_ratio(total, weight), weighted_ratio(total, 0 * weight))
        [[3.  1.5]] [[0. 0.]]
    """
    weight = jnp.broadcast_to(weight, total.shape)
    return divide(total, weight, where=weight > 0, otherwise=otherwise)


def masked_mean(
    values: Float[Array, "h w c"],
    mask: Mask | None,
    *,
    per_channel: bool = False,
    otherwise: float = 0.0,
) -> Array:
    """Return the mean over the pixels that a mask selects.

    Args:
        values: any unit, shape [H,W,C]; may hold anything where the mask is False.
        mask: pixels to average, shape [H,W,1]; None for all.
        per_channel: keep channels apart.
        otherwise: the result if the mask selects no pixel.

    Returns:
        the mean over pixels and channels, shape []; or over pixels, shape [1,1,C].

    Example:
        >>> values = jnp.array([[[1.0], [3.0], [jnp.nan]]])
        >>> print(masked_mean(values, finite(values)))
        2.0
    """
    axes = (0, 1) if per_channel else None
    if mask is None:
        return jnp.mean(values, axis=axes, keepdims=per_channel)
    total = jnp.sum(jnp.where(mask, values, 0.0), axis=axes, keepdims=per_channel)
    pixels = jnp.sum(mask).astype(values.dtype)
    count = jnp.broadcast_to(pixels, total.shape)
    if not per_channel:
        count = count * values.shape[-1]
    return divide(total, count, where=count > 0, otherwise=otherwise)


def safe_sqrt(square: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Return the square root, with 0 and a derivative of 0 where it is not positive.

    Args:
        square: any shape and unit; NaN stays NaN.

    Returns:
        the root, same shape.

    Example:
        >>> print(safe_sqrt(jnp.array([4.0, 0.0])), jax.grad(safe_sqrt)(0.0))
        [2. 0.] 0.0
    """
    none = square <= 0
    return jnp.where(none, 0.0, jnp.sqrt(jnp.where(none, 1.0, square)))
