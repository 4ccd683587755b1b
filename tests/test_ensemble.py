"""Ensemble denoising: its matrix, weights, filter and promises."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from jscomb import ensemble
from jscomb.denoisers import smoothing
from jscomb.frame import Estimate
from jscomb.numerics import simplex
from jscomb.numerics.weights import bilateral_weights, weighted_mean
from tests.statistics import assert_mean, assert_mean_below

OURS = {"solver": "multi-scale", "filter": False}
combine = jax.jit(ensemble.combine, static_argnames=("solver", "filter", "windows"))
error_matrix = jax.jit(
    ensemble.error_matrix, static_argnames=("windows", "whole_frame", "shared")
)


def bases_of(image):
    """Three different biased images."""
    return jnp.stack(
        [
            smoothing.gaussian(image, sigma=1.0),
            smoothing.box(image, window=7),
            0.9 * smoothing.box(image, window=3),
        ]
    )


@jax.jit
def rendering(key, truth, noise):
    """Halves, and bases of the full image and of both halves."""
    a, b = truth[None] + noise * jax.random.normal(key, (2, *truth.shape), truth.dtype)
    return bases_of((a + b) / 2), bases_of(a), bases_of(b), a, b


@pytest.fixture(scope="module")
def truth():
    """A smooth ramp with a step."""
    y, x = np.mgrid[:24, :26] / 24
    image = np.stack([1 + x, 1 + y, 1 + (x > 0.5)], axis=-1)
    return jnp.asarray(image)


@pytest.fixture(scope="module")
def many(truth):
    """Bases of many renderings: of the full images, of half a, and each <M>."""

    def one(key):
        full, *halves = rendering(key, truth, 0.5)
        return full, halves[0], ensemble.mse_matrix(*halves)

    return jax.jit(jax.vmap(one))(jax.random.split(jax.random.key(0), 400))


def test_the_matrix_is_unbiased_for_that_of_halves(many, truth):
    _, half, estimates = map(np.asarray, many)
    truth = np.asarray(truth)
    for place in ((3, 4, 0), (12, 13, 2)):
        for i, j in ((0, 0), (0, 1), (2, 2)):
            error = half[(slice(None), slice(None), *place)] - truth[place]
            difference = (
                estimates[(slice(None), i, j, *place)] - error[:, i] * error[:, j]
            )
            assert_mean(difference, 0.0)
    exact = ensemble.true_matrix(jnp.asarray(half), jnp.asarray(truth))
    by_loop = np.mean((half[:, 0] - truth) * (half[:, 1] - truth), axis=0)
    np.testing.assert_allclose(exact[0, 1], by_loop, rtol=1e-10)


def test_with_the_true_matrix_no_base_is_better(many, truth):
    full, _, _ = many
    matrix = ensemble.true_matrix(full, truth)
    weights = jax.jit(simplex.quadratic)(matrix)
    error = jnp.sum(weights[:, None] * weights[None] * matrix, axis=(0, 1))
    single = jnp.stack([matrix[i, i] for i in range(3)])
    assert (error <= single.min(axis=0) * (1 + 1e-9)).all()
    combined = jax.jit(jax.vmap(ensemble.average, in_axes=(0, None)))(full, weights)
    measured = jnp.mean((combined - truth[None]) ** 2)
    np.testing.assert_allclose(measured, error.mean(), rtol=1e-9)
    assert measured < 0.9 * single.mean(axis=(1, 2, 3)).min()


def test_multi_scale_beats_every_base(truth):
    """On average over renderings, by standard errors; single pixels' weights do not."""

    def one(key):
        images = rendering(key, truth, 0.5)
        error = lambda image: jnp.mean((image - truth) ** 2)
        best = jnp.min(jnp.mean((images[0] - truth[None]) ** 2, axis=(1, 2, 3)))
        ours = error(ensemble.combine(*images, **OURS, windows=(7, 15)))
        paper = error(ensemble.combine(*images, solver="hull"))
        return ours - best, paper - ours

    gain, paper = jax.jit(jax.vmap(one))(jax.random.split(jax.random.key(1), 40))
    assert_mean_below(gain, 0.0)
    assert_mean_below(-paper, 0.0)


@pytest.mark.parametrize("solver", ["hull", "multi-scale"])
def test_consistent_if_one_base_is(truth, solver):
    """With the unbiased image among the bases the error vanishes with the noise."""
    errors = []
    for noise in (0.1, 0.01, 0.001):
        full, y_a, y_b, a, b = rendering(jax.random.key(2), truth, noise)
        more = lambda bases, x: jnp.concatenate([bases, x[None]])
        combined = combine(
            more(full, (a + b) / 2), more(y_a, a), more(y_b, b), a, b, solver=solver
        )
        errors.append(float(jnp.mean((combined - truth) ** 2)))
    assert errors[2] < 0.1 * errors[1] < 0.1 * errors[0]


def test_multi_scale_is_between_its_scales(truth, rng):
    """Pure noise leaves the frame's matrix; what both halves agree on is kept."""
    images = rendering(jax.random.key(3), truth, 0.5)[1:]
    frame = error_matrix(*images, windows=())
    assert frame.shape == (3, 3, 24, 26, 1)
    assert float(jnp.ptp(frame, axis=(2, 3)).max()) < 1e-12
    same = rendering(jax.random.key(3), truth, 0.0)[1:]
    multi = error_matrix(*same, windows=(7, 15))
    local = error_matrix(*same, windows=(7,), whole_frame=False)
    np.testing.assert_allclose(multi, local, atol=1e-12)
    noise = [jnp.asarray(rng.normal(size=(3, 64, 64, 1))) for _ in range(2)]
    flat = jnp.ones((64, 64, 1)) + 0.1 * noise[0][0], jnp.ones((64, 64, 1))
    bases = [1 + 0.1 * i for i in noise]
    spread = lambda matrix: float(jnp.std(matrix[0, 0]))
    shrunk = error_matrix(*bases, *flat, windows=(7, 15))
    plain = error_matrix(*bases, *flat, windows=(7,), whole_frame=False)
    assert spread(shrunk) < 0.5 * spread(plain)


def test_shared_or_each_channel():
    images = rendering(jax.random.key(4), jnp.ones((9, 10, 3)), 0.1)[1:]
    each = error_matrix(*images, windows=(7,), shared=False)
    assert each.shape == (3, 3, 9, 10, 3)
    assert error_matrix(*images, windows=(7,)).shape == (3, 3, 9, 10, 1)
    one_channel = [i[..., :1] for i in images]
    np.testing.assert_allclose(
        error_matrix(*one_channel, windows=(7,), shared=False),
        error_matrix(*one_channel, windows=(7,)),
        rtol=1e-10,
    )


def bilateral_by_loops(image, guide, noisy, variance, window, sigma):
    """Every pair of pixels, in float64."""
    every = np.concatenate([image, guide, noisy, variance], -1)
    valid = np.isfinite(every).all(-1)
    finite = np.isfinite(image).all(-1, keepdims=True)
    out, r = np.where(finite, image, 0.0), window // 2
    for p in np.argwhere(valid):
        total, weight = 0, 0
        for q in np.argwhere(valid):
            if abs(p - q).max() > r:
                continue
            a, b = tuple(p), tuple(q)
            d = ((p - q) ** 2).sum() / (2 * sigma**2) + (
                (guide[a] - guide[b]) ** 2
            ).sum()
            noise = variance[a] + variance[b]
            square = (noisy[a] - noisy[b]) ** 2
            far = np.where(square > 0, 1e4, 0)
            d += np.where(
                square < 1e4 * noise, square / np.maximum(noise, 1e-300), far
            ).sum()
            total, weight = total + np.exp(-d) * image[b], weight + np.exp(-d)
        out[tuple(p)] = total / weight
    return out


@pytest.mark.parametrize("size", [(9, 12), (1, 1), (1, 7)])
def test_the_filter_is_the_loops(size, rng):
    image, noisy = rng.normal(size=(2, *size, 2))
    guide, variance = rng.normal(size=(*size, 3)), rng.uniform(0, 1, (*size, 2))
    variance[0, 0] = 0
    if size == (9, 12):
        noisy[4, 5, 0], guide[2, 2, 1] = np.nan, np.inf
    data = image, guide, noisy, variance

    @jax.jit
    def filtered(image, *guides):
        alike = bilateral_weights(*guides, sigma=2.0)
        return weighted_mean(image, alike, window=5)

    arrays = [jnp.asarray(i) for i in data]
    np.testing.assert_allclose(
        filtered(*arrays), bilateral_by_loops(*data, 5, 2.0), rtol=1e-9, atol=1e-12
    )
    total = lambda *i: filtered(*i).sum()
    for gradient in jax.jit(jax.grad(total, argnums=(0, 1, 2, 3)))(*arrays):
        assert np.isfinite(gradient).all()


def test_the_filter_is_as_exact_far_from_the_origin(rng):
    """Where scaled coordinates would be rounded, in float32."""
    image, guide = jnp.asarray(rng.normal(size=(2, 3, 5000, 1)), jnp.float32)

    @jax.jit
    def filtered(image, guide):
        alike = bilateral_weights(guide, guide, guide**2, sigma=0.7)
        return weighted_mean(image, alike, window=5)

    crop = filtered(image[:, -20:], guide[:, -20:])
    far = filtered(image, guide)[:, -20:]
    np.testing.assert_allclose(far[:, 2:], crop[:, 2:], atol=2e-6)


def test_filtered_weights_stay_weights(glass_frame, rng):
    color, albedo, normal = glass_frame.color, glass_frame.albedo, glass_frame.normal
    w = rng.dirichlet(np.ones(3), color.shape)
    w = jnp.asarray(np.moveaxis(w, -1, 0), jnp.float32)
    smooth = jax.jit(ensemble.filter_weights)
    out = smooth(w, color, glass_frame.variance, albedo=albedo, normal=normal)
    np.testing.assert_allclose(out.sum(axis=0), 1, rtol=1e-5)
    assert out.min() >= 0
    assert out.std() < 0.8 * w.std()
    bare = smooth(w, color, glass_frame.variance)
    assert bare.std() < out.std()  # features keep edges
    broken = color.at[5, 6, 0].set(jnp.nan)
    kept = smooth(w, broken, glass_frame.variance)
    np.testing.assert_array_equal(kept[:, 5, 6], w[:, 5, 6])


def test_one_base_is_itself(truth):
    images = [i[:1] for i in rendering(jax.random.key(5), truth, 0.1)[:3]]
    x = rendering(jax.random.key(5), truth, 0.1)[3:]
    for options in ({}, OURS):
        np.testing.assert_allclose(
            combine(*images, *x, **options), images[0][0], rtol=1e-12
        )
    assert ensemble.select_bases(*images[1:], *x).kept == (0,)


def test_selection_drops_what_does_not_help(truth):
    """A copy and a base of nothing but noise leave, the good one stays."""
    _, y_a, y_b, a, b = rendering(jax.random.key(6), truth, 0.3)
    noise = 3 * np.random.default_rng(8).normal(size=(2, 1, *truth.shape))
    noise = jnp.asarray(noise)
    more_a = jnp.concatenate([y_a, y_a[:1], noise[0]])
    more_b = jnp.concatenate([y_b, y_b[:1], noise[1]])
    chosen = ensemble.select_bases(more_a, more_b, a, b, window=15)
    assert 4 not in chosen.kept
    assert not {0, 3} <= set(chosen.kept)
    assert chosen.errors[-1] <= chosen.errors[0] + 1e-5 * abs(chosen.errors[0])
    assert len(chosen.errors) == 6 - len(chosen.kept)


def test_stacked_bases_name_the_one_that_does_not_fit(truth):
    halves = jnp.stack([truth, 2 * truth])
    good, other = Estimate(1.5 * truth, halves), Estimate(truth[1:], halves[:, 1:])
    full, a, b = ensemble.stack_estimates({"one": good, "two": good})
    for stack, image in ((full, 1.5 * truth), (a, truth), (b, 2 * truth)):
        np.testing.assert_array_equal(stack, jnp.stack([image, image]))
    for bases, message in (
        ({}, "at least one estimate, got none"),
        (
            {"one": good, "two": Estimate(truth)},
            "needs estimates with halves: 'two' has none",
        ),
        ({"one": good, "two": other}, r"estimate 'two' has shape .* 'one' has"),
        (
            {"one": good, "two": Estimate(truth, halves[:, 1:])},
            "estimate 'two' has halves of",
        ),
    ):
        with pytest.raises(ValueError, match=message):
            ensemble.stack_estimates(bases)


def test_one_hot():
    errors = jnp.asarray([3.0, 1.0, 1.0]).reshape(3, 1, 1, 1)
    np.testing.assert_array_equal(ensemble.one_hot(errors).ravel(), [0, 1, 0])


def test_gradients(truth):
    images = [i[..., :5, :6, :1] for i in rendering(jax.random.key(7), truth, 0.5)]
    run = jax.jit(lambda *i: ensemble.combine(*i, **OURS, windows=(3,)))
    check_grads(run, images, order=1, eps=1e-6, rtol=1e-4, atol=1e-4)


@pytest.mark.usefixtures("unchecked")
def test_bad_input(truth):
    images = rendering(jax.random.key(8), truth, 0.1)
    run = ensemble.combine
    with pytest.raises(ValueError, match=r"biased_a must be .* at least one base"):
        run(*(i[:0] for i in images[:3]), *images[3:])
    with pytest.raises(
        ValueError, match=r"biased_b has shape \(2, 24, 26, 3\), expected"
    ):
        run(*images[:2], images[2][:2], *images[3:])
    with pytest.raises(ValueError, match="unbiased_b has shape"):
        run(*images[:4], images[4][:5])
    with pytest.raises(ValueError, match=r"biased is \(3, 20, 26, 3\)"):
        run(images[0][:, :20], *images[1:])
    with pytest.raises(ValueError, match=r"solver must be one of .*'hull'"):
        run(*images, solver="best")
    with pytest.raises(ValueError, match="needs solver_key"):
        run(*images, solver="iterative")
    with pytest.raises(ValueError, match="needs a window, or the whole frame"):
        ensemble.error_matrix(*images[1:], windows=(), whole_frame=False)


def by_loops(y_a, y_b, x_a, x_b, v_a, v_b, block):
    """Upper triangles of each half's block means, pixel by pixel in float64."""
    n, height, width, _ = y_a.shape
    grey = (np.median(y_a, axis=0) + np.median(y_b, axis=0)).mean(-1) / 2
    scale = grey**2 + 0.01 * grey.mean() ** 2
    found = []
    for y, truth, variance in ((y_a, x_b, v_b), (y_b, x_a, v_a)):
        relative = variance.mean(-1) / scale
        sums = np.zeros((n, n, -(-height // block), -(-width // block)))
        count = np.zeros(sums.shape[2:])
        for row in range(height):
            for column in range(width):
                near = relative[
                    max(row - 4, 0) : row + 5, max(column - 4, 0) : column + 5
                ].mean()
                weight = 1 / (scale[row, column] * (1 + 10 * near))
                error = y[:, row, column] - truth[row, column]
                mean = error.mean(axis=0)
                square = error[:, None] * error[None] - mean**2
                at = row // block, column // block
                sums[:, :, *at] += weight * square.mean(-1)
                count[at] += 1
        found.append(sums / count)
    return found


def test_blocks_and_weights_of_pixels_are_those_of_loops(rng):
    """A frame of which the last blocks are cut off."""
    truth = 1 + rng.random((11, 14, 3))
    noisy = lambda size: jnp.asarray(truth + size * rng.normal(size=(2, 11, 14, 3)))
    x, y = noisy(0.3), jnp.stack([noisy(0.1), 1.1 * noisy(0.1), noisy(0.2)])
    v = jnp.asarray(0.09 * (0.5 + rng.random((2, 11, 14, 3))))
    images = y[:, 0], y[:, 1], *x
    a, b = by_loops(*map(np.asarray, (*images, *v)), block=4)
    options = {"variance_a": v[0], "variance_b": v[1], "block": 4}
    one = ensemble.error_matrix(*images, windows=(3,), whole_frame=False, **options)
    # In excess of the plain average's, which does not change the weights.
    np.testing.assert_allclose(one[..., 0], (a + b) / 2, rtol=1e-9)
    count = np.outer([4, 4, 3], [4, 4, 4, 2])
    whole = ensemble.error_matrix(*images, windows=(), **options)
    mean = ((a + b) / 2 * count).sum((2, 3)) / count.sum()
    np.testing.assert_allclose(whole[:, :, 1, 2, 0], mean, rtol=1e-9)
    plain = ensemble.error_matrix(*images, windows=())
    np.testing.assert_allclose(
        ensemble.error_matrix(*images, windows=(), block=4)[:, :, 0, 0],
        plain[:, :, 0, 0],
        rtol=1e-9,
    )


def test_weights_of_blocks_are_smooth(truth):
    """No seam between blocks, and near those of every pixel."""
    images = rendering(jax.random.key(5), truth, 0.3)[1:]
    solve = jax.jit(
        lambda block: ensemble.solve_weights(
            *images, solver="multi-scale", windows=(13,), block=block
        ),
        static_argnums=0,
    )
    fine, coarse = solve(1), solve(4)
    np.testing.assert_allclose(coarse.sum(axis=0), 1.0, rtol=1e-9)
    assert float(coarse.min()) >= 0
    steps = jnp.abs(jnp.diff(coarse, axis=2))
    across = steps[:, :, 3::4].mean() / steps.mean()
    assert 0.5 < float(across) < 2
    assert float(jnp.abs(coarse - fine).mean()) < 0.1


@pytest.mark.parametrize("where", ["the truth's half", "a base"])
def test_fireflies_do_not_buy_weights(where):
    """Neither one in x, which says nothing, nor one that a base lets through."""
    keys = jax.random.split(jax.random.key(6), 2)
    x = 1 + 0.2 * jax.random.normal(keys[0], (2, 48, 48, 3))
    v = jnp.full_like(x, 0.04)
    good = 1 + 0.02 * jax.random.normal(keys[1], (2, 48, 48, 3))
    through = jnp.full_like(good, 1.02)
    spots = [(5, 9), (20, 33), (41, 14), (30, 6)]
    for row, column in spots:
        if where == "a base":  # and in the half it was made from, with its variance
            x = x.at[0, row, column].set(60.0)
            v = v.at[0, row, column].set(900.0)
            through = through.at[0, row, column].set(30.0)
        else:
            x = x.at[1, row, column].set(60.0)
            v = v.at[1, row, column].set(900.0)
    y = jnp.stack([good, through])
    solve = functools.partial(ensemble.solve_weights, windows=(29,))
    images = y[:, 0], y[:, 1], *x
    weights = jax.jit(solve)(*images, variance_a=v[0], variance_b=v[1])
    near = jnp.stack([weights[:, row, column, 0] for row, column in spots])
    # Both are equally wrong where there is no firefly: 0.02 squared.
    if where == "a base":
        assert float(near[:, 1].max()) < 0.05
    else:
        assert 0.2 < float(near.mean(axis=0)[0]) < 0.8


def test_spread_is_a_weighted_variance(rng):
    y, w = rng.random((3, 4, 5, 3)), rng.random((3, 4, 5, 3))
    w /= w.sum(axis=0)
    expected = (w * (y - (w * y).sum(axis=0)) ** 2).sum(axis=0)
    found = ensemble.spread(jnp.asarray(y), jnp.asarray(w))
    np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_blocks_without_pixels_have_weights_and_change_no_others(rng):
    """Of sum one; as if the frame ended beside them. Derivatives stay finite."""
    x = rng.normal(2, 0.5, (2, 40, 24, 3))
    x[:, :, 12:] += 2  # where the second base is wrong
    x = jnp.asarray(x)
    y = jnp.stack([x + 0.2, jnp.full_like(x, 2.1), x])  # [N,2,H,W,C]
    y_a, y_b = y[:, 0], y[:, 1]
    solve = jax.jit(ensemble.solve_weights)
    alone = solve(*(i[..., :15, :, :] for i in (y_a, y_b, *x)))
    gone = [i.at[..., 15:, :, :].set(jnp.nan) for i in (y_a, y_b, *x)]
    found = solve(*gone)
    slope = jax.jit(jax.grad(lambda y, *i: jnp.sum(jnp.square(solve(y, *i)))))(*gone)
    assert np.isfinite(slope).all()
    assert jnp.abs(slope[..., :15, :, :]).max() > 0
    np.testing.assert_allclose(found[:, :15], alone, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(found.sum(0), 1, rtol=1e-9)
    assert alone.std((1, 2)).max() > 1e-3
