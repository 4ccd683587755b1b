"""Layers of networks: convolutions, and what a U-Net is made of.

Layout: images [H,W,C]; `vmap` for a batch. Of flax, which is slow to import: nothing
that the front door imports may import this.
"""

from collections.abc import Iterable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Array, Float

from jscomb.numerics.convolution import convolve
from jscomb.numerics.windows import check_window
from jscomb.typing import Key

__all__ = ["Convolution", "apply_each", "halved", "reach_of", "unet_reach"]


class Convolution(nnx.Module):
    """A convolution of an image with a border of zeros.

    Attributes:
        kernel: shape [k,k,in,out].
        bias: shape [out].

    Example:
        >>> convolution = Convolution(jax.random.key(0), 3, 5)
        >>> image = jax.eval_shape(convolution, jnp.ones((6, 4, 3)))
        >>> print(image.shape, convolution.reach)
        (6, 4, 5) 1
    """

    def __init__(self, key: Key, inputs: int, outputs: int, *, size: int = 3):
        """Draw a kernel by He's rule for ReLU."""
        deviation = np.float32((2 / (size**2 * inputs)) ** 0.5)
        shape = check_window(size), size, inputs, outputs
        self.kernel = nnx.Param(deviation * jax.random.normal(key, shape, jnp.float32))
        self.bias = nnx.Param(jnp.zeros(outputs, jnp.float32))

    @property
    def reach(self) -> int:
        """Distance of the farthest pixel that an output pixel depends on."""
        return self.kernel.shape[0] // 2

    def __call__(
        self, image: Float[Array, "_ w i"], *, inner: bool = False
    ) -> Float[Array, "_ w o"]:
        """Convolve; with `inner` only the rows that have all their neighbours."""
        kernel, bias = (p[...].astype(image.dtype) for p in (self.kernel, self.bias))
        rows = 0 if inner else self.reach
        return convolve(image, kernel, rows=rows) + bias.reshape(1, 1, -1)


def apply_each(convolutions: Iterable[Convolution], image: Array) -> Array:
    """Apply convolutions one after another, each with a ReLU.

    Args:
        convolutions: in order.
        image: shape [H,W,in of the first].

    Returns:
        shape [H,W,out of the last], at least zero.

    Example:
        >>> two = [Convolution(jax.random.key(0), 3, 3)] * 2
        >>> print(apply_each(two, jnp.zeros((1, 2, 3)))[0, 0])
        [0. 0. 0.]
    """
    for convolution in convolutions:
        image = jax.nn.relu(convolution(image))
    return image


def halved(image: Float[Array, "h w c"]) -> Float[Array, "_ _ c"]:
    """Return the maximum of each block of 2x2 pixels.

    By pairs: the derivative of a maximum over axes counts ties, which takes longer.

    Args:
        image: shape [H,W,C], height and width even.

    Returns:
        shape [H/2,W/2,C].

    Example:
        >>> print(halved(jnp.arange(8.0).reshape(2, 4, 1))[..., 0])
        [[5. 7.]]
    """
    rows = jnp.maximum(image[::2], image[1::2])
    return jnp.maximum(rows[:, ::2], rows[:, 1::2])


def reach_of(convolutions: Iterable[Convolution]) -> int:
    """Return the reach of convolutions one after another.

    Args:
        convolutions: any number.

    Returns:
        distance in pixels of the farthest pixel that an output pixel depends on.

    Example:
        >>> print(reach_of([Convolution(jax.random.key(0), 1, 1, size=5)] * 2))
        4
    """
    return sum(convolution.reach for convolution in convolutions)


def unet_reach(
    down: Sequence[Sequence[Convolution]], up: Sequence[Sequence[Convolution]]
) -> int:
    """Return the distance of the farthest pixel that a U-Net's output depends on.

    Args:
        down: convolutions of each level on the way down, finest first.
        up: convolutions of each level on the way up, coarsest first.

    Returns:
        the distance in rows or columns, of the pixel of a block that sees farthest.

    Example:
        >>> one = Convolution(jax.random.key(0), 1, 1)
        >>> print(unet_reach([[one]], []), unet_reach([[one], [one]], [[one]]))
        1 5
    """
    *finer, coarsest = [reach_of(level) for level in down]
    rising = [reach_of(level) for level in reversed(up)]

    def farthest(pixel: int) -> int:
        """Walk through the coarsest level, which sees all that the finer ones see."""
        first = last = pixel
        for reach in rising:
            first, last = (first - reach) // 2, (last + reach) // 2
        first, last = first - coarsest, last + coarsest
        for reach in reversed(finer):
            first, last = 2 * first - reach, 2 * last + 1 + reach
        return max(pixel - first, last - pixel)

    return max(map(farthest, range(2 ** len(up))))
