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
from jscomb.ensemble import Candidates
from jscomb.features import FEATURES
from jscomb.james_stein import Parameters, Rule
from jscomb.learning.losses import compress
from jscomb.learning.unet import WIDTHS, Headed, Size, UNet
from jscomb.numerics.guards import weighted_ratio
from jscomb.numerics.kernels import Kernels
from jscomb.numerics.layers import Convolution, apply_each, reach_of
from jscomb.numerics.windows import check_window
from jscomb.typing import Image, Key, Variance

__all__ = [
    "Convolution",
    "EnsembleNetwork",
    "JamesSteinNetwork",
    "Joint",
    "KernelPredictor",
    "MixingNetwork",
    "ShrinkageNetwork",
    "Size",
    "UNet",
]

Form = Literal["quotient", "direct"]
Serves = Literal["denoised", "independent", "any"]

_MIXING_WIDTH = {"full": 48, "light": 24}
_MINIMUM_WEIGHT = 1e-4  # NJS adds it to its weights
_MAXIMUM_EXPONENT = 30.0  # of eta²; beyond it the prior has no weight
_VARIANCE_UNIT = 0.01  # squared normalised radiance
_SQUARE_UNIT = 1e-4  # squared relative error
_PAPER = Rule()


class JamesSteinNetwork(Headed):
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
        width = WIDTHS[size][0]
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


class ShrinkageNetwork(Headed):
    """How to pool the errors of two integrators, and how far to trust the prior.

    Attributes:
        body: U-Net.
        kernels: projection to two kernels.
        prior_mse: projection to the logarithm of eta².
        window: width of the kernels in pixels.
        serves: biased images that it was trained on: denoised, independent (of another
            integrator), or any.

    Example:
        >>> network = ShrinkageNetwork(jax.random.key(0), size="light")
        >>> prior_mse = lambda x, v: network(x, x, x, v, v).prior_mse
        >>> x, v = jnp.ones((6, 4, 3)), jnp.ones((6, 4, 1))
        >>> print(jax.eval_shape(prior_mse, x, v).shape)
        (6, 4, 1)

    Source: DSC section 4.3.
    """

    def __init__(
        self, key: Key, *, window: int = 13, size: Size = "full", serves: Serves = "any"
    ):
        """Draw all convolutions."""
        body, kernels, prior_mse = jax.random.split(key, 3)
        width = WIDTHS[size][0]
        self.body = UNet(body, 11, size=size)
        self.window, self.serves = window, serves
        weights = 2 * check_window(window) ** 2
        self.kernels = Convolution(kernels, width, weights, size=1)
        self.prior_mse = Convolution(prior_mse, width, 1, size=1)

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
            self.prior_mse(features), -_MAXIMUM_EXPONENT, _MAXIMUM_EXPONENT
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


class EnsembleNetwork(Headed):
    """How much more or less of each base of an ensemble to take.

    One U-Net sees every base by itself; then each learns of the others by the mean of
    their features. So bases are alike: any number, in any order. Untrained it leaves
    the ensemble's weights as they are.

    Attributes:
        body: U-Net.
        exchange: projection of a base's features and the mean of all.
        logit: projection to one number a base.

    Example:
        >>> network = EnsembleNetwork(jax.random.key(0), size="light")
        >>> one = lambda *shape: jnp.ones((*shape[:-1], 6, 4, shape[-1]))
        >>> guide = [one(3), one(1), one(7), one(3), one(1)]
        >>> bases = [one(2, 3), one(2, 3), one(2, 1), one(2, 2), one(2, 1) > 0]
        >>> print(jax.eval_shape(network, Candidates(*guide, *bases)).shape)
        (2, 6, 4, 1)

    Source: ours; M. Zaheer et al., "Deep sets", 2017.
    """

    def __init__(self, key: Key, *, size: Size = "full"):
        """Draw all convolutions."""
        body, exchange, logit = jax.random.split(key, 3)
        width = WIDTHS[size][0]
        self.body = UNet(body, 16 + sum(FEATURES.values()), size=size)
        self.exchange = Convolution(exchange, 2 * width, width, size=1)
        self.logit = Convolution(logit, width, 1, size=1)
        self.logit.kernel = nnx.Param(jnp.zeros_like(self.logit.kernel[...]))

    def __call__(self, seen: Candidates) -> Float[Array, "n h w 1"]:
        """Return a logit of each base for `ensemble.neural_weights`."""
        relative = lambda square: _compress_square(square / seen.square)
        mean = lambda i: jnp.mean(jnp.square(i), axis=-1, keepdims=True)
        spread = jnp.sum(seen.weights * mean(seen.bases - seen.blend[None]), axis=0)
        common = [
            compress(seen.unbiased),
            relative(seen.variance),
            relative(spread),
            seen.features,
        ]

        def features(base: tuple[Array, ...]) -> Array:
            """Of one base by itself."""
            y, difference, weight, errors = base
            image = [
                compress(y),
                compress((y - seen.blend) / jnp.sqrt(seen.square)),
                relative(mean(y - seen.unbiased)),
                relative(mean(difference) / 4),
                weight,
                jnp.sign(errors) * _compress_square(jnp.abs(errors)),
            ]
            return self.body(jnp.concatenate([*common, *image], axis=-1))

        each = seen.bases, seen.differences, seen.weights, seen.errors
        own = jax.vmap(features)(each)
        present = seen.present.astype(own.dtype)
        others = weighted_ratio(
            jnp.sum(present * own, axis=0), jnp.sum(present, axis=0)
        )

        def logit(features: Array) -> Array:
            """Of one base among the others."""
            both = jnp.concatenate([features, others], axis=-1)
            return self.logit(jax.nn.relu(self.exchange(both)))

        return jax.vmap(logit)(own)


class KernelPredictor(Headed):
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
        self.kernels = Convolution(kernels, WIDTHS[size][0], weights)

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


def _compress_square(square: Array) -> Array:
    """Return the logarithm of a squared relative error, steep above one percent."""
    return jnp.log1p(square / _SQUARE_UNIT) / 4


def _softmax(logits: Array, *, parts: int) -> Array:
    """Return the softmax of each part of the channels."""
    split = jnp.split(logits, parts, axis=-1)
    return jnp.concatenate([jax.nn.softmax(part) for part in split], axis=-1)
