"""Errors against their definitions, their invariances, and FLIP's guard."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from jscomb import metrics
from tests.statistics import assert_mean
from tests.test_windows import near

PURE = [*map(jax.jit, (metrics.rel_l2, metrics.rmse, metrics.smape, metrics.dssim))]
# Of these more is better.
ALL = [*PURE, *map(jax.jit, (metrics.psnr, metrics.ssim))]


@pytest.fixture
def pair():
    """An image and its reference, linear radiance up to about 10."""
    r = jnp.exp(jax.random.normal(jax.random.key(0), (13, 9, 3)))
    return r * (1 + 0.1 * jax.random.normal(jax.random.key(1), r.shape)), r


def test_definitions(pair):
    a, r = map(np.asarray, pair)
    d = a - r
    grey = r.mean(-1, keepdims=True)
    expected = [
        np.mean(d**2 / (grey**2 + 0.01)),
        np.sqrt(np.mean(d**2)),
        np.mean(np.abs(d) / (np.abs(a) + np.abs(r) + 0.001)),
        np.mean((1 - ssim_loops(a, r)) / 2),
        -10 * np.log10(np.mean(np.square(shown(a) - shown(r)))),
        np.mean(ssim_loops(a, r)),
    ]
    for metric, value in zip(ALL, expected, strict=True):
        np.testing.assert_allclose(metric(*pair), value, rtol=1e-9)
    errors = np.mean(d**2, axis=-1, keepdims=True) / (grey**2 + 0.01)
    np.testing.assert_allclose(metrics.rel_l2_map(*pair), errors, rtol=1e-9)


def shown(image):
    """Display values by the definition of both curves."""
    x = np.maximum(image, 0)
    x = np.clip(x * (2.51 * x + 0.03) / (x * (2.43 * x + 0.59) + 0.14), 0, 1)
    return np.where(x > 0.0031308, 1.055 * x ** (1 / 2.4) - 0.055, 12.92 * x)


def test_equal_images_are_as_good_as_can_be(pair):
    """And their gradients are finite, also of black ones."""
    _, r = pair
    assert metrics.psnr(r, r) == np.inf
    np.testing.assert_allclose(metrics.ssim(r, r), 1, rtol=1e-12)
    for metric in (metrics.psnr, metrics.ssim):
        gradient = jax.jit(jax.grad(metric))
        assert np.isfinite(gradient(r, r)).all()
        assert np.isfinite(gradient(0 * r, 0 * r)).all()


def ssim_loops(a, r):
    """Structural similarity of the tone-mapped images, window by window."""
    a, r = (np.asarray(metrics.tone_map(jnp.asarray(i))) for i in (a, r))
    out = np.empty_like(a)
    for y, x, c in np.ndindex(*a.shape):
        rows, columns = near(y, x, a.shape, 11)
        dy, dx = np.mgrid[rows, columns]
        w = np.exp(-((dy - y) ** 2 + (dx - x) ** 2) / (2 * 1.5**2))
        w /= w.sum()
        p, q = a[rows, columns, c], r[rows, columns, c]
        mp, mq = (w * p).sum(), (w * q).sum()
        vp, vq = (w * (p - mp) ** 2).sum(), (w * (q - mq) ** 2).sum()
        cov = (w * (p - mp) * (q - mq)).sum()
        out[y, x, c] = (2 * mp * mq + 1e-4) * (2 * cov + 9e-4)
        out[y, x, c] /= (mp**2 + mq**2 + 1e-4) * (vp + vq + 9e-4)
    return out


@pytest.mark.parametrize("metric", PURE)
def test_zero_for_equal_images_with_finite_gradient(metric, pair):
    _, r = pair
    np.testing.assert_allclose(metric(r, r), 0, atol=1e-15)
    gradient = jax.jit(jax.grad(metric))
    assert np.isfinite(gradient(r, r)).all()
    black = jnp.zeros_like(r)
    assert np.isfinite(gradient(black, black)).all()


@pytest.mark.parametrize("metric", ALL)
def test_gradients_and_transforms(metric, pair):
    check_grads(metric, pair, order=1, modes=("rev",), rtol=1e-4)
    batch = [jnp.stack([i, 2 * i]) for i in pair]
    np.testing.assert_allclose(
        jax.vmap(metric)(*batch), [metric(a, r) for a, r in zip(*batch, strict=True)]
    )


@pytest.mark.parametrize("metric", ALL)
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_pixel_that_is_not_finite_is_never_hidden(metric, pair, value):
    a, r = pair
    bad = a.at[2, 3, 1].set(value)
    assert not np.isfinite(metric(bad, r))
    assert not np.isfinite(metric(r, bad))
    mask = jnp.isfinite(bad).all(-1, keepdims=True)
    masked = metric(bad, r, mask=mask)
    assert np.isfinite(masked)
    np.testing.assert_array_equal(masked, metric(a.at[2, 3].set(1e6), r, mask=mask))
    gradient = jax.jit(jax.grad(lambda *i: metric(*i, mask=mask), argnums=(0, 1)))
    assert np.isfinite(gradient(bad, r)).all()
    np.testing.assert_array_equal(gradient(bad, r)[0][2, 3], 0)
    nothing = jnp.zeros_like(mask)
    assert np.isnan(metric(a, r, mask=nothing))


def test_relative_l2_less_the_references_noise_is_unbiased():
    """A noisy reference raises the error by its own variance, no more."""
    truth, sigma = jnp.full((8, 8, 3), 2.0), 0.2
    image = truth + 0.1

    def corrected(key):
        a, b = truth[None] + sigma * jax.random.normal(key, (2, *truth.shape))
        # The weight is taken at the noisy reference; a large epsilon keeps it fixed.
        return metrics.rel_l2(image, (a + b) / 2, epsilon=1e8, half_difference=a - b)

    values = jax.vmap(corrected)(jax.random.split(jax.random.key(0), 4000))
    assert_mean(values * 1e8, 0.01)


def test_a_change_is_known_without_a_reference():
    """Unbiased for the true change, whichever of the two is better."""
    truth = jnp.sin(jnp.arange(192.0)).reshape(8, 8, 3) + 2
    for z_error, y_error in ((0.1, 0.3), (0.3, 0.1)):

        def excess(key, z_error=z_error, y_error=y_error):
            x = truth[None] + 0.5 * jax.random.normal(key, (2, *truth.shape))
            y = truth[None] + y_error + 0.1 * (x - truth[None])  # made from its half
            z = truth[None] + z_error + 0.2 * (x - truth[None])
            mean, error = metrics.rel_l2_change(z, y, x, epsilon=1e8)
            true = jnp.mean((z - truth[None]) ** 2 - (y - truth[None]) ** 2)
            return mean * 1e8 - true, mean * 1e8, error * 1e8

        keys = jax.random.split(jax.random.key(0), 4000)
        difference, estimate, error = jax.jit(jax.vmap(excess))(keys)
        # The weight of 1e8 varies with y by 1e-7 of the value.
        assert_mean(difference, 0.0)
        assert np.sign(estimate.mean()) == np.sign(z_error**2 - y_error**2)
        np.testing.assert_allclose(error.mean(), difference.std(), rtol=0.3)
        sure = metrics.Change(estimate.mean(), error.mean())
        assert sure.helps == (z_error < y_error)
        assert not metrics.Change(-error.mean(), 2 * error.mean()).helps


def test_a_limited_change_is_not_decided_by_a_firefly():
    """Better everywhere; one firefly in x says the opposite, and louder."""
    y, z = jnp.full((2, 2, 9, 9, 3), 1.5).at[1].set(1.1)
    x = jnp.ones((2, 9, 9, 3))
    exact = metrics.rel_l2_change(z, y, x)
    np.testing.assert_allclose(metrics.rel_l2_change(z, y, x, limit=9.0), exact)
    burnt = x.at[:, 4, 4].set(1e6)
    assert metrics.rel_l2_change(z, y, burnt).mean > 0
    limited = metrics.rel_l2_change(z, y, burnt, limit=2.0)
    assert limited.mean < 0
    np.testing.assert_allclose(limited.mean, exact.mean, rtol=0.2)


def test_no_change_is_exactly_none_with_finite_derivatives():
    x, y = jax.random.uniform(jax.random.key(0), (2, 2, 5, 4, 3))
    change = metrics.rel_l2_change(y, y, x)
    assert (change.mean, change.standard_error, change.helps) == (0, 0, False)
    bound = lambda *data: sum(metrics.rel_l2_change(*data))
    for gradient in jax.jit(jax.grad(bound, argnums=(0, 1, 2)))(y, y, x):
        assert np.isfinite(gradient).all()


def test_a_change_excludes_bad_pixels():
    x, y, z = jax.random.uniform(jax.random.key(0), (3, 2, 8, 8, 3))
    clean = metrics.rel_l2_change(z[:, 1:], y[:, 1:], x[:, 1:])
    for image in range(3):
        data = [z, y, x]
        data[image] = data[image].at[:, 0].set(jnp.nan)
        found = metrics.rel_l2_change(*data)
        np.testing.assert_allclose(found, clean, rtol=1e-12)


def test_tone_map_is_monotone_and_finite():
    x = jnp.concatenate([jnp.array([-1.0, 0.0]), jnp.geomspace(1e-8, 1e30, 200)])
    for dtype in ("float32", "float64"):
        y = metrics.tone_map(x.astype(dtype))
        assert (jnp.diff(y) >= 0).all()
        assert (y[0], y[1]) == (0, 0)
        np.testing.assert_allclose(y[-1], 1, rtol=1e-6)
        assert np.isfinite(jax.grad(lambda x: metrics.tone_map(x).sum())(x)).all()


@pytest.mark.usefixtures("unchecked")
def test_shapes_are_named(pair):
    a, r = pair
    for metric in (*ALL, metrics.rel_l2_map):
        with pytest.raises(ValueError, match="reference has shape"):
            metric(a, r[:-1])
    with pytest.raises(ValueError, match="half_difference has shape"):
        metrics.rel_l2(a, r, half_difference=r[:-1])


def test_flip(glass_frame):
    image, reference = glass_frame.estimates["oidn"].image, glass_frame.reference.image
    for flip in (metrics.flip, metrics.hdr_flip):
        better, worse = flip(image, reference), flip(glass_frame.color, reference)
        assert 0 < better < worse < 1
    assert metrics.flip(reference, reference) < 1e-6
    # The worst pixels are where the image is wrong.
    wrong = reference.at[10:20, 30:40].multiply(2)
    for error_map in (metrics.flip_map, metrics.hdr_flip_map):
        errors = error_map(wrong, reference)
        assert errors.shape == (64, 64, 1)
        assert errors[10:20, 30:40].mean() > 0.1
        assert np.max(errors[40:]) < 1e-6


def test_flip_is_guarded(pair):
    """Each of these ends the evaluator's process, or passes as perfect."""
    a, r = pair
    black = jnp.zeros_like(r)
    for flip in (metrics.flip, metrics.hdr_flip):
        with pytest.raises(ValueError, match="reference must have pixels and be fin"):
            flip(a, r.at[0, 0, 0].set(jnp.inf))
        with pytest.raises(ValueError, match="image must have pixels and be finite"):
            flip(a[:0], r[:0])
        with pytest.raises(ValueError, match=r"must be \[H,W,3\]"):
            flip(a, r[:-1])
    with pytest.raises(ValueError, match="reference is all black"):
        metrics.hdr_flip(a, black)
    assert 0 <= metrics.flip(a, black) <= 1


@pytest.mark.parametrize("bias", [0.0, 0.1])
def test_the_estimated_error_has_the_true_mean(bias):
    """Of halves with noise of their own: over many frames, by its standard errors."""
    size, noise, kept = 48, 0.2, 0.05
    # Where the bases differ as much as they are wrong, as the map assumes.
    shape = 0.5 + np.abs(np.sin(np.arange(size) / 5))[:, None, None]
    spread = jnp.asarray(np.broadcast_to(bias**2 * shape**2, (size, size, 3)))

    @jax.jit
    def one(key):
        x = 1 + noise * jax.random.normal(key, (2, size, size, 3))
        z = 1 + bias * shape[None] + kept * (x - 1)  # follows its own noise
        full = jnp.mean(z, axis=0)
        weight = jnp.square(full.mean(-1, keepdims=True)) + 0.01
        true = jnp.mean(jnp.square(full - 1) / weight)
        found = metrics.estimate_error(full, z, x, spread)
        return found.mean, true, found.standard_error

    means, true, deviations = jax.vmap(one)(jax.random.split(jax.random.key(0), 64))
    assert_mean(np.asarray(means - true), 0.0)
    # Its own standard error is that of one frame.
    assert 0.5 < float(means.std() / deviations.mean()) < 1.5
