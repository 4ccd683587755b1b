"""Safe divisions and square roots, and invalid pixels."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from jscomb import james_stein, metrics
from jscomb.denoisers import (
    bilateral,
    kernel_predicting,
    nonlocal_means,
    rdfc,
    smoothing,
)
from jscomb.numerics import (
    guards,
    kernels,
    luminance,
    regression,
    sure,
    weights,
    windows,
)


@pytest.mark.parametrize("d", [1e-30, 1e-8, 1.0, 1e18])
def test_derivatives_survive_where_squares_leave_the_range(d):
    """In float32 1/d^2 is infinite below 1e-19, the derivative itself is not."""
    n, d = jnp.float32(3 * d), jnp.float32(d)

    def quotient(n, d):
        return guards.divide(n, d, where=d > 0)

    np.testing.assert_allclose(quotient(n, d), 3, rtol=1e-6)
    for transform in (lambda f: f, jax.jit):
        for grad in (jax.grad, jax.jacfwd):
            dn, dd = transform(grad(quotient, argnums=(0, 1)))(n, d)
            np.testing.assert_allclose([dn * d, dd * d], [1, -3], rtol=1e-6)


def test_second_derivative():
    quotient = lambda n, d: guards.divide(n, d, where=d > 0)
    check_grads(jax.jit(quotient), (2.0, 3.0), order=2, rtol=1e-4)


def test_nothing_passes_where_it_does_not_divide():
    quotient = lambda n, d: guards.divide(n, d, where=d > 1, otherwise=7.0)
    n, d = jnp.float64(1), jnp.float64(0)
    assert quotient(n, d) == 7
    np.testing.assert_array_equal(jax.grad(quotient, argnums=(0, 1))(n, d), (0, 0))


def test_first_finite_chooses_whole_pixels():
    nan, inf = jnp.nan, jnp.inf
    a = jnp.array([[[1.0, 2.0], [nan, 2.0], [nan, 2.0]]])
    b = jnp.array([[[3.0, 4.0], [3.0, 4.0], [3.0, -inf]]])
    expected = [[[1, 2], [3, 4], [0, 0]]]
    np.testing.assert_array_equal(guards.first_finite(a, b), expected)
    np.testing.assert_array_equal(guards.finite(a, b)[0, :, 0], [True, False, False])


def test_invalid_pixels_are_zeroed_in_all_images_and_stacks():
    nan, inf = jnp.nan, jnp.inf
    image = jnp.array([[[1.0, nan], [2.0, 3.0], [4.0, 5.0], [6.0, 7.0]]])
    other = jnp.array([[[8.0], [9.0], [-inf], [10.0]]])
    stack = jnp.stack([other + 20, other.at[0, 3].set(nan)])
    valid, *zeroed = guards.zero_invalid(image, other, stack)
    np.testing.assert_array_equal(valid[0, :, 0], [False, True, False, False])
    for before, after in zip((image, other, stack), zeroed, strict=True):
        assert before.shape == after.shape
        np.testing.assert_array_equal(after[..., 1, :], before[..., 1, :])
        assert not after[..., np.array([0, 2, 3]), :].any()
    total = lambda *i: sum(jnp.sum(jnp.square(z)) for z in guards.zero_invalid(*i)[1:])
    gradients = jax.grad(total, (0, 1, 2))(image, other, stack)
    for after, gradient in zip(zeroed, gradients, strict=True):
        np.testing.assert_array_equal(gradient, 2 * after)


@pytest.mark.parametrize("transform", [lambda f: f, jax.jit])
def test_a_weighted_ratio_where_weight_is_missing(transform):
    total = jnp.array([[6.0, 3.0], [0.0, 0.0], [5.0, 7.0]])
    weight = jnp.array([[2.0], [0.0], [jnp.nan]])
    ratio = transform(lambda t, w: guards.weighted_ratio(t, w, otherwise=9.0))
    np.testing.assert_array_equal(ratio(total, weight), [[3, 1.5], [9, 9], [9, 9]])
    image = guards.weighted_ratio(total, weight, otherwise=-total)
    np.testing.assert_array_equal(image, [[3, 1.5], [0, 0], [-5, -7]])
    by_channel = jnp.array([[3.0, 1.0], [0.0, 1.0], [5.0, 0.0]])
    expected = [[2, 3], [0, 0], [1, 0]]
    np.testing.assert_array_equal(guards.weighted_ratio(total, by_channel), expected)
    dt, dw = jax.grad(lambda t, w: jnp.sum(ratio(t, w)), (0, 1))(total, weight)
    np.testing.assert_array_equal(dt, [[0.5, 0.5], [0, 0], [0, 0]])
    np.testing.assert_array_equal(dw, [[-(6 + 3) / 2**2], [0], [0]])


@pytest.mark.parametrize("per_channel", [False, True])
def test_a_masked_mean_is_that_of_the_selected_pixels(per_channel):
    rng = np.random.default_rng(0)
    values, mask = rng.normal(size=(4, 5, 3)), rng.random((4, 5, 1)) < 0.6
    axes = 0 if per_channel else None
    expected = values[mask[..., 0]].mean(axes)
    values[~mask[..., 0]] = np.nan
    mean = lambda v, m=None: guards.masked_mean(
        v, m, per_channel=per_channel, otherwise=7.0
    )
    found = mean(jnp.asarray(values), jnp.asarray(mask))
    assert found.shape == ((1, 1, 3) if per_channel else ())
    np.testing.assert_allclose(found.ravel(), np.ravel(expected), rtol=1e-14)
    gradient = jax.grad(lambda v: jnp.sum(mean(v, jnp.asarray(mask))))(values)
    share = 1 / mask.sum() if per_channel else 1 / (3 * mask.sum())
    np.testing.assert_allclose(gradient, np.where(mask, share, np.zeros(3)), rtol=1e-14)
    whole = np.nan_to_num(values)
    expected = whole.mean((0, 1) if per_channel else None)
    np.testing.assert_allclose(mean(jnp.asarray(whole)).ravel(), np.ravel(expected))


@pytest.mark.parametrize("per_channel", [False, True])
def test_an_empty_mask_has_a_mean_and_no_derivative(per_channel):
    values, empty = jnp.full((2, 3, 3), jnp.nan), jnp.zeros((2, 3, 1), bool)
    mean = lambda v: guards.masked_mean(
        v, empty, per_channel=per_channel, otherwise=7.0
    )
    assert mean(values).ravel().tolist() == [7.0] * (3 if per_channel else 1)
    assert not jax.grad(lambda v: jnp.sum(mean(v)))(values).any()
    assert guards.masked_mean(values, empty) == 0


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@pytest.mark.parametrize("transform", [lambda f: f, jax.jit])
def test_a_safe_root_at_its_singular_point(dtype, transform):
    square = jnp.array([4.0, 0.0, -0.0, -1.0, 1e-30, jnp.inf], dtype)
    root = transform(guards.safe_sqrt)(square)
    assert root.dtype == dtype
    np.testing.assert_allclose(root, [2, 0, 0, 0, 1e-15, np.inf], rtol=1e-6)
    gradient = transform(jax.vmap(jax.grad(guards.safe_sqrt)))(square)
    np.testing.assert_allclose(gradient, [0.25, 0, 0, 0, 5e14, 0], rtol=1e-6)
    tangent = jax.jvp(guards.safe_sqrt, (square,), (jnp.ones_like(square),))[1]
    np.testing.assert_allclose(tangent, gradient, rtol=1e-6)


def test_a_safe_root_reports_nan():
    assert jnp.isnan(guards.safe_sqrt(jnp.array(jnp.nan)))


def test_shapes_are_named():
    with pytest.raises(ValueError, match=r"noise has shape \(2, 3, 1\), color has"):
        guards.check_same_shape(color=jnp.ones((2, 3, 3)), noise=jnp.ones((2, 3, 1)))
    with pytest.raises(ValueError, match=r"color must have shape \[H, W, C\]"):
        guards.check_same_shape(color=jnp.ones((2, 3)))


def test_one_channel_is_told_how_to_repeat():
    message = r"broadcast_to\(noise, color.shape\) repeats its channel"
    with pytest.raises(ValueError, match=message):
        guards.check_same_shape(color=jnp.ones((2, 3, 3)), noise=jnp.ones((2, 3, 1)))


x = jnp.ones((6, 5, 3))
OF_IMAGES = {
    "james_stein.combine": lambda x, window: james_stein.combine(
        x, x, x, window=window
    ),
    "bilateral": lambda x, window: bilateral.denoise(x, x, x, window=window),
    "nonlocal means": lambda x, window: nonlocal_means.denoise(x, x, x, window=window),
    "their patch": lambda x, window: nonlocal_means.denoise(x, x, x, patch=window),
    "rdfc": lambda x, window: rdfc.denoise(x, x, x, x, window=window),
    "box": lambda x, window: smoothing.box(x, window=window),
    "window_sum": windows.window_sum,
    "window_max": windows.window_max,
    "weighted_mean": lambda x, window: weights.weighted_mean(
        x, weights.feature_weights(x), window=window
    ),
    "kernel_mean": lambda x, window: kernels.kernel_mean(
        x, jnp.ones((6, 5, 9)), window
    ),
}


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("name", OF_IMAGES)
def test_a_batch_and_several_windows_say_what_helps(name):
    """Instead of what goes wrong inside."""
    function = OF_IMAGES[name]
    with pytest.raises(ValueError, match=r"\(2, 6, 5, 3\): for a batch .* jax.vmap"):
        function(jnp.stack([x, x]), 3)
    static = "window is static: .* Static are the options .* loop in Python"
    for mapped in (jax.vmap, jax.jit):
        with pytest.raises(ValueError, match=static):
            mapped(lambda window: function(x, window))(jnp.array([3, 5]))
    assert jax.vmap(lambda x: function(x, 3))(jnp.stack([x, x])).shape == (2, 6, 5, 3)


def images(seed):
    return jax.random.uniform(jax.random.key(seed), (6, 5, 3))


even = lambda x, v, f: kernels.Kernels(x, lambda x: jnp.ones((*x.shape[:2], 9)), 0, 3)
key = lambda: jax.random.key(0)
OF_VARIANCE = {
    "james_stein.combine": lambda x, y, v: james_stein.combine(x, y, v, window=3),
    "james_stein.risk": lambda x, y, v: james_stein.risk(x, y, v, window=3),
    "sure": lambda x, y, v: sure.monte_carlo_sure(key(), jnp.sin, x, v),
    "exact": lambda x, y, v: sure.exact_sure(jnp.sin, x, v),
    "pooled": lambda x, y, v: sure.pooled(sure.Risk(x, x, x), x, v, window=3),
    "bilateral": lambda x, y, v: bilateral.denoise(x, v, y, window=3),
    "nonlocal means": lambda x, y, v: nonlocal_means.denoise(
        x, y, v, window=3, patch=1
    ),
    "rdfc": lambda x, y, v: rdfc.denoise(x, y, v, y, window=3, patch=1),
    "kernels": lambda x, y, v: kernel_predicting.denoise(even, x, v, y),
}


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("name", OF_VARIANCE)
def test_a_variance_of_one_channel_is_that_of_each(name):
    function, x, y, v = OF_VARIANCE[name], *map(images, range(3))
    found = function(x, y, v[..., :1])
    expected = function(x, y, jnp.broadcast_to(v[..., :1], v.shape))
    jax.tree.map(np.testing.assert_array_equal, found, expected)


@pytest.mark.usefixtures("unchecked")
def test_other_static_options_are_named():
    fit = lambda stride: regression.local_linear(x, x, x, 1.0, window=5, stride=stride)
    risk = lambda probes: sure.monte_carlo_sure(
        jax.random.key(0), lambda x: x, x, x, probes=probes
    )
    for name, function in {"stride": fit, "probes": risk}.items():
        with pytest.raises(ValueError, match=f"{name} is static: it must be"):
            jax.vmap(function)(jnp.array([1, 2]))


@pytest.mark.usefixtures("unchecked")
def test_every_metric_says_vmap():
    batch = jnp.stack([x, x])
    for metric in (metrics.rel_l2, metrics.rmse, metrics.smape, metrics.ssim):
        with pytest.raises(ValueError, match="for a batch of images map"):
            metric(batch, batch)


def test_this_jax_adds_up():
    """Compiled sums of large arrays: one release of JAX gets them wrong on CPUs."""
    rng = np.random.default_rng(0)
    t, u = (
        rng.normal(size=s).astype(np.float32) for s in ((3, 40_000), (3, 2, 40_000))
    )
    found = jax.jit(lambda t, u: jnp.sum(t[:, None] * u, axis=0))(t, u)
    np.testing.assert_allclose(found, (t[:, None] * u).sum(axis=0), atol=1e-5)


def test_a_unit_has_a_derivative_beside_bad_pixels(rng):
    """One that depends on the image; and a square is not divided by a square."""
    image = jnp.asarray(rng.uniform(1, 2, (4, 4, 3))).at[1, 2].set(jnp.nan)

    def total(image):
        unit = luminance.median_luminance(image)
        return jnp.nansum(luminance.in_unit(image, unit))

    value, gradient = jax.value_and_grad(total)(image)
    unit = np.nanmedian(np.mean(image, axis=-1))
    np.testing.assert_allclose(value, np.nansum(image) / unit, rtol=1e-12)
    assert np.isfinite(gradient[0, 0]).all()
    assert np.any(gradient != 1 / unit)
    bright = jnp.full((1, 1, 1), 1e38, jnp.float32)
    found = luminance.in_unit(bright, jnp.float32(1e20), power=2)
    np.testing.assert_allclose(found, 0.01, rtol=1e-6)
