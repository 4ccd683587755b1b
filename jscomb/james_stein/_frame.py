"""The James-Stein combiner on frames, without and with its network."""

import functools
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jscomb.features import select, stack
from jscomb.frame import Estimate, Frame, Maker, Needs, with_halves
from jscomb.james_stein._bands import combine_bands, reach_of_bands, strength_for
from jscomb.james_stein._combine import combine, reach
from jscomb.james_stein._estimate import COARSE, worth_regressing
from jscomb.james_stein._neural import Network, combine_inputs, rule_of
from jscomb.james_stein._regression import RIDGE, cross_regression
from jscomb.metrics import Change
from jscomb.numerics.tiles import Local, compiled, network_plan
from jscomb.numerics.variances import ROBUST_WINDOW, robust_variance, smooth_variance
from jscomb.numerics.windows import reach_of
from jscomb.typing import Image, Key, Variance

NEEDS = Needs(variance=True)
_EPSILON = 0.01  # squared radiance, of normalised frames
BANDS_NEEDS = Needs(variance=True, normalised=True)
NEURAL_NEEDS = Needs(variance=True, channels=3, normalised=True)


def combine_frame(
    frame: Frame, estimate: Estimate | Maker, *, window: int = 7, whiten: bool = True
) -> Estimate:
    """Combine a frame with an estimate by the rule without a network.

    Args:
        frame: with variance; in any unit.
        estimate: biased image, or a function that makes it from a frame.
        window: width of the windows in pixels, odd, at least three.
        whiten: robust variances of single pixels, which measure better with windows of
            7; else one box-filtered variance a window, as in the paper with 15.

    Returns:
        the combination, radiance in the frame's unit.

    Raises:
        ValueError: if the frame has no variance or `window` is even or < 3.

    Example:
        >>> from jscomb.frame import make_frame
        >>> x, y = jnp.full((3, 3, 1), 3.0), Estimate(jnp.ones((3, 3, 1)))
        >>> frame = make_frame(x, variance=y.image)
        >>> made = combine_frame(frame, y, window=15, whiten=False)
        >>> print(made.image[0, 0].round(3))
        [2.611]

    Source: NJS eq. 5-7, 13; the whitened form is ours.
    """
    frame.require("james_stein", NEEDS)
    plan = functools.partial(plan_frame, window=window, whiten=whiten)
    make = lambda part, y: plan(part, y).whole()
    return with_halves(frame, make, estimate, needs=NEEDS)


def plan_frame(
    frame: Frame, estimate: Estimate, *, window: int = 7, whiten: bool = True
) -> Local:
    """Return `combine_frame` as a local function of images, for crops.

    Args:
        frame: with variance.
        estimate: biased image.
        window: as in `combine_frame`.
        whiten: as in `combine_frame`.

    Returns:
        the function, its images and how far it sees.

    Raises:
        ValueError: if the frame has no variance.

    Example:
        >>> from jscomb.frame import make_frame
        >>> one = jnp.ones((3, 3, 1))
        >>> print(plan_frame(make_frame(one, variance=one), Estimate(one)).halo)
        15
    """
    images = frame.color, estimate.image, frame.variance
    rule = compiled(_combine_pooled, window=window, whiten=whiten)
    # The whitened rule sums over a window what each of its pixels pools.
    pool = reach_of(ROBUST_WINDOW) if whiten else 0
    return Local(lambda i: rule(*i), images, pool + reach(window=window))


def _combine_pooled(
    x: Image, y: Image, variance: Variance, *, window: int, whiten: bool
) -> Image:
    """Pool the sample variances, then combine."""
    if whiten:
        v = robust_variance(variance)
    else:
        v = smooth_variance(variance, window=window)
    return combine(x, y, v, window=window, whiten=whiten)


def plan_bands(frame: Frame, estimate: Estimate) -> Local:
    """Return `combine_bands` of the whitened combination, as a local function.

    Args:
        frame: normalised, with variance.
        estimate: biased image.

    Returns:
        the function, its images and how far it sees.

    Raises:
        ValueError: if the frame has no variance or is not normalised.

    Example:
        >>> from jscomb.frame import make_frame
        >>> one = jnp.ones((3, 3, 1))
        >>> frame = make_frame(one, variance=one).normalised()
        >>> print(plan_bands(frame, Estimate(one)).halo)
        25
    """
    frame.require("james_stein.plan_bands", BANDS_NEEDS)
    first = plan_frame(frame, estimate)
    assert first.halo is not None
    rule = compiled(combine_bands, epsilon=_EPSILON)
    strength = strength_for(frame.samples)
    refine = lambda i: rule(i[0], first.function(i), i[2], strength=strength)
    return first._replace(function=refine, halo=first.halo + reach_of_bands())


class Regressed(NamedTuple):
    """An estimate after cross-regression, where that helps.

    Attributes:
        estimate: y* and its halves y^_a and y^_b; or the estimate unchanged.
        change: estimated change of the relative L2; negative where regression helps.
        ran: whether `estimate` is regressed.
    """

    estimate: Estimate
    change: Change
    ran: bool


def regress(
    key: Key,
    frame: Frame,
    estimate: Estimate,
    *,
    window: int = 51,
    stride: int = 1,
    always: bool = False,
) -> Regressed:
    """Regress an estimate where the halves show that it lowers the error.

    Excludes constant and duplicate features. Decides on values, so not for `jit`.

    Args:
        key: for the decision, see `worth_regressing`.
        frame: normalised, with sub-buffers.
        estimate: with halves.
        window: width of the windows in pixels, odd.
        stride: pixels between the centres of windows.
        always: regress regardless of the decision.

    Returns:
        the regressed estimate, or the given one, and the decision.

    Raises:
        ValueError: if frame or estimate has no halves, the frame is not normalised, or
            as `cross_regression`.

    Example:
        >>> from jscomb.frame import make_frame
        >>> ramp = np.linspace(0, 1, 16)[:, None, None] * np.ones((1, 16, 1))
        >>> noise = np.random.default_rng(0).normal(0, 0.2, (2, 16, 16, 1))
        >>> flat = jnp.full((2, 16, 16, 1), 0.5)
        >>> flat = {"flat": Estimate(flat[0], flat)}
        >>> frame = make_frame(ramp + noise, depth=ramp, estimates=flat).normalised()
        >>> key, estimate = jax.random.key(0), frame.estimates["flat"]
        >>> found = regress(key, frame, estimate, window=9)
        >>> print(f"{found.change.mean:.1f} {found.ran}")
        -0.2 True
    """
    frame.require("james_stein.regress", Needs(halves=True, normalised=True))
    if estimate.halves is None:
        raise ValueError("james_stein.regress needs an estimate with halves")
    a, b = frame.halves()
    needed = select([stack(a), stack(b)])
    features = [needed.of(stack(half)) for half in (a, b)]
    images = (a.color, b.color, *estimate.halves, *features)
    # The channels of the biased image are the first features.
    ridges = np.append(np.full(a.color.shape[-1], RIDGE), needed.ridge(RIDGE))
    ridge = jnp.asarray(ridges, a.color.dtype)
    judge = compiled(
        worth_regressing, window=window, stride=min(COARSE, window // 2 + 1)
    )
    change = judge(key, *images, _variance(a, b), _variance(b, a), ridge=ridge)
    if not (always or change.helps):
        return Regressed(estimate, change, ran=False)
    fit = compiled(cross_regression, window=window, stride=stride)
    halves = jnp.stack(fit(*images, ridge=ridge))
    return Regressed(Estimate(jnp.mean(halves, axis=0), halves), change, ran=True)


def _variance(half: Frame, other: Frame) -> Variance:
    """Variance of a half's mean; without any, from the difference of both halves."""
    if NEEDS.missing(half):
        return jnp.square(half.color - other.color) / 2
    return half.variance


def neural_combine_frame(
    key: Key,
    network: Network,
    frame: Frame,
    estimate: Estimate | Maker,
    *,
    stride: int = 2,
) -> Estimate:
    """Combine a frame with an estimate by the variances that a network chooses.

    Decides on values (features, whether to regress), so not for `jit`.

    Args:
        key: for the decision whether to regress.
        network: such as `learning.networks.JamesSteinNetwork`.
        frame: normalised, with variance and three channels.
        estimate: biased image, or a function that makes it from a frame; regressed
            where it has halves and they show that it helps.
        stride: pixels between the centres of the regression's windows.

    Returns:
        the combination, normalised radiance.

    Raises:
        ValueError: if the frame lacks what is needed.

    Example:
        >>> from jscomb.frame import make_frame
        >>> from jscomb.learning.recipes import shipped
        >>> x = np.random.default_rng(0).normal(1, 0.2, (8, 8, 3)).astype(np.float32)
        >>> y = Estimate(jnp.full((8, 8, 3), 1.15, jnp.float32))
        >>> frame = make_frame(x, variance=np.full_like(x, 0.04)).normalised(1.0)
        >>> made = neural_combine_frame(jax.random.key(0), shipped("njs"), frame, y)
        >>> for image in (x, y.image, made.image):
        ...     print(f"{np.sqrt(np.mean((image - 1) ** 2)):.2f}")
        0.19
        0.15
        0.13

    Source: NJS section 4.4; by the rule that the network was trained for.
    """
    frame.require("njs", NEURAL_NEEDS)

    def make(part: Frame, y: Estimate) -> Image:
        own = jax.random.clone(key)  # halves share the decision's random image
        return plan_neural(own, network, part, y, stride=stride).whole()

    return with_halves(frame, make, estimate, needs=NEURAL_NEEDS)


def plan_neural(
    key: Key, network: Network, frame: Frame, estimate: Estimate, *, stride: int = 2
) -> Local:
    """Return `neural_combine_frame` as a local function of images, for crops.

    Args:
        key: for the decision whether to regress.
        network: as in `neural_combine_frame`.
        frame: normalised, with variance.
        estimate: biased image.
        stride: as in `neural_combine_frame`.

    Returns:
        the function, its images and how far it sees: the whole frame for a network
        without `reach`.

    Raises:
        ValueError: if the frame lacks what is needed.

    Example:
        >>> from jscomb.frame import make_frame
        >>> from jscomb.learning.recipes import shipped
        >>> one = jnp.ones((8, 8, 3), jnp.float32)
        >>> frame = make_frame(one, variance=one).normalised()
        >>> plan = plan_neural(
        ...     jax.random.key(0), shipped("njs"), frame, Estimate(one)
        ... )
        >>> print(sorted(plan.images), plan.multiple)
        ['biased_a', 'biased_b', 'unbiased', 'variance'] 4
    """
    inputs = neural_inputs(key, frame, estimate, stride=stride)
    around = reach(window=rule_of(network).window)
    return network_plan(combine_inputs, network, inputs, around=around)


def neural_inputs(
    key: Key,
    frame: Frame,
    estimate: Estimate,
    *,
    stride: int = 2,
    choose: Literal["helps", "opposite"] = "helps",
) -> dict[str, Image]:
    """Return what the network is given of a frame.

    Args:
        key: for the decision whether to regress.
        frame: normalised, with variance.
        estimate: biased image; regressed if it has halves.
        stride: pixels between the centres of the regression's windows.
        choose: regress where the halves show that it "helps", or the "opposite", for
            training.

    Returns:
        x, both halves of the (regressed) biased image and the variance, as named by
        `neural_combine`.

    Raises:
        ValueError: if the frame lacks what is needed.

    Example:
        >>> from jscomb.frame import make_frame
        >>> one = jnp.ones((4, 4, 3))
        >>> frame = make_frame(one, variance=one).normalised()
        >>> print(sorted(neural_inputs(jax.random.key(0), frame, Estimate(one))))
        ['biased_a', 'biased_b', 'unbiased', 'variance']
    """
    frame.require("njs", NEURAL_NEEDS)
    a = b = estimate.image
    if estimate.halves is not None:
        opposite = choose == "opposite"
        found = regress(key, frame, estimate, stride=stride, always=opposite)
        if not found.change.helps if opposite else found.ran:
            assert found.estimate.halves is not None
            a, b = found.estimate.halves
    return {
        "unbiased": frame.color,
        "biased_a": a,
        "biased_b": b,
        "variance": frame.variance,
    }
