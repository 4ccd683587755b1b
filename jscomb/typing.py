"""The arrays that appear in public signatures: channels last, linear radiance."""

from jaxtyping import Array, Bool, Float
from jaxtyping import Key as _Key

__all__ = ["Image", "Key", "Mask", "Scalar", "Variance"]

Image = Float[Array, "h w c"]
"""Linear scene-referred radiance, or a feature."""

Variance = Float[Array, "h w c"]
"""Squared radiance, of the mean, never of one sample."""

Mask = Bool[Array, "h w 1"]
"""True at the pixels that count."""

Scalar = Float[Array, ""]
"""One number."""

Key = _Key[Array, ""]
"""Typed, from `jax.random.key`."""
