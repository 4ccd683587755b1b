"""Non-local means and NFOR."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from jscomb import combine, exr, james_stein
from jscomb.denoisers import bilateral, nfor, nonlocal_means, rdfc, smoothing
from jscomb.frame import make_frame
from jscomb.metrics import rel_l2
from jscomb.numerics.sure import monte_carlo_sure
from tests.conftest import DATA

SIZES = {"window": 7, "patch": 3}
means = jax.jit(nonlocal_means.denoise, static_argnames=("window", "patch", "strength"))


def means_by_loops(image, u, v, f=None, *, window, patch, strength):
    """Every patch of every pair of pixels, in float64; also of features if given."""
    size, r, near = np.array(image.shape[:2]), window // 2, patch // 2
    f = np.zeros((*size, 0)) if f is None else f
    valid = np.isfinite(np.concatenate([image, u, v, f], -1)).all(-1)
    inside = lambda p: (p >= 0).all() and (p < size).all() and valid[tuple(p)]

    def distance(p, q):
        p, q = tuple(p), tuple(q)
        square = (u[p] - u[q]) ** 2 - (v[p] + np.minimum(v[p], v[q]))
        noise = strength**2 * (v[p] + v[q])
        far = np.where(square > 0, 1e6, 0.0)
        near = square < 1e6 * noise
        return np.where(near, square / np.where(noise > 0, noise, 1), far).mean()

    def slope(p, axis):
        step = np.eye(2, dtype=int)[axis]
        around = (tuple(np.clip(p + s, 0, size - 1)) for s in (step, -step))
        after, before = (
            f[q] if np.isfinite(f[q]).all() else f[tuple(p)] for q in around
        )
        return ((after - before) / 2) ** 2

    def unlike(p, q):
        scale = 0.36 * np.maximum(slope(p, 0) + slope(p, 1), 1e-3)
        return np.max((f[tuple(p)] - f[tuple(q)]) ** 2 / scale, initial=0)

    result = np.where(np.isfinite(image).all(-1, keepdims=True), image, 0.0)
    offsets = [np.array(o) - near for o in np.ndindex(patch, patch)]
    for p in np.argwhere(valid):
        total, weight = 0, 0
        for o in np.ndindex(window, window):
            q = p + o - r
            if not inside(q):
                continue
            pairs = [(p + s, q + s) for s in offsets]
            seen = [distance(a, b) for a, b in pairs if inside(a) and inside(b)]
            w = np.exp(-max(0, np.mean(seen), unlike(p, q)))
            total, weight = total + w * image[tuple(q)], weight + w
        result[tuple(p)] = total / weight
    return result


def noisy(rng, height=9, width=11):
    """Image, guide and its variance; one pixel without variance."""
    image, u = rng.uniform(size=(2, height, width, 2))
    v = rng.uniform(0.01, 0.1, (height, width, 2))
    v[3, 0] = 0
    return image, u, v


@pytest.mark.parametrize("broken", [False, True])
def test_non_local_means_are_the_loops(broken, rng):
    data = noisy(rng)
    if broken:
        for k, bad in enumerate((np.nan, np.inf, np.nan)):
            data[k][2 + 3 * k, 4, 0] = bad
    expected = means_by_loops(*data, **SIZES, strength=0.7)
    for dtype, tolerance in ((np.float64, 1e-11), (np.float32, 1e-5)):
        arrays = [jnp.asarray(d, dtype) for d in data]
        found = means(*arrays, **SIZES, strength=0.7)
        np.testing.assert_allclose(found, expected, rtol=tolerance, atol=tolerance)
    total = lambda *i: means(*i, **SIZES).sum()
    for gradient in jax.jit(jax.grad(total, argnums=(0, 1, 2)))(*arrays):
        assert np.isfinite(gradient).all()


@pytest.mark.parametrize("broken", [False, True])
def test_rdfc_is_the_loops(broken, rng):
    data = (*noisy(rng), np.add.outer(np.arange(9), np.arange(11) % 7)[..., None] / 10)
    if broken:
        data[3][4, 9], data[0][6, 3, 1] = np.nan, np.inf
    expected = means_by_loops(*data, **SIZES, strength=0.7)
    run = jax.jit(lambda *i: rdfc.denoise(*i, **SIZES, strength=0.7))
    for dtype, tolerance in ((np.float64, 1e-11), (np.float32, 1e-5)):
        arrays = [jnp.asarray(d, dtype) for d in data]
        np.testing.assert_allclose(
            run(*arrays), expected, rtol=tolerance, atol=tolerance
        )
    total = lambda *i: run(*i).sum()
    for gradient in jax.jit(jax.grad(total, argnums=(0, 1, 2, 3)))(*arrays):
        assert np.isfinite(gradient).all()


def test_rdfc_of_a_frame():
    """It lowers the error; without features it is non-local means."""
    frame = exr.read_frame(DATA / "cornell-box-64.exr")
    reference, noise = frame.reference
    error = lambda image: rel_l2(image, reference, half_difference=noise)
    bare = frame._replace(
        buffers=frame.buffers._replace(
            albedo=None, normal=None, depth=None, visibility=None
        )
    )
    plain, denoised = (rdfc.denoise_frame(f, window=11) for f in (bare, frame))
    x, v = frame.color, frame.variance
    np.testing.assert_array_equal(plain.image, means(x, x, v, window=11))
    assert error(denoised.image) < 0.3 * error(x)
    for half, base in zip(frame.halves(), denoised.halves, strict=True):
        assert error(base) < 0.3 * error(half.color)


@pytest.mark.slow
def test_rdfc_selects_by_risk(rng):
    """By the parts, step after step; one candidate is itself."""
    x, v = jnp.asarray(rng.normal(1, 0.3, (20, 18, 3))), jnp.full((20, 18, 3), 0.09)
    f = jnp.asarray(np.mgrid[:20, :18][0] > 9, float)[..., None]
    first, options = rdfc.CANDIDATES[0], {"window": 7}
    key = jax.random.key(3)
    every, risks = [], []
    keys = jax.random.split(jax.random.clone(key), 3)
    for one, candidate in zip(keys, rdfc.CANDIDATES, strict=True):
        run = lambda i, c=candidate: rdfc.denoise(i, i, v, f, **options, **c._asdict())
        found = monte_carlo_sure(one, run, x, v, slope_limit=1.0)
        every.append(np.asarray(found.denoised))
        risks.append(found.squared_error.mean(axis=-1))
    by_first = lambda i: rdfc.denoise(i, x, v, f, **options, **first._asdict())
    risk = np.asarray(by_first(jnp.stack(risks, axis=-1)))
    chosen = (risk.argmin(-1)[..., None] == np.arange(3)).astype(float)
    assert 0.05 < chosen.mean(axis=(0, 1)).max() < 0.95
    shares = np.asarray(by_first(jnp.asarray(chosen)))
    expected = sum(shares[..., k, None] * y for k, y in enumerate(every))
    found = rdfc.denoise_selected(key, x, v, f, **options)
    np.testing.assert_allclose(found, expected, rtol=1e-9)
    alone = rdfc.denoise_selected(jax.random.key(3), x, v, f, candidates=[first])
    np.testing.assert_allclose(alone, rdfc.denoise(x, x, v, f, **first._asdict()))
    with pytest.raises(ValueError, match="there must be a candidate, got none"):
        rdfc.denoise_selected(jax.random.key(0), x, v, f, candidates=())


def test_rdfc_by_features_alone_does_not_compare_colours():
    """Not even where a pixel is certain; without features all are alike."""
    x = jnp.asarray([0.0, 1.0, 5.0, 9.0]).reshape(1, 4, 1)
    f = jnp.asarray([0.0, 0.0, 1.0, 1.0]).reshape(1, 4, 1)
    run = lambda f: rdfc.denoise(x, x, 0 * x, f, window=7, strength=np.inf)
    np.testing.assert_allclose(run(f).ravel(), [0.5, 0.5, 7, 7], atol=1e-3)
    np.testing.assert_allclose(run(f[..., :0]).ravel(), 15 / 4)


@pytest.mark.slow
def test_rdfc_selection_beats_its_candidates(rng):
    """Where one half has texture that no feature shows, the other only features."""
    y, z = np.mgrid[:48, :48]
    texture = np.where(z < 24, np.sign(np.sin(y * 1.3)), 0.0)
    edge = np.where((z >= 24) & ((y + z) % 12 < 6), 0.6, 0.0)
    truth = (2 + texture + edge)[..., None]
    v = jnp.full(truth.shape, 0.16)
    f = jnp.asarray(edge)[..., None]
    errors = []
    for seed in range(3):
        x = jnp.asarray(truth + 0.4 * rng.standard_normal(truth.shape))
        made = [rdfc.denoise_selected(jax.random.key(seed), x, v, f, window=11)]
        made += [
            rdfc.denoise(x, x, v, f, window=11, **c._asdict()) for c in rdfc.CANDIDATES
        ]
        errors.append([float(jnp.mean((i - truth) ** 2)) for i in made])
    selected, *alone = np.mean(errors, axis=0)
    assert selected < 0.9 * min(alone)


def test_rdfc_keeps_apart_what_the_noise_hides():
    side = jnp.asarray(np.tile(np.arange(12)[:, None] > 5, (9, 1, 1)), float)
    guide, variance = 0.1 * side, jnp.ones_like(side)
    out = jax.jit(lambda *i: rdfc.denoise(*i, **SIZES))(side, guide, variance, side)
    np.testing.assert_allclose(out, side, atol=1e-4)
    assert float(jnp.abs(means(side, guide, variance, **SIZES) - side).max()) > 0.4


def test_non_local_means_gradient(rng):
    data = [jnp.asarray(i[:5, :6]) for i in noisy(rng)]
    data[2] = data[2] + 0.01
    # Short steps: each of the many pairs has a kink where its patches are alike.
    check_grads(
        jax.jit(lambda *i: means(*i, **SIZES)), data, order=1, modes=["rev"], eps=1e-7
    )


def test_non_local_means_keep_an_edge_and_clear_the_rest(rng):
    truth = np.zeros((24, 24, 1))
    truth[:, 12:] = 1
    image = jnp.asarray(truth + 0.1 * rng.normal(size=truth.shape))
    variance = jnp.full_like(image, 0.01)
    error = lambda i: float(jnp.mean((i - truth) ** 2))
    assert error(means(image, image, variance)) < 0.1 * error(image)


def test_nothing_is_mixed_where_nothing_is_alike():
    ramp = jnp.arange(30.0).reshape(5, 6, 1)
    out = means(ramp, ramp, jnp.zeros_like(ramp), **SIZES)
    np.testing.assert_allclose(out, ramp, rtol=1e-6)


@pytest.mark.slow
def test_nfor_lowers_the_error_of_a_real_frame():
    box_frame = exr.read_frame(DATA / "cornell-box-64.exr")
    reference, noise = box_frame.reference
    error = lambda image: rel_l2(image, reference, half_difference=noise)
    denoised = nfor.denoise_frame(box_frame)
    assert error(denoised.image) < 0.3 * error(box_frame.color)
    assert error(denoised.halves[0]) < 0.3 * error(box_frame.halves()[0].color)


def test_nfor_is_scale_equivariant(glass_frame):
    corner = lambda i: i[..., :24, :24, :] if i.ndim > 2 else i
    frame = jax.tree.map(corner, glass_frame).merged(2)
    run = lambda frame: nfor.denoise_frame(frame, window=9).image
    one = run(frame)
    for scale in (1e-6, 1e6):
        other = run(frame.scaled(scale)) / scale
        np.testing.assert_allclose(other, one, rtol=1e-3, atol=1e-5)


def test_nfor_is_consistent(rng):
    """With ever less noise its error vanishes, even where features explain nothing."""
    truth = rng.uniform(0.5, 1.5, (20, 20, 3))
    errors = []
    for noise in (0.1, 0.01):
        a, b = truth + noise * rng.normal(size=(2, 20, 20, 3))
        variance = jnp.full((20, 20, 3), noise**2)
        none = jnp.zeros((20, 20, 0))
        run = jax.jit(lambda *i: nfor.denoise(*i, window=7, patch=3))
        pair = run(jnp.asarray(a), jnp.asarray(b), variance, variance, none, none)
        errors.append(float(jnp.mean((sum(pair) / 2 - truth) ** 2)))
    assert errors[1] < 0.02 * errors[0]


def test_a_pixel_unlike_in_one_channel_is_kept(rng):
    """However few of a patch's values differ, if they do so beyond the noise."""
    image = np.full((14, 14, 3), 0.5)
    image[6, 7, 0] = 5
    f = np.zeros((14, 14, 8))
    f[6, 7, 2] = 1
    filtered, _ = jax.jit(nfor.filter_features)(jnp.asarray(f), jnp.asarray(f))
    np.testing.assert_allclose(filtered, f, atol=1e-6)
    a, b = image + 1e-3 * rng.normal(size=(2, *image.shape))
    v, none = jnp.full_like(image, 1e-6), jnp.zeros((14, 14, 0))
    run = jax.jit(lambda a, b: nfor.denoise(a, b, v, v, none, none, window=7))
    pair = run(jnp.asarray(a), jnp.asarray(b))
    np.testing.assert_allclose((pair[0] + pair[1]) / 2, image, atol=0.02)


def test_nfor_of_a_bare_frame(rng):
    """No features; halves as soon as each has what it needs; one bad pixel."""
    color = rng.uniform(0.5, 1, (8, 9, 10, 3))
    color[0, 4, 4] = np.nan
    run = lambda frame: nfor.denoise_frame(frame, window=3)
    eight = run(make_frame(color))
    assert eight.halves.shape == (2, 9, 10, 3)
    four = run(make_frame(color[:4]))  # both fits
    np.testing.assert_allclose(four.image, four.halves.mean(axis=0), rtol=1e-12)
    given = make_frame(color[:4], variance=np.full((4, 9, 10, 3), 0.01))
    assert run(given).halves is not None
    good_half = color[4:, 4, 4].mean(axis=0)
    np.testing.assert_allclose(eight.image[4, 4], good_half, rtol=1e-6)


@pytest.mark.parametrize(
    ("buffers", "given", "halves"),
    [
        (2, True, False),
        (4, False, False),
        (4, True, True),
        (8, False, True),
        (8, True, True),
    ],
)
def test_nfor_has_halves_where_each_is_a_frame_for_it(buffers, given, halves, rng):
    color = rng.uniform(0.5, 1, (buffers, 5, 6, 3))
    variance = jnp.full(color.shape, 0.01) if given else None
    frame = make_frame(color, variance=variance)
    made = nfor.denoise_frame(frame, window=3)
    pair = frame.halves()
    if halves:
        expected = [nfor.denoise_frame(half, window=3).image for half in pair]
    else:  # its own two fits, which share their weights
        none = frame.color[..., :0]
        given = [i for name in ("color", "variance") for i in map(_of(name), pair)]
        expected = nfor.denoise(*given, none, none, window=3)
        np.testing.assert_allclose(made.image, np.mean(expected, axis=0), rtol=1e-12)
    np.testing.assert_allclose(made.halves, expected, rtol=1e-12)


def _of(name):
    """An image of a frame."""
    return lambda frame: getattr(frame, name)


def test_two_sub_buffers_are_enough_for_an_ensemble_of_nfor(rng):
    """And for cross-regression towards its two outputs (NJS fig. 16)."""
    color = rng.uniform(0.5, 1, (2, 16, 16, 3))
    frame = make_frame(color, variance=np.full(color.shape, 0.02)).normalised()
    names = ["nfor", "path-tracing"]
    made = combine(jax.random.key(0), frame, method="ensemble", biased=names)
    assert np.isfinite(made.halves).all()
    y = nfor.denoise_frame(frame)
    regressed = james_stein.regress(jax.random.key(0), frame, y)
    assert np.isfinite(regressed.estimate.image).all()


def depends(function, images, k, reach):
    """Whether pixels that far see a change of the middle pixel of image k, or beyond.

    Args:
        function: of the images to one of their size.
        images: square, of odd width.
        k: which of them is changed.
        reach: distance in pixels.

    Returns:
        at that distance, and anywhere beyond it.
    """
    middle = len(images[k]) // 2
    changed = list(images)
    changed[k] = images[k].at[middle, middle].multiply(0.9)
    run = jax.jit(function)
    moved = np.any(np.asarray(run(*changed) != run(*images)), axis=-1)
    away = abs(np.arange(len(moved)) - middle)
    distance = np.maximum.outer(away, away)
    assert distance.max() > reach
    return moved[distance == reach].any(), moved[distance > reach].any()


LOCAL = {
    "bilateral": (
        lambda x, v, f: bilateral.denoise(x, v, f, window=7, sigma_radiance=9.0),
        bilateral.reach(window=7),
        # The image and its variance through the pooled guide, features directly.
        (4, 4, 3),
    ),
    "nonlocal_means": (
        lambda x, v, f: nonlocal_means.denoise(x, x, v, window=7, patch=5),
        nonlocal_means.reach(window=7, patch=5),
        (5, 5, None),
    ),
    "rdfc": (
        lambda x, v, f: rdfc.denoise(x, x, v, f, window=7, patch=5),
        rdfc.reach(window=7, patch=5),
        (5, 5, 3),
    ),
    "rdfc, patches of a pixel": (
        lambda x, v, f: rdfc.denoise(x, x, v, f, window=3, patch=1),
        rdfc.reach(window=3, patch=1),
        (1, 1, 1),
    ),
    "gaussian": (
        lambda x, v, f: smoothing.gaussian(x, sigma=1.3),
        smoothing.reach(sigma=1.3),
        (4, None, None),
    ),
}


@pytest.mark.parametrize("name", LOCAL)
def test_reach_is_exact(name, rng):
    """One pixel's change is seen at that distance, and nowhere beyond."""
    denoise, reach, reaches = LOCAL[name]
    near = jnp.asarray(rng.uniform(1, 1.1, (2, 17, 17, 2)))
    images = near[0], 5e-4 * near[1], 0.6 * near[1]
    assert reach == max(r for r in reaches if r is not None)
    for k, own in enumerate(reaches):
        if own is None:
            assert not any(depends(denoise, images, k, 0))
        else:
            assert depends(denoise, images, k, own) == (True, False)


def test_nfor_survives_bad_pixels(rng):
    x, f = rng.uniform(size=(2, 2, 12, 12, 3))
    v = np.full((2, 12, 12, 3), 0.01)
    x[0, 3, 4], v[1, 6, 6], f[0, 9, 9] = np.nan, np.inf, np.nan
    x[1, 5, 5] = 1e6
    arrays = [jnp.asarray(i) for pair in (x, v, f) for i in pair]
    run = lambda *i: nfor.denoise(*i, window=3, patch=3, mixing=5)
    assert all(np.isfinite(i).all() for i in jax.jit(run)(*arrays))
    total = lambda *i: sum(jnp.sum(part) for part in run(*i))
    for gradient in jax.jit(jax.grad(total, argnums=tuple(range(6))))(*arrays):
        assert np.isfinite(gradient).all()


@pytest.mark.usefixtures("unchecked")
def test_frame_without_what_it_needs(rng):
    lacking = "nfor needs half buffers: render with variances, or at least 4"
    with pytest.raises(ValueError, match=lacking):
        nfor.denoise_frame(make_frame(jnp.ones((4, 4, 3))))
    with pytest.raises(ValueError, match="strength must be positive, got 0"):
        nonlocal_means.weights(jnp.ones((4, 4, 3)), jnp.ones((4, 4, 3)), strength=0.0)
    with pytest.raises(ValueError, match=r"guide has shape \(5, 4, 3\), image has"):
        means(jnp.ones((4, 4, 3)), jnp.ones((5, 4, 3)), jnp.ones((5, 4, 3)))
    with pytest.raises(ValueError, match="window must be odd"):
        means(*map(jnp.asarray, noisy(rng)), window=4)


@pytest.mark.parametrize("window", [9, 11])
def test_derivatives_through_windows_of_several_pieces(window):
    """Where the columns of a row do and do not fill its pieces."""
    x = jnp.asarray(np.random.default_rng(4).normal(1, 0.5, (2, 13, 12, 1)))
    variance = jnp.full_like(x[0], 0.3)

    @jax.jit
    def denoised(image, guide, strength):
        return nonlocal_means.denoise(
            image, guide, variance, window=window, patch=3, strength=strength
        )

    given = (*x, jnp.asarray(1.0))
    check_grads(denoised, given, 1, modes=("fwd", "rev"), rtol=1e-5)
    _, tangent = jax.jvp(denoised, given, (*jnp.ones_like(x), jnp.asarray(0.0)))
    assert np.abs(np.asarray(tangent) - 1).max() < 1e-9  # a shift of both images
