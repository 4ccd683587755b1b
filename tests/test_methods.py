"""The table of methods, and the default one in its tiers."""

import importlib.util

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jscomb import (
    combine,
    ensemble,
    exr,
    james_stein,
    methods,
    metrics,
    uncorrelated,
)
from jscomb.denoisers import nonlocal_means, oidn
from jscomb.frame import Estimate, Needs, make_frame
from jscomb.learning import recipes
from jscomb.methods import BASES, METHODS, TIERS, Method, combine_tier
from jscomb.numerics.tiles import Local, compiled, cut, padded
from tests.battery import catalogue
from tests.conftest import DATA

CHEAP = ["oidn", "multi-scale", "path-tracing"]
key = lambda: jax.random.key(0)
needs_oidn = pytest.mark.skipif(not oidn.available(), reason="needs Open Image Denoise")


def slow_ones(names, slow=("ensemble", "neural-ensemble", "nfor")):
    """The names, those of methods that take long to compile marked."""
    marks = {name: [pytest.mark.slow] for name in slow}
    return [pytest.param(name, marks=marks.get(name, [])) for name in names]


def error(image, frame):
    """Relative L2 of an image of a frame with a reference."""
    r, noise = frame.reference
    return float(metrics.rel_l2(image, r, half_difference=noise))


@pytest.fixture(scope="module")
def small(glass_frame):
    """A corner of a rendered frame, of one size, so that tests share programs."""
    return cut(glass_frame, 24, 24)


# Of any frame: what takes a second rendering has a test of its own.
SHARING = "neural-ensemble"  # combiners among its bases have no halves of halves
ALONE = [name for name, method in METHODS.items() if method.input is None]


@needs_oidn
@pytest.mark.parametrize("name", slow_ones(n for n in ALONE if n != SHARING))
def test_every_method_makes_an_estimate(name, small):
    """Finite, and each half is what the method makes of that half alone."""
    frame = small
    made = combine(key(), frame, method=name)
    assert made.image.shape == (24, 24, 3)
    assert np.isfinite(made.image).all()
    assert not METHODS[name].needs.missing_for_halves(frame.normalised())
    unit = frame.median_luminance
    for half, own in zip(frame.halves(), made.halves, strict=True):
        alone = half.normalised(unit)
        if METHODS[name].takes != "nothing":  # quarters as a denoiser makes them
            fresh = oidn.denoise_frame(alone)._replace(
                image=alone.estimates["oidn"].image
            )
            alone = alone.with_estimate("oidn", fresh)
        expected = combine(key(), alone, method=name).image * unit
        np.testing.assert_allclose(own, expected, rtol=2e-4, atol=1e-5 * unit)


@pytest.mark.parametrize("name", [n for n, m in METHODS.items() if m.pure])
def test_invalid_pixels_beside_a_frame_change_nothing(name, glass_frame):
    frame = cut(glass_frame, 19, 22).normalised()
    takes = METHODS[name].takes == "one estimate"
    given = (frame.estimates["oidn"],) if takes else ()
    made = METHODS[name].estimate(key(), frame, *given)
    wide = METHODS[name].estimate(key(), *padded((frame, *given), multiple=32))
    for one, other in zip(made, cut(wide, 19, 22), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-6)


def test_sizes_near_each_other_share_programs(glass_frame):
    """And the estimates are of their own size, as the methods make them alone."""
    name = "nonlocal-means-narrow"
    frames = [cut(glass_frame, *size).normalised() for size in ((21, 18), (17, 23))]
    made = methods.with_inputs(key(), frames[0], [name])
    program = compiled(nonlocal_means.denoise, window=11)
    count = program._cache_size()
    other = methods.with_inputs(key(), frames[1], [name])
    assert program._cache_size() == count > 0
    assert other.estimates[name].halves.shape == (2, 17, 23, 3)
    alone = METHODS[name].estimate(key(), frames[0])
    for one, other in zip(made.estimates[name], alone, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("tier", ["fast", "balanced"])
def test_a_tier_is_the_same_beside_invalid_pixels(tier, glass_frame, monkeypatch):
    frame = cut(glass_frame, 19, 22)
    biased = "oidn" if tier == "fast" else ["oidn", "path-tracing", "whitened"]
    made = combine_tier(key(), frame, tier=tier, biased=biased)
    monkeypatch.setattr("jscomb.methods._inputs._LARGE", 0)
    alone = combine_tier(key(), frame, tier=tier, biased=biased)
    assert made.tier == alone.tier == tier
    found, expected = ((m.estimate, m.error) for m in (made, alone))
    for one, other in zip(*map(jax.tree.leaves, (found, expected)), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-6)


@needs_oidn
@pytest.mark.slow
def test_an_ensemble_of_combiners_gives_both_halves_the_same_weights(small):
    made = combine(key(), small, method=SHARING)
    names = METHODS[SHARING].bases
    whole = methods.with_inputs(key(), small.normalised(), names)
    estimates = {name: whole.estimates[name] for name in names}
    network = recipes.shipped(SHARING)
    weights = ensemble.plan_neural_weights(network, whole, estimates).whole()
    assert weights.min(axis=(0, 1)).max() > 0
    for number in range(2):
        halves = np.stack([e.halves[number] for e in estimates.values()], axis=2)
        expected = np.sum(weights[..., None] * halves, axis=2) * whole.unit
        np.testing.assert_allclose(made.halves[number], expected, rtol=1e-4, atol=1e-7)


@needs_oidn
@pytest.mark.parametrize("name", slow_ones(ALONE))
def test_the_unit_of_the_frame_does_not_matter(name, small):
    frame = small.merged(2)
    made = METHODS[name].needs.missing(frame.normalised())
    assert not made
    one = combine(key(), frame, method=name).image
    scaled = combine(key(), frame.scaled(2.0**20), method=name).image
    np.testing.assert_allclose(scaled / 2.0**20, one, rtol=1e-4, atol=1e-6)
    inside = combine(key(), frame.normalised(), method=name).image
    unit = frame.median_luminance
    np.testing.assert_allclose(unit * inside, one, rtol=1e-5, atol=1e-7)


def test_a_second_rendering_is_a_base_of_an_ensemble(small):
    """As `uncorrelated` in the table, of the estimate of that name only."""
    z = jnp.stack([half.color for half in small.halves()])
    with pytest.raises(ValueError, match="uncorrelated needs an estimate 'correlated'"):
        combine(key(), small, method="uncorrelated")
    _, skipped = methods.inputs(small.normalised(), biased="uncorrelated")
    assert "needs an estimate 'correlated'" in skipped["uncorrelated"]
    frame = small.with_estimate("correlated", Estimate(small.color, z))
    made = combine(key(), frame, method="uncorrelated")
    expected = uncorrelated.combine_frame(
        frame.normalised(), frame.normalised().estimates["correlated"]
    ).scaled(small.median_luminance)
    for image, other in zip(made, expected, strict=True):
        np.testing.assert_allclose(image, other, rtol=1e-5)
    names = ["path-tracing", "uncorrelated"]
    found = combine(key(), frame, method="ensemble", biased=names)
    assert np.isfinite(found.halves).all()
    assert combine_tier(key(), frame, biased=names).bases == tuple(names)


def test_unchanged_is_bit_by_bit(glass_frame):
    y = glass_frame.estimates["oidn"]
    made = combine(key(), glass_frame, method="denoised")
    np.testing.assert_array_equal(made.image, y.image)
    np.testing.assert_array_equal(made.halves, y.halves)
    plan = methods.plan(key(), glass_frame, method="denoised")
    np.testing.assert_array_equal(plan.whole(), y.image)


def average(key, frame, estimate):
    """Half of each."""
    images = {"x": frame.color, "y": estimate.image}
    return Local(lambda i: (i["x"] + i["y"]) / 2, images, 0)


def test_ten_lines_are_a_method_everywhere(monkeypatch, jscomb, tmp_path, glass_frame):
    """The command, the sweep, the battery and the pages read the table."""
    method = Method("half of each", Needs(), "one estimate", average, pure=True)
    monkeypatch.setitem(METHODS, "average", method)
    path, out = tmp_path / "f.exr", tmp_path / "o.exr"
    exr.write_frame(path, glass_frame)
    status, text, _ = jscomb("combine", path, "-o", out, "--method", "average")
    assert status == 0
    assert "average of oidn" in text
    expected = (glass_frame.color + glass_frame.estimates["oidn"].image) / 2
    np.testing.assert_allclose(exr.read_image(out), expected, rtol=1e-5)
    assert "average (half of each)" in " ".join(jscomb("combine", "--help")[1].split())
    assert "methods.plan average" in catalogue.combiners()
    assert "| `average` | half of each | one estimate |  |" in methods.table()
    made = combine(key(), glass_frame, method="average")
    assert made.halves.shape == (2, 64, 64, 3)
    names = ["oidn", "average"]
    assert combine_tier(key(), glass_frame, biased=names).bases == tuple(names)


def test_the_pages_hold_the_table():
    for name, method in METHODS.items():
        assert f"| `{name}` | {method.summary} |" in methods.__doc__


@needs_oidn
@pytest.mark.parametrize("tier", slow_ones(TIERS, slow=("best",)))
def test_a_tier_is_better_than_what_it_is_made_of(tier):
    """On two crops of rendered frames: on average, and never much worse."""
    ratios = []
    for name in ("cornell-glass-64", "cornell-box-64"):
        frame = exr.read_frame(DATA / f"{name}.exr").normalised()
        made = combine_tier(key(), frame, tier=tier)
        assert (made.tier, made.reason) == (tier, "")
        ends = frame.color, frame.estimates["oidn"].image
        better = min(error(image, frame) for image in ends)
        ratios.append(error(made.estimate.image, frame) / better)
        assert {*made.bases, *made.skipped} == {*TIERS[tier].bases}
        by_name = combine(key(), frame, method=tier)
        np.testing.assert_array_equal(by_name.image, made.estimate.image)
    assert max(ratios) < 1.05
    most = {"fast": 0.82, "balanced": 0.7, "best": 0.43}
    assert np.prod(ratios) ** 0.5 < most[tier]


@needs_oidn
def test_the_estimated_error_is_near_the_true_one(real_frame):
    """On a rendered frame: within twice, and where it is large the error is."""
    frame = real_frame.normalised()
    made = combine_tier(key(), frame, tier="balanced")
    true = error(made.estimate.image, frame)
    assert 0.5 * true < float(made.error.mean) < 2 * true
    assert 0 < float(made.error.standard_error) < true
    np.testing.assert_allclose(made.error.map.mean(), made.error.mean, rtol=1e-4)
    square = jnp.square(made.estimate.image - frame.reference.image)
    weight = jnp.square(frame.reference.image.mean(-1, keepdims=True)) + 0.01
    blocks = lambda i: i.mean(-1).reshape(8, 8, 8, 8).mean((1, 3)).ravel()
    ranks = [
        np.argsort(np.argsort(blocks(i))) for i in (square / weight, made.error.map)
    ]
    assert np.corrcoef(*ranks)[0, 1] > 0.4


@pytest.mark.parametrize("truth_is", ["biased", "unbiased"])
def test_a_perfect_image_is_kept_and_a_wrong_one_is_not(truth_is):
    noise = jax.random.normal(key(), (2, 96, 96, 3))
    one = jnp.ones((96, 96, 3))
    y = one if truth_is == "biased" else 3 * one
    frame = make_frame(
        1 + 0.1 * noise,
        variance=one * 0.01,
        estimates={"y": Estimate(y, jnp.stack([y, y]))},
    )
    told = []
    names = ["y", "path-tracing"]
    made = combine_tier(key(), frame, biased=names, progress=told.append)
    assert told == ["making path-tracing", "combining 2 estimates"]
    wrong = float(jnp.mean(jnp.square(made.estimate.image - 1)))
    noisy = float(jnp.mean(jnp.square(frame.color - 1)))
    assert wrong < (0.01 if truth_is == "biased" else 1.01) * noisy
    scaled = combine_tier(key(), frame.scaled(1e-5), biased=["y", "path-tracing"])
    np.testing.assert_allclose(
        1e5 * scaled.estimate.image, made.estimate.image, rtol=1e-4
    )
    np.testing.assert_allclose(scaled.error.mean, made.error.mean, rtol=1e-3)


@pytest.mark.parametrize("samples", [2**14, 2**18])
def test_a_tier_is_consistent(samples, real_frame):
    """With known noise on the truth, at many samples no worse than path tracing."""
    truth = real_frame.normalised().reference.image
    deviation = jnp.sqrt(jnp.square(truth) + 0.1)
    noise = jax.random.normal(key(), (2, *truth.shape), truth.dtype)
    color = truth[None] + deviation[None] * noise * (2 / samples) ** 0.5
    variance = 0 * color + jnp.square(deviation)[None] * 2 / samples
    y = 0.99 * truth + 0.01 * jnp.roll(truth, 1, axis=0)
    biased = Estimate(y, jnp.stack([y, y]))
    frame = make_frame(color, variance=variance, estimates={"oidn": biased})
    noisy = jnp.mean(jnp.square(frame.color - truth))
    names = {"fast": None, "balanced": CHEAP}
    for tier, bases in names.items():
        made = combine_tier(key(), frame, tier=tier, biased=bases)
        wrong = jnp.mean(jnp.square(made.estimate.image - truth))
        assert float(wrong) < 1.01 * float(noisy)


@needs_oidn
def test_a_budget_picks_the_tier(small):
    for budget, tier in ((0.0, "fast"), (1e9, "balanced")):
        made = combine_tier(key(), small.merged(2), tier="balanced", budget=budget)
        assert made.tier == tier
    none = combine_tier(key(), small, budget=0.0)
    assert none.tier == "fast"
    assert none.reason.startswith("best takes about ")
    assert none.estimate.halves is None


def test_without_halves_or_variance(glass_frame):
    """A sensible default, and why."""
    made = combine_tier(key(), glass_frame.merged(1))
    assert (made.tier, made.bases, made.error) == ("fast", ("oidn",), None)
    assert made.reason == "best needs half buffers, to weigh its estimates by"
    y = glass_frame.estimates["oidn"].image
    bare = make_frame(glass_frame.color, estimates={"y": y})
    made = combine_tier(key(), bare)
    assert (made.tier, made.bases) == ("denoised", ("y",))
    assert made.reason.startswith("fast needs the variance: render with variances")
    np.testing.assert_allclose(made.estimate.image, y, rtol=1e-6)
    no_halves = glass_frame._replace(estimates={}).with_estimate("y", y)
    made = combine_tier(key(), no_halves, biased="y")
    assert (made.tier, made.bases) == ("fast", ("y",))
    assert made.reason == "best: no estimate has halves"


def test_invalid_pixels_do_not_spread(glass_frame):
    bad = np.array(glass_frame.buffers.color)
    bad[0, 3, 4], bad[1, 5, 6] = np.nan, np.inf
    frame = glass_frame._replace(
        buffers=glass_frame.buffers._replace(color=jnp.asarray(bad))
    )
    names = ["oidn", "path-tracing"]
    made, clean = (combine_tier(key(), f, biased=names) for f in (frame, glass_frame))
    assert np.isfinite(made.estimate.image).all()
    far = np.s_[32:, 32:]
    np.testing.assert_allclose(
        made.estimate.image[far], clean.estimate.image[far], rtol=0.02, atol=1e-3
    )
    np.testing.assert_allclose(made.error.mean, clean.error.mean, rtol=0.1)


def test_an_ensemble_says_what_it_skips(glass_frame):
    names, skipped = methods.inputs(glass_frame.normalised())
    filters = {"bilateral", "rdfc"}
    assert set(names) == (set(BASES) if oidn.available() else filters)
    assert not set(names) & set(skipped)
    without = glass_frame.buffers._replace(albedo=None, normal=None)
    names, skipped = methods.inputs(glass_frame._replace(buffers=without).normalised())
    assert "oidn" in names
    if oidn.available():
        assert skipped.keys() == {*oidn.VARIANTS} & {*BASES} - {"oidn", "oidn-color"}
        assert (
            skipped["oidn-clean"] == "needs albedo, normal: render with these features"
        )
    bare = glass_frame._replace(estimates={}).with_estimate("y", glass_frame.color)
    names, skipped = methods.inputs(bare.merged(1).normalised())
    assert names == ()
    assert skipped["y"] == "it has no halves"
    assert skipped["bilateral"].startswith("needs half buffers: render at least 2")
    with pytest.raises(ValueError, match=r"no bases: .*y it has no halves"):
        combine(key(), bare, method="ensemble", biased="y")


def test_tiers_without_open_image_denoise(glass_frame, monkeypatch):
    """A frame's own denoised image is combined; what needs it of each half is not."""
    there = importlib.util.find_spec
    gone = lambda name: None if name == "pyoidn" else there(name)
    monkeypatch.setattr(importlib.util, "find_spec", gone)
    names, skipped = methods.inputs(
        glass_frame.normalised(), biased=TIERS["best"].bases
    )
    assert "oidn" in names
    for name in ("double-shrinkage", "pd", "oidn-clean"):
        assert "pip install" in skipped[name]
    small = jax.tree.map(
        lambda i: i[..., :16, :16, :] if i.ndim > 2 else i, glass_frame
    )
    made = combine_tier(key(), small, tier="best")
    assert made.bases == names
    assert jnp.isfinite(made.estimate.image).all()


def test_bad_input(glass_frame):
    with pytest.raises(ValueError, match="no biased image 'x': this frame has oidn"):
        combine_tier(key(), glass_frame, biased="x")
    with pytest.raises(ValueError, match="no tier 'x'; there are fast, balanced, best"):
        combine_tier(key(), glass_frame, tier="x")
    two = glass_frame.with_estimate("other", glass_frame.estimates["oidn"])
    with pytest.raises(ValueError, match="which biased image"):
        combine(key(), two, method="whitened")
    with pytest.raises(ValueError, match="no method 'x'; there are oidn, "):
        combine(key(), glass_frame, method="x")
    with pytest.raises(ValueError, match="no biased image 'x'"):
        combine(key(), glass_frame, method="whitened", biased="x")
    with pytest.raises(ValueError, match="bilateral takes no biased image"):
        combine(key(), glass_frame, method="bilateral", biased="oidn")


@pytest.mark.parametrize("name", METHODS)
def test_what_is_missing_is_named_with_the_method(name, glass_frame):
    """A grey frame of one buffer without variance lacks what most methods need."""
    grey = glass_frame.color[..., :1]
    y = Estimate(grey, jnp.stack([grey, grey]))
    frame = make_frame(grey, estimates={"y": y})
    needs = METHODS[name].needs
    if not needs.missing(frame.normalised()):
        assert combine(key(), frame, method=name).image.shape == grey.shape
        return
    with pytest.raises((ValueError, ImportError)) as raised:
        combine(key(), frame, method=name)
    text = str(raised.value)
    assert "\n" not in text
    assert " needs " in text or "has no bases" in text
    assert text.split()[0] == name


def test_frames_are_normalised_where_constants_are_absolute(glass_frame):
    y = glass_frame.estimates["oidn"]
    with pytest.raises(ValueError, match=r"njs needs a normalised frame: call frame\."):
        james_stein.neural_combine_frame(key(), lambda *_: None, glass_frame, y)
    if oidn.available():
        with pytest.raises(ValueError, match="oidn needs a normalised frame"):
            oidn.denoise_frame(glass_frame)
