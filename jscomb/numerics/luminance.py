"""The median luminance of an image: the unit that radiance is normalised by."""

from collections.abc import Callable, Sequence

import jax.numpy as jnp
from jaxtyping import Array, Float

from jscomb.numerics.guards import divide
from jscomb.numerics.medians import median
from jscomb.typing import Image, Scalar

__all__ = ["at_unit_luminance", "in_unit", "median_luminance"]


def median_luminance(image: Image) -> Scalar:
    """Return the median of the positive luminances, the means over the channels.

    Robust against fireflies and black backgrounds.

    Args:
        image: linear radiance, shape [H,W,C]; may hold pixels that are not finite.

    Returns:
        the median, linear radiance; 1 for a black image.

    Example:
        >>> image = jnp.array([0.0, 2.0, 3.0, 1e6]).reshape(2, 2, 1)
        >>> print(median_luminance(image))
        3.0
    """
    luminance = jnp.mean(image, axis=-1)
    lit = jnp.isfinite(luminance) & (luminance > 0)
    return jnp.where(jnp.any(lit), median(luminance, lit), 1.0)


def at_unit_luminance(
    function: Callable[..., Image],
    *images: Image,
    squares: Sequence[Float[Array, "h w _"]],
) -> Image:
    """Apply a function to normalised images, and scale its result back.

    Makes a function with absolute constants, such as a network, scale-equivariant.

    Args:
        function: of the normalised images, then the normalised squares.
        images: linear radiance, shape [H,W,C]; the first sets the unit.
        squares: variances and errors, squared radiance, shape [H,W,*].

    Returns:
        the function's result times the median luminance of the first image.

    Example:
        >>> dim = jnp.full((1, 1, 1), 0.5)
        >>> clipped = lambda x, v: jnp.minimum(x, 1.0) + v
        >>> print(at_unit_luminance(clipped, dim, squares=[dim / 4]).item())
        0.75
    """
    unit = median_luminance(images[0])
    return unit * function(
        *(in_unit(i, unit) for i in images),
        *(in_unit(s, unit, power=2) for s in squares),
    )


def in_unit(
    image: Float[Array, "*n c"], unit: Scalar, *, power: int = 1
) -> Float[Array, "*n c"]:
    """Return an image in another unit of radiance.

    Args:
        image: radiance to a power, shape [...,C]; may hold anything.
        unit: radiance to measure in, positive.
        power: 1 for radiance, 2 for its variance, 0 for features.

    Returns:
        the image divided by the unit to that power; as it is where it is not finite,
        or the unit would have no derivative.

    Example:
        >>> print(in_unit(jnp.array([8.0, jnp.inf]), jnp.asarray(2.0), power=2))
        [ 2. inf]
    """
    known, units = jnp.isfinite(image), jnp.broadcast_to(unit, image.shape)
    for _ in range(power):  # not by the power, which may leave the range of float32
        image = divide(image, units, where=known, otherwise=image)
    return image
