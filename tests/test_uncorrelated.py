"""Uncorrelated kernels against loops, and what theorem 2 says of their bias."""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from jscomb import uncorrelated
from jscomb.frame import make_frame
from jscomb.numerics.windows import window_mean, window_sum
from jscomb.uncorrelated._estimate import powers
from tests.statistics import assert_mean

combine = jax.jit(uncorrelated.combine, static_argnames="window")
crosswise = jax.jit(uncorrelated.combine_crosswise, static_argnames="window")
variances = jax.jit(
    uncorrelated.relative_variances,
    static_argnames=("window", "multiples", "stride", "crosswise"),
)
SIZES = [(9, 11), (1, 1), (1, 7), (6, 1), (3, 4)]


def estimates(shape, sub_averages=2, channels=2, seed=0):
    """Independent estimates, and correlated ones of half the noise in common."""
    rng = np.random.default_rng(seed)
    truth = 1 + rng.random((*shape, channels))
    noise = lambda *size: rng.standard_normal((sub_averages, *size, channels))
    y = truth + noise(*shape)
    z = truth + noise(1, 1) + 0.5 * noise(*shape)
    return jnp.asarray(y), jnp.asarray(z)


def oracle(weigh, y, z, guides, window):
    """Image u by loops over pixels and windows; bad pixels left out."""
    y, z, guides = (np.asarray(i, np.float64) for i in (y, z, guides))
    valid = np.isfinite(np.concatenate([y, z])).all(axis=(0, -1))
    mean_y, mean_z = y.mean(axis=0), z.mean(axis=0)
    h, w = valid.shape
    u, r = np.full_like(mean_y, np.nan), window // 2
    for c in np.ndindex(h, w):
        if not valid[c]:
            continue
        near = [
            i
            for i in itertools.product(
                range(max(0, c[0] - r), min(h, c[0] + r + 1)),
                range(max(0, c[1] - r), min(w, c[1] + r + 1)),
            )
            if i != c and valid[i]
        ]
        u[c] = mean_y[c]
        for i in near:
            k = weigh(*(guides[:, *c] - guides[:, *i])) / len(near)
            u[c] += k * (mean_z[c] - mean_z[i] - mean_y[c] + mean_y[i])
    return u


def paper(gamma, n):
    """The kernel, eq. 8."""
    return lambda first, second: np.exp(-gamma * n * (first - second) ** 2)


@pytest.mark.parametrize("shape", SIZES)
@pytest.mark.parametrize("window", [1, 5, 15])
def test_loops(shape, window):
    y, z = estimates(shape)
    expected = oracle(paper(0.3, 4), y, z, z, window)
    found = combine(y, z, 0.3, 4, window=window)
    np.testing.assert_allclose(found, expected, rtol=1e-12)
    y, z = y.astype(jnp.float32), z.astype(jnp.float32)
    found = combine(y, z, 0.3, 4, window=window)
    assert found.dtype == jnp.float32
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6)


def test_an_image_of_several_tiles():
    y, z = estimates((70, 131), channels=1)
    expected = oracle(paper(0.3, 4), y, z, z, 5)
    np.testing.assert_allclose(combine(y, z, 0.3, 4, window=5), expected, rtol=1e-11)


def test_baselines():
    y, z = estimates((8, 9), sub_averages=4)
    equal = lambda *_: 1.0
    u = uncorrelated.combine_uniform(y, z, window=5)
    far = lambda y, z: oracle(equal, y, z, z, 5) - np.mean(y, axis=0)
    others = window_sum(jnp.ones((8, 9, 1)), 5) - 1
    expected = np.mean(y, axis=0) + far(y, z) * others / (others + 1)
    np.testing.assert_allclose(u, expected, rtol=1e-12)
    weigh, first, second = paper(0.2, 3), slice(2), slice(2, 4)
    sides = (first, second), (second, first)
    each = [oracle(weigh, y[s], z[s], z[other], 5) for s, other in sides]
    found = crosswise(y, z, 0.2, 3, window=5)
    np.testing.assert_allclose(found, np.mean(each, axis=0), rtol=1e-12)
    each = [oracle(weigh, y[s], z[other], z[other], 5) for s, other in sides]
    found = uncorrelated.combine_decorrelated(y, z, 0.2, 3, window=5)
    np.testing.assert_allclose(found, np.mean(each, axis=0), rtol=1e-12)


def test_any_kernel():
    """Of three sub-averages: less weight where they spread, but not as a Gaussian."""
    y, z = estimates((7, 8), sub_averages=3)
    spread = lambda d: abs(d[0] - d[1]) + abs(d[1] - d[2]) + abs(d[2] - d[0])
    kernel = lambda *d: 1 / (1 + spread(d))
    found = uncorrelated.combine_with(kernel, y, z, window=5)
    np.testing.assert_allclose(found, oracle(kernel, y, z, z, 5), rtol=1e-12)
    assert max(uncorrelated.admissibility(KEY(), kernel, sub_averages=3)) < 1e-12


def within(samples, expected):
    """Every element's mean over the first axis is the expected one."""
    for at in np.ndindex(samples.shape[1:]):
        assert_mean(samples[:, *at], expected[at])


KEY = functools.partial(jax.random.key, 7)


@pytest.mark.parametrize("gamma", [0.01, 1.0, 100.0])
def test_the_papers_kernel_is_admissible(gamma):
    kernel = uncorrelated.variance_kernel(gamma, 8)
    found = uncorrelated.admissibility(KEY(), kernel, scale=(8 * gamma) ** -0.5)
    assert max(found) < 1e-11


def test_kernels_that_are_not():
    """By the difference itself, as a bilateral filter, and by its sign."""
    by_size = lambda first, second: jnp.exp(-jnp.square(first + second))
    assert uncorrelated.admissibility(KEY(), by_size).shift > 0.5
    by_sign = lambda first, second: jnp.where(first > second, 1.0, 0.5)
    found = uncorrelated.admissibility(KEY(), by_sign)
    assert found.sign == 0.5
    assert found.shift == 0


def test_limits():
    y, z = estimates((6, 7))
    np.testing.assert_allclose(combine(y, z, 1e12, 1), jnp.mean(y, axis=0), rtol=1e-6)
    # Alike in all, differences of z decide alone.
    all_alike = combine(y, y[:1] + jnp.zeros_like(y), 0.3, 4)
    assert np.isfinite(all_alike).all()
    np.testing.assert_allclose(combine(y, y, 0.0, 1), jnp.mean(y, axis=0), rtol=1e-12)


def test_unbiased_under_symmetric_noise():
    """Dependent weights, unlike noise in every pixel: no bias, less variance."""
    h, w, n, trials = 5, 6, 4, 40_000
    rng = np.random.default_rng(1)
    truth, spread = jnp.asarray(rng.random((2, h, w, 1)))

    def one(key):
        keys = jax.random.split(key, 4)
        size = 2, h, w, 1
        common = jax.random.normal(keys[0], (2, 1, 1, 1))
        own = jax.random.laplace(keys[1], size) * spread[None] / 2
        z = truth[None] + (common * (1 + spread)[None] + own) / n**0.5
        y = truth[None] + jax.random.normal(keys[2], size) / n**0.5
        return uncorrelated.combine(y, z, 1.0, n, window=5), jnp.mean(y, axis=0)

    u, y = jax.jit(jax.vmap(one))(jax.random.split(jax.random.key(0), trials))
    assert np.var(u, axis=0).mean() < 0.75 * np.var(y, axis=0).mean()
    within(u, truth)


def two_states(low, high, share):
    """Moments of a skewed variable of two values, and the values with their shares."""
    return np.array([low, high]), np.array([1 - share, share])


def test_biased_as_predicted_under_skewed_noise():
    """Two pixels, z of one of them noisy: every outcome's chance is known."""
    values, chances = two_states(-0.25, 1.0, 0.2)  # of mean 0, skewness 1.5
    gamma, n = 0.7, 2
    pairs = list(itertools.product(range(2), repeat=2))
    # u_1 = y_1 + k (D z - D y), and y is independent of k: E[k D z] is the bias.
    weigh = paper(gamma, n)
    expected = (
        sum(
            chances[a]
            * chances[b]
            * weigh(values[a], values[b])
            * (values[a] + values[b])
            for a, b in pairs
        )
        / 2
    )
    assert expected < -0.02

    def one(key):
        of_y, of_z = jax.random.split(key)
        y = jax.random.normal(of_y, (2, 1, 2, 1))
        high = jax.random.bernoulli(of_z, chances[1], (2, 1, 1, 1))
        noisy = jnp.where(high, values[1], values[0])
        z = jnp.concatenate([noisy, jnp.zeros_like(noisy)], axis=2)
        return uncorrelated.combine(y, z, gamma, n, window=3) - jnp.mean(y, axis=0)

    # Less y, whose noise says nothing of the bias.
    keys = jax.random.split(jax.random.key(0), 100_000)
    found = jax.jit(jax.vmap(one))(keys)
    within(found, np.array([expected, -expected]).reshape(1, 2, 1))


def test_consistent_under_skewed_noise():
    """With four times the samples the bias falls by more than the noise does."""
    trials, gamma = 8000, 1.0
    spread = jnp.asarray(np.random.default_rng(2).random((4, 5, 1)) + 0.2)

    def one(key, n):
        of_y, of_z = jax.random.split(key)
        y = jax.random.normal(of_y, (2, 4, 5, 1)) / n**0.5
        # Sums of exponentials; the first sub-average of n is the mean of n of them.
        samples = jax.random.exponential(of_z, (n, 2, 4, 5, 1)) - 1
        z = spread[None] * jnp.mean(samples, axis=0)
        return uncorrelated.combine(y, z, gamma, n, window=5)

    bias, error = [], []
    for n in (1, 4, 16):
        keys = jax.random.split(jax.random.key(n), trials)
        u = np.asarray(jax.jit(jax.vmap(functools.partial(one, n=n)))(keys))
        noise = u.var(axis=0).mean() / trials
        bias.append(max((u.mean(axis=0) ** 2).mean() - noise, noise))
        error.append((u**2).mean())
    assert error[0] > 3.5 * error[1] > 3.5**2 * error[2]
    assert bias[0] > 8 * bias[1] > 8 * 8 * bias[2]


@pytest.mark.parametrize("stride", [1, 3])
@pytest.mark.parametrize("crossed", [False, True])
def test_gamma_is_the_brute_force_choice(stride, crossed):
    h, w, n, epsilon = 11, 12, 3, 0.02
    y, z = estimates((h, w), sub_averages=4, seed=3)
    y = y.at[:, 2:5].multiply(0.3)
    multiples = (1, 4, 7, 30, 100)
    found = variances(
        y, z, n, window=5, unit=0.01, multiples=multiples, epsilon=epsilon,
        stride=stride, crosswise=crossed,
    )  # fmt: skip
    a, b = (0, 2), (1, 3)
    level = window_mean(jnp.mean(y, axis=0), 5)
    weight = 1 / (np.asarray(level) ** 2 + epsilon)
    expected = []
    for multiple in multiples:
        weigh = paper(0.01 * multiple, n)
        u = [
            oracle(weigh, y[s,], z[s,], z[other,], 5)
            for s, other in (((a, b), (b, a)) if crossed else ((a, a), (b, b)))
        ]
        square = weight * (u[0] - u[1]) ** 2
        expected.append(square[::stride].mean())
    np.testing.assert_allclose(found, expected, rtol=1e-11)
    assert 0 < np.argmin(expected) < len(multiples) - 1
    gamma = uncorrelated.select_gamma(
        y, z, n, window=5, unit=0.01, multiples=multiples, epsilon=epsilon,
        stride=stride, crosswise=crossed,
    )  # fmt: skip
    np.testing.assert_allclose(gamma, 0.01 * multiples[np.argmin(expected)])


def test_float32_choice():
    """The powers of one exponential keep their digits."""
    y, z = estimates((40, 70), sub_averages=4, channels=1)
    wide = variances(y, z, 3)
    narrow = variances(y.astype(jnp.float32), z.astype(jnp.float32), 3)
    assert narrow.dtype == jnp.float32
    np.testing.assert_allclose(narrow, wide, rtol=1e-4)


@pytest.mark.parametrize("exponents", [uncorrelated.MULTIPLES, (7,), (1, 31, 1000)])
def test_powers(exponents):
    base = jnp.asarray([0.97, 1.0, 0.0, 0.5])
    found = powers(base, exponents)
    np.testing.assert_allclose(found, [base**k for k in exponents], rtol=1e-12)


def frame_pair(y, z, samples=64):
    """Frames of sub-averages, normalised by one unit."""
    y, z = (make_frame(i, samples=samples) for i in (y, z))
    return y.normalised(), z.normalised(y.median_luminance)


def test_frames():
    """Gamma by quarters of normalised radiance, then halves of all samples."""
    y, z = (10 * i for i in estimates((9, 8), sub_averages=8, channels=3))
    frames = frame_pair(y, z)
    found = uncorrelated.combine_frame(*frames, window=5)
    y, z = (f.buffers.color for f in frames)
    quarters = [jnp.mean(i.reshape(4, 2, 9, 8, 3), axis=1) for i in (y, z)]
    gamma = uncorrelated.select_gamma(*quarters, 16, window=5)
    selected = uncorrelated.select_gamma_frame(*frames, window=5)
    np.testing.assert_allclose(selected, gamma, rtol=1e-12)
    halves = [jnp.mean(i.reshape(2, 4, 9, 8, 3), axis=1) for i in (y, z)]
    image = combine(*halves, gamma, 32, window=5)
    np.testing.assert_allclose(found.image, image, rtol=1e-12)
    much = frame_pair(1e4 * y, 1e4 * z)
    bright = uncorrelated.combine_frame(*much, window=5)
    np.testing.assert_allclose(bright.image, found.image, rtol=1e-10)


def test_halves_of_frames():
    """Each half pair by itself, where it has four sub-buffers; jit changes nothing."""
    y, z = estimates((9, 8), sub_averages=16, channels=3)
    frames = frame_pair(y, z)
    found = uncorrelated.combine_frame(*frames, window=5)
    pairs = zip(*(f.halves() for f in frames), strict=True)
    for pair, image in zip(pairs, found.halves, strict=True):
        alone = uncorrelated.combine_frame(*pair, window=5)
        np.testing.assert_array_equal(image, alone.image)
        assert alone.halves is not None
    few = frames[0].merged(4), frames[1]  # halves share the frame's gamma
    shared = uncorrelated.combine_frame(*few, window=5).halves
    gamma = uncorrelated.select_gamma_frame(*few, window=5)
    half = (f.halves()[1].merged(2).buffers.color for f in few)
    expected = combine(*half, gamma, 16, window=5)
    np.testing.assert_allclose(shared[1], expected, rtol=1e-12)
    jitted = jax.jit(lambda y, z: uncorrelated.combine_frame(y, z, window=5))(*frames)
    np.testing.assert_allclose(jitted.halves, found.halves, rtol=1e-12)


def test_gradients():
    y, z = estimates((4, 5), channels=1)
    of = lambda y, z, gamma: combine(y, z, gamma, 4.0, window=3)
    check_grads(of, (y, z, 0.3), order=1, modes=["fwd", "rev"], rtol=1e-6)
    four = estimates((4, 5), sub_averages=4, channels=1)
    of = lambda y, z: variances(y, z, 4.0, window=3, stride=1)
    check_grads(of, four, order=1, modes=["fwd", "rev"], rtol=1e-5)


def hard_cases():
    """Sub-averages by name, float32, one of them ugly."""
    y, z = (i.astype(jnp.float32) for i in estimates((9, 10)))
    return {
        "firefly in y": (y.at[0, 4, 4].set(1e6), z),
        "firefly in z": (y, z.at[1, 4, 4].set(1e6)),
        "tiny": (1e-8 * y, 1e-8 * z),
        "no noise": (y[:1] + 0 * y, z[:1] + 0 * z),
        "all alike": (0 * y, 0 * z),
        "y is z": (y, y),
        "nan": (y.at[0, 4, 4, 0].set(jnp.nan), z),
        "inf": (y, z.at[1, 4, 4].set(jnp.inf)),
        "all nan": (jnp.nan * y, z),
    }


@pytest.mark.parametrize("name", hard_cases())
@pytest.mark.parametrize("gamma", [0.0, 0.3, 1e12])
def test_hard_cases(name, gamma):
    y, z = hard_cases()[name]
    expected = oracle(paper(gamma, 4), y, z, z, 5)
    bad = ~np.isfinite(expected)
    fallback = y[1] if name == "nan" else jnp.mean(y, axis=0)
    fallback = jnp.mean(z, axis=0) if name == "all nan" else fallback
    expected = np.where(bad, fallback, expected)
    total = lambda y, z, g: (lambda u: (jnp.sum(u), u))(combine(y, z, g, 4, window=5))
    both = jax.jit(jax.value_and_grad(total, argnums=(0, 1, 2), has_aux=True))
    (_, found), gradients = both(y, z, jnp.float32(gamma))
    # Rounding: of what is added at a pixel, and of its share in the windows.
    inputs = np.nan_to_num(np.concatenate([y, z]), posinf=0)
    size = abs(inputs).max(axis=0)
    bound = 2e-5 * abs(expected) + 3e-7 * np.maximum(size, size.max() / 8)
    assert (abs(np.asarray(found) - expected) <= bound).all()
    for gradient in gradients:
        assert np.isfinite(gradient).all()


@pytest.mark.parametrize("name", hard_cases())
def test_variances_of_hard_cases(name):
    y, z = (jnp.concatenate([i, i]) for i in hard_cases()[name])
    found = variances(y, z, 4, window=5, stride=2)
    assert np.isfinite(found).all()
    assert (found == 0).all() == (name in ("no noise", "all alike", "all nan"))


def test_memory_is_that_of_images():
    """Not of windows, which have 225 pixels: values, gradients and all candidates."""
    total = lambda y, z: jnp.sum(uncorrelated.combine(y, z, 1.0, 8))
    select = lambda y, z: uncorrelated.relative_variances(y, z, 8)
    size = 256
    for count, function in ((2, total), (2, jax.grad(total)), (4, select)):
        shape = jax.ShapeDtypeStruct((count, size, size, 3), jnp.float32)
        compiled = jax.jit(function).lower(shape, shape).compile()
        memory = compiled.memory_analysis().temp_size_in_bytes
        assert memory < 25 * size**2 * 3 * 4


def test_vmap():
    y, z = estimates((6, 7))
    two = jnp.stack([y, 2 * y[::-1]]), jnp.stack([z, 2 * z[::-1]])
    gammas = jnp.array([0.3, 0.7])
    mapped = jax.vmap(lambda y, z, g: combine(y, z, g, 4, window=5))(*two, gammas)
    for k in range(2):
        one = combine(two[0][k], two[1][k], gammas[k], 4, window=5)
        np.testing.assert_allclose(mapped[k], one, rtol=1e-12)


def test_scale_equivariant_with_gamma():
    y, z = (i.astype(jnp.float32) for i in estimates((9, 10)))
    plain = combine(y, z, 0.3, 4)
    for s in (1e-6, 1e6):
        scaled = combine(s * y, s * z, 0.3 / s**2, 4)
        np.testing.assert_allclose(scaled, s * plain, rtol=1e-5, atol=1e-6 * s)


def test_bad_input(unchecked):
    y, z = estimates((4, 5), sub_averages=4)
    with pytest.raises(ValueError, match=r"sub-averages, at least 4; got 2"):
        uncorrelated.select_gamma(y[:2], z[:2], 4)
    with pytest.raises(ValueError, match=r"correlated must be 4 sub-averages.*got \(3"):
        uncorrelated.combine_crosswise(y, z[:3], 0.1, 4)
    with pytest.raises(ValueError, match=r"correlated has shape .*, independent has"):
        uncorrelated.combine_uniform(y, z[:, 1:])
    with pytest.raises(ValueError, match=r"must be sub-averages.*got \(4, 5, 2\)"):
        uncorrelated.combine_uniform(y[0], z[0])
    for call in (uncorrelated.combine, uncorrelated.combine_decorrelated):
        few = 2 if call is uncorrelated.combine else 4
        with pytest.raises(ValueError, match=r"samples must be at least 1, got 0\.5"):
            call(y[:few], z[:few], 0.1, 0.5)
    with pytest.raises(ValueError, match="samples must be at least 1, got 0"):
        uncorrelated.select_gamma(y, z, 0)
    with pytest.raises(ValueError, match="stride must be at least 1, got 0"):
        uncorrelated.select_gamma(y, z, 1, stride=0)
    for bad in ((), (0, 1), (1.5,)):
        with pytest.raises(ValueError, match="multiples must be whole and positive"):
            uncorrelated.select_gamma(y, z, 1, multiples=bad)
    with pytest.raises(ValueError, match="window must be odd"):
        uncorrelated.combine(y[:2], z[:2], 0.1, 4, window=4)


def test_frames_that_are_not_alike():
    y, z = estimates((4, 5), sub_averages=4, channels=3)
    call = uncorrelated.combine_frame
    with pytest.raises(
        ValueError, match=r"sub-buffers in a multiple of 4, correlated has 2"
    ):
        call(*frame_pair(y, z[:2]))
    with pytest.raises(ValueError, match="needs the samples a pixel of independent:"):
        call(make_frame(y).normalised(2.0), make_frame(z, samples=8).normalised(2.0))
    y, z = make_frame(y, samples=16), make_frame(z, samples=16)
    with pytest.raises(ValueError, match="uncorrelated needs a normalised frame"):
        call(y, z.normalised())
    for other in (z, z.normalised()):
        with pytest.raises(
            ValueError, match=r"one unit: call correlated\.normalised\("
        ):
            call(y.normalised(), other)
    few = z._replace(samples=z.samples / 2)
    with pytest.raises(ValueError, match=r"independent has 16\.0, correlated 8\.0"):
        call(y.normalised(2.0), few.normalised(2.0))
