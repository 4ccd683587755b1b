"""The radiance that is typical of an image, as a unit of it."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jscomb.numerics.medians import median
from jscomb.typing import Image, Mask, Scalar


def exposure(image: Image) -> Scalar:
    """Median of the positive luminances.

    Robust against fireflies and black backgrounds.

    Args:
        image: linear radiance, shape [H,W,C]; may hold pixels that are not finite.

    Returns:
        the radiance; 1 for an image that is all black.

    Example:
        >>> import jax.numpy as jnp
        >>> print(exposure(jnp.array([0.0, 2.0, 3.0, 1e6]).reshape(2, 2, 1)))
        3.0
    """
    luminance = jnp.mean(image, axis=-1)
    lit = jnp.isfinite(luminance) & (luminance > 0)
    return jnp.where(jnp.any(lit), median(luminance, lit), 1.0)


def in_units(
    unit: Scalar | None, valid: Mask, *images: Image, **squares: Float[Array, "h w _"]
) -> tuple[Array, ...]:
    """Images in units of the first one's exposure, for what has absolute constants.

    Args:
        unit: radiance to divide by; None for the exposure of the first image.
        valid: pixels that take part, shape [H,W,1]; the others become 0.
        images: linear radiance, shape [H,W,C].
        squares: squared radiance, shape [H,W,*].

    Returns:
        the unit, the images and then the squares, in it.

    Example:
        >>> at = lambda value: jnp.full((1, 1, 1), value)
        >>> valid = jnp.ones((1, 1, 1), bool)
        >>> found = in_units(None, valid, at(4.0), at(8.0), variance=at(16.0))
        >>> print([i.item() for i in found])
        [4.0, 1.0, 2.0, 1.0]
    """
    if unit is None:
        unit = exposure(jnp.where(valid, images[0], 0.0))
    scaled = [jnp.where(valid, image, 0.0) / unit for image in images]
    # Twice by the unit: its square may leave the range of float32.
    of_squares = [jnp.where(valid, s, 0.0) / unit / unit for s in squares.values()]
    return unit, *scaled, *of_squares
