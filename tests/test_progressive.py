"""Progressive denoising: mixing, activation, bound."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.scipy.special import ndtr
from jax.test_util import check_grads

from jscomb import exr, progressive
from jscomb.denoisers import oidn, smoothing
from jscomb.frame import make_frame
from jscomb.metrics import rel_l2
from jscomb.numerics import sure
from tests.conftest import DATA
from tests.statistics import assert_mean, assert_mean_below

_RNG = np.random.default_rng(6)
SHAPE = 12, 13, 3
X, Y = (jnp.asarray(i) for i in _RNG.uniform(0.5, 1.5, (2, *SHAPE)))
V = jnp.asarray(_RNG.uniform(0.001, 0.01, SHAPE))
S = jnp.asarray(_RNG.normal(0, 0.2, SHAPE))
combine = jax.jit(progressive.combine, static_argnames=("mix", "bound"))
bound_mixing = jax.jit(progressive.bound_mixing, static_argnames="window")


def test_both_equations_are_one_choice():
    """Eq. 9 of the window, and one minus eq. 10, with D from SURE."""
    square = (Y - X) ** 2
    divergence = (S - square + V) / 2
    around = lambda image: smoothing.box(image, window=5)  # means, whose ratios count
    alpha = around(V - divergence) / around(square)
    beta = around(S - divergence) / around(square)
    np.testing.assert_allclose(alpha + beta, 1, rtol=1e-10)
    found = progressive.mixing(X, Y, V, S, window=5)
    np.testing.assert_allclose(found, jnp.clip(alpha, 0, 1), atol=1e-12)
    assert 0 < float(jnp.mean((found > 0) & (found < 1))) < 1


def test_mixing_has_the_least_risk():
    """With many realisations no constant mixture is better than the rule's."""
    truth = jnp.asarray(1 + np.add.outer(np.arange(16), np.arange(16))[..., None] / 16)
    noise = 0.15
    blur = lambda x: smoothing.box(x, window=7)

    @jax.jit
    def one(key):
        a, b = jax.random.split(key)
        x = truth + noise * jax.random.normal(a, truth.shape, truth.dtype)
        v = jnp.full_like(x, noise**2)
        risk = sure.monte_carlo_sure(b, blur, x, v)
        z = progressive.combine(x, risk.denoised, v, risk.squared_error, bound=False)
        error = lambda image: jnp.mean((image - truth) ** 2)
        return error(z), error(x), error(risk.denoised)

    z, x, y = jax.lax.map(one, jax.random.split(jax.random.key(0), 400), batch_size=50)
    assert_mean_below(z - x, 0)
    assert_mean_below(z - y, 0)


def test_risk_is_unbiased_for_a_fixed_mixing(rng):
    truth = jnp.asarray(1 + np.add.outer(np.arange(9), np.arange(9))[..., None] / 9)
    alpha = jnp.asarray(rng.uniform(size=truth.shape))
    blur = lambda x: smoothing.box(x, window=3)

    @jax.jit
    def excess(key):
        a, b = jax.random.split(key)
        x = truth + 0.2 * jax.random.normal(a, truth.shape, truth.dtype)
        v = jnp.full_like(x, 0.04)
        y, s, _ = sure.monte_carlo_sure(b, blur, x, v)
        z = x + alpha * (y - x)
        estimate = progressive.risk(alpha, x, y, v, s)
        return jnp.mean(estimate - (z - truth) ** 2)

    keys = jax.random.split(jax.random.key(0), 5000)
    assert_mean(jax.lax.map(excess, keys, batch_size=500), 0)


def bound_by_loops(alpha, x, y, v, *, window, strength, shift):
    """Eq. 12 to 18, every window by itself."""
    height, width, channels = x.shape
    z = (x + alpha * (y - x)).mean(-1)
    noise, x = v.sum(-1) / channels**2, x.mean(-1)
    relative = np.sqrt(noise.mean()) / abs(x).mean()
    sigma = np.clip(100 * relative, 1e-3, 100)
    out = np.zeros_like(np.asarray(alpha))
    for place in np.ndindex(height, width):
        near = [
            q
            for q in np.ndindex(height, width)
            if max(abs(q[0] - place[0]), abs(q[1] - place[1])) <= window // 2
        ]
        largest = max(near, key=lambda q: noise[q])
        x_bar, z_bar, variance = x[largest], z[largest], noise[largest]
        for q in near:
            square = (q[0] - place[0]) ** 2 + (q[1] - place[1]) ** 2
            k = np.exp(-square / (2 * sigma**2)) / (sigma * np.sqrt(2 * np.pi))
            x_bar, z_bar = x_bar + k * x[q], z_bar + k * z[q]
            variance += k**2 * noise[q]
        t = abs(z_bar - x_bar) / np.sqrt(variance)
        out[place] = alpha[place] * float(ndtr(strength * (shift - t)))
    return out


@pytest.mark.parametrize("scale", [1.0, 100.0])
def test_widths_of_the_bound(scale):
    """PD eq. 15 by both readings of its words, and relative to the radiance."""
    x, v = scale * X, scale**2 * 1e-4 * V
    noise, radiance = np.asarray(v).sum(-1) / X.shape[-1] ** 2, np.asarray(x).mean(-1)
    paper = lambda variance: 100 * min(np.sqrt(variance), 1)
    expected = {
        "absolute": paper(noise.mean()),
        "image mean": paper(noise.sum() / noise.size**2),
        "relative": paper(noise.mean() / abs(radiance).mean() ** 2),
    }
    for width, sigma in expected.items():
        found = progressive.bound_sigma(x, v, width=width)
        np.testing.assert_allclose(found, max(sigma, 1e-3), rtol=1e-6)


def test_the_noise_of_a_single_buffer_is_taken_as_grey():
    """What nothing tells apart; with half buffers `channel_variance` tells."""
    frame = make_frame(X, variance=V).normalised()
    same = lambda color, frame: color
    found = progressive.neural_inputs(jax.random.key(0), same, frame)
    expected = np.square(np.sqrt(found["variance"]).mean(-1, keepdims=True))
    np.testing.assert_allclose(found["noise"], expected, rtol=1e-6)


@pytest.mark.parametrize("noise", [1e-6, 1e-4, 1.0])
def test_bound_is_the_loops(noise, rng):
    alpha = jnp.asarray(rng.uniform(size=SHAPE))
    y = X + np.sqrt(noise) * (Y - X)
    options = {"window": 5, "strength": 2.0, "shift": 4.2}
    expected = bound_by_loops(
        *(np.asarray(i) for i in (alpha, X, y, noise * V)), **options
    )
    for dtype, tolerance in ((jnp.float64, 1e-9), (jnp.float32, 2e-3)):
        arrays = [i.astype(dtype) for i in (alpha, X, y, noise * V)]
        found = bound_mixing(*arrays, window=5)
        np.testing.assert_allclose(found, expected, atol=tolerance)


@pytest.mark.parametrize("bias", [0.0, 0.05])
def test_the_bound_is_consistent(bias, rng):
    """As samples grow a biased denoiser loses its share, an unbiased one keeps it."""
    shares = []
    for variance in (1e-1, 1e-3, 1e-5, 1e-7):
        noise = np.sqrt(variance) * rng.normal(size=(2, 24, 24, 3))
        x, y = (
            1 + jnp.asarray(n) for n in noise * np.array([1, 0.1])[:, None, None, None]
        )
        v = jnp.full_like(x, variance)
        shares.append(float(bound_mixing(jnp.ones_like(x), x, y + bias, v).mean()))
    assert shares[0] > 0.95
    if bias:
        assert shares[-1] < 1e-6
    else:
        assert min(shares) > 0.95


def test_the_variance_of_the_channels_mean(rng):
    """Right for independent channels, for grey noise, and in between."""
    shape = 2, 64, 64, 3
    own, grey = rng.normal(size=shape), rng.normal(size=(*shape[:3], 1))
    for part in (0.0, 0.6, 1.0):
        noise = jnp.asarray((1 - part**2) ** 0.5 * own + part * grey)
        v = jnp.full(shape[1:], 0.5)  # of the mean of two of variance one
        found = progressive.channel_variance(*noise, v)
        expected = 0.5 * ((1 - part**2) / 3 + part**2)
        np.testing.assert_allclose(found.mean(), expected, rtol=0.05)
    same = progressive.channel_variance(X, X, V)  # no difference to learn from
    np.testing.assert_allclose(same, V.mean(-1, keepdims=True), rtol=1e-12)


def test_the_bound_knows_correlated_channels(rng):
    """What grey noise explains is not bounded; by the paper's third it would be."""
    variance, shape = 1e-4, (32, 32, 3)
    grey = 1 + variance**0.5 * jnp.asarray(rng.normal(size=(2, 32, 32, 1)))
    x, y = (
        jnp.broadcast_to(i, shape) for i in (grey[0], grey[0].mean()[None, None, None])
    )
    v, one = jnp.full(shape, variance), jnp.ones(shape)
    noise = v[..., :1]
    known = bound_mixing(one, x, y, v, noise=noise)
    assert known.mean() > 0.95
    assert bound_mixing(one, x, y, v).mean() < known.mean()


def test_the_bound_of_crops_is_that_of_the_image(rng):
    """With the image's sigma."""
    alpha = jnp.asarray(rng.uniform(size=(24, 13, 3)))
    x, y = (jnp.asarray(i) for i in rng.uniform(0.5, 1.5, (2, 24, 13, 3)))
    v = jnp.asarray(rng.uniform(1e-5, 1e-2, (24, 13, 3)))
    whole = bound_mixing(alpha, x, y, v, window=5)
    sigma = progressive.bound_sigma(x, v)
    crop = bound_mixing(*(i[:16] for i in (alpha, x, y, v)), sigma=sigma, window=5)
    np.testing.assert_allclose(crop[:13], whole[:13], rtol=1e-12)


def test_activation(rng):
    outputs = jnp.asarray(rng.normal(size=(3, 4, 3, 2)))
    found = progressive.activation(outputs)
    one, two, three = np.moveaxis(np.asarray(outputs), 2, 0)
    expected = np.clip((one - two) / np.maximum(three, 1e-6), 0, 1)
    np.testing.assert_allclose(found, expected)
    free = progressive.activation(outputs, limit=False)
    np.testing.assert_allclose(free, (one - two) / np.maximum(three, 1e-6))
    direct = progressive.direct_activation(outputs)
    share = 1 / (1 + np.exp(-one))
    np.testing.assert_allclose(direct, np.clip(1.04 * share - 0.02, 0, 1))
    smooth = progressive.direct_activation(outputs, limit=False)
    np.testing.assert_allclose(smooth, share)
    ends = jnp.array([-9.0, 9.0]).reshape(1, 2, 1, 1) + jnp.zeros((1, 2, 3, 1))
    np.testing.assert_array_equal(progressive.direct_activation(ends).ravel(), [0, 1])


def test_a_network_may_mix():
    half = lambda x, y, v, s: jnp.full_like(x, 0.5)
    z = progressive.combine(X, Y, V, S, mix=half, bound=False)
    np.testing.assert_allclose(z, (X + Y) / 2)


def test_certain_pixels_are_kept():
    """Without any variance the bound keeps x; where both agree nothing is moved."""
    zero = jnp.zeros_like(X)
    np.testing.assert_array_equal(combine(X, Y, zero, -jnp.ones_like(X)), X)
    np.testing.assert_array_equal(combine(X, X, V, S), X)
    total = lambda *i: progressive.combine(*i).sum()
    for v, y in ((zero, Y), (V, X), (zero, X)):
        for gradient in jax.jit(jax.grad(total, argnums=(0, 1, 2, 3)))(X, y, v, S):
            assert np.isfinite(gradient).all()


@pytest.mark.parametrize("firefly", [1.0, 1e6])
def test_whitened_stays_finite_however_certain_a_pixel(firefly):
    """In float32: without the cap 1e12 / 1e-30 would be infinite, and the ratio NaN."""
    x, y, v = (i.astype(jnp.float32) for i in (X, Y, V))
    x, v = x.at[4, 5].set(firefly), v.at[4, 5].set(1e-30).at[9, 9].set(0.0)
    s = (y - x) ** 2 - v
    run = lambda *i: progressive.mixing(*i, window=5, whiten=True)
    alpha = jax.jit(run)(x, y, v, s)
    assert ((alpha >= 0) & (alpha <= 1)).all()
    assert (alpha[2:7, 3:8] < 1e-3).all()  # the certain pixel decides for its windows
    total = lambda *i: jnp.sum(run(*i) * X.astype(jnp.float32))
    for gradient in jax.jit(jax.grad(total, argnums=(0, 1, 2, 3)))(x, y, v, s):
        assert np.isfinite(gradient).all()


def test_gradients():
    y = X + 0.2 * (Y - X)
    small = lambda *images: [i[:6, :7] for i in images]
    s = 0.2 * (y - X) ** 2  # so that mixing is strictly between its limits
    run = lambda *i: progressive.combine(*i)
    check_grads(jax.jit(run), small(X, y, V, s), 1, modes=["rev"], rtol=1e-4)


@pytest.mark.usefixtures("unchecked")
def test_bad_input():
    with pytest.raises(ValueError, match="sure has shape"):
        progressive.combine(X, Y, V, S[1:])
    with pytest.raises(ValueError, match="window must be odd"):
        progressive.mixing(X, Y, V, S, window=4)


@pytest.mark.skipif(not oidn.available(), reason="needs Open Image Denoise")
@pytest.mark.parametrize("samples", [64, 1024])
def test_mixing_lowers_a_real_frames_error(samples):
    """Against the denoised image, and against path tracing."""
    frame = exr.read_frame(DATA / f"cornell-glass-{samples}.exr").normalised()
    mixed = progressive.combine_frame(jax.random.key(1), oidn.denoise_color, frame)
    reference, difference = frame.reference
    error = lambda image: rel_l2(image, reference, half_difference=difference)
    assert error(mixed.image) < error(oidn.denoise_frame(frame).image)
    assert error(mixed.image) < error(frame.color)
