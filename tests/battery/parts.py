"""What combiners, denoisers and solvers are made of, each at work on a rendering."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from jscomb import (
    double_shrinkage,
    ensemble,
    james_stein,
    metrics,
    progressive,
    uncorrelated,
)
from jscomb.denoisers import nfor
from jscomb.numerics import cholesky, convolution, kernels, luminance, windows
from jscomb.numerics import sure as risks
from jscomb.numerics.weights import (
    bilateral_weights,
    feature_weights,
    gaussian_weights,
    weighted_mean,
)
from tests.battery.catalogue import SAMPLES
from tests.battery.rendering import Rendering, bases, sub_averages

Function = Callable[[Rendering], Any]
WINDOW = 15


def _of_radiance(r: Rendering) -> tuple[jax.Array, ...]:
    """x, y and the variance."""
    return r.unbiased, r.biased, r.variance


def _of_halves(r: Rendering) -> tuple[jax.Array, ...]:
    """Of each half x, then of each y."""
    return r[:4]


def _of_bases(r: Rendering) -> tuple[jax.Array, ...]:
    """Bases of each half, and the halves."""
    return *bases(r), *r[:2]


def _sure(r: Rendering) -> jax.Array:
    """As if the denoiser did not follow the noise."""
    return jnp.square(r.unbiased - r.biased) - r.variance


def _systems(r: Rendering) -> jax.Array:
    """One of eight unknowns and three right sides for each pixel."""
    f = jnp.moveaxis(r.features[..., :8].reshape(-1, 8), 0, 1)
    matrix = f[:, None] * f[None] + jnp.eye(8, dtype=f.dtype)[..., None]
    right = f[:, None] * jnp.moveaxis(r.unbiased.reshape(-1, 3), 0, 1)[None]
    return cholesky.solve(matrix, right, jnp.ones((8, 1), f.dtype))


def _predicted(r: Rendering) -> jax.Array:
    """Weights that cost no more than an exponential."""
    count = WINDOW**2

    def head(strip: jax.Array) -> jax.Array:
        steps = jnp.linspace(0, 1, count, dtype=strip.dtype)
        return jnp.exp(-strip[..., :1] * steps[None, None])

    made = kernels.Kernels(r.features, head, 0, WINDOW)
    return kernels.predicted_mean(r.unbiased[None], made)


def _convolved(r: Rendering) -> jax.Array:
    """To 32 channels."""
    taps = jnp.full((3, 3, 8, 32), 0.1, r.features.dtype)
    return convolution.convolve(r.features[..., :8], taps, rows=1)


def parts() -> dict[str, Function]:
    """Errors, weights, windows and the like.

    Returns:
        functions of a rendering by the public name.
    """
    first = lambda r: r.unbiased_a[..., :1]
    kernel = jnp.full((WINDOW,), 1 / WINDOW)
    flow = lambda r: (*sub_averages(r, 4), SAMPLES)
    return _combining(flow) | {
        "windows.window_sum": lambda r: windows.window_sum(r.unbiased, WINDOW),
        "windows.window_mean": lambda r: windows.window_mean(r.unbiased, WINDOW),
        "windows.window_min": lambda r: windows.window_min(r.unbiased, WINDOW),
        "windows.window_max": lambda r: windows.window_max(r.unbiased, WINDOW),
        "windows.at_window_max": lambda r: windows.at_window_max(
            first(r), r.unbiased, WINDOW
        ),
        "windows.separable_sum": lambda r: windows.separable_sum(r.unbiased, kernel),
        "weights.gaussian_weights": lambda r: weighted_mean(
            r.unbiased, gaussian_weights(r.biased, 0.1), window=WINDOW
        ),
        "weights.feature_weights": lambda r: weighted_mean(
            r.unbiased, feature_weights(r.features), window=WINDOW
        ),
        "weights.bilateral_weights": lambda r: weighted_mean(
            r.unbiased,
            bilateral_weights(r.biased, r.biased, r.variance, sigma=3.0),
            window=WINDOW,
        ),
        "kernels.predicted_mean": _predicted,
        "convolution.convolve": _convolved,
        "cholesky.solve": _systems,
        "luminance.median_luminance": lambda r: luminance.median_luminance(r.unbiased),
        "luminance.in_unit": lambda r: luminance.in_unit(r.variance, r.unit, power=2),
        "sure.pooled": lambda r: risks.pooled(
            risks.Risk(r.biased, _sure(r), r.variance),
            r.unbiased,
            r.variance,
            window=WINDOW,
        ),
        "nfor.filter_features": lambda r: nfor.filter_features(r.features, r.features),
        "metrics.rel_l2": lambda r: metrics.rel_l2(r.unbiased, r.biased),
        "metrics.rmse": lambda r: metrics.rmse(r.unbiased, r.biased),
        "metrics.smape": lambda r: metrics.smape(r.unbiased, r.biased),
        "metrics.dssim": lambda r: metrics.dssim(r.unbiased, r.biased),
        "metrics.ssim": lambda r: metrics.ssim(r.unbiased, r.biased),
        "metrics.psnr": lambda r: metrics.psnr(r.unbiased, r.biased),
        "metrics.rel_l2_map": lambda r: metrics.rel_l2_map(r.unbiased, r.biased),
        "metrics.rel_l2_change": lambda r: metrics.rel_l2_change(
            jnp.stack(r[2:4]), jnp.stack(r[:2]), jnp.stack(r[:2])
        ),
        "metrics.estimate_error": lambda r: metrics.estimate_error(
            r.biased,
            jnp.stack([r.biased_a, r.biased_b]),
            jnp.stack([r.unbiased_a, r.unbiased_b]),
            jnp.square(r.biased_a - r.biased_b) / 8,
        ),
        "metrics.tone_map": lambda r: metrics.tone_map(r.unbiased),
    }


def _combining(flow: Callable[[Rendering], tuple]) -> dict[str, Function]:
    """Parts of the papers' methods."""
    shared = lambda r: jnp.square(r.biased_a - r.biased_b) / 4
    # Out of the images: constants would be worked on while the program is compiled.
    share = lambda r: jnp.clip(r.unbiased, 0.0, 0.5)
    weights = lambda r: jnp.stack([share(r), share(r), 1 - 2 * share(r)])
    return {
        "james_stein.risk": lambda r: james_stein.risk(*_of_radiance(r)),
        "james_stein.risk_bound": lambda r: james_stein.risk_bound(
            r.biased, r.variance, r.variance / 2
        ),
        "james_stein.smooth_variance": lambda r: james_stein.smooth_variance(
            r.variance
        ),
        "james_stein.robust_variance": lambda r: james_stein.robust_variance(
            r.variance
        ),
        "james_stein.guide_noise": lambda r: james_stein.guide_noise(*r[2:4]),
        "ensemble.mse_matrix": lambda r: ensemble.mse_matrix(*_of_bases(r)),
        "ensemble.error_matrix": lambda r: ensemble.error_matrix(*_of_bases(r)),
        "ensemble.true_matrix": lambda r: ensemble.true_matrix(
            jnp.stack(bases(r)), r.biased
        ),
        "ensemble.filter_weights": lambda r: ensemble.filter_weights(
            weights(r), r.biased, r.variance
        ),
        "ensemble.average": lambda r: ensemble.average(bases(r)[0], weights(r)),
        "ensemble.spread": lambda r: ensemble.spread(bases(r)[0], weights(r)),
        "ensemble.selection_errors": lambda r: ensemble.selection_errors(
            *_of_bases(r), r.variance, r.variance
        ),
        "ensemble.one_hot": lambda r: ensemble.one_hot(jnp.square(bases(r)[0])),
        "double_shrinkage.unbiased_error": (
            lambda r: double_shrinkage.unbiased_error(*_of_radiance(r))
        ),
        "double_shrinkage.biased_error": (
            lambda r: double_shrinkage.biased_error(*_of_halves(r))
        ),
        "double_shrinkage.dependence": (
            lambda r: double_shrinkage.dependence(*r[:4]).correlation
        ),
        "double_shrinkage.prior_error": lambda r: double_shrinkage.prior_error(
            r.biased, *_of_radiance(r), shared(r)
        ),
        "double_shrinkage.limit_prior": lambda r: double_shrinkage.limit_prior(
            2 * r.biased, *_of_radiance(r)
        ),
        "double_shrinkage.factors": lambda r: double_shrinkage.factors(
            r.variance, shared(r), shared(r)
        ),
        "double_shrinkage.radius_bias": lambda r: double_shrinkage.radius_bias(
            r.biased, r.unbiased, jnp.linspace(1.0, 0.5, 8)
        ),
        "progressive.mixing": lambda r: progressive.mixing(*_of_radiance(r), _sure(r)),
        "progressive.bound_mixing": lambda r: progressive.bound_mixing(
            share(r), *_of_radiance(r)
        ),
        "progressive.bound_sigma": (
            lambda r: progressive.bound_sigma(r.unbiased, r.variance)
        ),
        "progressive.channel_variance": lambda r: progressive.channel_variance(
            *r[:2], r.variance
        ),
        "progressive.risk": lambda r: progressive.risk(
            share(r), *_of_radiance(r), _sure(r)
        ),
        "progressive.activation": lambda r: progressive.activation(
            jnp.stack(r[:3], axis=2)
        ),
        "progressive.direct_activation": lambda r: progressive.direct_activation(
            jnp.stack(r[:3], axis=2)
        ),
        "uncorrelated.select_gamma": lambda r: uncorrelated.select_gamma(*flow(r)),
        "uncorrelated.select_gamma_map": (
            lambda r: uncorrelated.select_gamma_map(*flow(r), region=9)
        ),
        "uncorrelated.relative_variances": (
            lambda r: uncorrelated.relative_variances(*flow(r))
        ),
    }
