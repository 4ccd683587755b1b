"""James-Stein combination with a network's variances."""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from jscomb.james_stein._combine import combine, combine_dual
from jscomb.numerics.guards import check_same_shape, first_finite, zero_invalid
from jscomb.numerics.kernels import Kernels, predicted_mean
from jscomb.numerics.luminance import at_unit_luminance
from jscomb.typing import Image, Mask, Variance


class Rule(NamedTuple):
    """The rule that a network's variances are for.

    Attributes:
        window: width of the windows that are shrunk, in pixels, odd, at least three.
        whiten: allow each pixel its own variance within a window: the greater of its
            sample variance and what the network makes of its neighbourhood.
    """

    window: int = 15
    whiten: bool = False


class Parameters(NamedTuple):
    """What the network decides.

    Attributes:
        kernels: weights of the sample variances of each pixel's window, w² a pixel.
        share: alpha, of y^_a in y*, in [0, 1], shape [H,W,1].
    """

    kernels: Kernels
    share: Float[Array, "h w 1"]


Network = Callable[[Image, Variance, Image, Image], Parameters]


def rule_of(network: Network) -> Rule:
    """Return the rule that a network was trained for.

    Args:
        network: as for `neural_combine`.

    Returns:
        its attribute `rule`, or the paper's rule where it has none.

    Example:
        >>> print(rule_of(lambda *images: None))
        Rule(window=15, whiten=False)
    """
    return getattr(network, "rule", Rule())


def neural_combine(
    network: Network,
    unbiased: Image,
    biased_a: Image,
    biased_b: Image,
    variance: Variance,
    *,
    rule: Rule | None = None,
) -> Image:
    """Shrink towards the regressed image by the variance that a network estimates.

    Pure, scale-equivariant, and differentiable in every array and in the network's
    parameters. The network's w² weights a pixel exist for a strip of rows at a time.
    Radiance is divided by the median luminance of x before, and scaled back after.

    Args:
        network: of x, v, y^_a and y^_b, finite and normalised, such as
            `learning.networks.JamesSteinNetwork`.
        unbiased: x, linear radiance, shape [H,W,C].
        biased_a: y^_a of `cross_regression`, or the biased image, same shape.
        biased_b: y^_b, same shape.
        variance: sample variance of the mean x, squared radiance, at least zero,
            same shape.
        rule: to shrink by; None for the network's own, see `rule_of`.

    Returns:
        the combined rendering, linear radiance, shape [H,W,C]; at an invalid pixel the
        first finite of (y^_a, y^_b, x), else 0.

    Raises:
        ValueError: while tracing, if shapes differ.

    Example:
        >>> import jax
        >>> x, y = jnp.full((4, 4, 1), 3.0), jnp.ones((4, 4, 1))
        >>> head = lambda near: jnp.ones((*near.shape[:2], 15**2))
        >>> even = Kernels(x, head, 0, 15)
        >>> network = lambda *_: Parameters(even, 0.5 * y)
        >>> fast = jax.jit(neural_combine, static_argnames=("network", "rule"))
        >>> print(fast(network, x, y, y, y, rule=Rule(window=3))[0, 0].round(3))
        [2.674]

    Source: NJS eq. 6, 7, 12, 13; the whitened form is ours.
    """
    check_same_shape(
        unbiased=unbiased, biased_a=biased_a, biased_b=biased_b, variance=variance
    )
    names = "unbiased", "biased_a", "biased_b", "variance"
    normalised = lambda *images: combine_inputs(
        network, dict(zip(names, images, strict=True)), rule=rule
    )
    images = unbiased, biased_a, biased_b
    return at_unit_luminance(normalised, *images, squares=[variance])


def combine_inputs(
    network: Network,
    inputs: Mapping[str, Image],
    *,
    rule: Rule | None = None,
) -> Image:
    """Combine normalised images by name, for crops of a frame and for training.

    Local, and not scale-equivariant: `neural_combine` without its normalisation.

    Args:
        network: as for `neural_combine`.
        inputs: unbiased, biased_a, biased_b and variance, as `neural_inputs` makes.
        rule: to shrink by; None for the network's own.

    Returns:
        the combined rendering, normalised radiance, shape [H,W,C]; at an invalid pixel
        the first finite of (y^_a, y^_b, x), else 0.

    Raises:
        ValueError: while tracing, if shapes differ.

    Example:
        >>> x, y = jnp.full((4, 4, 1), 3.0), jnp.ones((4, 4, 1))
        >>> head = lambda near: jnp.ones((*near.shape[:2], 15**2))
        >>> even = Kernels(x, head, 0, 15)
        >>> network = lambda *_: Parameters(even, 0.5 * y)
        >>> inputs = {"unbiased": x, "biased_a": y, "biased_b": y, "variance": y}
        >>> print(combine_inputs(network, inputs, rule=Rule(7, True))[0, 0].round(3))
        [2.562]

    Source: NJS eq. 6, 7, 12, 13; the whitened form is ours.
    """
    check_same_shape(**inputs)
    window, whiten = rule or rule_of(network)
    decided = _decide(network, inputs, whiten=whiten)
    y = decided.share * decided.a + (1 - decided.share) * decided.b
    shrunk = combine(decided.x, y, decided.variance, window=window, whiten=whiten)
    return jnp.where(decided.valid, shrunk, decided.instead)


def neural_combine_dual(
    network: Network,
    unbiased_a: Image,
    unbiased_b: Image,
    biased_a: Image,
    biased_b: Image,
    variance: Variance,
    *,
    rule: Rule | None = None,
) -> Image:
    """Shrink each half towards the other half's biased image, by a network's variances.

    `combine_dual` with the variance that the network estimates, blended by its alpha.
    Pure, scale-equivariant and differentiable like `neural_combine`.

    Args:
        network: as for `neural_combine`; sees the mean of both halves of x.
        unbiased_a: x of half a, linear radiance, shape [H,W,C].
        unbiased_b: x of half b, same shape.
        biased_a: y^_a of `cross_regression`, or y made from half a, same shape.
        biased_b: y^_b, same shape.
        variance: sample variance of the mean of **both** halves, squared radiance, at
            least zero, same shape.
        rule: to shrink by; None for the network's own, see `rule_of`.

    Returns:
        the combined rendering, linear radiance, shape [H,W,C]; at an invalid pixel the
        first finite of (y^_a, y^_b, x), else 0.

    Raises:
        ValueError: while tracing, if shapes differ.

    Example:
        >>> x, y = jnp.full((4, 4, 1), 3.0), jnp.ones((4, 4, 1))
        >>> head = lambda near: jnp.ones((*near.shape[:2], 15**2))
        >>> even = Kernels(x, head, 0, 15)
        >>> network = lambda *_: Parameters(even, 0.5 * y)
        >>> made = neural_combine_dual(network, x, x, y, y, y / 2, rule=Rule(window=3))
        >>> print(made[0, 0].round(3))
        [2.674]

    Source: NJS table 2, with section 4.4's variances and alpha.
    """
    images = {"unbiased_a": unbiased_a, "unbiased_b": unbiased_b}
    images |= {"biased_a": biased_a, "biased_b": biased_b, "variance": variance}
    check_same_shape(**images)
    window, whiten = rule or rule_of(network)

    def normalised(x_a: Image, x_b: Image, a: Image, b: Image, v: Variance) -> Image:
        x = (x_a + x_b) / 2
        inputs = {"unbiased": x, "biased_a": a, "biased_b": b, "variance": v}
        decided = _decide(network, inputs, whiten=whiten)
        x_a, x_b = (jnp.where(decided.valid, half, 0.0) for half in (x_a, x_b))
        shrunk = combine_dual(
            x_a,
            x_b,
            decided.a,
            decided.b,
            decided.variance,
            window=window,
            whiten=whiten,
            share=decided.share,
        )
        return jnp.where(decided.valid, shrunk, decided.instead)

    *radiances, v = images.values()
    return at_unit_luminance(normalised, *radiances, squares=[v])


class _Decided(NamedTuple):
    """Images without their invalid pixels, and what the network makes of them."""

    valid: Mask
    x: Image
    a: Image
    b: Image
    variance: Variance
    share: Float[Array, "h w 1"]
    instead: Image


def _decide(network: Network, inputs: Mapping[str, Image], *, whiten: bool) -> _Decided:
    """Let the network pool the variances and choose the share of both biased images."""
    names = "unbiased", "biased_a", "biased_b", "variance"
    x, a, b, v = (inputs[name] for name in names)
    instead = first_finite(a, b, x)
    valid, x, a, b, v = zero_invalid(x, a, b, v)
    kernels, share = network(x, v, a, b)
    (s2,) = predicted_mean(v[None], kernels, mask=valid)
    if whiten:
        s2 = jnp.maximum(v, s2)
    # An invalid pixel is not combined, and excluded from its neighbours' windows.
    return _Decided(valid, x, a, b, jnp.where(valid, s2, jnp.nan), share, instead)
