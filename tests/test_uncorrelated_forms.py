"""Forms of uncorrelated kernels: any sub-averages, of y and of both, robust ones."""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jscomb import uncorrelated
from jscomb.frame import Estimate, make_frame
from jscomb.numerics.windows import window_mean
from tests.statistics import assert_mean
from tests.test_uncorrelated import estimates, frame_pair, oracle

STATIC = "window", "guides"
combine = jax.jit(uncorrelated.combine, static_argnames=STATIC)
median = jax.jit(uncorrelated.combine_median, static_argnames=STATIC)


def spread(differences):
    """Mean square of the differences of all pairs: of two that of eq. 8."""
    pairs = itertools.combinations(differences, 2)
    return np.mean([(d - e) ** 2 for d, e in pairs], axis=0)


def guided(y, z, guides):
    """The images that a kernel reads, z before y."""
    return {"correlated": z, "independent": y, "both": jnp.concatenate([z, y])}[guides]


def kernel_of(gamma, n, count):
    """Eq. 8 of any number of sub-averages; of both the product."""

    def weigh(*d):
        parts = [d[k : k + count] for k in range(0, len(d), count)]
        return np.exp(-gamma * n * sum(spread(part) for part in parts))

    return weigh


@pytest.mark.parametrize("count", [2, 3, 6])
@pytest.mark.parametrize("guides", ["correlated", "independent", "both"])
def test_loops(count, guides):
    y, z = estimates((7, 8), sub_averages=count)
    expected = oracle(kernel_of(0.2, 4, count), y, z, guided(y, z, guides), 5)
    found = combine(y, z, 0.2, 4, window=5, guides=guides)
    np.testing.assert_allclose(found, expected, rtol=1e-11)


def test_gamma_of_each_centre():
    """As with one number, pixel by pixel."""
    y, z = estimates((7, 8))
    gammas = np.random.default_rng(0).choice([0.0, 0.1, 3.0], (7, 8, 1))
    found = combine(y, z, jnp.asarray(gammas), 4, window=5)
    for gamma in np.unique(gammas):
        alone = combine(y, z, gamma, 4, window=5)
        at = gammas[..., 0] == gamma
        np.testing.assert_allclose(found[at], alone[at], rtol=1e-11)
    total = lambda g: jnp.sum(jnp.sin(uncorrelated.combine(y, z, g, 4, window=5)))
    assert np.isfinite(jax.jit(jax.grad(total))(jnp.asarray(gammas))).all()


@pytest.mark.parametrize("pairs", [1, 2, 3])
def test_median_of_pairs(pairs):
    y, z = estimates((6, 7), sub_averages=2 * pairs)
    each = [
        combine(y[k : k + 2], z[k : k + 2], 0.3, 4, window=5)
        for k in range(0, 2 * pairs, 2)
    ]
    found = median(y, z, 0.3, 4, window=5)
    np.testing.assert_allclose(found, np.median(each, axis=0), rtol=1e-12)


@pytest.mark.parametrize("which", ["y", "z"])
def test_a_firefly_does_not_pass_the_median_of_three(which):
    """Anywhere in one sub-average; that of y does pass the mean of all."""
    y, z = estimates((6, 7), sub_averages=6, channels=1)
    given = {"y": y, "z": z}
    clean = median(y, z, 0.3, 4, window=5)
    given[which] = given[which].at[3, 2, 3].set(1e6)
    found = median(given["y"], given["z"], 0.3, 4, window=5)
    assert np.max(abs(found - clean)) < 3 * np.std(y)
    if which == "y":
        assert np.max(combine(given["y"], z, 0.3, 4, window=5)) > 1e3


KERNELS = {
    "variance of four": (lambda g: uncorrelated.variance_kernel(g, 8), 4),
    "median of two": (lambda g: uncorrelated.median_kernel(g, 8), 2),
    "median of five": (lambda g: uncorrelated.median_kernel(g, 8), 5),
}


@pytest.mark.parametrize("name", KERNELS)
def test_kernels_are_admissible(name):
    make, count = KERNELS[name]
    found = uncorrelated.admissibility(
        jax.random.key(7), make(1.0), sub_averages=count, scale=0.3
    )
    assert max(found) < 1e-11


def test_a_median_kernel_is_the_median_of_pairs():
    d = np.random.default_rng(0).normal(size=(4, 30))
    pairs = [(one - other) ** 2 for one, other in itertools.combinations(d, 2)]
    expected = np.exp(-0.4 * 3 * np.median(pairs, axis=0))
    found = uncorrelated.median_kernel(0.4, 3)(*map(jnp.asarray, d))
    np.testing.assert_allclose(found, expected, rtol=1e-12)


FORMS = {
    "of y": (2, functools.partial(uncorrelated.combine, guides="independent")),
    "of both": (2, functools.partial(uncorrelated.combine, guides="both")),
    "of four": (4, uncorrelated.combine),
    "median": (6, uncorrelated.combine_median),
}


@pytest.mark.parametrize("name", FORMS)
def test_unbiased_under_symmetric_noise(name):
    """Theorem 2, its variations for y and for both, and for the median."""
    (count, form), (h, w, n, trials) = FORMS[name], (4, 5, 4, 20_000)
    rng = np.random.default_rng(1)
    truth, width = jnp.asarray(rng.random((2, h, w, 1)))

    def one(key):
        keys = jax.random.split(key, 3)
        size = count, h, w, 1
        common = jax.random.normal(keys[0], (count, 1, 1, 1))
        own = jax.random.laplace(keys[1], size) * width[None] / 2
        z = truth[None] + (common * (1 + width)[None] + own) / n**0.5
        y = truth[None] + jax.random.laplace(keys[2], size) * (1 - width)[None] / n**0.5
        return form(y, z, 1.0, n, window=5)

    u = jax.jit(jax.vmap(one))(jax.random.split(jax.random.key(0), trials))
    for at in np.ndindex(h, w, 1):
        assert_mean(u[:, *at], truth[at])


@pytest.mark.parametrize("guides", ["correlated", "independent", "both"])
@pytest.mark.parametrize("count", [4, 8])
def test_gamma_is_the_brute_force_choice(guides, count):
    """Of the image, and of the region of each pixel."""
    h, w, n, epsilon, multiples = 11, 12, 3, 0.02, (1, 7, 40)
    y, z = estimates((h, w), sub_averages=count, seed=3)
    options = {"window": 5, "unit": 0.01, "multiples": multiples, "guides": guides}
    options |= {"epsilon": epsilon, "stride": 2}
    found = uncorrelated.relative_variances(y, z, n, **options)
    level = window_mean(jnp.mean(y, axis=0), 5)
    weight = 1 / (np.asarray(level) ** 2 + epsilon)
    squares = []
    for multiple in multiples:
        weigh = kernel_of(0.01 * multiple, n, count // 2)
        u = [
            oracle(weigh, y[k::2], z[k::2], guided(y[k::2], z[k::2], guides), 5)
            for k in (0, 1)
        ]
        squares.append((weight * (u[0] - u[1]) ** 2)[::2])
    expected = [np.mean(square) for square in squares]
    np.testing.assert_allclose(found, expected, rtol=1e-9)
    chosen = uncorrelated.select_gamma_map(y, z, n, region=5, **options)
    for row, column in ((0, 0), (4, 6), (10, 11)):
        rows = [k for k in range(0, h, 2) if abs(k - row) <= 2]
        near = (
            slice(rows[0] // 2, rows[-1] // 2 + 1),
            slice(max(column - 2, 0), column + 3),
        )
        best = np.argmin([np.mean(square[near]) for square in squares])
        np.testing.assert_allclose(chosen[row, column], 0.01 * multiples[best])


@pytest.mark.slow
def test_frames_with_every_option():
    """By the functions of arrays, on normalised sub-averages."""
    y, z = estimates((9, 8), sub_averages=8, channels=3)
    frames = frame_pair(y, z)
    y, z = (f.buffers.color for f in frames)
    call = functools.partial(uncorrelated.combine_frame, *frames, window=5)
    gamma = uncorrelated.select_gamma(y, z, 8, window=5, guides="both")
    four = [jnp.mean(i.reshape(4, 2, 9, 8, 3), axis=1) for i in (y, z)]
    expected = combine(*four, gamma, 16, window=5, guides="both")
    found = call(sub_averages=4, guides="both")
    np.testing.assert_allclose(found.image, expected, rtol=1e-11)
    halves = [combine(*(i[s] for i in (y, z)), gamma, 8, window=5, guides="both")
              for s in (slice(4), slice(4, 8))]  # fmt: skip
    np.testing.assert_allclose(found.halves, np.stack(halves), rtol=1e-11)
    by_region = uncorrelated.select_gamma_map(*four, 16, window=5, region=7)
    two = [jnp.mean(i.reshape(2, 4, 9, 8, 3), axis=1) for i in (y, z)]
    expected = combine(*two, by_region, 32, window=5)
    np.testing.assert_allclose(call(region=7).image, expected, rtol=1e-11)
    gamma = uncorrelated.select_gamma(*four, 16, window=5)
    expected = median(*four, gamma, 16, window=5)
    found = call(median=True, sub_averages=4).image
    np.testing.assert_allclose(found, expected, rtol=1e-11)


def test_an_estimate_by_common_random_numbers():
    """Kernels of y's differences alone: halves of z are enough, and the result has."""
    y, z = estimates((9, 8), sub_averages=4, channels=3)
    frames = frame_pair(y, z)
    y, z = (f.buffers.color for f in frames)
    ab = jnp.stack([(z[0] + z[1]) / 2, (z[2] + z[3]) / 2])
    estimate = Estimate(jnp.mean(ab, axis=0), ab)
    found = uncorrelated.combine_frame(frames[0], estimate, window=5)
    gamma = uncorrelated.select_gamma(
        y, ab[jnp.array([0, 1, 0, 1])], 16, window=5, guides="independent"
    )
    halves = jnp.stack([(y[0] + y[1]) / 2, (y[2] + y[3]) / 2])
    expected = combine(halves, ab, gamma, 32, window=5, guides="independent")
    np.testing.assert_allclose(found.image, expected, rtol=1e-11)
    one = jnp.stack([ab[0], ab[0]])
    expected = combine(y[:2], one, gamma, 16, window=5, guides="independent")
    np.testing.assert_allclose(found.halves[0], expected, rtol=1e-11)
    with pytest.raises(ValueError, match="uncorrelated needs an estimate with halves"):
        uncorrelated.combine_frame(frames[0], Estimate(ab[0]), window=5)
    with pytest.raises(ValueError, match="and guides 'independent'; got 'both'"):
        uncorrelated.combine_frame(frames[0], estimate, guides="both")


def test_bad_input(unchecked):
    y, z = estimates((4, 5), sub_averages=4, channels=3)
    for bad in (-0.1, jnp.full((4, 5, 1), -0.1), float("nan")):
        with pytest.raises(ValueError, match=r"gamma must be at least zero, got"):
            uncorrelated.combine(y, z, bad, 4)
    for make in (uncorrelated.variance_kernel, uncorrelated.median_kernel):
        with pytest.raises(ValueError, match=r"gamma must be at least zero, got -1"):
            make(-1.0, 4)
    with pytest.raises(
        ValueError, match="combine needs at least 2 sub-averages, got 1"
    ):
        uncorrelated.combine(y[:1], z[:1], 0.1, 4)
    with pytest.raises(ValueError, match="an even number of sub-averages, got 3"):
        uncorrelated.combine_median(y[:3], z[:3], 0.1, 4)
    with pytest.raises(ValueError, match=r"guides must be one of .*, got 'neither'"):
        uncorrelated.combine(y, z, 0.1, 4, guides="neither")
    call = uncorrelated.combine_frame
    frames = (make_frame(i, samples=2).normalised(2.0) for i in (y, z))
    with pytest.raises(
        ValueError, match=r"at least one sample in each .*has 2\.0 in 4"
    ):
        call(*frames)
    with pytest.raises(ValueError, match="sub_averages must be at least 2, got 1"):
        call(*frame_pair(y, z), sub_averages=1)
    with pytest.raises(ValueError, match="sub_averages must be even and at least 2"):
        call(*frame_pair(y, z), sub_averages=3, median=True)
