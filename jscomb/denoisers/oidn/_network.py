"""The network of Open Image Denoise, and the curves around it.

The forward curve compresses what the network sees, the inverse one expands what it
makes. Both are exact also in their derivatives.
"""

import functools
import math
from collections.abc import Callable, Mapping
from typing import Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Array, ArrayLike, Float

from jscomb.numerics.convolution import convolve, convolve_doubled
from jscomb.numerics.layers import Convolution, apply_each, halved, unet_reach
from jscomb.typing import Key

Size = Literal["small", "base", "large"]

_DOWN = {
    "small": ((32, 32), (32,), (32,), (32,), (32, 32)),
    "base": ((32, 32), (48,), (64,), (80,), (96, 96)),
    "large": ((64, 64), (96, 96), (128, 128), (192, 192), (256, 256)),
}
_UP = {
    "small": ((64, 64), (64, 64), (64, 32), (32, 32)),
    "base": ((112, 112), (96, 96), (64, 64), (64, 32)),
    "large": ((192, 192), (128, 128), (96, 96), (64, 64)),
}


class Network(nnx.Module):
    """U-Net of five levels whose skips carry the inputs of each level.

    Attributes:
        down: convolutions of each level on the way down, finest first.
        up: pairs of convolutions of each level on the way up, coarsest first.
        last: convolution to the image.

    Example:
        >>> network = Network(jax.random.key(0), 9, size="small")
        >>> print(sum(array.size for array in jax.tree.leaves(network)))
        320035
        >>> print(network.reach, jax.eval_shape(network, jnp.ones((16, 32, 9))).shape)
        94 (16, 32, 3)
    """

    def __init__(self, key: Key, inputs: int, *, size: Size = "base"):
        """Draw all convolutions."""
        keys = iter(jax.random.split(key, 32))

        def level(before: int, widths: tuple[int, ...]):
            pairs = zip((before, *widths), widths, strict=False)
            return nnx.List([Convolution(next(keys), *pair) for pair in pairs])

        skips = (inputs, *(widths[-1] for widths in _DOWN[size]))
        levels = zip(skips, _DOWN[size], strict=False)
        self.down = nnx.List([level(*each) for each in levels])
        self.up = nnx.List([])
        width = skips[-1]
        for skip, widths in zip(skips[-3::-1], _UP[size], strict=True):
            self.up.append(level(width + skip, widths))
            width = widths[-1]
        self.last = Convolution(next(keys), width, 3)

    @property
    def convolutions(self) -> list[Convolution]:
        """All, in the order in which they are applied."""
        return [c for level in (*self.down, *self.up) for c in level] + [self.last]

    @property
    def multiple(self) -> int:
        """Width of the blocks of pixels that are pooled to one."""
        return 2 ** len(self.up)

    @property
    def reach(self) -> int:
        """Distance of the farthest pixel that some pixel of a block depends on."""
        return unet_reach(self.down, self.up) + self.last.reach

    def __call__(self, image: Float[Array, "h w _"]) -> Float[Array, "h w 3"]:
        """Return the image; pads inputs that are not whole blocks with zeros."""
        height, width, _ = image.shape
        block = self.multiple
        image = jnp.pad(image, ((0, -height % block), (0, -width % block), (0, 0)))
        skips = []
        for number, level in enumerate(self.down):
            image = halved(image) if number else image
            skips.append(image)
            image = apply_each(level, image)
        skips.pop()
        for first, second in self.up:
            image = jax.nn.relu(_joined(first, image, skips.pop()))
            image = apply_each([second], image)
        return self.last(image)[:height, :width]


class Trained(NamedTuple):
    """A network with its weights, and what it takes.

    Attributes:
        network: the network.
        inputs: channels of its input.
        size: how large it is.
    """

    network: Network
    inputs: int
    size: Size


def from_arrays(arrays: Mapping[str, np.ndarray]) -> Trained | None:
    """Return the network of arrays by name; None if it has another architecture.

    Args:
        arrays: kernels [out,in,3,3], named `*.weight`, and biases [out], `*.bias`, each
            in the order in which they are applied.

    Returns:
        the network.
    """
    kernels = [a for name, a in arrays.items() if name.endswith(".weight")]
    biases = [a for name, a in arrays.items() if name.endswith(".bias")]
    if len(kernels) != len(biases) or any(k.ndim != 4 for k in kernels):
        return None
    parameters = [k.transpose(2, 3, 1, 0) for k in kernels], biases
    wanted = [(k.shape, b.shape) for k, b in zip(*parameters, strict=True)]
    for size in get_args(Size):
        widths = [w for level in _DOWN[size] + _UP[size] for w in level]
        if [len(bias) for bias in biases] != [*widths, 3]:
            continue
        inputs = kernels[0].shape[1]
        make = functools.partial(Network, inputs=inputs, size=size)
        network = jax.eval_shape(make, jax.random.key(0))
        blank = network.convolutions
        if [(c.kernel.shape, c.bias.shape) for c in blank] != wanted:
            continue
        for convolution, kernel, bias in zip(blank, *parameters, strict=True):
            convolution.kernel, convolution.bias = nnx.Param(kernel), nnx.Param(bias)
        return Trained(network, inputs, size)
    return None


def _joined(convolution: Convolution, coarse: Array, skip: Array) -> Array:
    """Convolve a coarse image, doubled, beside a fine one."""
    parameters = convolution.kernel, convolution.bias
    kernel, bias = (p[...].astype(skip.dtype) for p in parameters)
    above, beside = jnp.split(kernel, [coarse.shape[-1]], axis=2)
    both = convolve_doubled(coarse, above) + convolve(skip, beside, rows=1)
    return both + bias.reshape(1, 1, -1)


class Curve(NamedTuple):
    """A transfer function of radiance or reflectance.

    Attributes:
        forward: increasing, of numbers at least zero.
        inverse: of it.
    """

    forward: Callable[[Array], Array]
    inverse: Callable[[Array], Array]


_MAXIMUM = 65504.0  # the largest half float, which the curves of radiance map to one


def _scaled(curve: Curve, top: float) -> Curve:
    """The curve divided by a number."""
    return Curve(lambda y: curve.forward(y) / top, lambda x: curve.inverse(x * top))


def _pieces(at: ArrayLike, ends: tuple[float, ...], pieces: list[Callable]) -> Array:
    """Return a function given by pieces, each evaluated only where it holds.

    A piece elsewhere gets its nearest end: its slope there is finite, and not used.
    """
    at = jnp.asarray(at)
    bounds = [None, *ends, None]
    values = [
        piece(jnp.clip(at, low, high))
        for piece, low, high in zip(pieces, bounds, bounds[1:], strict=False)
    ]
    chosen = values[0]
    for end, value in zip(ends, values[1:], strict=True):
        chosen = jnp.where(at > end, value, chosen)
    return chosen


# Perceptually uniform: a fit of PU2 (Aydin et al. 2008), linear, then a power, then a
# logarithm.
_A, _B, _C, _D = 1.41283765e03, 1.64593172, 4.31384981e-01, -2.94139609e-03
_E, _F, _G = 1.92653254e-01, 6.26026094e-03, 9.98620152e-01
_PU = Curve(
    functools.partial(
        _pieces,
        ends=(1.57945760e-06, 3.22087631e-02),
        pieces=[
            lambda y: _A * y,
            lambda y: _B * y**_C + _D,
            lambda y: _E * jnp.log(y + _F) + _G,
        ],
    ),
    functools.partial(
        _pieces,
        ends=(2.23151711e-03, 3.70974749e-01),
        pieces=[
            lambda x: x / _A,
            lambda x: ((x - _D) / _B) ** (1 / _C),
            lambda x: jnp.exp((x - _G) / _E) - _F,
        ],
    ),
)
_SRGB = Curve(
    functools.partial(
        _pieces,
        ends=(0.0031308,),
        pieces=[lambda y: 12.92 * y, lambda y: 1.055 * y ** (1 / 2.4) - 0.055],
    ),
    functools.partial(
        _pieces,
        ends=(0.04045,),
        pieces=[lambda x: x / 12.92, lambda x: ((x + 0.055) / 1.055) ** 2.4],
    ),
)
CURVES: Mapping[str, Curve] = {
    "pu": _scaled(_PU, _E * math.log(_MAXIMUM + _F) + _G),
    "log": _scaled(Curve(jnp.log1p, jnp.expm1), math.log1p(_MAXIMUM)),
    "srgb": _SRGB,
    "linear": Curve(lambda y: y, lambda x: x),
}
