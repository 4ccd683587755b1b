"""The public functions of images, each at work on one rendering.

For the tests, which hold all of them to the same promises, and for the table of what
each costs.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jscomb import (
    double_shrinkage,
    ensemble,
    james_stein,
    progressive,
    uncorrelated,
)
from jscomb.denoisers import (
    bilateral,
    kernel_predicting,
    nfor,
    nonlocal_means,
    oidn,
    rdfc,
    smoothing,
)
from jscomb.frame import Buffers, Estimate, Frame
from jscomb.learning import networks
from jscomb.methods import METHODS, Method
from jscomb.numerics import poisson, regression, simplex, sure
from jscomb.numerics.guards import finite, first_finite
from jscomb.numerics.tiles import Local
from jscomb.numerics.weights import noise_free_weights
from jscomb.typing import Image, Scalar
from tests.battery.rendering import Rendering, bases, sub_averages

SAMPLES = 8  # in each sub-average


class Entry(NamedTuple):
    """A public function with all that it takes from a rendering.

    Attributes:
        function: to an image, [H,W,C]; two of halves are one of 2 C channels.
        reach: pixels around a pixel that its result depends on; None for the frame.
        degree: the power of the unit of radiance that its result is in.
        rounding: largest difference of float32 from float64, of the brightest pixel.
        backwards: whether gradients go through it, not only derivatives forwards.
        ripple: largest relative difference of its result from a flat image.
        multiple: what crops have to start at multiples of.
    """

    function: Callable[[Rendering], jax.Array]
    reach: int | None = None
    degree: int = 1
    rounding: float = 1e-5
    backwards: bool = True
    ripple: float = 1e-5
    multiple: int = 1


def _normalised(
    function: Callable[[Rendering], Image],
) -> Callable[[Rendering], Image]:
    """Of normalised images, for a function with absolute constants."""

    def scaled(r: Rendering) -> Image:
        unit = lax.stop_gradient(r.unit)
        return unit * function(r.scaled(1 / unit))

    return scaled


def _targets(r: Rendering) -> tuple[jax.Array, ...]:
    """The bases of both halves, and the halves."""
    return *bases(r), r.unbiased_a, r.unbiased_b


def _ensemble(r: Rendering, **options: Any) -> Image:
    """Of the bases and their means."""
    a, b = bases(r)
    albedo, normal = r.features[..., :3], r.features[..., 3:6]
    guides = {"albedo": albedo, "normal": normal}
    halves = a, b, r.unbiased_a, r.unbiased_b
    return ensemble.combine((a + b) / 2, *halves, **guides, **options)


def _candidates(r: Rendering) -> dict[str, jax.Array]:
    """What a network sees of the unbiased and the biased image."""
    one = jnp.ones_like(r.grey)
    pairs = (r.unbiased_a, r.unbiased_b), (r.biased_a, r.biased_b)
    found = {"unbiased": r.unbiased, "variance": r.variance}
    found |= {"albedo": r.features[..., :3], "normal": r.features[..., 3:6]}
    for k, (a, b) in enumerate(pairs):
        found |= {f"base{k}": (a + b) / 2, f"difference{k}": a - b}
        errors = jnp.concatenate([k * one, one - k], axis=-1)
        found |= {f"weight{k}": (1 + k) / 3 * one, f"error{k}": errors}
    return found


def _by(solve: Callable[..., jax.Array]) -> Callable[[Rendering], Image]:
    """The bases' mean with the weights of a solver of points and targets.

    Where bases are nearly alike their weights are hardly determined, but the mean is.
    """

    def function(r: Rendering) -> Image:
        a, b, *halves = _targets(r)
        return ensemble.average((a + b) / 2, solve(a, b, *halves))

    return function


def _by_matrix(solve: Callable[[jax.Array], jax.Array]) -> Callable[..., Image]:
    """Likewise of a matrix: the bases' errors, and as much again of their own each."""

    def weights(*targets: jax.Array, unit: Scalar) -> jax.Array:
        a, _, _, x = targets
        errors = jnp.where(jnp.isfinite(a) & jnp.isfinite(x)[None], a - x[None], 0.0)
        errors = errors / unit
        own = jnp.eye(len(a), dtype=errors.dtype)[:, :, None, None, None]
        return solve(errors[:, None] * errors[None] + own)

    return lambda r: _by(functools.partial(weights, unit=r.unit))(r)


def _two(r: Rendering) -> Image:
    """The same of the first two bases."""
    a, b, *halves = _targets(r)
    a, b = a[:2], b[:2]
    return ensemble.average((a + b) / 2, simplex.two(a, b, *halves))


def _uncorrelated(combine: Callable, count: int) -> Callable[[Rendering], Image]:
    """With a gamma that does not follow single pixels."""

    def function(r: Rendering) -> Image:
        gamma = 10 / jnp.square(r.unit)
        return combine(*sub_averages(r, count), gamma, SAMPLES)

    return function


def _sure(r: Rendering) -> Image:
    """Of a denoiser that averages."""
    denoise = lambda x: smoothing.box(x, window=5)
    key = jax.random.key(0)
    return sure.monte_carlo_sure(key, denoise, r.unbiased, r.variance).squared_error


def _poisson(r: Rendering) -> Image:
    """With the gradients of the biased image."""
    y = r.biased
    return poisson.reconstruct(r.unbiased, jnp.diff(y, axis=1), jnp.diff(y, axis=0))


def combiners() -> dict[str, Entry]:
    """All functions that combine unbiased and biased images.

    Returns:
        what they are by the public function's name, and a variant's after a blank.
    """
    kinds = (
        networks.JamesSteinNetwork,
        networks.ShrinkageNetwork,
        networks.MixingNetwork,
        networks.EnsembleNetwork,
    )
    keys = jax.random.split(jax.random.key(0), len(kinds))
    njs, dsc, pd, mixed = (
        n(key, size="light") for n, key in zip(kinds, keys, strict=True)
    )
    njs.rule, pd.form = james_stein.Rule(window=7, whiten=True), "direct"
    mixed.logit = networks.Convolution(keys[-1], 16, 1, size=1)  # untrained it is 0
    xyv = lambda r: (r.unbiased, r.biased, r.variance)
    halves = lambda r: (r.unbiased_a, r.unbiased_b, r.biased_a, r.biased_b)
    known = lambda r: finite(r.unbiased, r.biased)  # so that derivatives are, too
    risk = lambda r: jnp.square(jnp.where(known(r), r.unbiased - r.biased, 0.0))
    prior = lambda r: smoothing.box(r.biased, window=3)
    shrink = james_stein.combine
    return {
        "james_stein.combine": Entry(lambda r: shrink(*xyv(r)), james_stein.reach()),
        "james_stein.combine whitened": Entry(
            lambda r: shrink(*xyv(r), whiten=True), james_stein.reach()
        ),
        "james_stein.combine corrected": Entry(
            lambda r: shrink(*xyv(r), divergence=r.variance / 4),
            james_stein.reach(),
        ),
        "james_stein.combine_bands": Entry(
            lambda r: james_stein.combine_bands(*xyv(r))
        ),
        "james_stein.combine_dual": Entry(
            lambda r: james_stein.combine_dual(*halves(r), r.variance),
            james_stein.reach(),
        ),
        "james_stein.combine_inputs": Entry(
            _normalised(
                lambda r: james_stein.combine_inputs(
                    njs,
                    {
                        "unbiased": r.unbiased,
                        "biased_a": r.biased_a,
                        "biased_b": r.biased_b,
                        "variance": r.variance,
                    },
                )
            ),
            max(njs.reach, 7) + james_stein.reach(window=7),
            multiple=njs.multiple,
        ),
        "ensemble.combine": Entry(
            lambda r: _ensemble(r, solver="hull", filter=True), rounding=1e-4
        ),
        "ensemble.combine multi-scale": Entry(
            lambda r: _ensemble(r, solver="multi-scale", windows=(7, 11))
        ),
        "ensemble.combine_inputs": Entry(
            _normalised(lambda r: ensemble.combine_inputs(mixed, _candidates(r))),
            mixed.reach,
            multiple=mixed.multiple,
        ),
        "uncorrelated.combine": Entry(_uncorrelated(uncorrelated.combine, 2), 7),
        "uncorrelated.combine of both": Entry(
            _uncorrelated(functools.partial(uncorrelated.combine, guides="both"), 4), 7
        ),
        "uncorrelated.combine_median": Entry(
            _uncorrelated(uncorrelated.combine_median, 4), 7
        ),
        "uncorrelated.combine_crosswise": Entry(
            _uncorrelated(uncorrelated.combine_crosswise, 4), 7
        ),
        "uncorrelated.combine_decorrelated": Entry(
            _uncorrelated(uncorrelated.combine_decorrelated, 4), 7
        ),
        "uncorrelated.combine_uniform": Entry(
            lambda r: uncorrelated.combine_uniform(*sub_averages(r, 2)), 7
        ),
        "double_shrinkage.combine": Entry(
            lambda r: double_shrinkage.combine(
                prior(r), *xyv(r), r.variance / 2, r.variance / 3
            ),
            1,
        ),
        "double_shrinkage.combine_inputs": Entry(
            _normalised(
                lambda r: double_shrinkage.combine_inputs(
                    dsc,
                    {
                        "prior": prior(r),
                        "unbiased": r.unbiased,
                        "biased": r.biased,
                        "variance": r.grey,
                        "mse": r.grey / 4,
                    },
                )
            ),
            max(dsc.reach, 6) + 1,
            multiple=dsc.multiple,
        ),
        "progressive.combine": Entry(lambda r: progressive.combine(*xyv(r), risk(r))),
        "progressive.combine_inputs": Entry(
            _normalised(
                lambda r: progressive.combine_inputs(
                    pd,
                    {
                        "unbiased": r.unbiased,
                        "biased": r.biased,
                        "variance": r.variance,
                        "sure": risk(r),
                    },
                    bound=False,
                )
            ),
            pd.reach,
        ),
        **{
            f"methods.plan {name}": Entry(
                _normalised(lambda r, method=method: _plan(r, method).whole()),
                _reach(method),
            )
            for name, method in METHODS.items()
            # `denoised` returns its input; denoisers have entries of their own.
            if method.pure and method.takes == "one estimate" and name != "denoised"
        },
    }


def _plan(r: Rendering, method: Method) -> Local:
    """What a method of one estimate makes of a rendering."""
    color = jnp.stack([r.unbiased_a, r.unbiased_b])
    variance = jnp.stack([r.variance, r.variance]) * 2
    frame = Frame(Buffers(color, variance), None, {}, None, r.unit)
    assert method.plan is not None
    return method.plan(jax.random.key(0), frame, Estimate(r.biased))


def _reach(method: Method) -> int | None:
    """How far a method sees."""
    image = jnp.ones((1, 1, 3), jnp.float32)
    return _plan(Rendering(*6 * [image], jnp.ones(())), method).halo


def denoisers(*, window: int | None = None) -> dict[str, Entry]:
    """All functions that make a biased image.

    Args:
        window: width of their windows in pixels, odd; None for what each has by itself.

    Returns:
        as `combiners`.
    """
    network = networks.KernelPredictor(jax.random.key(0), size="light")
    guided = lambda r: (r.unbiased, r.biased, r.variance)
    halves = lambda r: (r.unbiased_a, r.unbiased_b)
    seven = lambda r: r.features[..., :7]
    near = window or 21
    wide = window or 51
    far = 2 * (wide // 2)  # a pixel's fits, and the fits' pixels
    # Priors say by what is not finite where nothing is known.
    found = {
        "bilateral.denoise": Entry(
            lambda r: bilateral.denoise(
                r.unbiased, r.variance, r.features, window=near
            ),
            bilateral.reach(window=near),
        ),
        "nonlocal_means.denoise": Entry(
            lambda r: nonlocal_means.denoise(*guided(r), window=near),
            nonlocal_means.reach(window=near),
        ),
        "rdfc.denoise": Entry(
            lambda r: rdfc.denoise(*guided(r), r.features, window=near),
            rdfc.reach(window=near),
        ),
        "nfor.denoise": Entry(
            lambda r: jnp.concatenate(
                nfor.denoise(
                    *halves(r),
                    *2 * [r.variance],
                    *2 * [r.features],
                    window=window or 19,
                ),
                axis=-1,
            )
        ),
        "smoothing.gaussian": Entry(
            lambda r: smoothing.gaussian(r.unbiased), smoothing.reach()
        ),
        "smoothing.box": Entry(lambda r: smoothing.box(r.unbiased), 3),
        "kernel_predicting.denoise_normalised": Entry(
            _normalised(
                lambda r: kernel_predicting.denoise_normalised(
                    network, r.unbiased, r.variance, seven(r)
                )
            ),
            max(network.reach, 5),
            multiple=network.multiple,
        ),
        "james_stein.cross_regression": Entry(
            _normalised(
                lambda r: jnp.concatenate(
                    james_stein.cross_regression(
                        *r[:4], r.features, r.features, kappa=0.01, window=wide
                    ),
                    axis=-1,
                )
            ),
            far,
        ),
        "double_shrinkage.radiance_prior": Entry(
            _normalised(
                lambda r: first_finite(
                    double_shrinkage.radiance_prior(
                        *guided(r)[:2], r.grey, r.grey / 4, r.features, window=wide
                    )
                )
            ),
            far,
        ),
        "double_shrinkage.blend_prior": Entry(
            _normalised(
                lambda r: first_finite(
                    double_shrinkage.blend_prior(
                        r.biased, r.grey, r.features, window=wide
                    )
                )
            ),
            far,
        ),
    }
    if oidn.available():
        found["oidn.denoise"] = Entry(lambda r: oidn.denoise(r.unbiased), ripple=0.06)
    return found


def solvers(*, window: int | None = None) -> dict[str, Entry]:
    """All that solve something at each pixel, or for the frame.

    Args:
        window: width of the regressions' windows in pixels, odd; None for their own.

    Returns:
        as `combiners`.
    """
    wide = window or 51
    far = 2 * (wide // 2)

    def regressed(r: Rendering) -> Image:
        prediction, weight = regression.local_linear(
            r.unbiased, r.biased, r.features, 0.1, window=wide
        )
        return jnp.where(weight > 0, prediction, 0.0)

    def jointly(r: Rendering) -> Image:
        weights = noise_free_weights(r.biased, r.grey, epsilon=0.01)
        targets = [(r.unbiased_a, weights), (r.unbiased_b, weights)]
        ((prediction, weight),) = regression.joint_local_linear(
            targets, r.features, window=wide
        )
        return jnp.where(weight > 0, prediction, 0.0)

    return {
        # A weight below a thousand roundings may be lost.
        "simplex.hull": Entry(_by(simplex.hull), 1, rounding=2e-5),
        "simplex.two": Entry(_two, 1),
        "simplex.quadratic": Entry(_by_matrix(simplex.quadratic), 1, rounding=2e-4),
        "simplex.affine": Entry(_by_matrix(simplex.affine), 1, rounding=1e-2),
        "simplex.iterative": Entry(
            _by(lambda *given: simplex.iterative(jax.random.key(0), *given)),
            rounding=1e-3,
            backwards=False,
        ),
        "simplex.iterative_quadratic": Entry(
            _by_matrix(lambda m: simplex.iterative_quadratic(jax.random.key(0), m)),
            rounding=2e-3,
            backwards=False,
        ),
        "ensemble.solve_weights": Entry(
            _by(functools.partial(ensemble.solve_weights, solver="hull")),
            1,
            rounding=2e-5,
        ),
        "poisson.reconstruct": Entry(_poisson),
        "regression.local_linear": Entry(_normalised(regressed), far),
        "regression.joint_local_linear": Entry(_normalised(jointly), far),
        "sure.monte_carlo_sure": Entry(_sure, degree=2),
    }
