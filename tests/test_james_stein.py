"""James-Stein: its definition by loops, its theorems by standard errors, its limits."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from jscomb import james_stein
from jscomb.frame import Estimate, make_frame
from jscomb.numerics import sure
from tests.statistics import assert_mean, assert_mean_below
from tests.test_windows import near

SHAPES = [(6, 5, 2), (1, 1, 1), (1, 9, 3), (12, 3, 1)]
BOTH = pytest.mark.parametrize("whiten", [False, True])
combine = jax.jit(james_stein.combine, static_argnames=("window", "whiten"))
risk = jax.jit(james_stein.risk, static_argnames="window")


def finite(*images):
    """Pixels that are finite in all images, [H,W]."""
    return np.all([np.isfinite(i).all(axis=-1) for i in images], axis=0)


def oracle(x, y, v, window, whiten, divergence=None):
    """The definition, pixel by pixel, in NumPy float64."""
    x, y, v = (np.asarray(i, np.float64) for i in (x, y, v))
    in_common = np.zeros_like(x) if divergence is None else np.asarray(divergence)
    missing = 2 if divergence is None else 0
    valid = finite(x, y, v)
    share = np.full_like(x, np.nan)
    for i, j, c in np.ndindex(*x.shape):
        if not valid[i, j]:
            continue
        at = near(i, j, x.shape, window)
        members = valid[at]
        square = (x[at] - y[at])[members, c] ** 2
        variance, common = v[at][members, c], in_common[at][members, c]
        if whiten:
            counted = variance > 0
            p, energy = counted.sum(), np.sum(square[counted] / variance[counted])
            common = np.sum(common[counted] / variance[counted])
            noise = max(p - missing - common, 0)
        else:
            p, energy = members.sum(), square.sum()
            noise = max((p - missing) * v[i, j, c] - common.sum(), 0)
        lost = (1.0 if energy <= 0 else min(1.0, noise / energy)) if noise > 0 else 0.0
        share[i, j, c] = 1 - lost
    out = np.where(finite(y)[..., None], y, np.where(finite(x)[..., None], x, 0))
    for i, j, c in np.ndindex(*x.shape):
        if valid[i, j]:
            mean = np.nanmean(share[(*near(i, j, x.shape, window), c)])
            out[i, j, c] = y[i, j, c] + mean * (x[i, j, c] - y[i, j, c])
    return out


def images(shape, seed=0):
    """x, y and a variance of several decades."""
    x, y, v = np.random.default_rng(seed).normal(size=(3, *shape))
    return tuple(map(jnp.asarray, (x, y, 0.3 * np.exp(v))))


@BOTH
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("window", [3, 5, 15])
def test_matches_the_definition(shape, window, whiten):
    data = images(shape)
    expected = oracle(*data, window, whiten)
    functions = (combine, james_stein.combine) if shape == SHAPES[0] else (combine,)
    for function in functions:
        found = function(*data, window=window, whiten=whiten)
        np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-15)


@BOTH
def test_matches_the_definition_with_a_divergence(whiten):
    x, y, v = images((9, 8, 2))
    divergence = v * jax.random.uniform(jax.random.key(9), v.shape, minval=-1, maxval=2)
    x, v = x.at[2, 3, 1].set(np.nan), v.at[5].set(0.0)
    expected = oracle(x, y, v, 5, whiten, divergence)
    found = combine(x, y, v, window=5, whiten=whiten, divergence=divergence)
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-15)


@BOTH
def test_the_divergence_mends_what_a_denoiser_costs(whiten):
    """A y that is half x, half wrong: taken as independent of x, too much is used."""
    truth = jnp.asarray(1 + np.add.outer(np.arange(20), np.arange(20))[..., None] / 9)
    denoise = lambda x: (x + truth + 0.5) / 2

    @jax.jit
    def one(key):
        a, b = jax.random.split(key)
        x = truth + 0.3 * jax.random.normal(a, truth.shape, truth.dtype)
        v = jnp.full_like(x, 0.09)
        y, _, divergence = sure.monte_carlo_sure(b, denoise, x, v)
        run = lambda **options: james_stein.combine(x, y, v, whiten=whiten, **options)
        error = lambda image: jnp.mean((image - truth) ** 2)
        return error(run(divergence=divergence)), error(run()), error(x), error(y)

    found = jax.lax.map(one, jax.random.split(jax.random.key(0), 500), batch_size=50)
    corrected, *others = found
    for other in others:
        assert_mean_below(corrected - other, 0)


@BOTH
def test_an_image_that_is_the_rendering_keeps_its_noise(whiten):
    """A denoiser that does nothing has the whole variance in common."""
    x, y, v = images((6, 7, 2))
    found = combine(x, y, v, window=3, whiten=whiten, divergence=v)
    if whiten:
        np.testing.assert_allclose(found, x, rtol=1e-12)
    same = combine(x, x, v, window=3, whiten=whiten, divergence=v)
    np.testing.assert_allclose(same, x, rtol=1e-12)


@BOTH
def test_gradients_with_a_divergence(whiten):
    x, y, v = images((5, 6, 1))
    run = lambda *i: james_stein.combine(
        *i[:3], window=3, whiten=whiten, divergence=i[3]
    )
    check_grads(jax.jit(run), (x, y, v, v / 3), order=1, modes=["rev"])


@BOTH
def test_matches_the_definition_on_a_real_frame(real_frame, whiten):
    """In float32, where radiance and variance span eight decades."""
    frame = real_frame
    data = frame.color, frame.estimates["oidn"].image, frame.variance
    assert data[0].dtype == jnp.float32
    result = combine(*data, whiten=whiten)
    np.testing.assert_allclose(result, oracle(*data, 15, whiten), rtol=2e-5, atol=1e-7)


# One window that holds the whole image is the theorem's own setting: p = 49.
ONE_WINDOW = (7, 7, 1)
REALISATIONS = 20_000


def errors(
    key, bias, deviation, *, window, whiten, shape=ONE_WINDOW, count=REALISATIONS
):
    """Squared errors of each realisation, [n,*shape]: of x, and of the combination."""
    truth = jnp.sin(jnp.arange(float(np.prod(shape)))).reshape(shape)

    def one(key):
        x = truth + deviation * jax.random.normal(key, shape)
        variance = jnp.broadcast_to(deviation**2, shape)
        y = truth + bias
        out = james_stein.combine(x, y, variance, window=window, whiten=whiten)
        return jnp.square(x - truth), jnp.square(out - truth)

    return jax.jit(jax.vmap(one))(jax.random.split(key, count))


@pytest.mark.parametrize("bias", [0.0, 0.3, 1.0, 10.0])
def test_dominates_the_unbiased_image(bias):
    """Equal variances: lower risk than x whatever the bias (NJS eq. 9)."""
    sigma = jnp.asarray(0.5)
    x, out = errors(jax.random.key(1), bias, sigma, window=15, whiten=False)
    assert_mean_below(jnp.sum(out - x, axis=(1, 2, 3)), 0.0)


@pytest.mark.parametrize("bias", [0.0, 0.3, 1.0, 10.0])
def test_whitened_dominates_under_unequal_variances(bias):
    """Risk in units of the variance: lower than that of x whatever the bias."""
    sigma = jnp.geomspace(0.05, 2.0, 49).reshape(ONE_WINDOW)
    x, out = errors(jax.random.key(2), bias, sigma, window=15, whiten=True)
    assert_mean_below(jnp.sum((out - x) / sigma[None] ** 2, axis=(1, 2, 3)), 0.0)


def test_whitened_does_not_dominate_in_squared_error():
    """One pixel of variance 1e4 and y off by 300 there: six times the error of x."""
    sigma = jnp.ones(ONE_WINDOW).at[3, 3].set(100.0)
    bias = jnp.zeros(ONE_WINDOW).at[3, 3].set(300.0)
    options = {"window": 15, "whiten": True, "count": 4000}
    x, out = errors(jax.random.key(2), bias, sigma, **options)
    assert_mean_below(jnp.sum((out - x) / sigma[None] ** 2, axis=(1, 2, 3)), 0.0)
    assert_mean_below(jnp.sum(5 * x - out, axis=(1, 2, 3)), 0.0)


@BOTH
def test_a_pixel_may_lose_where_its_window_gains(whiten):
    """Equal variances, y off at one pixel: an error that weighs it most is larger."""
    bias = jnp.zeros(ONE_WINDOW).at[3, 3].set(2.0)
    options = {"window": 15, "whiten": whiten, "count": 4000}
    x, out = errors(jax.random.key(2), bias, jnp.asarray(0.5), **options)
    assert_mean_below(jnp.sum(out - x, axis=(1, 2, 3)), 0.0)
    assert_mean_below((2 * x - out)[:, 3, 3, 0], 0.0)


@BOTH
def test_a_dark_pixel_beside_a_light_may_lose_in_relative_error(whiten):
    """The light is noisy, and y spreads it: the plain error falls, the other rises."""
    truth = jnp.full(ONE_WINDOW, 0.1).at[3, 3].set(100.0)
    sigma, y = truth / 5, jnp.full(ONE_WINDOW, 2.0).at[3, 3].set(100.0)
    pooled = jnp.broadcast_to(jnp.mean(sigma**2), ONE_WINDOW)  # as robust ones are

    def one(key):
        x = truth + sigma * jax.random.normal(key, ONE_WINDOW)
        out = james_stein.combine(x, y, pooled, window=15, whiten=whiten)
        return jnp.square(x - truth), jnp.square(out - truth)

    x, out = jax.jit(jax.vmap(one))(jax.random.split(jax.random.key(0), 4000))
    assert_mean_below(jnp.sum(out - x, axis=(1, 2, 3)), 0.0)
    relative = jnp.square(truth[None]) + 0.01
    assert_mean_below(jnp.sum((10 * x - out) / relative, axis=(1, 2, 3)), 0.0)


@pytest.mark.parametrize("bias", [0.0, 0.3, 3.0])
@BOTH
def test_dominates_when_windows_overlap(bias, whiten):
    shape, sigma = (24, 24, 1), jnp.asarray(0.5)
    options = {"window": 7, "whiten": whiten, "shape": shape, "count": 2000}
    x, out = errors(jax.random.key(3), bias, sigma, **options)
    assert_mean_below(jnp.mean(out - x, axis=(1, 2, 3)), 0.0)


@pytest.mark.parametrize("bias", [0.0, 0.2, 0.5, 5.0])
def test_risk_is_unbiased(bias):
    """Its mean is the true squared error, at every share between 0 and 1."""
    truth, sigma = jnp.zeros(ONE_WINDOW), 0.5
    v = jnp.full(ONE_WINDOW, sigma**2)

    def excess(key):
        x = truth + sigma * jax.random.normal(key, ONE_WINDOW)
        out = james_stein.combine(x, truth + bias, v, window=15)
        estimate = james_stein.risk(x, truth + bias, v, window=15)
        return estimate[3, 3, 0] - jnp.sum(jnp.square(out - truth))

    keys = jax.random.split(jax.random.key(4), REALISATIONS)
    assert_mean(jax.jit(jax.vmap(excess))(keys), 0.0)


def test_risk_is_equation_8_in_every_window():
    x, y, v = images((6, 5, 2))
    estimate = risk(x, y, v, window=3)
    x, y, v = map(np.asarray, (x, y, v))
    for i, j, c in np.ndindex(*x.shape):
        at = (*near(i, j, x.shape, 3), c)
        p, s2 = x[at].size, float(v[i, j, c])
        energy = np.sum(np.square(x[at] - y[at]))
        expected = p * s2 - (p - 2) ** 2 * s2**2 / energy
        if energy <= (p - 2) * s2:
            expected = energy - p * s2
        np.testing.assert_allclose(estimate[i, j, c], expected, rtol=1e-12)


@pytest.mark.parametrize(("bias", "xi"), [(0.3, 0.0), (0.5, 0.4), (3.0, 1.0)])
def test_the_bound_of_equation_9_is_one(bias, xi):
    """The mean error of the rule is below it, and it is below the error of x.

    By how much, exactly: the bound by Jensen's inequality is that of the rule without
    the positive part, whose expectation is 1 / the mean of a non-central chi-square.
    """
    sigma, p = 0.5, 49
    full = lambda value: jnp.full(ONE_WINDOW, value)
    bound = james_stein.risk_bound(full(bias), full(xi**2), full(sigma**2))[3, 3, 0]
    energy = p * (bias**2 + xi**2 + sigma**2)
    expected = p * sigma**2 - (p - 2) ** 2 * sigma**4 / energy
    np.testing.assert_allclose(bound, expected, rtol=1e-12)
    assert bound < p * sigma**2

    def error(key):
        one, other = jax.random.split(key)
        x = sigma * jax.random.normal(one, ONE_WINDOW)
        y = bias + xi * jax.random.normal(other, ONE_WINDOW)
        out = james_stein.combine(x, y, full(sigma**2), window=15)
        return jnp.sum(jnp.square(out))

    keys = jax.random.split(jax.random.key(5), REALISATIONS)
    errors = np.asarray(jax.jit(jax.vmap(error))(keys))
    # Where y is far off the bound is the error itself.
    assert errors.mean() - 5 * errors.std() / len(errors) ** 0.5 < bound
    assert errors.mean() > 0.5 * bound


def test_dual_is_the_mean_of_the_crossed_halves():
    xa, ya, v = images((6, 5, 2), 1)
    xb, yb, _ = images((6, 5, 2), 2)
    out = james_stein.combine_dual(xa, xb, ya, yb, v, window=3)
    a, b = oracle(xa, yb, 2 * v, 3, False), oracle(xb, ya, 2 * v, 3, False)
    np.testing.assert_allclose(out, (a + b) / 2, rtol=1e-12)
    share = jnp.linspace(0, 1, 30).reshape(6, 5, 1)
    out = james_stein.combine_dual(xa, xb, ya, yb, v, window=3, share=share)
    np.testing.assert_allclose(out, share * a + (1 - share) * b, rtol=1e-12)


def test_dual_dominates_a_denoiser_that_overfits():
    """A y that copies its half's noise fools `combine`; crossed halves do not.

    Judged against the mean of the halves, as the theorem promises for each of them.
    """
    shape, sigma = (21, 21, 1), 1.0
    v = jnp.full(shape, sigma**2 / 2)

    def excess(key):
        a, b = sigma * jax.random.normal(key, (2, *shape))
        ya, yb = 0.5 * a, 0.5 * b
        out = james_stein.combine_dual(a, b, ya, yb, v)
        return jnp.mean(jnp.square(out) - jnp.square((a + b) / 2))

    keys = jax.random.split(jax.random.key(5), 2000)
    assert_mean_below(jax.jit(jax.vmap(excess))(keys), 0.0)


@BOTH
def test_limits(whiten):
    x, y, v = images((6, 5, 2))

    run = lambda *data: combine(*data, whiten=whiten)
    np.testing.assert_allclose(run(x, y, 0 * v), x, rtol=1e-12)
    np.testing.assert_array_equal(run(x, y, 1e9 * (v + 1)), y)
    np.testing.assert_allclose(run(x, x, v), x, rtol=1e-15)
    np.testing.assert_array_equal(run(0 * x, 0 * x, 0 * v), 0 * x)


@pytest.mark.parametrize("background", [0.0, 1e-6, 0.1])
def test_pixels_without_variance_do_not_decide_for_their_neighbours(background):
    """Be they a black background, or pixels whose samples all missed the light."""
    x, y, v = (jnp.zeros((15, 30, 1)).at[:, 15:].set(k) for k in (2.0, 1.0, 0.25))
    y = y.at[:, :15].set(background)
    out = combine(x, y, v, window=59, whiten=True)
    p = 15 * 15
    np.testing.assert_allclose(out[:, 15:], 2 - (p - 2) / (p * 4), rtol=1e-12)


@BOTH
def test_gradients(whiten):
    data = images((5, 6, 2))
    run = lambda *i: combine(*i, window=3, whiten=whiten)
    check_grads(run, data, order=1, modes=("fwd", "rev"), rtol=1e-4)
    check_grads(risk, data, order=1, rtol=1e-4)


@BOTH
@pytest.mark.parametrize("image", [0, 1])
def test_gradient_reaches_every_pixel_of_the_windows(whiten, image):
    """The share of a window depends on all its pixels, not only on its centre."""
    x, y, _ = images((9, 11, 1), 3)
    data = x, y, jnp.full(x.shape, 0.1)

    def centre(value):
        replaced = [value if n == image else d for n, d in enumerate(data)]
        out = james_stein.combine(*replaced, window=3, whiten=whiten)
        return out[4, 5, 0]

    gradient = jax.jit(jax.grad(centre))(data[image])[..., 0]
    reached = np.zeros((9, 11), bool)
    reached[2:7, 3:8] = True  # windows of 3x3 that overlap the centre's pixel
    np.testing.assert_array_equal(np.asarray(gradient) != 0, reached)


SINGULAR = {
    "x equals y": lambda x, y, v: (x, x, v),
    "no variance": lambda x, y, v: (x, y, 0 * v),
    "x equals y, no variance": lambda x, y, v: (x, x, 0 * v),
    "all black": lambda x, y, v: (0 * x, 0 * y, 0 * v),
    "almost equal": lambda x, y, v: (x, x + 1e-12, v),
    "firefly": lambda x, y, v: (x.at[2, 2].set(1e6), y, v.at[2, 2].set(1e12)),
    "certain firefly": lambda x, y, v: (x.at[2, 2].set(1e6), y, v.at[2, 2].set(0)),
    "radiance 1e-8": lambda x, y, v: (1e-8 * x, 1e-8 * y, 1e-16 * v),
    "radiance 1e6": lambda x, y, v: (1e6 * x, 1e6 * y, 1e12 * v),
    "tiny variance": lambda x, y, v: (x, y, 1e-30 * v),
    "not finite": lambda x, y, v: (
        x.at[1, 1].set(jnp.nan),
        y.at[3, 3, 0].set(jnp.inf),
        v.at[5, 4].set(-jnp.inf),
    ),
}


@functools.partial(jax.jit, static_argnames="whiten")
def gradients_of_total(*data, whiten):
    """Of all pixels of the combination and of its risk, in every image."""

    def total(*i):
        made = james_stein.combine(*i, window=5, whiten=whiten)
        return made.sum() + james_stein.risk(*i, window=5).sum()

    return jax.grad(total, argnums=(0, 1, 2))(*data)


@pytest.mark.parametrize("precision", ["float32", "float64"])
@pytest.mark.parametrize("case", SINGULAR)
@BOTH
def test_hard_cases_stay_finite_and_right(case, precision, whiten):
    data = [i.astype(precision) for i in SINGULAR[case](*images((8, 9, 3)))]
    out = combine(*data, window=5, whiten=whiten)
    expected = oracle(*data, 5, whiten)
    scale = np.nanmax(np.abs(np.where(np.isfinite(data[1]), data[1], 0)), initial=0)
    tolerance = 2e-5 if precision == "float32" else 1e-7
    np.testing.assert_allclose(out, expected, rtol=tolerance, atol=tolerance * scale)
    gradients = gradients_of_total(*data, whiten=whiten)
    assert all(np.isfinite(g).all() for g in gradients)


@BOTH
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("image", [0, 1, 2])
def test_a_pixel_that_is_not_finite_stays_local(bad, image, whiten):
    """It is the first finite of (y, x, 0), and to others as if it were not there."""
    data = list(images((8, 9, 3)))
    poisoned = data.copy()
    poisoned[image] = data[image].at[3, 4, 1].set(bad)
    out = combine(*poisoned, window=5, whiten=whiten)
    np.testing.assert_allclose(out, oracle(*poisoned, 5, whiten), rtol=1e-12)
    assert np.isfinite(out).all()
    np.testing.assert_array_equal(out[3, 4], data[0 if image == 1 else 1][3, 4])
    clean = combine(*data, window=5, whiten=whiten)
    far = np.ones((8, 9), bool)
    far[: 3 + 5, 4 - 4 : 4 + 5] = False
    np.testing.assert_array_equal(out[far], clean[far])


def test_all_pixels_invalid():
    nothing = jnp.full((3, 3, 1), jnp.nan)
    np.testing.assert_array_equal(combine(nothing, nothing, nothing), 0.0)
    np.testing.assert_array_equal(risk(nothing, nothing, nothing), 0.0)


def test_smooth_variance_kinds():
    v = images((6, 7, 2))[2]
    box = james_stein.smooth_variance(v, window=3)
    given = james_stein.smooth_variance(v, window=3, weights=jnp.full((6, 7, 9), 2.0))
    wide = james_stein.smooth_variance(v, window=3, sigma=1e6)
    np.testing.assert_allclose(given, box, rtol=1e-12)
    np.testing.assert_allclose(wide, box, rtol=1e-9)
    np.testing.assert_allclose(box[0, 0], v[:2, :2].mean((0, 1)), rtol=1e-12)
    narrow = james_stein.smooth_variance(v, window=3, sigma=0.05)
    np.testing.assert_allclose(narrow, v, rtol=1e-12)
    hole = james_stein.smooth_variance(v.at[2, 2].set(jnp.nan), window=3)
    assert np.isfinite(hole).all()


def test_robust_variance_only_raises():
    v = images((9, 8, 2))[2].at[4, 4].set(0).at[2, 3].set(1e12).at[0, 0].set(jnp.nan)
    robust = james_stein.robust_variance(v)
    finite_pixels = np.isfinite(v)
    assert (robust >= v)[finite_pixels].all()
    assert robust[4, 4].min() > 0
    np.testing.assert_array_equal(robust[2, 3], v[2, 3])
    np.testing.assert_array_equal(np.isfinite(robust), finite_pixels)


@pytest.mark.usefixtures("unchecked")
def test_rejects_bad_input():
    x, y, v = images((6, 5, 2))
    combine = james_stein.combine
    with pytest.raises(ValueError, match=r"biased has shape .*5, 5, 2.*, unbiased"):
        combine(x, y[:5], v)
    with pytest.raises(ValueError, match="variance has shape"):
        jax.jit(combine)(x, y, v[:, :4])
    with pytest.raises(ValueError, match=r"unbiased must have shape \[H, W, C\]"):
        combine(x[0], y[0], v[0])
    with pytest.raises(ValueError, match=r"at least one pixel; got \(0, 5, 2\)"):
        combine(x[:0], y[:0], v[:0])
    with pytest.raises(ValueError, match="window must be at least three"):
        jax.jit(lambda *i: combine(*i, window=1))(x, y, v)
    with pytest.raises(ValueError, match="window must be odd"):
        james_stein.risk(x, y, v, window=4)
    with pytest.raises(ValueError, match="not both"):
        james_stein.smooth_variance(v, sigma=1.0, weights=jnp.ones((6, 5, 225)))


def bands_by_loops(x, y, v, sigmas, strength):
    """Every kernel written out pixel by pixel, in float64."""
    height, width, _ = x.shape
    grey = y.mean(-1)
    scale = np.sqrt(grey**2 + 0.01 * grey.mean() ** 2)[..., None]
    r, noise = (x - y) / scale, (v / scale**2).mean(-1)
    rows, columns = np.mgrid[:height, :width]

    def kernel(row, column, sigma):
        if sigma == 0:
            return ((rows == row) & (columns == column)).astype(float)
        reach = int(np.ceil(2.5 * sigma))
        square = (rows - row) ** 2 + (columns - column) ** 2
        inside = (abs(rows - row) <= reach) & (abs(columns - column) <= reach)
        weights = inside * np.exp(-square / (2 * sigma**2))
        return weights / weights.sum()

    every = [0.0, *sigmas]
    pixels = [(i, j) for i in range(height) for j in range(width)]
    kernels = np.array([[kernel(i, j, s) for i, j in pixels] for s in every])
    kernels = kernels.reshape(len(every), height, width, height, width)
    result = y.copy()
    for k, sigma in enumerate(every):
        band = kernels[k] - (kernels[k + 1] if k + 1 < len(every) else 0)
        d = np.einsum("ijkl,klc->ijc", band, r)
        spread = np.einsum("ijkl,kl->ij", band**2, noise)
        around = kernels[k] if sigma else kernels[-1]
        power = np.einsum("ijkl,kl->ij", around, (d**2).mean(-1))
        spread = np.einsum("ijkl,kl->ij", around, spread)
        share = np.clip(1 - strength * spread / power, 0, 1)
        result += scale * share[..., None] * d
    return result


def test_bands_are_those_of_loops(rng):
    x, y = 1 + rng.random((2, 12, 13, 3))
    v = 0.05 * rng.random((12, 13, 3))
    made = james_stein.combine_bands(
        *map(jnp.asarray, (x, y, v)), sigmas=(0.7, 1.6), strength=1.5
    )
    expected = bands_by_loops(x, y, v, (0.7, 1.6), 1.5)
    np.testing.assert_allclose(made, expected, rtol=1e-9)
    assert np.abs(made - y).max() > 0.1
    assert np.abs(made - x).max() > 0.1


def test_bands_have_their_limits(rng):
    """Without noise x, with much y; texture that y lost comes back, noise does not."""
    x, y = jnp.asarray(1 + rng.random((2, 24, 24, 3)))
    nothing, much = jnp.zeros_like(x), jnp.full_like(x, 1e6)
    combine = jax.jit(james_stein.combine_bands)
    np.testing.assert_allclose(combine(x, y, nothing), x, rtol=1e-9)
    np.testing.assert_allclose(combine(x, y, much), y, rtol=1e-9)
    stripes = 1 + 0.3 * (np.arange(64) // 2 % 2)[None, :, None]
    truth = jnp.asarray(np.broadcast_to(stripes, (64, 64, 3)))
    flat = jnp.full_like(truth, 1.15)
    noise = jnp.asarray(0.1 * rng.normal(size=truth.shape))
    variance = jnp.full_like(truth, 0.01)
    error = lambda image, of: float(jnp.mean(jnp.square(image - of)))
    refined = combine(truth + noise, flat, variance)
    assert error(refined, truth) < 0.5 * error(flat, truth)
    same = combine(flat + noise, flat, variance)
    assert error(same, flat) < 0.05 * 0.01


def test_bands_have_derivatives(rng):
    x, y = jnp.asarray(1 + rng.random((2, 9, 9, 1)))
    v = jnp.full_like(x, 0.01)
    combine = jax.jit(lambda *i: james_stein.combine_bands(*map(jnp.asarray, i)))
    check_grads(combine, (x, y, v), order=1, modes=("fwd", "rev"))
    slope = jax.jit(jax.grad(lambda *i: combine(*i).sum(), argnums=(0, 1, 2)))
    for images in ((x, x, v), (x, y, 0 * v), (0 * x, 0 * x, 0 * v)):
        assert all(np.isfinite(g).all() for g in slope(*images))


def test_few_samples_shrink_more(rng):
    """The strength of a frame's bands is 2 + 12 / samples."""
    x, y = 1 + rng.random((2, 24, 24, 3))
    made = {}
    for samples, strength in ((4, 5.0), (None, 2.0)):
        frame = make_frame(x, samples=samples, variance=np.full(x.shape, 0.1))
        frame, flat = frame.normalised(1.0), Estimate(jnp.asarray(y))
        first = james_stein.combine_frame(frame, flat).image
        made[samples] = james_stein.plan_bands(frame, flat).whole()
        expected = james_stein.combine_bands(
            frame.color, first, frame.variance, epsilon=0.01, strength=strength
        )
        np.testing.assert_allclose(made[samples], expected, rtol=1e-12)
    assert jnp.abs(made[4] - made[None]).max() > 1e-3


@pytest.mark.parametrize("sigmas", [(), (1.0, 1.0), (0.0,), (2.0, 1.0)])
def test_bands_ascend(sigmas):
    one = jnp.ones((3, 3, 1))
    with pytest.raises(ValueError, match="sigmas must be positive and ascend"):
        james_stein.combine_bands(one, one, one, sigmas=sigmas)
