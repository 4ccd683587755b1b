"""Double shrinkage against loops and Bayes, and what it is told of errors."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from jscomb import double_shrinkage
from jscomb.features import stack
from jscomb.frame import Estimate, make_frame, with_halves
from jscomb.numerics.kernels import Kernels
from jscomb.numerics.tiles import map_crops
from jscomb.numerics.windows import window_mean
from tests.statistics import assert_mean, assert_mean_below

combine = jax.jit(double_shrinkage.combine)


def images(shape=(6, 7, 3), seed=0):
    """Prior, u, b and their errors, [H,W,C]."""
    rng = np.random.default_rng(seed)
    p, u, b = rng.standard_normal((3, *shape)) + 2
    v, m, eta = rng.random((3, *shape)) + 0.1
    return tuple(map(jnp.asarray, (p, u, b, v, m, eta)))


def test_inverse_variances():
    """The posterior mean: each of three by the inverse of its error."""
    p, u, b, v, m, eta = images()
    expected = (p / eta + u / v + b / m) / (1 / eta + 1 / v + 1 / m)
    np.testing.assert_allclose(combine(p, u, b, v, m, eta), expected, rtol=1e-12)
    one = lambda image: image[..., :1]
    expected = (p / one(eta) + u / v + b / one(m)) / (1 / one(eta) + 1 / v + 1 / one(m))
    found = combine(p, u, b, v, one(m), one(eta))
    np.testing.assert_allclose(found, expected, rtol=1e-12)


def test_posterior_mean_in_the_gaussian_model():
    """Truth and bias drawn from their priors: no other share of any has less error."""
    trials, v, gamma2, sb2, eta = 200_000, 0.7, 0.4, 0.2, 0.5
    keys = jax.random.split(jax.random.key(0), 4)
    g = [jax.random.normal(k, (trials, 1, 1)) for k in keys]
    truth = 1 + eta**0.5 * g[0]
    u = truth + v**0.5 * g[1]
    b = truth + gamma2**0.5 * g[2] + sb2**0.5 * g[3]
    at = lambda value: jnp.full_like(truth, value)
    m = sb2 + gamma2
    x = combine(at(1.0), u, b, at(v), at(m), at(eta))
    error = np.ravel(x - truth)
    expected = 1 / (1 / v + 1 / m + 1 / eta)
    assert_mean(error**2, expected)
    assert_mean(error, 0.0)
    for other in (u, b, at(1.0)):  # a step towards any of them is a step too far
        assert_mean(error * np.ravel(other - x), 0.0)
    worse = combine(at(1.0), u, b, at(2 * v), at(m / 2), at(eta))
    assert_mean_below(error**2 - np.ravel(worse - truth) ** 2, 0.0)


def test_limits():
    p, u, b, v, m, eta = images()
    none, endless = jnp.zeros_like(v), jnp.full_like(v, jnp.inf)
    np.testing.assert_allclose(combine(p, u, b, v, m, none), p, rtol=1e-15)
    blend = (u / v + b / m) / (1 / v + 1 / m)
    np.testing.assert_allclose(combine(p, u, b, v, m, endless), blend, rtol=1e-12)
    np.testing.assert_allclose(combine(p, u, b, v, m, 1e20 * eta), blend, rtol=1e-12)
    np.testing.assert_array_equal(combine(p, u, b, none, m, eta), u)
    np.testing.assert_array_equal(combine(p, u, b, v, none, eta), b)
    np.testing.assert_array_equal(combine(p, u, b, none, none, none), u)


def test_an_infinite_error_leaves_the_image_out():
    """The limit of eq. 9 and 10; u where nothing is known of any."""
    p, u, b, v, m, eta = images()
    endless = jnp.full_like(v, jnp.inf)
    share = v / (v + eta)
    no_b = share * p + (1 - share) * u
    np.testing.assert_allclose(combine(p, u, b, v, endless, eta), no_b, rtol=1e-12)
    one = endless[..., :1]
    np.testing.assert_allclose(combine(p, u, b, v, one, eta), no_b, rtol=1e-12)
    np.testing.assert_allclose(combine(p, u, b, v, 1e20 * m, eta), no_b, rtol=1e-12)
    np.testing.assert_array_equal(combine(p, u, b, v, endless, endless), u)
    share = m / (m + eta)
    no_u = share * p + (1 - share) * b
    np.testing.assert_allclose(combine(p, u, b, endless, m, eta), no_u, rtol=1e-12)
    np.testing.assert_array_equal(combine(p, u, b, endless, endless, eta), p)
    np.testing.assert_array_equal(combine(p, u, b, endless, endless, endless), u)
    found = double_shrinkage.factors(v, endless, eta)
    np.testing.assert_array_equal(found.biased, 0)
    np.testing.assert_array_equal(found.error, v)


def test_factors():
    _, _, _, v, m, eta = images()
    found = double_shrinkage.factors(v, m, eta)
    np.testing.assert_allclose(found.biased, v / (v + m), rtol=1e-12)
    s = v * m / (v + m)
    np.testing.assert_allclose(found.error, s, rtol=1e-12)
    paper = v * m / (v * m + eta * (v + m))
    np.testing.assert_allclose(found.prior, paper, rtol=1e-12)


@pytest.mark.parametrize("scale", [1e-8, 1e6])
def test_scale_equivariant_in_float32(scale):
    given = tuple(i.astype(jnp.float32) for i in images())
    s = jnp.float32(scale)
    scaled = [i * s for i in given[:3]] + [i * s * s for i in given[3:]]
    np.testing.assert_allclose(combine(*scaled), s * combine(*given), rtol=2e-6)


def test_gradients():
    given = images((2, 3, 1))
    check_grads(combine, given, order=1, modes=["fwd", "rev"], rtol=1e-6)
    total = lambda *given: jnp.sum(combine(*given))
    gradient = jax.jit(jax.grad(total, argnums=range(6)))
    p, u, b, v, m, eta = given
    for zero in (
        (0 * v, m, eta),
        (v, 0 * m, eta),
        (0 * v, 0 * m, 0 * eta),
        (v, m, 0 * eta),
        (v, m, eta + jnp.inf),
        (v, m + jnp.inf, eta),
        (v + jnp.inf, m, eta),
        (v + jnp.inf, m + jnp.inf, eta + jnp.inf),
    ):
        for part in gradient(p, u, b, *zero):
            assert np.isfinite(part).all()


@pytest.mark.parametrize("which", range(6))
def test_a_bad_pixel_stays_local(which):
    given = list(images())
    clean = combine(*given)
    given[which] = given[which].at[2, 3, 1].set(jnp.nan)
    found = combine(*given)
    away = np.ones((6, 7), bool)
    away[2, 3] = False
    np.testing.assert_array_equal(found[away], clean[away])
    expected = given[1][2, 3] if which == 2 else given[2][2, 3]
    np.testing.assert_array_equal(found[2, 3], expected)
    total = lambda *given: jnp.sum(combine(*given))
    for part in jax.jit(jax.grad(total, argnums=range(6)))(*given):
        assert np.isfinite(part).all()


def test_bad_input(unchecked):
    p, u, b, v, m, eta = images()
    with pytest.raises(ValueError, match="mse must be at least zero, its minimum is -"):
        double_shrinkage.combine(p, u, b, v, -m, eta)
    with pytest.raises(ValueError, match=r"mse must have shape .*\(6, 7, 3\): None"):
        double_shrinkage.combine(p, u, b, v, None, eta)
    with pytest.raises(ValueError, match=r"variance must have shape .*: \(5, 7, 3\)"):
        double_shrinkage.combine(p, u, b, v[1:], m, eta)
    with pytest.raises(ValueError, match=r"prior has shape \(5, 7, 3\), unbiased has"):
        double_shrinkage.combine(p[1:], u, b, v, m, eta)
    one = v[..., :1]
    with pytest.raises(ValueError, match=r"mse has shape \(6, 7, 3\), expected"):
        double_shrinkage.radiance_prior(u, b, one, m, u)
    with pytest.raises(ValueError, match="epsilon must be positive"):
        double_shrinkage.radiance_prior(u, b, one, one, u, epsilon=0.0)


def likeness(i, js, image, error, epsilon, less):
    """Weights of pixels js about i, eq. 12, or eq. 17 less the channels' noise."""
    both = (error[i] + error[js])[:, 0]
    square = ((image[i] - image[js]) ** 2).sum(axis=1)
    return np.exp(-(square - less * both) / (both + epsilon))


def prior_oracle(u, b, v, m, f, *, window, epsilon=0.01, ridge=0.1, floor=0.1):
    """Eq. 11-17 by loops; the constant has no ridge, features are scaled per window."""
    h, w, c = u.shape
    r = window // 2
    flat = [np.asarray(i, np.float64).reshape(h * w, -1) for i in (u, b, v, m, f)]
    u, b, v, m, f = flat
    place = np.array(list(np.ndindex(h, w)))
    near = [
        np.flatnonzero((abs(place - place[i]) <= r).all(axis=1)) for i in range(h * w)
    ]
    total, weight = np.zeros((h * w, c)), np.zeros((h * w, 1))
    for i, js in enumerate(near):
        wu, wb = (likeness(i, js, *of, epsilon, 0) for of in ((b, m), (u, v)))
        d = f[js] - f[i]
        d = d / (abs(d).max(axis=0, initial=0) + floor)
        a = np.concatenate([np.ones((len(js), 1)), d], axis=1)
        normal = (a * (wu + wb)[:, None]).T @ a
        normal += ridge * np.diag([0.0] + [1.0] * d.shape[1])
        right = (a * wu[:, None]).T @ u[js] + (a * wb[:, None]).T @ b[js]
        fit = a @ np.linalg.solve(normal, right)
        predict = likeness(i, js, b, m, epsilon, c)
        total[js] += predict[:, None] * fit
        weight[js] += predict[:, None]
    return (total / weight).reshape(h, w, c)


def scene(shape=(9, 10), seed=1):
    """u, b, v, m of one channel, and two features that tell something."""
    rng, (h, w) = np.random.default_rng(seed), shape
    f = rng.random((h, w, 2))
    truth = f @ rng.random((2, 3)) + (np.arange(w) > w // 2)[None, :, None]
    v, m = 0.05 * rng.random((2, h, w, 1)) + 0.01
    noise = rng.standard_normal((2, h, w, 3))
    return tuple(
        map(
            jnp.asarray, (truth + v**0.5 * noise[0], truth + m**0.5 * noise[1], v, m, f)
        )
    )


prior = jax.jit(double_shrinkage.radiance_prior, static_argnames=("window", "stride"))


@pytest.mark.parametrize("window", [3, 7])
def test_prior_is_the_loops(window):
    given = scene()
    expected = prior_oracle(*given, window=window)
    np.testing.assert_allclose(prior(*given, window=window), expected, rtol=1e-9)
    narrow = (i.astype(jnp.float32) for i in given)
    np.testing.assert_allclose(prior(*narrow, window=window), expected, rtol=2e-4)


def test_prior_of_a_blend():
    """That of both integrators, were they the same; and its gradient."""
    x1, _, s, _, f = scene()
    of = lambda x1, s, f: double_shrinkage.blend_prior(x1, s, f, window=5)
    found = jax.jit(of)(x1, s, f)
    np.testing.assert_allclose(found, prior(x1, x1, s, s, f, window=5), rtol=1e-9)
    small = tuple(i[:4, :4] for i in (x1, s, f))
    check_grads(jax.jit(of), small, order=1, modes=["rev"], rtol=1e-5, eps=1e-5)


def test_prior_without_features_and_in_hard_cases():
    u, b, v, m, f = scene()
    none = f[..., :0]
    found = prior(u, b, v, m, none, window=5)
    np.testing.assert_allclose(
        found, prior_oracle(u, b, v, m, none, window=5), rtol=1e-9
    )
    total = lambda *given: jnp.sum(prior(*given, window=5))
    gradient = jax.jit(jax.grad(total, argnums=range(5)))
    cases = {
        "no noise": (u, b, 0 * v, 0 * m, f),
        "alike": (u, u, v, v, f),
        "firefly": (u.at[4, 4].set(1e6), b, v.at[4, 4].set(1e10), m, f),
        "nan": (u.at[4, 4, 0].set(jnp.nan), b, v, m, f),
        "constant features": (u, b, v, m, 0 * f + 1),
    }
    for name, given in cases.items():
        found = prior(*given, window=5)
        bad = ~np.isfinite(np.asarray(found)).all(axis=-1)
        assert bad.sum() == (name == "nan"), name
        for part in gradient(*given):
            assert np.isfinite(np.where(bad[..., None], 0, part)).all(), name
    assert prior(*(i[:1, :1] for i in (u, b, v, m, f)), window=5).shape == (1, 1, 3)


def test_prior_gradients():
    given = tuple(i[:4, :4] for i in scene())
    of = lambda *given: prior(*given, window=3)
    check_grads(of, given, order=1, modes=["rev"], rtol=1e-5, eps=1e-5)


LEVEL = 100.0


def halves(trials, bias, shape=(5, 6, 1)):
    """u_a, u_b, b_a, b_b of truth `LEVEL`; variance .5 and .3 a half, [trials,...]."""
    keys = jax.random.split(jax.random.key(0), 4)
    g = [jax.random.normal(k, (trials, *shape)) for k in keys]
    unbiased = [LEVEL + 0.5**0.5 * i for i in g[:2]]
    return unbiased + [LEVEL + bias + 0.3**0.5 * i for i in g[2:]]


@pytest.mark.parametrize("bias", [0.0, 2.0])
def test_error_of_halves_is_the_true_one(bias):
    """Unbiased where the squared bias is far from 0; never below the variance."""
    trials = 4000
    of = lambda *h: double_shrinkage.biased_error(*h, window=7)
    found = jax.jit(jax.vmap(of))(*halves(trials, bias))
    if bias:
        assert_mean(found[:, 2, 3, 0], bias**2 + 0.3 / 2)
    else:
        assert np.mean(found[:, 2, 3, 0]) < 2 * 0.3 / 2
    assert np.all(np.asarray(found) > 0)


def test_a_lamp_does_not_decide_for_its_surroundings():
    """Errors of a tenth of the radiance everywhere, and a pixel 1e4 times as bright."""
    rng = np.random.default_rng(0)
    truth = np.ones((31, 31, 1))
    truth[15, 15] = 1e4
    noisy = lambda size: jnp.asarray(
        truth * (1 + size * rng.standard_normal(truth.shape))
    )
    given = noisy(0.1), noisy(0.1), noisy(0.2), noisy(0.2)
    m = double_shrinkage.biased_error(*given, window=15)
    relative = np.asarray(m / truth**2)
    assert 0.005 < relative.min() < relative.max() < 0.08  # 0.02 in expectation
    u, b = (given[0] + given[1]) / 2, (given[2] + given[3]) / 2
    eta = double_shrinkage.prior_error(
        jnp.asarray(1.3 * truth), u, b, jnp.asarray(0.005 * truth**2), m, window=15
    )
    relative = np.asarray(eta / truth**2)
    assert 0.05 < relative.min() < relative.max() < 0.13  # 0.09 in expectation


def test_variance_of_a_pixel_and_its_neighbours():
    """Half its own, half what goes with its radiance; a firefly keeps its own."""
    b = jnp.ones((9, 9, 1)).at[4, 4].set(3.0)
    v = (0.04 * b**2).at[2, 2].set(0.0).at[6, 6].set(1e6)
    u = b.at[6, 6].set(1e3)
    found = double_shrinkage.unbiased_error(u, b, v, window=17)
    pooled = found * 2 - v  # of the whole image, times the square of b
    np.testing.assert_allclose(pooled, pooled[0, 0, 0] * b**2, rtol=1e-9, atol=1e-8)
    assert 0.03 < pooled[0, 0, 0] < 0.08
    np.testing.assert_allclose(found[6, 6, 0], 5e5, rtol=1e-3)
    bad = double_shrinkage.unbiased_error(u.at[0, 0].set(jnp.nan), b, v, window=3)
    assert np.isfinite(bad).all()
    nothing = double_shrinkage.unbiased_error(0 * u, 0 * b, 0 * v, window=3)
    np.testing.assert_array_equal(nothing, 0)


def test_errors_where_b_is_black():
    """It knows nothing there; nor do windows that are black as a whole."""
    u = jnp.full((4, 5, 1), 2.0)
    for shape in ((4, 5, 1), (1, 1, 1)):
        b = jnp.ones((4, 5, 1)).at[: shape[0], : shape[1]].set(0.0)
        m = double_shrinkage.biased_error(u, u, b, b, window=3)
        np.testing.assert_allclose(m[0, 0], (4 + 4) / 4)
    eta = double_shrinkage.prior_error(0 * u, u, u, 0 * u, 0 * u, window=3)
    np.testing.assert_allclose(eta, 4 / 2)
    nothing = double_shrinkage.biased_error(*[0 * u] * 4, window=3)
    np.testing.assert_array_equal(nothing, 0)


@pytest.mark.parametrize("scale", [1e-8, 1e6])
def test_errors_are_scale_equivariant(scale):
    ua, ub, ba, bb = (i[0].astype(jnp.float32) / 100 for i in halves(1, 1.0))
    s = jnp.float32(scale)
    m = double_shrinkage.biased_error(ua, ub, ba, bb, window=3)
    found = double_shrinkage.biased_error(s * ua, s * ub, s * ba, s * bb, window=3)
    np.testing.assert_allclose(found, s * s * m, rtol=1e-4)
    of = jax.jit(jax.grad(lambda *g: jnp.sum(double_shrinkage.biased_error(*g))))
    assert np.isfinite(of(ua, ub, 0 * ba, bb)).all()
    assert np.isfinite(of(*[0 * ua] * 4)).all()


def test_error_of_halves_leaves_bad_pixels_out():
    ua, ub, ba, bb = (i[0] for i in halves(1, 1.0))
    bad = double_shrinkage.biased_error(ua.at[2, 2].set(jnp.nan), ub, ba, bb, window=3)
    clean = double_shrinkage.biased_error(ua, ub, ba, bb, window=3)
    assert np.isfinite(bad).all()
    np.testing.assert_array_equal(bad[:, 4:], clean[:, 4:])


def test_bias_by_radii():
    """Of passes whose bias is 3 r^2 beside noise."""
    rng = np.random.default_rng(0)
    radii = jnp.asarray(np.linspace(0.5, 0.1, 40))
    square = np.asarray(radii) ** 2
    passes = 2 + 3 * square[:, None, None, None] + rng.normal(0, 0.01, (40, 6, 7, 2))
    weighted = np.mean(passes * square[:, None, None, None], axis=0)
    given = jnp.asarray(passes.mean(axis=0)), jnp.asarray(weighted)
    found = double_shrinkage.radius_bias(*given, radii, window=5)
    np.testing.assert_allclose(found, (3 * square.mean()) ** 2, rtol=0.1)
    same = double_shrinkage.radius_bias(*given, jnp.ones(40), window=5)
    np.testing.assert_array_equal(same, 0)


@pytest.mark.parametrize("away", [0.0, 1.0])
def test_error_of_the_prior_is_its_distance_to_the_truth(away):
    rng, shape, v, m = np.random.default_rng(0), (60, 60, 1), 0.4, 0.6
    truth = LEVEL + rng.standard_normal(shape)
    u = truth + v**0.5 * rng.standard_normal(shape)
    b = truth + m**0.5 * rng.standard_normal(shape)
    p = truth + away
    full = lambda value: jnp.full(shape, value)
    found = double_shrinkage.prior_error(
        *map(jnp.asarray, (p, u, b)), full(v), full(m), window=31
    )
    assert abs(found[30, 30, 0] - away**2) < 0.1
    assert np.all(np.asarray(found) >= 0)


def test_error_of_the_prior_leaves_bad_pixels_out():
    p, u, b, v, m, _ = images()
    bad = double_shrinkage.prior_error(p.at[2, 2].set(jnp.nan), u, b, v, m, window=3)
    clean = double_shrinkage.prior_error(p, u, b, v, m, window=3)
    assert np.isfinite(bad).all()
    np.testing.assert_array_equal(bad[:, 4:], clean[:, 4:])


def test_a_frame_is_made_of_the_parts(glass_frame):
    """Of normalised radiance, with the features that are not constant."""
    raw = glass_frame._replace(reference=None)
    frame, options = raw.normalised(), {"window": 9, "stride": 1}
    y = frame.estimates["oidn"]
    found = double_shrinkage.combine_frame(frame, y, **options).image
    a, b = frame.halves()
    u = frame.color
    v = double_shrinkage.unbiased_error(u, y.image, frame.variance)
    m = double_shrinkage.biased_error(a.color, b.color, *y.halves)
    one = lambda errors: jnp.mean(errors, axis=-1, keepdims=True)
    features = stack(frame)
    first = double_shrinkage.factors(v, m, 0 * v)
    x1, s = first.blend(u, y.image), one(first.error)
    p = prior(x1, x1, s, s, features, window=9)
    p = double_shrinkage.limit_prior(p, u, y.image, v)
    eta = double_shrinkage.prior_error(p, u, y.image, v, m)
    expected = combine(p, u, y.image, v, m, eta)
    np.testing.assert_allclose(found, expected, rtol=2e-3, atol=1e-3)
    inputs = double_shrinkage.make_inputs(frame, y, **options)
    np.testing.assert_array_equal(combine(*inputs), found)
    np.testing.assert_allclose(inputs.mse, m, rtol=1e-4)
    share = double_shrinkage.factors(*inputs[3:]).prior
    assert np.all((share >= 0) & (share <= 1))
    bright = raw.scaled(1e3).normalised()
    bright = double_shrinkage.combine_frame(bright, bright.estimates["oidn"], **options)
    np.testing.assert_allclose(bright.image, found, rtol=1e-3, atol=1e-3)


def smoothed(frame):
    """A frame and its halves, averaged over windows."""
    return with_halves(frame, lambda part: window_mean(part.color, 3))


def test_halves_of_a_frame_are_the_halves_combined(glass_frame):
    """By a maker, which sees each half alone; not by an estimate of both halves."""
    frame, options = glass_frame.normalised(), {"window": 9, "stride": 1}
    found = double_shrinkage.combine_frame(frame, smoothed, **options)
    given = double_shrinkage.combine_frame(frame, smoothed(frame), **options)
    np.testing.assert_array_equal(given.image, found.image)
    assert given.halves is None
    for half, image in zip(frame.halves(), found.halves, strict=True):
        alone = double_shrinkage.combine_frame(half, smoothed(half), **options)
        np.testing.assert_array_equal(image, alone.image)
    two = frame.merged(2)
    assert double_shrinkage.combine_frame(two, smoothed, **options).halves is None


class Pooling(NamedTuple):
    """A network of one parameter, which sees less far than its kernels."""

    rate: jax.Array
    reach, multiple, window = 1, 1, 13

    def __call__(self, p, u, b, v, m):
        """Narrower kernels and a worse prior where the images differ."""
        width, differences = 2 * self.reach + 1, jnp.mean(abs(u - b), -1, keepdims=True)
        features = self.rate * window_mean(differences, width)
        steps = jnp.linspace(0, 1, 2 * 13**2, dtype=features.dtype)
        head = lambda near: jnp.exp(-near * steps[None, None])
        return double_shrinkage.Filters(Kernels(features, head, 0, 13), features)


class Wide(Pooling):
    """One that sees farther than its kernels."""

    reach = 9


@pytest.mark.slow
def test_a_frame_by_a_network(glass_frame):
    """The same as by arrays; halves are the halves combined."""
    frame, network = glass_frame.normalised(), Pooling(jnp.float32(2.0))
    found = double_shrinkage.neural_combine_frame(network, frame, smoothed)
    inputs = double_shrinkage.neural_inputs(frame, smoothed(frame))
    expected = double_shrinkage.neural_combine(network, **inputs)
    np.testing.assert_allclose(found.image, expected, rtol=1e-4, atol=1e-5)
    half = frame.halves()[1]
    alone = double_shrinkage.neural_combine_frame(network, half, smoothed(half))
    np.testing.assert_array_equal(found.halves[1], alone.image)


@pytest.mark.parametrize(("kind", "halo"), [(Pooling, 6), (Wide, 9)])
def test_a_frame_by_crops(kind, halo, glass_frame):
    """The halo is exact: a pixel less is too little."""
    frame, network = glass_frame.normalised(), kind(jnp.float32(2.0))
    plan = double_shrinkage.plan_neural(network, frame, smoothed(frame))
    assert (plan.halo, plan.multiple) == (halo, 1)
    whole = plan.whole()
    cut, short = (
        map_crops(plan.function, plan.images, tile=20, halo=around)
        for around in (halo, halo - 1)
    )
    np.testing.assert_allclose(cut, whole, rtol=1e-6)
    assert np.max(abs(short - whole)) > 1e-4


def test_a_network_without_reach(glass_frame):
    network = lambda *given: Pooling(jnp.float32(1.0))(*given)
    frame = glass_frame.normalised()
    plan = double_shrinkage.plan_neural(network, frame, smoothed(frame))
    assert plan.halo is None
    assert np.isfinite(plan.whole()).all()


@pytest.mark.parametrize(
    "call",
    [
        double_shrinkage.combine_frame,
        functools.partial(double_shrinkage.neural_combine_frame, lambda *_: None),
    ],
)
def test_frames_without_what_it_takes(call, glass_frame):
    frame = glass_frame.normalised()
    with pytest.raises(ValueError, match="double_shrinkage needs an estimate with hal"):
        call(frame, Estimate(frame.color))
    with pytest.raises(ValueError, match=r"double_shrinkage needs .*\.normalised\(\)"):
        call(glass_frame, glass_frame.estimates["oidn"])
    with pytest.raises(ValueError, match="double_shrinkage needs half buffers: render"):
        call(frame.merged(1), frame.estimates["oidn"])


def test_ugly_frames(glass_frame):
    """A bad pixel in either image keeps to itself; features are optional."""
    color = glass_frame.buffers.color.at[0, 20, 30].set(jnp.nan)
    photons = glass_frame.estimates["oidn"]
    photons = photons._replace(image=photons.image.at[40, 9].set(jnp.inf))
    frame = make_frame(
        color,
        variance=glass_frame.buffers.variance,
        samples=64,
        estimates={"photons": photons},
    ).normalised()
    photons, options = frame.estimates["photons"], {"window": 9, "stride": 1}
    found = double_shrinkage.combine_frame(frame, photons, **options).image
    inputs = double_shrinkage.make_inputs(frame, photons, **options)
    shares = double_shrinkage.factors(*inputs[3:])
    for part in (found, *inputs[3:], shares.biased, shares.prior):
        assert np.isfinite(part).all()
    prior = inputs.prior
    assert np.isfinite(np.delete(prior.reshape(-1, 3), (1310, 2569), 0)).all()
    np.testing.assert_allclose(found[20, 30], photons.image[20, 30], rtol=1e-6)
    np.testing.assert_allclose(found[40, 9], frame.color[40, 9], rtol=1e-6)


def test_dependence_tells_a_denoised_image_from_another_integrators(glass_frame):
    """By its noise: also where the noise is heavy-tailed and the images are tiny."""
    a, b = (half.color for half in glass_frame.halves())
    y = glass_frame.estimates["oidn"].halves
    assert double_shrinkage.depends(glass_frame, glass_frame.estimates["oidn"])
    turned = jnp.stack([half[::-1, ::-1] for half in y])  # its noise is another's
    assert not double_shrinkage.depends(glass_frame, Estimate(turned[0], turned))
    run = jax.jit(double_shrinkage.dependence)
    assert run(a, b, *y).correlation > 0.05
    assert not run(a, b, a, a).certain
    one = run(a[:1, :1], b[:1, :1], *y[:, :1, :1])
    assert np.isfinite(one.standard_error)
    total = lambda *images: double_shrinkage.dependence(*images).correlation
    for images in ((a, b, *y), (a, a, *y), (a, b, a, a)):
        for gradient in jax.jit(jax.grad(total, argnums=(0, 1, 2, 3)))(*images):
            assert np.isfinite(gradient).all()


def test_independent_noise_has_no_correlation_in_the_mean():
    """However heavy its tails; and the standard error is not too small."""
    keys = jax.random.split(jax.random.key(0), 300)

    def t(key):
        u, b = jax.random.pareto(key, 1.5, (2, 2, 32, 32, 3))
        found = double_shrinkage.dependence(*u, *b)
        return found.correlation / found.standard_error

    found = jax.jit(jax.vmap(t))(keys)
    assert_mean(found, 0.0)
    assert 0.5 < float(jnp.std(found)) < 1.1


def test_the_wrong_use_of_a_network_warns(glass_frame):
    frame = glass_frame.normalised()
    y = frame.estimates["oidn"]
    network = Pooling(jnp.float32(2.0))
    network.__class__.serves = "independent"
    try:
        with pytest.warns(UserWarning, match="combines independent images"):
            double_shrinkage.plan_neural(network, frame, y)
        network.__class__.serves = "denoised"
        double_shrinkage.plan_neural(network, frame, y)
    finally:
        del network.__class__.serves


def test_a_wild_prior_is_limited_to_what_the_images_allow():
    """A lone 69 beside u = 0.5 +- 0.25 goes; a prior that replaces a firefly stays."""
    at = lambda value: jnp.full((2, 2, 3), value)
    limited = lambda *images: double_shrinkage.limit_prior(*map(at, images))
    np.testing.assert_allclose(limited(69.0, 0.5, 0.0, 0.0625), 1.25)
    np.testing.assert_allclose(limited(-69.0, 0.5, 0.0, 0.0625), -0.25)
    firefly = limited(1.1, 1e6, 1.0, 0.0)  # its own variance silent
    np.testing.assert_allclose(firefly, 1.1)
    missed = limited(4.0, 0.1, 5.0, 0.0)  # u missed a light
    np.testing.assert_allclose(missed, 4.0)
