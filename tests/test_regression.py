"""Windowed regression against a loop over windows in float64."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from jscomb.numerics import regression
from jscomb.numerics.regression import joint_local_linear
from jscomb.numerics.weights import gaussian_weights


def gaussian(guide, bandwidth):
    """exp(-|g_i - g_c|^2 / h) of a window about c; h a number or the mean of two."""

    def weigh(c, window):
        square = ((guide[window] - guide[c]) ** 2).sum(-1)
        if np.ndim(bandwidth):
            return np.exp(-2 * square / (bandwidth[window] + bandwidth[c])[..., 0])
        return np.exp(-square / bandwidth)

    return weigh


def oracle(targets, features, *, predict=None, window, stride=1, ridge=0.1, floor=0.1):
    """One least-squares solve a window, with the constant among the unknowns."""
    height, width, f = features.shape
    valid = np.isfinite(np.concatenate([features, *(t for t, _ in targets)], -1)).all(
        -1
    )
    total, weight = np.zeros_like(targets[0][0]), np.zeros((height, width))
    total[~np.isfinite(total)] = 0
    r = window // 2
    penalty = np.diag([0, *np.broadcast_to(ridge, f)])
    for c in np.ndindex(height, width):
        if not valid[c] or (stride > 1 and not on_grid(c, window, stride)):
            continue
        around = tuple(slice(max(0, x - r), x + r + 1) for x in c)
        inside = valid[around]
        d = np.where(inside[..., None], features[around] - features[c], 0)
        d = d / (abs(d).max((0, 1)) + floor)
        basis = np.concatenate([np.ones((*d.shape[:2], 1)), d], -1)[inside]
        matrix, right = penalty, 0
        for target, weigh in targets:
            w = weigh(c, around)[inside][:, None]
            matrix = matrix + (basis * w).T @ basis
            right = right + (basis * w).T @ target[around][inside]
        predicted = basis @ np.linalg.solve(matrix, right)
        w = (predict or targets[0][1])(c, around)[inside]
        total[around][inside] += w[:, None] * predicted
        weight[around][inside] += w
    return total / np.where(weight > 0, weight, 1)[..., None], weight


def on_grid(c, window, stride):
    """One centre in each block, on another line in the next."""
    (row, shift_row), (column, shift_column) = (divmod(x, stride) for x in c)
    side = regression._grid(window, stride).side
    shift = lambda block: (
        block % side % stride if side >= stride else block % side * stride // side
    )
    return (shift_row, shift_column) == (shift(column), shift(row))


def images(rng, height, width, features, channels=2):
    """Target, guide and features."""
    return (
        rng.uniform(size=(height, width, channels)),
        rng.uniform(size=(height, width, 3)),
        rng.normal(size=(height, width, features)),
    )


def errors(fit, expected):
    """Relative errors of the prediction, by the largest channel of a pixel."""
    prediction, _ = expected
    scale = abs(prediction).max(-1, keepdims=True) + 1e-300
    return abs(np.asarray(fit.prediction, np.float64) - prediction) / scale


fit = jax.jit(
    regression.local_linear,
    static_argnames=("window", "stride", "ridge", "scale_floor"),
)


gradient = jax.jit(
    jax.grad(lambda *i: fit(*i, window=11).prediction.sum(), argnums=(0, 1, 2, 3))
)


def assert_accurate(data, bandwidth, **options):
    """Float64 to rounding; float32 within what the method promises."""
    target, guide, features = data
    h = np.asarray(bandwidth)
    floor = options.pop("scale_floor", 0.1)
    expected = oracle([(target, gaussian(guide, h))], features, floor=floor, **options)
    for dtype, maximum, median in ((np.float64, 1e-8, 1e-10), (np.float32, 1e-3, 1e-4)):
        arrays = [jnp.asarray(a, dtype) for a in (*data, h)]
        found = fit(*arrays, scale_floor=floor, **options)
        assert found.prediction.dtype == dtype
        error = errors(found, expected)
        assert error.max() < maximum
        assert np.median(error) < median
        np.testing.assert_allclose(
            found.weight[..., 0], expected[1], rtol=100 * maximum
        )


@pytest.mark.parametrize(
    ("size", "features", "window", "stride"),
    [
        ((40, 37), 11, 21, 1),  # several tiles along both axes, and clipped windows
        ((33, 70), 3, 51, 2),
        ((30, 33), 2, 9, 3),
        ((19, 24), 1, 7, 4),
        ((1, 1), 2, 51, 1),
        ((1, 9), 2, 5, 2),
        ((9, 1), 0, 3, 1),  # without features: a weighted mean
        ((4, 5), 2, 1, 1),
    ],
)
def test_is_the_loop(size, features, window, stride, rng):
    data = images(rng, *size, features)
    assert_accurate(data, 0.1, window=window, stride=stride)


def test_a_bandwidth_for_each_pixel(rng):
    data = images(rng, 12, 20, 2)
    bandwidth = rng.uniform(0.02, 0.5, (12, 20, 1))
    assert_accurate(data, bandwidth, window=7)
    same = fit(*map(jnp.asarray, data), jnp.full((12, 20, 1), 0.1), window=7)
    one = fit(*map(jnp.asarray, data), 0.1, window=7)
    np.testing.assert_allclose(same.prediction, one.prediction, rtol=1e-12)


def test_two_targets_share_one_model(rng):
    (a, ga, features), (b, gb, _) = images(rng, 14, 18, 3), images(rng, 14, 18, 3)
    ha, hb = rng.uniform(0.05, 0.5, (2, 14, 18, 1))
    predict = gaussian(ga, 0.2)
    expected = oracle(
        [(a, gaussian(ga, ha)), (b, gaussian(gb, hb))],
        features,
        predict=predict,
        window=9,
    )

    def joint(a, ga, ha, b, gb, hb, features):
        (fit,) = joint_local_linear(
            [(a, gaussian_weights(ga, ha)), (b, gaussian_weights(gb, hb))],
            features,
            predict=gaussian_weights(ga, 0.2),
            window=9,
        )
        return fit

    found = jax.jit(joint)(*map(jnp.asarray, (a, ga, ha, b, gb, hb, features)))
    assert errors(found, expected).max() < 1e-10
    np.testing.assert_allclose(found.weight[..., 0], expected[1], rtol=1e-10)


def test_powers_are_bandwidths(rng):
    t, g, features = images(rng, 14, 18, 3)
    powers = (4, 1, 2.5)

    @jax.jit
    def fits(t, g, features):
        weighted = [(t, gaussian_weights(g, 0.4))]
        return joint_local_linear(weighted, features, powers=powers, window=9)

    for power, found in zip(powers, fits(t, g, features), strict=True):
        expected = oracle([(t, gaussian(g, 0.4 / power))], features, window=9)
        assert errors(found, expected).max() < 1e-10
        np.testing.assert_allclose(found.weight[..., 0], expected[1], rtol=1e-10)
    t, g, features = map(jnp.asarray, (t, g, features))
    with pytest.raises(ValueError, match="powers must be positive"):
        joint_local_linear(
            [(t, gaussian_weights(g, 0.4))], features, powers=(1, 0), window=9
        )


def hard_cases():
    """Target, guide, features and bandwidth that break careless arithmetic."""
    rng = np.random.default_rng(0)
    t, g, f = images(rng, 24, 26, 3)
    firefly = 1e-3 * t
    firefly[12, 13] = 1e6
    collinear = np.concatenate([f[..., :1], 2 * f[..., :1] + 1, 0 * f[..., :1]], -1)
    bright = 1e-3 * f
    bright[12, 13] = 1e6
    return {
        "firefly in the target": (firefly, g, f, 0.1),
        "firefly in all": (
            firefly,
            1e-3 * g + (firefly.max(-1, keepdims=True) > 1),
            bright,
            0.1,
        ),
        "collinear and constant features": (t, g, collinear, 0.1),
        "features far from zero": (t, g, f + 1000, 0.1),
        "one effective pixel": (t, 100 * g, f, 1e-3),
        "faint": (1e-8 * t, g, 1e-8 * f, 0.1),
        "all alike": (t, 0 * g, f, 0.1),
        "nothing varies": (0 * t + 1, 0 * g, 0 * f, 0.1),
    }


@pytest.mark.parametrize("case", hard_cases())
def test_hard_cases(case):
    """Accurate, and with finite derivatives, also in float32."""
    *data, h = hard_cases()[case]
    assert_accurate(data, h, window=11)
    assert_accurate(data, h, window=11, stride=2)
    single = [jnp.asarray(i, jnp.float32) for i in (*data, h)]
    assert all(np.isfinite(g).all() for g in gradient(*single))


@pytest.mark.parametrize("stride", [1, 2])
def test_the_middle_of_a_tile_lies_in_all_its_windows(stride, rng):
    """Features are taken relative to it: a bright one there must not drown the rest."""
    t, g, f = images(rng, 24, 26, 3)
    grid = regression._grid(11, stride)
    middle = grid.places[:, abs(grid.places - (grid.step - 1) / 2).sum(0).argmin()]
    row, column = middle + grid.step
    f[row, column] = 1e6
    assert_accurate((t, g, f), 0.1, window=11, stride=stride)
    t[row - 1, column] = t[row, column - 1] = np.nan
    assert_accurate((t, g, f), 0.1, window=11, stride=stride)


def test_a_bright_pixel_keeps_its_light():
    """The constant has no ridge: an isolated pixel is not darkened at all."""
    spot = np.zeros((9, 9, 1))
    spot[4, 4] = 1
    found = fit(*map(jnp.asarray, (spot, spot, spot)), 1e-3, window=5)
    np.testing.assert_allclose(found.prediction, spot, atol=1e-12)


def test_equal_features_with_the_ridge_shared_are_one_feature(rng):
    t, g, f = map(jnp.asarray, images(rng, 12, 12, 1))
    twice = jnp.concatenate([f, f], axis=-1)
    run = jax.jit(
        lambda f, ridge: regression.local_linear(t, g, f, 0.1, window=7, ridge=ridge)
    )
    both, one = run(twice, jnp.array([0.1, 0.1])), run(f, jnp.array([0.05]))
    np.testing.assert_allclose(one.prediction, both.prediction, rtol=1e-10)


@pytest.mark.parametrize("which", [0, 1, 2, 3])
def test_a_bad_pixel_is_excluded(which, rng):
    data = [*images(rng, 13, 14, 2), rng.uniform(0.1, 0.2, (13, 14, 1))]
    missing = data[0].copy()
    missing[4, 5] = np.nan
    weigh = gaussian(data[1], data[3])
    expected = oracle([(missing, weigh)], data[2], window=11)
    for bad in (np.nan, np.inf) if which < 3 else (np.nan, 0.0, -1.0):
        poisoned = [d.copy() for d in data]
        poisoned[which][4, 5, 0] = bad
        arrays = [jnp.asarray(p) for p in poisoned]
        found = fit(*arrays, window=11)
        assert np.isfinite(found.prediction).all()
        assert found.weight[4, 5, 0] == 0
        assert found.prediction[4, 5].tolist() == [0.0, 0.0]
        error = errors(found, expected)
        error[4, 5] = 0
        assert error.max() < 1e-10
        assert all(np.isfinite(g).all() for g in gradient(*arrays))


@pytest.mark.parametrize("stride", [1, 2])
def test_gradients(stride, rng):
    t, g, f = map(jnp.asarray, images(rng, 7, 8, 2, channels=1))
    h = jnp.asarray(rng.uniform(0.1, 0.2, (7, 8, 1)))
    ridge = jnp.array([0.1, 0.2])

    def predict(t, g, f, h, ridge):
        return regression.local_linear(
            t, g, f, h, window=5, stride=stride, ridge=ridge
        ).prediction

    check_grads(jax.jit(predict), (t, g, f, h, ridge), order=1, rtol=1e-5)


def test_vmap_is_a_loop(rng):
    batch = [
        jnp.asarray(np.stack(i))
        for i in zip(images(rng, 9, 9, 2), images(rng, 9, 9, 2), strict=True)
    ]
    run = lambda t, g, f: fit(t, g, f, 0.1, window=5)
    mapped = jax.jit(jax.vmap(run))(*batch)
    for k in range(2):
        one = run(*(b[k] for b in batch))
        np.testing.assert_allclose(mapped.prediction[k], one.prediction, rtol=1e-10)


def test_reverse_mode_does_not_store_the_tiles():
    """Memory of the gradient stays far below the weights of all windows."""
    shapes = [jax.ShapeDtypeStruct((128, 128, c), jnp.float32) for c in (1, 1, 1)]
    total = lambda *i: fit(*i, 0.1, window=31).prediction.sum()
    compiled = jax.jit(jax.grad(total, argnums=(0, 1, 2))).lower(*shapes).compile()
    memory = compiled.memory_analysis().temp_size_in_bytes
    assert memory < 4 * 128**2 * 31**2


def test_a_large_frame_fits():
    """2048x2048 with 11 features stays below 2 GB, images and result included."""
    shape = lambda c: jax.ShapeDtypeStruct((2048, 2048, c), jnp.float32)
    run = jax.jit(lambda *i: regression.local_linear(*i, 0.1))
    memory = run.lower(shape(3), shape(3), shape(11)).compile().memory_analysis()
    images = memory.argument_size_in_bytes + memory.output_size_in_bytes
    assert memory.temp_size_in_bytes + images < 2e9


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"bandwidth": 0.0}, "bandwidth must be positive, got 0.0"),
        ({"bandwidth": jnp.ones((6, 7))}, r"bandwidth has shape \(6, 7\), guide has"),
        ({"ridge": -1.0}, "ridge must be positive, got -1.0"),
        ({"scale_floor": 0.0}, "scale_floor must be positive, got 0.0"),
        ({"window": 4}, "window must be odd and positive, got 4"),
        ({"stride": 9}, "stride must be from 1 to 3 for window=5, got 9"),
        ({"features": jnp.ones((6, 6, 2))}, r"features has shape \(6, 6, 2\), target"),
        ({"guide": jnp.ones((5, 6, 2))}, r"guide has shape \(5, 6, 2\), target"),
        ({"target": jnp.ones((6, 7))}, r"target 0 must have shape \[H, W, C\]"),
    ],
)
def test_bad_input(change, message):
    good = dict.fromkeys(("target", "guide", "features"), jnp.ones((6, 7, 2)))
    options = {"bandwidth": 0.1, "window": 5} | good | change
    with pytest.raises(ValueError, match=message):
        regression.local_linear(**options)
