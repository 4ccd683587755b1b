"""Ensembles whose weights a network corrects, pixel by pixel."""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jscomb.ensemble._combine import Guide, average, interpolated
from jscomb.ensemble._estimate import SCALES, error_matrix
from jscomb.ensemble._evidence import Bases
from jscomb.ensemble._frame import NEEDS, Stacked, stack_estimates
from jscomb.features import FEATURES, scaled_depth
from jscomb.frame import (
    Estimate,
    Frame,
    Maker,
    Needs,
    estimates_of,
    halves_possible,
    with_halves,
)
from jscomb.numerics import simplex
from jscomb.numerics.guards import divide, weighted_ratio, zero_invalid
from jscomb.numerics.luminance import in_unit, median_luminance
from jscomb.numerics.tiles import Local, compiled, network_plan
from jscomb.numerics.variances import robust_variance
from jscomb.typing import Image, Variance

NEURAL_NEEDS = NEEDS._replace(variance=True, channels=3, normalised=True)

_BLOCK = 4
_LEAST = 0.01  # weight of a base like the blend, however small its own
_LARGEST_LOGIT = 2.0
_DARK = 0.01  # added to squared normalised radiance
_NOISELESS = 1e-6  # of the squared radiance: less variance is not trusted
_KINDS = "base", "difference", "weight", "error"


class Candidates(NamedTuple):
    """What a network sees of N bases, normalised and finite.

    Attributes:
        unbiased: x, [H,W,3].
        variance: of x, mean over channels, [H,W,1].
        features: albedo, normal and depth, 0 for what is missing, [H,W,7].
        blend: the bases with their weights, [H,W,3].
        square: of the blend's radiance, positive, [H,W,1].
        bases: [N,H,W,3].
        differences: of each base's halves, [N,H,W,3].
        weights: multi-scale, of sum one, [N,H,W,1].
        errors: of `neural_inputs`, [N,H,W,2].
        present: which bases are known at a pixel, [N,H,W,1].
    """

    unbiased: Image
    variance: Float[Array, "h w 1"]
    features: Guide
    blend: Image
    square: Float[Array, "h w 1"]
    bases: Bases
    differences: Bases
    weights: Float[Array, "n h w 1"]
    errors: Float[Array, "n h w 2"]
    present: Bool[Array, "n h w 1"]


Network = Callable[[Candidates], Float[Array, "n h w 1"]]


def neural_combine(
    network: Network,
    biased: Bases,
    biased_a: Bases,
    biased_b: Bases,
    unbiased_a: Image,
    unbiased_b: Image,
    variance: Variance,
    *,
    variance_a: Variance | None = None,
    variance_b: Variance | None = None,
    albedo: Guide | None = None,
    normal: Guide | None = None,
    depth: Guide | None = None,
) -> Image:
    """Combine any number of bases by multi-scale weights that a network corrects.

    Pure, scale-equivariant, differentiable in every array and in the network's
    parameters; the order of the bases does not matter.

    Args:
        network: of `Candidates` to a logit of each base, such as
            `learning.networks.EnsembleNetwork`.
        biased: y, each base of the full frame, radiance, shape [N,H,W,3].
        biased_a: the bases made from half a, same shape.
        biased_b: the bases made from half b, same shape.
        unbiased_a: x_a, shape [H,W,3].
        unbiased_b: x_b, same shape.
        variance: of the mean of both halves, squared radiance, same shape.
        variance_a: of x_a, see `error_matrix`, same shape; optional.
        variance_b: of x_b, same shape; optional.
        albedo: shape [H,W,3]; optional, as are the normal and the depth.
        normal: shape [H,W,3].
        depth: shape [H,W,1], any unit.

    Returns:
        the combined image, radiance, shape [H,W,3]; a base that is not finite at a
        pixel takes no part there; 0 where none is finite.

    Raises:
        ValueError: while tracing, if shapes differ or there is no base.

    Example:
        >>> network = lambda seen: jnp.zeros_like(seen.weights)
        >>> x = jnp.full((4, 4, 3), 2.0)
        >>> y = jnp.stack([x, x + 1])
        >>> print(neural_combine(network, y, y, y, x, x, 0 * x)[0, 0].round(2))
        [2. 2. 2.]

    Source: ours, from ED.
    """
    unit = median_luminance((unbiased_a + unbiased_b) / 2)
    radiances = biased, biased_a, biased_b, unbiased_a, unbiased_b
    scaled = (in_unit(image, unit) for image in radiances)
    square = lambda v: None if v is None else in_unit(v, unit, power=2)
    images = _inputs(*scaled, *map(square, (variance, variance_a, variance_b)))
    depth = None if depth is None else scaled_depth(depth)
    features = {"albedo": albedo, "normal": normal, "depth": depth}
    images |= {name: image for name, image in features.items() if image is not None}
    return unit * combine_inputs(network, images)


def neural_combine_frame(
    network: Network, frame: Frame, estimates: Mapping[str, Estimate | Maker]
) -> Estimate:
    """Combine a frame's estimates by multi-scale weights that a network corrects.

    Args:
        network: as for `neural_combine`.
        frame: normalised, with half buffers and variance.
        estimates: with halves, or functions that make them from a frame, by name. As
            for `combine_frame`, the halves of the result are independent where each can
            have weights of its own; otherwise both share those of the full frame.

    Returns:
        the ensemble, normalised radiance.

    Raises:
        ValueError: if frame or estimates lack what is needed, or shapes differ.

    Example:
        >>> import jax
        >>> from jscomb.frame import make_frame
        >>> x = 2 + 0.1 * jax.random.normal(jax.random.key(0), (4, 8, 8, 3))
        >>> frame = make_frame(x).normalised()
        >>> y = jnp.ones((2, 8, 8, 3))
        >>> estimates = {"good": Estimate(y[0], y), "bad": Estimate(3 * y[0], 3 * y)}
        >>> network = lambda seen: jnp.zeros_like(seen.weights)
        >>> made = neural_combine_frame(network, frame, estimates)
        >>> print(f"{made.image.mean():.1f}", made.halves.shape)
        1.0 (2, 8, 8, 3)

    Source: ours, from ED.
    """
    frame.require("neural-ensemble", NEURAL_NEEDS)

    def combined(part: Frame, given: Mapping[str, Estimate]) -> Estimate:
        """With both halves by the same weights."""
        weights = plan_neural_weights(network, part, given).whole()
        return compiled(_averages)(stack_estimates(given), weights)

    given = dict(estimates)
    if halves_possible(frame, given, needs=NEURAL_NEEDS):
        image_of = lambda part, given: combined(part, given).image
        return with_halves(frame, image_of, given, needs=NEURAL_NEEDS)
    return combined(frame, estimates_of(frame, given))


def _averages(bases: Stacked, weights: Float[Array, "h w n"]) -> Estimate:
    """Of all bases and of those of each half, by the same weights."""
    weights = jnp.moveaxis(weights, -1, 0)[..., None]
    shares = jnp.broadcast_to(weights, bases.biased.shape)
    image, *halves = (average(y, shares) for y in bases)
    return Estimate(image, jnp.stack(halves))


def plan_neural_weights(
    network: Network, frame: Frame, estimates: Mapping[str, Estimate]
) -> Local:
    """Return the weights of `neural_combine_frame` as a local function of images.

    Args:
        network: as for `neural_combine`.
        frame: normalised, with half buffers and variance.
        estimates: with halves, by name.

    Returns:
        the function, to weights [H,W,N], its images and how far it sees.

    Raises:
        ValueError: if frame or estimates lack what is needed, or shapes differ.

    Example:
        >>> from jscomb.frame import make_frame
        >>> x = jnp.ones((4, 8, 8, 3), jnp.float32)
        >>> estimates = {"own": Estimate(x[0], x[:2])}
        >>> network = lambda seen: jnp.zeros_like(seen.weights)
        >>> frame = make_frame(x).normalised()
        >>> print(plan_neural_weights(network, frame, estimates).whole().shape)
        (8, 8, 1)
    """
    inputs = neural_inputs(frame, estimates)
    return network_plan(neural_weights, network, inputs)


def neural_inputs(frame: Frame, estimates: Mapping[str, Estimate]) -> dict[str, Image]:
    """Return what a network sees of a frame's estimates, as images.

    Args:
        frame: normalised, with half buffers and variance.
        estimates: with halves, by name.

    Returns:
        x as `unbiased` and its robust `variance`, the features that the frame has, and
        of estimate k `base{k}`, the difference of its halves `difference{k}`, its
        multi-scale weight `weight{k}`, and as `error{k}` two channels: its estimated
        relative squared error, in excess of the best estimate's, and how much a larger
        weight would raise that of the ensemble.

    Raises:
        ValueError: if frame or estimates lack what is needed, or shapes differ.

    Example:
        >>> from jscomb.frame import make_frame
        >>> x = jnp.ones((4, 8, 8, 3))
        >>> estimates = {"own": Estimate(x[0], x[:2])}
        >>> print(*sorted(neural_inputs(make_frame(x).normalised(), estimates)))
        base0 difference0 error0 unbiased variance weight0
    """
    frame.require("neural-ensemble", NEURAL_NEEDS)
    halves = frame.halves()
    known = not Needs(variance=True).missing(halves[0])
    variances = [half.variance if known else None for half in halves]
    images = compiled(_inputs)(
        *stack_estimates(estimates),
        *(half.color for half in halves),
        frame.variance,
        *variances,
    )
    features = {name: getattr(frame, name) for name in FEATURES}
    if features["depth"] is not None:
        features["depth"] = scaled_depth(features["depth"])
    return images | {n: image for n, image in features.items() if image is not None}


def _inputs(
    y: Bases,
    y_a: Bases,
    y_b: Bases,
    x_a: Image,
    x_b: Image,
    variance: Variance,
    variance_a: Variance | None,
    variance_b: Variance | None,
) -> dict[str, Image]:
    """`neural_inputs` without features, of normalised images."""
    v = robust_variance(variance)
    matrix = error_matrix(
        *(y_a, y_b, x_a, x_b),
        variance_a=variance_a,
        variance_b=variance_b,
        windows=SCALES,
        block=_BLOCK,
    )
    weights = simplex.quadratic(matrix)
    diagonal = jnp.moveaxis(jnp.diagonal(matrix), -1, 0)
    slope = jnp.sum(matrix * weights[None], axis=1)
    found = {
        "weight": weights,
        "error": diagonal - jnp.min(diagonal, axis=0, keepdims=True),
        "slope": slope - jnp.sum(weights * slope, axis=0, keepdims=True),
    }
    height, width = x_a.shape[:2]
    fine = {
        name: interpolated(image, _BLOCK)[:, :height, :width]
        for name, image in found.items()
    }
    errors = jnp.concatenate([fine["error"], fine["slope"]], axis=-1)
    kinds = dict(zip(_KINDS, [y, y_a - y_b, fine["weight"], errors], strict=True))
    each = {f"{n}{k}": i for n, stack in kinds.items() for k, i in enumerate(stack)}
    return {"unbiased": (x_a + x_b) / 2, "variance": v} | each


def combine_inputs(network: Network, inputs: Mapping[str, Image]) -> Image:
    """Combine normalised images by name, for crops of a frame and for training.

    Local, and not scale-equivariant: `neural_combine` without its normalisation.

    Args:
        network: as for `neural_combine`.
        inputs: as `neural_inputs` makes. A base that is not finite takes no part.

    Returns:
        the combined image, normalised radiance, shape [H,W,3]; 0 where no base is
        finite.

    Example:
        >>> one = jnp.ones((2, 2, 3))
        >>> inputs = {"unbiased": one, "variance": one}
        >>> for k, radiance in enumerate((1.0, 1.5)):
        ...     inputs |= {f"base{k}": radiance * one, f"difference{k}": 0 * one}
        ...     inputs |= {f"weight{k}": one[..., :1] / 2, f"error{k}": one[..., :2]}
        >>> network = lambda seen: jnp.zeros_like(seen.weights)
        >>> print(combine_inputs(network, inputs)[0, 0])
        [1.25 1.25 1.25]
    """
    weights = jnp.moveaxis(neural_weights(network, inputs), -1, 0)[..., None]
    bases = _stacked(inputs, "base")
    known = jnp.where(weights > 0, bases, 0.0)
    return jnp.where(
        jnp.any(weights > 0, axis=0), jnp.sum(weights * known, axis=0), 0.0
    )


def neural_weights(
    network: Network, inputs: Mapping[str, Image]
) -> Float[Array, "h w n"]:
    """Return the weights of bases: the multi-scale ones, times a network's factors.

    w_k ~ (m_k + f_k) exp(logit_k). The floor f_k lets the network choose a base that
    the windows did not. It is small for a base that differs much from the multi-scale
    blend b, relative to the radiance or to the noise of x,

        f_k = 0.01 / (1 + |y_k - b|^2 / b^2 + |y_k - b|^2 / v),

    and logits, less their mean, are at most 2. So where the multi-scale weights settle
    on one base, the network's influence vanishes with v; where they share out among
    bases that differ it does not, and with it their consistency may be lost.

    Args:
        network: as for `neural_combine`.
        inputs: as for `combine_inputs`.

    Returns:
        at least zero, of sum one; 0 for all where no base is finite.

    Example:
        >>> one = jnp.ones((2, 2, 3))
        >>> inputs = {"unbiased": one, "variance": one}
        >>> for k, weight in enumerate((0.25, 0.75)):
        ...     inputs |= {f"base{k}": one, f"difference{k}": 0 * one}
        ...     inputs |= {f"weight{k}": weight * one[..., :1]}
        ...     inputs |= {f"error{k}": one[..., :2]}
        >>> network = lambda seen: jnp.zeros_like(seen.weights)
        >>> print(neural_weights(network, inputs)[0, 0].round(2))
        [0.25 0.75]
    """
    seen = candidates(inputs)
    distance = _mean_square(seen.bases - seen.blend[None])
    noise = seen.variance + _NOISELESS * seen.square
    ratio = distance / seen.square[None] + distance / noise[None]
    prior = seen.weights + _LEAST / (1 + ratio)
    factors = jnp.where(seen.present, prior * jnp.exp(_logits(network, seen)), 0.0)
    total = jnp.sum(factors, axis=0, keepdims=True)
    total = jnp.broadcast_to(total, factors.shape)
    return jnp.moveaxis(divide(factors, total, where=total > 0)[..., 0], 0, -1)


def _logits(network: Network, seen: Candidates) -> Float[Array, "n h w 1"]:
    """A network's logits, limited smoothly: what is clipped has no derivative."""
    logits = network(seen)
    present = seen.present.astype(logits.dtype)
    mean = weighted_ratio(jnp.sum(present * logits, axis=0), jnp.sum(present, axis=0))
    return _LARGEST_LOGIT * jnp.tanh((logits - mean[None]) / _LARGEST_LOGIT)


def candidates(inputs: Mapping[str, Image]) -> Candidates:
    """Return what a network sees, from images by name.

    Args:
        inputs: as for `combine_inputs`.

    Returns:
        finite: 0 in place of what is not.

    Example:
        >>> one = jnp.ones((2, 2, 3))
        >>> inputs = {"unbiased": one, "variance": one, "base0": jnp.nan * one}
        >>> inputs |= {"difference0": one, "weight0": one[..., :1]}
        >>> inputs |= {"error0": one[..., :2]}
        >>> print(candidates(inputs).present[0, 0, 0], candidates(inputs).blend[0, 0])
        [False] [0. 0. 0.]
    """
    stacks = {kind: _stacked(inputs, kind) for kind in _KINDS}
    finite = [jnp.all(jnp.isfinite(s), axis=-1, keepdims=True) for s in stacks.values()]
    present = jnp.all(jnp.stack(finite), axis=0)
    bases, differences, weights, errors = (
        jnp.where(present, stack, 0.0) for stack in stacks.values()
    )
    x, v = inputs["unbiased"], inputs["variance"]
    none = lambda channels: jnp.zeros((*x.shape[:2], channels), x.dtype)
    features = [inputs.get(name, none(size)) for name, size in FEATURES.items()]
    _, x, v, features = zero_invalid(x, v, jnp.concatenate(features, axis=-1))
    blend = weighted_ratio(jnp.sum(weights * bases, axis=0), jnp.sum(weights, axis=0))
    square = _mean_square(blend) + _DARK
    mean = jnp.mean(v, axis=-1, keepdims=True)
    return Candidates(
        x, mean, features, blend, square, bases, differences, weights, errors, present
    )


def _stacked(inputs: Mapping[str, Image], kind: str) -> Array:
    """The images of one kind of all bases, [N,H,W,*]."""
    count = sum(name.startswith("base") for name in inputs)
    return jnp.stack([inputs[f"{kind}{k}"] for k in range(count)])


def _mean_square(image: Float[Array, "*n c"]) -> Float[Array, "*n 1"]:
    """Over channels."""
    return jnp.mean(jnp.square(image), axis=-1, keepdims=True)
