"""The papers' networks, as immutable callables of one normalised image.

Layout: images [H,W,C], normalised; `vmap` for a batch. Parameters are float32, from a
typed key. Size "full" is the paper's, "light" has half the channels and a quarter of
the work. `window` is the width in pixels, odd, of the kernels that a network predicts.
What a network was trained for (a rule, a form) is an attribute of it, which its
combiner obeys.

Every network has a `reach`, the distance in rows or columns of the farthest input pixel
that an output pixel depends on; crops have to start at multiples of its `multiple`.

Unlike the papers, radiance enters as log(1 + |.|) with its sign and variance as
log(1 + ./0.01): beside a firefly of 1e6 a network sees nothing else.

Sources: those of the combiners; M. Kettunen, E. Harkonen, J. Lehtinen, "Deep
convolutional reconstruction for gradient-domain rendering", 2019 (signed logarithm).
"""

import itertools
from typing import Literal

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float

from jscomb.double_shrinkage import Filters
from jscomb.james_stein import Parameters, Rule
from jscomb.learning.losses import compress
from jscomb.numerics.convolution import doubled
from jscomb.numerics.kernels import Kernels
from jscomb.numerics.layers import (
    Convolution,
    apply_each,
    halved,
    reach_of,
    unet_reach,
)
from jscomb.numerics.windows import check_window
from jscomb.typing import Image, Key, Variance

__all__ = [
    "Convolution",
    "JamesSteinNetwork",
    "Joint",
    "KernelPredictor",
    "MixingNetwork",
    "ShrinkageNetwork",
    "Size",
    "UNet",
]

Size = Literal["light", "full"]
Form = Literal["quotient", "direct"]
Serves = Literal["denoised", "independent", "any"]

_WIDTHS = {"full": (32, 64, 128), "light": (16, 32, 64)}  # of a U-Net's levels
_MIXING_WIDTH = {"full": 48, "light": 24}
_MINIMUM_WEIGHT = 1e-4  # NJS adds it to its weights
_MAXIMUM_EXPONENT = 30.0  # of a confidence; beyond it the prior has no weight
_VARIANCE_UNIT = 0.01  # squared normalised radiance
_PAPER = Rule()


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
        widths = _WIDTHS[size]
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


class _Headed(nnx.Module):
    """A U-Net with convolutions side by side on its features."""

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


class JamesSteinNetwork(_Headed):
    """Which variance each window has, and which half's regression to trust.

    Attributes:
        body: U-Net.
        kernels: convolution to the weights of the variances.
        share: convolution to alpha.
        window: width of the kernels in pixels.
        rule: that its variances are for.

    Example:
        >>> network = JamesSteinNetwork(jax.random.key(0), size="light")
        >>> share = lambda x: network(x, x, x, x).share
        >>> print(jax.eval_shape(share, jnp.ones((6, 4, 3))).shape)
        (6, 4, 1)

    Source: NJS section 4.4.
    """

    def __init__(
        self, key: Key, *, window: int = 15, size: Size = "full", rule: Rule = _PAPER
    ):
        """Draw all convolutions."""
        body, kernels, share = jax.random.split(key, 3)
        width = _WIDTHS[size][0]
        self.window, self.rule = window, rule
        self.body = UNet(body, 12, size=size)
        self.kernels = Convolution(kernels, width, check_window(window) ** 2)
        self.share = Convolution(share, width, 1)

    def __call__(
        self, unbiased: Image, variance: Variance, biased_a: Image, biased_b: Image
    ) -> Parameters:
        """Return w² kernel weights a pixel and alpha for `james_stein.neural_combine`.

        Takes its x, v, y^_a and y^_b, normalised and finite.
        """
        v = _compress_variance(variance)
        radiance = [compress(i) for i in (unbiased, biased_a, biased_b)]
        features = self.body(jnp.concatenate([*radiance, v], axis=-1))
        head = lambda f: jax.nn.relu(self.kernels(f, inner=True)) + _MINIMUM_WEIGHT
        alpha = jax.nn.sigmoid(self.share(features))
        kernels = Kernels(features, head, self.kernels.reach, self.window)
        return Parameters(kernels, alpha)


class ShrinkageNetwork(_Headed):
    """How to pool the errors of two integrators, and how far to trust the prior.

    Attributes:
        body: U-Net.
        kernels: projection to two kernels.
        confidence: projection to the logarithm of eta².
        window: width of the kernels in pixels.
        serves: biased images that it was trained on: denoised, independent (of another
            integrator), or any.

    Example:
        >>> network = ShrinkageNetwork(jax.random.key(0), size="light")
        >>> confidence = lambda x, v: network(x, x, x, v, v).confidence
        >>> x, v = jnp.ones((6, 4, 3)), jnp.ones((6, 4, 1))
        >>> print(jax.eval_shape(confidence, x, v).shape)
        (6, 4, 1)

    Source: DSC section 4.3.
    """

    def __init__(
        self, key: Key, *, window: int = 13, size: Size = "full", serves: Serves = "any"
    ):
        """Draw all convolutions."""
        body, kernels, confidence = jax.random.split(key, 3)
        width = _WIDTHS[size][0]
        self.body = UNet(body, 11, size=size)
        self.window, self.serves = window, serves
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
        """Return two kernels a pixel and eta² for `double_shrinkage.neural_combine`.

        Takes its p, u, b, v and m, normalised and finite.
        """
        radiance = [compress(i) for i in (prior, unbiased, biased)]
        errors = [_compress_variance(e) for e in (variance, mse)]
        features = self.body(jnp.concatenate([*radiance, *errors], axis=-1))
        exponent = jnp.clip(
            self.confidence(features), -_MAXIMUM_EXPONENT, _MAXIMUM_EXPONENT
        )
        head = lambda f: _softmax(self.kernels(f), parts=2)
        kernels = Kernels(features, head, self.kernels.reach, self.window)
        return Filters(kernels, jnp.exp(exponent))


class MixingNetwork(nnx.Module):
    """How much of the denoised image to take.

    Attributes:
        first: convolution of 5x5.
        blocks: two residual blocks of two convolutions.
        last: convolution to three numbers a channel.
        form: of alpha, one of `progressive.FORMS`.

    Example:
        >>> network = MixingNetwork(jax.random.key(0), size="light")
        >>> x = jnp.ones((6, 4, 3))
        >>> print(jax.eval_shape(network, x, x, x, x).shape, network.reach)
        (6, 4, 3, 3) 7

    Source: PD section 4.3, figure 6.
    """

    multiple = 1

    def __init__(self, key: Key, *, size: Size = "full", form: Form = "quotient"):
        """Draw all convolutions."""
        keys = iter(jax.random.split(key, 6))
        width = _MIXING_WIDTH[size]
        self.first = Convolution(next(keys), 18, width, size=5)
        pair = lambda: [Convolution(next(keys), width, width) for _ in range(2)]
        self.blocks = nnx.List([nnx.List(pair()) for _ in range(2)])
        self.last = Convolution(next(keys), width, 9)
        self.form = form
        if form == "quotient":  # begins with a denominator of one
            self.last.bias = nnx.Param(self.last.bias[...].at[6:].set(1.0))

    @property
    def reach(self) -> int:
        """Distance of the farthest pixel that an output pixel depends on."""
        return reach_of([self.first, *itertools.chain(*self.blocks), self.last])

    def __call__(
        self, unbiased: Image, biased: Image, variance: Variance, sure: Image
    ) -> Float[Array, "h w 3 3"]:
        """Return xi_1, xi_2 and xi_3 of each channel for `progressive.activation`.

        Takes x, y, v and s of `progressive.combine`, normalised and finite; PD eq. 19.
        """
        square = jnp.square(unbiased - biased)
        errors = [variance, sure, square, sure + variance - square]
        bounded = [jnp.arctan(e) for e in errors]
        image = [compress(unbiased), compress(biased), *bounded]
        features = jax.nn.relu(self.first(jnp.concatenate(image, axis=-1)))
        for block in self.blocks:
            features = features + apply_each(block, features)
        outputs = self.last(features)
        return outputs.reshape(*outputs.shape[:2], 3, 3)


class KernelPredictor(_Headed):
    """A small kernel-predicting denoiser: an image to learn jointly with a combiner.

    Attributes:
        body: U-Net.
        kernels: convolution to one softmax kernel a pixel.
        window: width of the kernels in pixels.

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
        self.window = window
        weights = check_window(window) ** 2
        self.kernels = Convolution(kernels, _WIDTHS[size][0], weights)

    def __call__(
        self, unbiased: Image, variance: Variance, features: Float[Array, "h w f"]
    ) -> Kernels:
        """Return w² weights a pixel, of sum one, for `kernel_predicting.denoise`.

        Takes its x, v and features, normalised and finite.
        """
        inputs = [compress(unbiased), _compress_variance(variance), features]
        body = self.body(jnp.concatenate(inputs, axis=-1))
        head = lambda f: _softmax(self.kernels(f, inner=True), parts=1)
        return Kernels(body, head, self.kernels.reach, self.window)


class Joint(nnx.Module):
    """A denoiser and the James-Stein combiner of its image, to be trained as one.

    Attributes:
        denoiser: kernel predictor.
        combiner: James-Stein network, by the paper's rule.

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


def _compress_variance(variance: Array) -> Array:
    """Return the logarithm of a variance, steep where typical variances are."""
    return jnp.log1p(variance / _VARIANCE_UNIT)


def _softmax(logits: Array, *, parts: int) -> Array:
    """Return the softmax of each part of the channels."""
    split = jnp.split(logits, parts, axis=-1)
    return jnp.concatenate([jax.nn.softmax(part) for part in split], axis=-1)
