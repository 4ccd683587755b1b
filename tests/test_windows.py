"""Window sums, means and extrema against loops; locality, clipping, masks."""

import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from jscomb.numerics import kernels, windows

SHAPES = [(1, 1, 1), (1, 7, 2), (6, 1, 1), (5, 8, 3), (20, 9, 1)]
WINDOWS = [1, 3, 5, 7, 15, 21, 25]


def near(y, x, shape, window):
    """Slices of the clipped window of a pixel."""
    r = window // 2
    rows = slice(max(0, y - r), min(shape[0], y + r + 1))
    return rows, slice(max(0, x - r), min(shape[1], x + r + 1))


def loop(image, window, fold):
    """`fold` over the clipped window of every pixel, in NumPy."""
    out = np.empty_like(image)
    for y, x, c in np.ndindex(*image.shape):
        out[y, x, c] = fold(image[(*near(y, x, image.shape, window), c)])
    return out


def images(shape, seed=0):
    return np.random.default_rng(seed).normal(size=shape)


FOLDS = {
    windows.window_sum: np.sum,
    windows.window_mean: np.mean,
    windows.window_min: np.min,
    windows.window_max: np.max,
}


@jax.jit
def of_all_windows(image):
    """Every function of every window, and the counts, by one program a shape."""
    count = lambda w: windows.window_count(image.shape, w, dtype=image.dtype)
    folded = {f: [f(image, window) for window in WINDOWS] for f in FOLDS}
    return list(folded.values()), [count(window) for window in WINDOWS]


@pytest.mark.parametrize("shape", SHAPES)
def test_matches_loops(shape):
    image = images(shape)
    found, _ = of_all_windows(image)
    for of_function, fold in zip(found, FOLDS.values(), strict=True):
        for of_window, window in zip(of_function, WINDOWS, strict=True):
            expected = loop(image, window, fold)
            np.testing.assert_allclose(of_window, expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("shape", SHAPES)
def test_count_is_the_sum_of_ones(shape):
    _, counts = of_all_windows(images(shape))
    for count, window in zip(counts, WINDOWS, strict=True):
        ones = loop(np.ones((*shape[:2], 1)), window, np.sum)
        np.testing.assert_array_equal(count, ones)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("window", [1, 5, 15])
def test_values_at_the_largest_match_loops(shape, window):
    image, by = images(shape), images((*shape[:2], 1), seed=1)
    mask = np.random.default_rng(2).random((*shape[:2], 1)) < 0.7
    expected = np.zeros_like(image)
    hidden = np.where(mask, by, -np.inf)
    for y, x in np.ndindex(*shape[:2]):
        at = near(y, x, shape, window)
        if mask[at].any():
            place = np.unravel_index(hidden[at].argmax(), hidden[at].shape)[:2]
            expected[y, x] = image[at][place]
    run = jax.jit(lambda *i: windows.at_window_max(*i, window, mask=jnp.asarray(mask)))
    broken = np.where(mask, image, np.nan)
    found = run(jnp.asarray(np.where(mask, by, np.nan)), jnp.asarray(broken))
    np.testing.assert_array_equal(found, expected)
    check_grads(lambda i: run(jnp.asarray(by), i), (jnp.asarray(image),), 1, ["rev"])


@pytest.mark.parametrize("shape", SHAPES)
def test_separable_sums_match_loops(shape):
    image, kernel = jnp.asarray(images(shape)), jnp.asarray([0.5, 2.0, 1.0, 0.0, 3.0])
    padded = np.pad(image, ((2, 2), (2, 2), (0, 0)))
    weights = np.outer(kernel, kernel)[..., None]
    expected = [
        [(weights * padded[y : y + 5, x : x + 5]).sum((0, 1)) for x in range(shape[1])]
        for y in range(shape[0])
    ]
    run = jax.jit(windows.separable_sum)
    np.testing.assert_allclose(run(image, kernel), expected, atol=1e-12)
    check_grads(run, (image, kernel), 1, ["rev"])
    with pytest.raises(ValueError, match="window must be odd"):
        windows.separable_sum(image, kernel[:4])


@pytest.mark.parametrize("window", [3, 15])
def test_masked_pixels_are_excluded(window):
    image = images((6, 7, 2))
    mask = np.random.default_rng(1).random((6, 7, 1)) < 0.6
    mask[:3, :3] = False  # a window without any pixel
    hidden = jnp.asarray(np.where(mask, image, np.nan))
    included = np.where(mask, image, 0)
    count = loop(np.broadcast_to(mask, image.shape).astype(float), window, np.sum)
    total = loop(included, window, np.sum)
    functions = (
        windows.window_sum,
        windows.window_mean,
        windows.window_max,
        windows.window_min,
    )
    run = jax.jit(lambda i, mask: [f(i, window, mask=mask) for f in functions])
    sums, means, maxima, minima = run(hidden, jnp.asarray(mask))
    np.testing.assert_allclose(sums, total, atol=1e-12)
    np.testing.assert_allclose(
        means,
        np.divide(total, count, out=np.zeros_like(total), where=count > 0),
        atol=1e-12,
    )
    np.testing.assert_array_equal(
        maxima,
        loop(np.where(mask, image, -np.inf), window, np.max),
    )
    np.testing.assert_array_equal(
        minima,
        loop(np.where(mask, image, np.inf), window, np.min),
    )


@pytest.mark.parametrize("shape", SHAPES)
def test_gaussian_mean_matches_loops(shape):
    image, window, sigma = images(shape), 7, 1.3
    out = np.empty_like(image)
    for y, x, c in np.ndindex(*shape):
        rows, columns = near(y, x, shape, window)
        dy, dx = np.mgrid[rows, columns]
        weight = np.exp(-((dy - y) ** 2 + (dx - x) ** 2) / (2 * sigma**2))
        out[y, x, c] = np.average(image[rows, columns, c], weights=weight)
    mean = jax.jit(lambda i: windows.window_mean(i, window, sigma=sigma))
    np.testing.assert_allclose(mean(image), out, rtol=1e-10)


@pytest.mark.parametrize("shape", SHAPES)
def test_kernel_mean_matches_loops(shape):
    window, r = 5, 2
    image = images(shape)
    weights = np.random.default_rng(2).random((*shape[:2], window**2))
    out = np.empty_like(image)
    for y, x, c in np.ndindex(*shape):
        total = weight = 0.0
        for k, (dy, dx) in enumerate(np.ndindex(window, window)):
            v, u = y + dy - r, x + dx - r
            if 0 <= v < shape[0] and 0 <= u < shape[1]:
                total += weights[y, x, k] * image[v, u, c]
                weight += weights[y, x, k]
        out[y, x, c] = total / weight
    mean = jax.jit(lambda i, w: kernels.kernel_mean(i, w, window))
    at = jnp.asarray(image), jnp.asarray(weights)
    np.testing.assert_allclose(mean(*at), out, rtol=1e-10)
    check_grads(mean, at, order=1, rtol=1e-4)


def test_a_firefly_leaves_other_windows_exact():
    """Running differences would lose the digits of everything after it."""
    image = np.full((9, 64, 1), 1e-3, np.float32)
    image[4, 8] = 1e6
    total = windows.window_sum(jnp.asarray(image), 5)
    np.testing.assert_allclose(total[4, 16:-2], 25e-3, rtol=1e-6)


@pytest.mark.parametrize(
    "function", [windows.window_sum, windows.window_mean, windows.window_max]
)
def test_transforms_agree(function):
    batch = jnp.asarray(images((3, 6, 5, 2)))
    eager = jnp.stack([function(i, 3) for i in batch])
    mapped = jax.jit(jax.vmap(lambda i: function(i, 3)))(batch)
    np.testing.assert_allclose(mapped, eager, rtol=1e-12, atol=1e-14)
    check_grads(jax.jit(lambda i: function(i, 3)), (batch[0],), order=1, rtol=1e-5)


@pytest.mark.parametrize("window", [5, 21, 25])
def test_a_sum_is_its_own_derivative(window):
    image, weights = (jnp.asarray(images((9, 30, 2), seed)) for seed in (3, 4))
    total = lambda image: jnp.sum(windows.window_sum(image, window) * weights)
    np.testing.assert_allclose(
        jax.jit(jax.grad(total))(image), windows.window_sum(weights, window), atol=1e-12
    )


@pytest.mark.parametrize("traced", [False, True])
def test_a_kernel_reversed_is_the_derivative(traced):
    image, weights = (jnp.asarray(images((6, 7, 2), seed)) for seed in (3, 4))
    kernel = jnp.array([1.0, 3.0, -2.0])
    fixed = jax.jit(lambda image: windows.separable_sum(image, kernel))
    given = lambda image: jax.jit(windows.separable_sum)(image, kernel)
    function = given if traced else fixed
    _, transpose = jax.vjp(function, image)
    np.testing.assert_allclose(
        *transpose(weights), windows.separable_sum(weights, kernel[::-1]), atol=1e-12
    )
    check_grads(function, (image,), order=2, modes=["fwd", "rev"])
    mapped = jax.vmap(jax.grad(lambda i: jnp.sum(function(i) * weights)))(image[None])
    np.testing.assert_allclose(mapped[0], *transpose(weights), atol=1e-12)


SHARDED = """
import re
import os
import subprocess
import sys

import jax
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jscomb.numerics.windows import window_sum

rows = NamedSharding(Mesh(jax.devices(), "rows"), PartitionSpec("rows"))
compiled = jax.jit(
    lambda i: window_sum(i, 15), in_shardings=rows, out_shardings=rows
)
image = jax.ShapeDtypeStruct((256, 64, 3), "float32")
text = compiled.lower(image).compile().as_text()
moves = re.findall(r"(collective-permute|all-\\w+)(?:-start)?\\(", text)
assert moves == 2 * ["collective-permute"], moves
print(len(jax.devices()))
"""


def test_a_sum_sharded_by_rows_is_one_exchange_of_halos():
    """Compiled for four devices, in a process that believes it has them."""
    flags = "--xla_force_host_platform_device_count=4"
    done = subprocess.run(
        [sys.executable, "-c", SHARDED],
        env=os.environ | {"XLA_FLAGS": flags},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.stdout == "4\n", done.stderr


@pytest.mark.parametrize("window", [0, -1, 2, 14])
def test_rejects_even_and_empty_windows(window):
    image = jnp.ones((3, 3, 1))
    for function in (windows.window_sum, windows.window_mean, windows.window_min):
        with pytest.raises(ValueError, match="window must be odd and positive"):
            function(image, window)
    with pytest.raises(ValueError, match="window must be odd and positive"):
        windows.window_count((3, 3), window)


@pytest.mark.parametrize("chain", [(), (1,), (7,), (3, 5), (15, 7, 7)])
def test_reach_is_how_far_windows_in_turn_see(chain):
    """Exactly: the pixel at the reach counts, the next one does not."""

    def value(row):
        image = row.reshape(1, -1, 1)
        for window in chain:
            image = windows.window_sum(image, window)
        return image[0, 30, 0]

    seen = np.flatnonzero(jax.jit(jax.grad(value))(jnp.zeros(61)))
    assert windows.reach_of(*chain) == 30 - seen.min() == seen.max() - 30
    with pytest.raises(ValueError, match="window must be odd and positive, got 4"):
        windows.reach_of(*chain, 4)


@pytest.mark.usefixtures("unchecked")
def test_rejects_bad_weights():
    image = jnp.ones((3, 4, 1))
    with pytest.raises(ValueError, match=r"weights must have shape \(3, 4, 25\)"):
        kernels.kernel_mean(image, jnp.ones((3, 4, 9)), 5)
    with pytest.raises(ValueError, match="sigma must be positive"):
        windows.window_mean(image, 3, sigma=0.0)
