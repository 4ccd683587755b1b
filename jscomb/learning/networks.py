"""The papers' networks, as immutable callables of one image.

Layout: images [H,W,C]; `vmap` for a batch. Every input is at an exposure of about one:
the combiners divide by the frame's exposure before they call a network, so that what
comes out is the same for a scene that is ten times as bright.

Sizes: "full" is the paper's, "light" has half the channels and a quarter of the work.
Parameters are drawn from a typed key, in float32; `window` is the width in pixels, odd,
of the kernels that a network makes.

Away from the papers: radiance enters as log(1 + |.|) with its sign and variance as
log(1 + ./0.01), since beside a firefly of 1e6 a network sees nothing else.

Sources: see the combiners; M. Kettunen, E. Harkonen, J. Lehtinen, "Deep convolutional
reconstruction for gradient-domain rendering", 2019 (the signed logarithm).
"""

from collections.abc import Sequence
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Array, Float

from jscomb.double_shrinkage import Filters
from jscomb.james_stein.neural import Parameters
from jscomb.numerics.convolution import convolve
from jscomb.numerics.kernels import Kernels
from jscomb.numerics.windows import check_window
from jscomb.typing import Image, Key, Variance

Size = Literal["light", "full"]

_WIDTHS = {"full": (32, 64, 128), "light": (16, 32, 64)}  # of a U-Net's levels
_MIXING_WIDTH = {"full": 48, "light": 24}
_LEAST_WEIGHT = 1e-4  # NJS's, added to its weights
_LARGEST_EXPONENT = 30.0  # of a confidence: beyond it there is no prior
_VARIANCE_UNIT = 0.01  # squared radiance at an exposure of one


def compress(image: Array) -> Array:
    """The signed logarithm of radiance.

    Args:
        image: linear radiance at an exposure of one, any shape.

    Returns:
        sign(v) log(1 + |v|), same shape.

    Example:
        >>> print(compress(jnp.array([-1.0, 0.0, 1e6])).round(2))
        [-0.69  0.   13.82]

    Source: NJS eq. 14, for its loss.
    """
    return jnp.sign(image) * jnp.log1p(jnp.abs(image))


def _compress_variance(variance: Array) -> Array:
    """The logarithm of a squared radiance, steep where typical variances are."""
    return jnp.log1p(variance / _VARIANCE_UNIT)


class Convolution(nnx.Module):
    """A convolution of an image that has zeros around it.

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
        """Rows to every side that a pixel depends on."""
        return self.kernel.shape[0] // 2

    def __call__(
        self, image: Float[Array, "_ w i"], *, inner: bool = False
    ) -> Float[Array, "_ w o"]:
        """Convolve.

        Args:
            image: shape [H,W,in].
            inner: only those rows of the result that have all their neighbours.

        Returns:
            shape [H,W,out], or `2 reach` rows less.
        """
        kernel, bias = (p[...].astype(image.dtype) for p in (self.kernel, self.bias))
        rows = 0 if inner else self.reach
        return convolve(image, kernel, rows=rows) + bias.reshape(1, 1, -1)


class UNet(nnx.Module):
    """Two convolutions a level, three levels: halved by maxima, doubled by repetition.

    Attributes:
        down: convolutions of each level on the way down.
        up: likewise on the way up, coarsest first.

    Example:
        >>> body = UNet(jax.random.key(0), 3, size="light")
        >>> print(jax.eval_shape(body, jnp.ones((7, 5, 3))).shape)
        (7, 5, 16)
    """

    def __init__(self, key: Key, inputs: int, *, size: Size = "full"):
        """Draw all convolutions."""
        widths = _WIDTHS[size]
        keys = iter(jax.random.split(key, 4 * len(widths)))

        def pair(before: int, after: int):
            first = Convolution(next(keys), before, after)
            return nnx.List([first, Convolution(next(keys), after, after)])

        befores = (inputs, *widths[:-1])
        self.down = nnx.List([pair(*w) for w in zip(befores, widths, strict=True)])
        rising = list(zip(widths[:0:-1], widths[-2::-1], strict=True))
        self.up = nnx.List([pair(below + w, w) for below, w in rising])

    def __call__(self, image: Float[Array, "h w _"]) -> Float[Array, "h w _"]:
        """Features of every pixel.

        Args:
            image: of any size; one that the levels do not divide is padded with zeros
                and the result cut.

        Returns:
            at least zero, as many channels as the first level has.
        """
        height, width, _ = image.shape
        block = 2 ** len(self.up)
        image = jnp.pad(image, ((0, -height % block), (0, -width % block), (0, 0)))
        levels = []
        for convolutions in self.down:
            image = _halved(levels[-1]) if levels else image
            levels.append(_each(convolutions, image))
        image = levels.pop()
        for convolutions in self.up:
            finer = levels.pop()
            both = jnp.concatenate([_doubled(image), finer], axis=-1)
            image = _each(convolutions, both)
        return image[:height, :width]


def _each(convolutions: Sequence[Convolution], image: Array) -> Array:
    """Convolutions one after another, each with a ReLU."""
    for convolution in convolutions:
        image = jax.nn.relu(convolution(image))
    return image


def _halved(image: Array) -> Array:
    """The largest of each block of 2x2 pixels."""
    h, w, c = image.shape
    return jnp.max(image.reshape(h // 2, 2, w // 2, 2, c), axis=(1, 3))


def _doubled(image: Array) -> Array:
    """Each pixel as a block of 2x2."""
    h, w, c = image.shape
    blocks = jnp.broadcast_to(image[:, None, :, None], (h, 2, w, 2, c))
    return blocks.reshape(2 * h, 2 * w, c)


class JamesSteinNetwork(nnx.Module):
    """Which variance each window has, and which half's regression to trust.

    Attributes:
        body: U-Net.
        kernels: convolution to the weights of the variances.
        share: convolution to alpha.

    Example:
        >>> network = JamesSteinNetwork(jax.random.key(0), size="light")
        >>> share = lambda x: network(x, x, x, x).share
        >>> print(jax.eval_shape(share, jnp.ones((6, 4, 3))).shape)
        (6, 4, 1)

    Source: NJS section 4.4.
    """

    def __init__(self, key: Key, *, window: int = 15, size: Size = "full"):
        """Draw all convolutions."""
        body, kernels, share = jax.random.split(key, 3)
        width = _WIDTHS[size][0]
        self.body = UNet(body, 12, size=size)
        self.kernels = Convolution(kernels, width, check_window(window) ** 2)
        self.share = Convolution(share, width, 1)

    def __call__(
        self, unbiased: Image, variance: Variance, biased_a: Image, biased_b: Image
    ) -> Parameters:
        """Parameters of `james_stein.neural_combine`.

        Args:
            unbiased: x at an exposure of one, finite, shape [H,W,3].
            variance: v, likewise.
            biased_a: y^_a, likewise.
            biased_b: y^_b, likewise.

        Returns:
            w² kernel weights a pixel and alpha.
        """
        v = _compress_variance(variance)
        radiance = [compress(i) for i in (unbiased, biased_a, biased_b)]
        features = self.body(jnp.concatenate([*radiance, v], axis=-1))
        head = lambda f: jax.nn.relu(self.kernels(f, inner=True)) + _LEAST_WEIGHT
        alpha = jax.nn.sigmoid(self.share(features))
        return Parameters(Kernels(features, head, self.kernels.reach), alpha)


class ShrinkageNetwork(nnx.Module):
    """How to pool the errors of two integrators, and how far to trust the prior.

    Attributes:
        body: U-Net.
        kernels: projection to two kernels.
        confidence: projection to the logarithm of eta^2.

    Example:
        >>> network = ShrinkageNetwork(jax.random.key(0), size="light")
        >>> confidence = lambda x, v: network(x, x, x, v, v).confidence
        >>> x, v = jnp.ones((6, 4, 3)), jnp.ones((6, 4, 1))
        >>> print(jax.eval_shape(confidence, x, v).shape)
        (6, 4, 1)

    Source: DSC section 4.3.
    """

    def __init__(self, key: Key, *, window: int = 13, size: Size = "full"):
        """Draw all convolutions."""
        body, kernels, confidence = jax.random.split(key, 3)
        width = _WIDTHS[size][0]
        self.body = UNet(body, 11, size=size)
        weights = 2 * check_window(window) ** 2
        self.kernels = Convolution(kernels, width, weights, size=1)
        self.confidence = Convolution(confidence, width, 1, size=1)

    def __call__(
        self,
        prior: Image,
        unbiased: Image,
        biased: Image,
        variance: Float[Array, "h w 1"],
        mse: Float[Array, "h w 1"],
    ) -> Filters:
        """Parameters of `double_shrinkage.neural_combine`.

        Args:
            prior: p at an exposure of one, finite, shape [H,W,3].
            unbiased: u, likewise.
            biased: b, likewise.
            variance: v, mean over channels, shape [H,W,1].
            mse: m, likewise.

        Returns:
            two softmax kernels a pixel and eta^2.
        """
        radiance = [compress(i) for i in (prior, unbiased, biased)]
        errors = [_compress_variance(e) for e in (variance, mse)]
        features = self.body(jnp.concatenate([*radiance, *errors], axis=-1))
        exponent = jnp.clip(
            self.confidence(features), -_LARGEST_EXPONENT, _LARGEST_EXPONENT
        )
        head = lambda f: _softmax(self.kernels(f), parts=2)
        return Filters(Kernels(features, head, self.kernels.reach), jnp.exp(exponent))


def _softmax(logits: Array, *, parts: int) -> Array:
    """Softmax of each part of the channels."""
    split = jnp.split(logits, parts, axis=-1)
    return jnp.concatenate([jax.nn.softmax(part) for part in split], axis=-1)


class MixingNetwork(nnx.Module):
    """How much of the denoised image to take.

    Attributes:
        first: convolution of 5x5.
        blocks: two residual blocks of two convolutions.
        last: convolution to three numbers a channel.

    Example:
        >>> network = MixingNetwork(jax.random.key(0), size="light")
        >>> x = jnp.ones((6, 4, 3))
        >>> print(jax.eval_shape(network, x, x, x, x).shape)
        (6, 4, 3, 3)

    Source: PD section 4.3, figure 6.
    """

    def __init__(self, key: Key, *, size: Size = "full"):
        """Draw all convolutions."""
        keys = iter(jax.random.split(key, 6))
        width = _MIXING_WIDTH[size]
        self.first = Convolution(next(keys), 18, width, size=5)
        pair = lambda: [Convolution(next(keys), width, width) for _ in range(2)]
        self.blocks = nnx.List([nnx.List(pair()) for _ in range(2)])
        self.last = Convolution(next(keys), width, 9)

    def __call__(
        self, unbiased: Image, biased: Image, variance: Variance, sure: Image
    ) -> Float[Array, "h w 3 3"]:
        """Outputs for `progressive.activation`.

        Args:
            unbiased: x at an exposure of one, finite, shape [H,W,3].
            biased: y, likewise.
            variance: v, likewise.
            sure: s, likewise, of either sign.

        Returns:
            xi_1, xi_2, xi_3 of each channel, shape [H,W,3,3].

        Source: PD eq. 19.
        """
        square = jnp.square(unbiased - biased)
        errors = [variance, sure, square, sure + variance - square]
        bounded = [jnp.arctan(e) for e in errors]
        image = [compress(unbiased), compress(biased), *bounded]
        features = jax.nn.relu(self.first(jnp.concatenate(image, axis=-1)))
        for block in self.blocks:
            features = features + _each(block, features)
        outputs = self.last(features)
        return outputs.reshape(*outputs.shape[:2], 3, 3)


class KernelPredictor(nnx.Module):
    """A small kernel-predicting denoiser: a biased image to learn jointly.

    Attributes:
        body: U-Net.
        kernels: convolution to one softmax kernel a pixel.

    Example:
        >>> network = KernelPredictor(jax.random.key(0), window=5, size="light")
        >>> def weights(x, features):
        ...     kernels = network(x, x, features)
        ...     return kernels.head(kernels.features)  # of a strip without its ends
        >>> strip = jnp.ones((6, 4, 3)), jnp.ones((6, 4, 7))
        >>> print(jax.eval_shape(weights, *strip).shape)
        (4, 4, 25)

    Source: S. Bako et al., "Kernel-predicting convolutional networks for denoising
    Monte Carlo renderings", 2017, with a U-Net in place of its nine convolutions.
    """

    def __init__(
        self, key: Key, *, features: int = 7, window: int = 11, size: Size = "full"
    ):
        """Draw all convolutions."""
        body, kernels = jax.random.split(key)
        self.body = UNet(body, 6 + features, size=size)
        weights = check_window(window) ** 2
        self.kernels = Convolution(kernels, _WIDTHS[size][0], weights)

    def __call__(
        self, unbiased: Image, variance: Variance, features: Float[Array, "h w f"]
    ) -> Kernels:
        """Kernels of `denoisers.kernel_predicting.denoise`.

        Args:
            unbiased: x at an exposure of one, finite, shape [H,W,3].
            variance: v, likewise.
            features: of a range of about one, shape [H,W,F].

        Returns:
            w² weights a pixel of sum one.
        """
        inputs = [compress(unbiased), _compress_variance(variance), features]
        body = self.body(jnp.concatenate(inputs, axis=-1))
        head = lambda f: _softmax(self.kernels(f, inner=True), parts=1)
        return Kernels(body, head, self.kernels.reach)


class Joint(nnx.Module):
    """A denoiser and the James-Stein combiner of its image, to be trained as one.

    Attributes:
        denoiser: kernel predictor.
        combiner: James-Stein network.

    Example:
        >>> network = Joint(jax.random.key(0), size="light")
        >>> print(sum(array.size for array in jax.tree.leaves(network)), "parameters")
        289563 parameters

    Source: NJS figure 15.
    """

    def __init__(self, key: Key, *, size: Size = "full"):
        """Draw both."""
        first, second = jax.random.split(key)
        self.denoiser = KernelPredictor(first, size=size)
        self.combiner = JamesSteinNetwork(second, size=size)
