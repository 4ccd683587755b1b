"""Cross-regression, and whether it pays."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from jscomb import features, james_stein
from jscomb.frame import Estimate, make_frame
from tests.statistics import assert_mean
from tests.test_regression import gaussian, oracle

cross = jax.jit(
    james_stein.cross_regression, static_argnames=("window", "stride", "fall_back")
)


def halves_of(rng, size=(10, 11), extra=2):
    """x_a, x_b, y_a, y_b and other features of both, in float64."""
    images = rng.uniform(size=(4, *size, 3))
    return [jnp.asarray(i) for i in (*images, *rng.normal(size=(2, *size, extra)))]


def test_is_two_fits_that_fade_to_y(rng):
    xa, xb, ya, yb, fa, fb = map(np.asarray, halves_of(rng))
    bandwidth = 2 * 0.3 + 0.01
    found = cross(*map(jnp.asarray, (xa, xb, ya, yb, fa, fb)), window=5, kappa=0.3)
    for got, (x, guide, f) in zip(found, [(xa, yb, fb), (xb, ya, fa)], strict=True):
        basis = np.concatenate([guide, f], -1)
        prediction, weight = oracle([(x, gaussian(guide, bandwidth))], basis, window=5)
        w = weight[..., None]
        expected = (w * prediction + 0.1 * guide) / (w + 0.1)
        np.testing.assert_allclose(got, expected, rtol=1e-9)


def test_a_pixel_alone_keeps_its_radiance_at_any_stride():
    """Without a window of its own it gets what that would have predicted."""
    spot = jnp.zeros((8, 8, 1)).at[3, 4].set(100.0)
    none = jnp.zeros((8, 8, 0))
    for stride in (1, 2, 3):
        a, b = cross(
            2 * spot,
            spot,
            spot,
            spot,
            none,
            none,
            window=5,
            stride=stride,
            fall_back=0.0,
        )
        np.testing.assert_allclose(a, 2 * spot, atol=1e-9)
        np.testing.assert_allclose(b, spot, atol=1e-9)


@pytest.mark.parametrize("robust", [True, False])
def test_guide_noise(robust, rng):
    a, b = rng.normal(size=(2, 7, 7, 3))
    square = ((a - b) ** 2).sum(-1) / 2
    a[2, 3, 1] = np.nan
    square = np.delete(square.ravel(), 2 * 7 + 3)
    expected = np.median(square) if robust else square.mean()
    noise = lambda a, b: james_stein.guide_noise(a, b, robust=robust)
    found = jax.jit(noise)(jnp.asarray(a), jnp.asarray(b))
    np.testing.assert_allclose(found, expected, rtol=1e-12)
    gradient = jax.jit(jax.grad(noise))(jnp.asarray(a), jnp.asarray(b))
    assert np.isfinite(gradient).all()
    nothing = jnp.full((2, 2, 3), jnp.nan)
    assert noise(nothing, nothing) == 0


@pytest.mark.parametrize("stride", [1, 2])
def test_a_bad_pixel_stays_local(stride, rng):
    """It takes no part, and becomes the first finite of y and x."""
    good = halves_of(rng, (24, 24))
    options = {"window": 5, "stride": stride, "kappa": 0.1}
    total = lambda *i: sum(jnp.sum(c) for c in cross(*i, **options))
    gradient = jax.jit(jax.grad(total, argnums=tuple(range(6))))
    clean = cross(*good, **options)
    for which in range(6):
        images = list(good)
        images[which] = images[which].at[6, 7, 0].set(jnp.nan)
        a, b = cross(*images, **options)
        assert np.isfinite(a).all()
        assert np.isfinite(b).all()
        _, _, ya, yb, *_ = images
        hit, y, other = (a, yb, ya) if which in (0, 3, 5) else (b, ya, yb)
        expected = other if which in (2, 3) else y
        np.testing.assert_allclose(hit[6, 7], expected[6, 7], rtol=1e-12)
        np.testing.assert_allclose(a[14:, 14:], clean[0][14:, 14:], rtol=1e-12)
        assert all(np.isfinite(g).all() for g in gradient(*images))
        if which < 2:
            bare = cross(*images, **options, fall_back=0.0)
            np.testing.assert_allclose(bare[which][6, 7], expected[6, 7], rtol=1e-12)


def test_the_decision_has_derivatives_where_the_variance_is_zero(rng):
    *images, v = *halves_of(rng, (8, 8)), jnp.zeros((8, 8, 3))
    worth = lambda v: james_stein.worth_regressing(
        jax.random.key(0), *images, v, v, window=5, stride=1
    )
    change, slope = jax.jit(lambda v: jax.jvp(worth, (v,), (jnp.ones_like(v),)))(v)
    assert np.isfinite([*change, *slope]).all()


def test_gradients(rng):
    images = halves_of(rng, (5, 6), extra=1)
    regress = jax.jit(lambda *i: james_stein.cross_regression(*i, window=5, kappa=0.2))
    check_grads(regress, tuple(images), order=1, modes=["rev"], rtol=1e-5)


def test_the_estimated_change_is_unbiased(rng):
    """Against the true change, over many noises; y and the guide are denoised x."""
    size, runs = (14, 14), 400
    truth = jnp.asarray(rng.uniform(0.5, 1.5, (*size, 1)))
    variance = jnp.asarray(rng.uniform(0.005, 0.02, (*size, 1)))
    f = jnp.asarray(rng.normal(size=(*size, 1)))
    blur = lambda i: (i + jnp.roll(i, 1, 0) + jnp.roll(i, 1, 1)) / 3

    def run(key):
        keys = jax.random.split(key)
        noise = jax.random.normal(keys[0], (2, *size, 1), truth.dtype)
        a, b = truth[None] + jnp.sqrt(variance)[None] * noise
        images = a, b, blur(a), blur(b), f, f
        change = james_stein.worth_regressing(
            keys[1], *images, variance, variance, window=5, stride=1, epsilon=1.0
        )
        both = james_stein.cross_regression(*images, window=5)
        y = (blur(a) + blur(b)) / 2
        error = lambda i: jnp.square(i - truth)
        weight = jnp.square(y) + 1.0
        true = jnp.mean((error((both[0] + both[1]) / 2) - error(y)) / weight)
        return change.mean, true

    estimates, true = jax.jit(jax.vmap(run))(jax.random.split(jax.random.key(0), runs))
    assert abs(np.mean(true)) > 10 * np.std(estimates - true) / np.sqrt(runs)
    assert_mean(estimates - true, 0.0)


def test_constant_and_equal_features_leave_without_a_trace(rng):
    """The result is that of all features, to rounding."""
    images = halves_of(rng, (12, 13), extra=2)
    *four, fa, fb = images
    more = [
        jnp.concatenate([f, jnp.full_like(f[..., :1], 3.0), f[..., :1]], -1)
        for f in (fa, fb)
    ]
    needed = features.select(more)
    assert needed == ((0, 1), (2, 1))
    ridge = jnp.concatenate([jnp.full(3, 0.1), jnp.asarray(needed.ridge(0.1), float)])
    few = cross(*four, *(needed.of(f) for f in more), window=5, ridge=ridge)
    all_ = cross(*four, *more, window=5)
    np.testing.assert_allclose(few, all_, rtol=1e-6)  # float32 ridge


def test_features_of_a_frame():
    color = jnp.ones((2, 3, 4, 3))
    assert features.stack(make_frame(color)).shape == (3, 4, 0)
    depth = jnp.arange(12.0).reshape(3, 4, 1).at[0, 0].set(jnp.inf)
    full = features.stack(make_frame(color, depth=depth, albedo=jnp.ones((3, 4, 3))))
    assert full.shape == (3, 4, 4)
    assert jnp.max(full[1:, :, 3]) == 1
    missing = full.at[..., 1].set(jnp.nan)
    assert features.select([full, missing]).channels == (3,)
    one_differs = [jnp.ones((3, 4, 1)), jnp.arange(12.0).reshape(3, 4, 1)]
    assert features.select(one_differs).channels == (0,)


def textured(rng, noise):
    """A frame whose albedo explains its radiance, and a blurred image of it."""
    albedo = rng.uniform(0.2, 1, (40, 40, 3))
    a, b = albedo + noise * rng.normal(size=(2, 40, 40, 3))
    blurred = np.full((2, 40, 40, 3), albedo.mean()) + 0.01 * rng.normal(
        size=(2, 40, 40, 3)
    )
    frame = make_frame(
        np.stack([a, b]),
        variance=np.full((2, 40, 40, 3), noise**2),
        albedo=albedo,
        reference=albedo,
    )
    return frame.with_estimate(
        "blurred", Estimate(blurred.mean(0), jnp.asarray(blurred))
    )


def regress(frame, name="blurred", *, window=9):
    """One of a frame's estimates."""
    y = frame.estimates[name]
    return james_stein.regress(jax.random.key(0), frame, y, window=window)


def test_regresses_where_features_explain_the_radiance(rng):
    frame = textured(rng, 0.1).normalised()
    done = regress(frame)
    assert done.ran
    error = lambda image: float(jnp.mean((image - frame.reference.image) ** 2))
    old, new = error(frame.estimates["blurred"].image), error(done.estimate.image)
    assert new < 0.2 * old
    assert done.estimate.halves.shape == (2, 40, 40, 3)


def test_leaves_a_perfect_image_alone(rng):
    frame = textured(rng, 0.3)
    truth = frame.reference.image
    frame = frame.with_estimate("truth", Estimate(truth, jnp.stack([truth, truth])))
    frame = frame.normalised()
    done = regress(frame, "truth")
    assert not done.ran
    assert done.estimate is frame.estimates["truth"]
    assert done.change.mean > 0


def test_regress_is_scale_equivariant(rng):
    frame = textured(rng, 0.1)
    one = regress(frame.normalised())
    for scale in (1e-4, 1e5):
        other = regress(frame.scaled(scale).normalised())
        np.testing.assert_allclose(other.estimate.image, one.estimate.image, rtol=1e-8)
        np.testing.assert_allclose(other.change.mean, one.change.mean, rtol=1e-6)


def test_regress_with_few_features_and_narrow_windows(rng):
    frame = textured(rng, 0.1)
    bare = frame._replace(buffers=frame.buffers._replace(albedo=None))
    done = regress(bare.normalised(), window=3)
    assert np.isfinite(done.change.mean)


def test_regress_without_given_variance(rng):
    frame = textured(rng, 0.1)
    frame = frame._replace(buffers=frame.buffers._replace(variance=None))
    assert regress(frame.normalised()).ran


@pytest.mark.usefixtures("unchecked")
def test_bad_input(rng):
    images = halves_of(rng)
    with pytest.raises(ValueError, match="biased_b has shape"):
        james_stein.cross_regression(*images[:3], images[3][:5], *images[4:])
    with pytest.raises(ValueError, match=r"features_b has shape \(10, 11, 1\)"):
        james_stein.cross_regression(*images[:5], images[5][..., :1])
    with pytest.raises(ValueError, match=r"features_b has shape \(9, 11, 2\)"):
        james_stein.worth_regressing(
            jax.random.key(0), *images[:5], images[5][:9], *images[:2]
        )
    frame = textured(rng, 0.1)
    with pytest.raises(ValueError, match=r"regress needs a normalised frame: call"):
        regress(frame)
    without = frame.with_estimate("blurred", frame.color).normalised()
    with pytest.raises(ValueError, match=r"regress needs an estimate with halves"):
        regress(without)
    with pytest.raises(ValueError, match=r"regress needs half buffers: render at le"):
        regress(frame.merged(1).normalised())
