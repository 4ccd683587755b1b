"""Stein's unbiased risk estimate."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from jscomb.denoisers import bilateral, smoothing
from jscomb.numerics import sure
from tests.statistics import assert_mean

_RNG = np.random.default_rng(5)
SHAPE = 8, 9, 2
TRUTH = jnp.asarray(1 + np.add.outer(np.arange(8), np.arange(9))[..., None] / [8, 16])
VARIANCE = jnp.asarray(_RNG.uniform(0.05, 0.2, SHAPE))
FEATURES = jnp.asarray(_RNG.uniform(size=(8, 9, 1)))
WEIGHTS = [0.3 * jnp.asarray(_RNG.normal(size=s)) for s in ((3, 3, 2, 4), (3, 3, 4, 2))]


def linear(x):
    """A filter whose Jacobian is a matrix."""
    return smoothing.gaussian(x, sigma=1.0)


def cross(x):
    """A filter whose weights depend on the image."""
    return bilateral.denoise(x, VARIANCE, FEATURES, window=5, sigma=2.0)


def network(x):
    """Two convolutions with a smooth activation between them."""
    for k, w in enumerate(WEIGHTS):
        x = jax.lax.conv_general_dilated(
            x[None],
            w.astype(x.dtype),
            (1, 1),
            "SAME",
            dimension_numbers=("NHWC", "HWIO", "NHWC"),
        )[0]
        x = x if k else jnp.tanh(x)
    return x


DENOISERS = {"linear": linear, "bilateral": cross, "network": network}
CALLS = 20000


@pytest.mark.parametrize(
    ("name", "probe"),
    [*((name, "rademacher") for name in DENOISERS), ("network", "gaussian")],
)
def test_unbiased(name, probe):
    """For the true squared error: of single elements, and of the mean."""
    denoise = DENOISERS[name]

    @jax.jit
    def one(key):
        noise, probes = jax.random.split(key)
        x = TRUTH + jnp.sqrt(VARIANCE) * jax.random.normal(noise, SHAPE, TRUTH.dtype)
        risk = sure.monte_carlo_sure(probes, denoise, x, VARIANCE, probe=probe)
        return risk.squared_error - jnp.square(risk.denoised - TRUTH)

    keys = jax.random.split(jax.random.key(1), CALLS)
    excess = np.asarray(jax.lax.map(one, keys, batch_size=500))
    assert_mean(excess.mean(axis=(1, 2, 3)), 0)
    for place in ((0, 0, 0), (4, 5, 1), (7, 8, 0)):
        assert_mean(excess[:, *place], 0)


@pytest.mark.parametrize("name", ["linear", "network"])
def test_probes_average_to_the_exact_divergence(name):
    """Four of them with half the spread of one."""
    denoise = DENOISERS[name]
    exact = jax.jit(lambda x: sure.exact_sure(denoise, x, VARIANCE))(TRUTH)
    spread = []
    for probes in (1, 4):
        run = jax.jit(
            lambda key, n=probes: sure.monte_carlo_sure(
                key, denoise, TRUTH, VARIANCE, probes=n
            )
        )
        keys = jax.random.split(jax.random.key(probes), 1000)
        found = jax.jit(lambda keys, run=run: jax.lax.map(run, keys))(keys)
        excess = np.asarray(found.divergence) - np.asarray(exact.divergence)
        excess = excess.mean(axis=(1, 2, 3))
        assert_mean(excess, 0)
        spread.append(excess.std())
        np.testing.assert_allclose(found.denoised[0], exact.denoised, rtol=1e-12)
    assert abs(spread[1] / spread[0] - 0.5) < 5 * 0.5 / 1000**0.5


def test_divergence_of_a_linear_filter_is_its_matrix():
    matrix = jax.jit(jax.jacfwd(linear))(TRUTH).reshape(TRUTH.size, TRUTH.size)
    found = jax.jit(lambda x: sure.exact_sure(linear, x, VARIANCE))(TRUTH)
    expected = jnp.diag(matrix).reshape(SHAPE) * VARIANCE
    np.testing.assert_allclose(found.divergence, expected, rtol=1e-12)
    error = (linear(TRUTH) - TRUTH) ** 2 + 2 * expected - VARIANCE
    np.testing.assert_allclose(found.squared_error, error, atol=1e-12)


def test_exact_for_pointwise_denoisers_with_one_sign():
    """Where each output depends on its own pixel alone, one Rademacher probe is all."""
    pointwise = lambda x: jnp.tanh(x) + x**2
    slope = 1 - jnp.tanh(TRUTH) ** 2 + 2 * TRUTH
    risk = sure.monte_carlo_sure(jax.random.key(3), pointwise, TRUTH, VARIANCE)
    np.testing.assert_allclose(risk.divergence, slope * VARIANCE, rtol=1e-12)
    other = sure.monte_carlo_sure(
        jax.random.key(3), pointwise, TRUTH, VARIANCE, probe="gaussian"
    )
    assert abs(other.divergence - slope * VARIANCE).max() > 0.1


def test_float32_keeps_the_digits_that_a_difference_loses():
    """On pixels of 1e-3 and 1e4, pointwise, so that the truth is known."""
    x = jnp.asarray(np.geomspace(1e-3, 1e4, 64).reshape(8, 8, 1), jnp.float32)
    v = (0.01 * x) ** 2
    f = lambda x: x / (1 + 1e-3 * x)
    exact = v / (1 + 1e-3 * x) ** 2
    risk = sure.monte_carlo_sure(jax.random.key(4), f, x, v)
    assert risk.divergence.dtype == jnp.float32
    np.testing.assert_allclose(risk.divergence, exact, rtol=1e-5)
    b = jnp.sqrt(v) * jax.random.rademacher(jax.random.key(4), x.shape, x.dtype)
    difference = b * (f(x + 1e-4 * b) - f(x)) / 1e-4
    assert jnp.median(abs(difference / exact - 1)) > 0.01


def test_no_variance_no_divergence():
    """Then the estimate is the squared distance itself; gradients stay finite."""
    v = VARIANCE.at[2:5].set(0.0)
    key = lambda: jax.random.key(0)
    risk = sure.monte_carlo_sure(key(), lambda x: x / 2, TRUTH, v)
    np.testing.assert_allclose(risk.squared_error[2:5], (TRUTH[2:5] / 2) ** 2)
    total = lambda x, v: jnp.sum(
        sure.monte_carlo_sure(key(), cross, x, v).squared_error
    )
    for gradient in jax.jit(jax.grad(total, argnums=(0, 1)))(TRUTH, v):
        assert np.isfinite(gradient).all()


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_scale_equivariant(scale):
    x, v = (i.astype(jnp.float32) for i in (TRUTH, VARIANCE))
    run = jax.jit(lambda x, v: sure.monte_carlo_sure(jax.random.key(0), linear, x, v))
    one, other = run(x, v), run(scale * x, scale**2 * v)
    np.testing.assert_allclose(
        other.squared_error / scale**2, one.squared_error, 2e-3, 1e-6
    )
    np.testing.assert_allclose(other.divergence / scale**2, one.divergence, 1e-4, 1e-6)


def test_bad_pixels_stay_where_they_are():
    x = TRUTH.at[1, 2, 0].set(jnp.nan).at[6, 6, 1].set(jnp.inf)
    v = VARIANCE.at[4, 4, 0].set(jnp.nan)
    bad = np.zeros(SHAPE[:2], bool)
    for place in ((1, 2), (6, 6), (4, 4)):
        bad[place] = True
    key = lambda: jax.random.key(0)
    risk = sure.monte_carlo_sure(key(), linear, x, v)
    for image in risk:
        assert np.isfinite(image).all()
    assert not risk.squared_error[bad].any()
    clean = sure.monte_carlo_sure(key(), linear, TRUTH, VARIANCE)
    far = np.ones(SHAPE[:2], bool)
    for y, x_ in np.argwhere(bad):
        far[max(0, y - 3) : y + 4, max(0, x_ - 3) : x_ + 4] = False
    np.testing.assert_allclose(risk.squared_error[far], clean.squared_error[far])
    near = sure.pooled(risk, x, v, window=3)
    assert np.isfinite(near.squared_error).all()
    one = (slice(0, 3), slice(1, 4))
    mean = risk.squared_error[one].sum(axis=(0, 1)) / 8
    np.testing.assert_allclose(near.squared_error[1, 2], mean)


def test_gradients():
    """Through the estimate, as training a denoiser by it wants."""
    run = lambda x, v: sure.monte_carlo_sure(jax.random.key(0), network, x, v)
    check_grads(jax.jit(run), (TRUTH[:5, :5], VARIANCE[:5, :5]), 1, modes=["rev"])


@pytest.mark.usefixtures("unchecked")
def test_bad_input():
    def run(denoise=linear, v=VARIANCE, **options):
        return sure.monte_carlo_sure(jax.random.key(0), denoise, TRUTH, v, **options)

    with pytest.raises(
        ValueError, match=r"made \(4, 5, 2\) of an image of \(8, 9, 2\)"
    ):
        run(lambda x: x[::2, ::2])
    with pytest.raises(ValueError, match="variance must be at least zero, its minimum"):
        run(v=VARIANCE - 0.1)
    with pytest.raises(ValueError, match="variance has shape"):
        run(v=VARIANCE[1:])
    with pytest.raises(ValueError, match="probes must be positive, got 0"):
        run(probes=0)
    with pytest.raises(ValueError, match="slope_limit must be positive, got 0"):
        run(slope_limit=0.0)
    with pytest.raises(ValueError, match="probe must be one of"):
        run(probe="cauchy")


def test_slopes_beyond_the_limit_are_not_believed():
    """Where they are within, nothing changes."""
    x = jnp.array([1.0, 1.0, 1.0]).reshape(1, 3, 1)
    v = jnp.array([4.0, 4.0, jnp.nan]).reshape(1, 3, 1)
    steep = lambda image: jnp.array([[[0.5], [-30.0], [7.0]]]) * image
    run = lambda limit: sure.monte_carlo_sure(
        jax.random.key(0), steep, x, v, slope_limit=limit
    )
    np.testing.assert_allclose(run(None).divergence.ravel(), [2.0, -120.0, 0.0])
    np.testing.assert_allclose(run(1.0).divergence.ravel(), [2.0, -4.0, 0.0])
    np.testing.assert_allclose(
        run(1.0).squared_error.ravel(), [0.25 + 4 - 4, 31.0**2 - 8 - 4, 0.0]
    )
