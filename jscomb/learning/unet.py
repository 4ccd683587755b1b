"""A U-Net, and what has one with outputs of its own.

Layout: images [H,W,C]; `vmap` for a batch.
"""

from typing import Literal

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float

from jscomb.numerics.convolution import doubled
from jscomb.numerics.layers import Convolution, apply_each, halved, unet_reach
from jscomb.typing import Key

__all__ = ["WIDTHS", "Headed", "Size", "UNet"]

Size = Literal["light", "full"]

WIDTHS = {"full": (32, 64, 128), "light": (16, 32, 64)}
"""Channels of a U-Net's levels by its size."""


class UNet(nnx.Module):
    """Three levels of two convolutions, with max pooling down and repetition up.

    Attributes:
        down: convolutions of each level on the way down.
        up: convolutions of each level on the way up, coarsest first.

    Example:
        >>> body = UNet(jax.random.key(0), 3, size="light")
        >>> print(jax.eval_shape(body, jnp.ones((7, 5, 3))).shape)
        (7, 5, 16)
        >>> print(body.reach, body.multiple)
        23 4
    """

    def __init__(self, key: Key, inputs: int, *, size: Size = "full"):
        """Draw all convolutions."""
        widths = WIDTHS[size]
        keys = iter(jax.random.split(key, 4 * len(widths)))

        def pair(before: int, after: int):
            first = Convolution(next(keys), before, after)
            return nnx.List([first, Convolution(next(keys), after, after)])

        befores = (inputs, *widths[:-1])
        self.down = nnx.List([pair(*w) for w in zip(befores, widths, strict=True)])
        rising = list(zip(widths[:0:-1], widths[-2::-1], strict=True))
        self.up = nnx.List([pair(below + w, w) for below, w in rising])

    @property
    def multiple(self) -> int:
        """Width of the blocks of pixels that are pooled to one."""
        return 2 ** len(self.up)

    @property
    def reach(self) -> int:
        """Distance of the farthest pixel that some pixel of a block depends on."""
        return unet_reach(self.down, self.up)

    def __call__(self, image: Float[Array, "h w _"]) -> Float[Array, "h w _"]:
        """Return features of every pixel, at least zero, as wide as the first level.

        Pads images that are not whole blocks with zeros.
        """
        height, width, _ = image.shape
        block = self.multiple
        image = jnp.pad(image, ((0, -height % block), (0, -width % block), (0, 0)))
        levels = []
        for convolutions in self.down:
            image = halved(levels[-1]) if levels else image
            levels.append(apply_each(convolutions, image))
        image = levels.pop()
        for convolutions in self.up:
            finer = levels.pop()
            both = jnp.concatenate([doubled(image), finer], axis=-1)
            image = apply_each(convolutions, both)
        return image[:height, :width]


class Headed(nnx.Module):
    """A U-Net with convolutions side by side on its features.

    Attributes:
        body: U-Net.

    Example:
        >>> class Grey(Headed):
        ...     def __init__(self, key):
        ...         self.body = UNet(jax.random.clone(key), 3, size="light")
        ...         self.head = Convolution(jax.random.clone(key), 16, 1)
        >>> print(Grey(jax.random.key(0)).reach)
        24
    """

    body: UNet

    @property
    def multiple(self) -> int:
        """Width of the blocks of pixels that are pooled to one."""
        return self.body.multiple

    @property
    def reach(self) -> int:
        """Distance of the farthest pixel that the outputs of a pixel depend on."""
        heads = [h for h in vars(self).values() if isinstance(h, Convolution)]
        return self.body.reach + max(head.reach for head in heads)
