"""The table of methods, and the one that half buffers choose."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jscomb import combine, exr, james_stein, methods, metrics
from jscomb.denoisers import oidn
from jscomb.frame import Estimate, Needs, make_frame
from jscomb.methods import BASES, CANDIDATES, METHODS, Method, choose
from jscomb.numerics.tiles import Local
from tests.battery import catalogue

CHEAP = ["denoised", "whitened"]
key = lambda: jax.random.key(0)
needs_oidn = pytest.mark.skipif(not oidn.available(), reason="needs Open Image Denoise")


def slow_ones(names, slow=("ensemble", "nfor")):
    """The names, those of methods that take long to compile marked."""
    marks = {name: [pytest.mark.slow] for name in slow}
    return [pytest.param(name, marks=marks.get(name, [])) for name in names]


def error(image, frame):
    """Relative L2 of an image of a frame with a reference."""
    r, noise = frame.reference
    return float(metrics.rel_l2(image, r, half_difference=noise))


def cut(frame, size):
    """A corner of a frame."""
    corner = lambda i: i[..., :size, :size, :] if i.ndim > 2 else i
    return jax.tree.map(corner, frame)


@pytest.fixture(scope="module")
def small(glass_frame):
    """A corner of a rendered frame, of one size, so that tests share programs."""
    return cut(glass_frame, 24)


@needs_oidn
@pytest.mark.parametrize("name", slow_ones(METHODS))
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


@needs_oidn
@pytest.mark.parametrize("name", METHODS)
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
    found = choose(key(), glass_frame, methods=["denoised", "average"])
    assert found.trials[0].change is not None


def test_the_pages_hold_the_table():
    for name, method in METHODS.items():
        assert f"| `{name}` | {method.summary} |" in methods.__doc__


@pytest.mark.slow
@needs_oidn
def test_the_choice_is_the_method_it_names(small):
    found = choose(key(), small)
    assert [t.method for t in found.trials] == list(CANDIDATES[1:])
    assert all(t.seconds > 0 for t in found.trials)
    changes = {t.method: sum(t.change) for t in found.trials if t.change.helps}
    assert found.method == min(changes, key=changes.get, default="denoised")
    chosen = combine(key(), small)
    by_name = combine(key(), small, method=found.method)
    np.testing.assert_allclose(chosen.image, by_name.image, rtol=1e-5)
    np.testing.assert_allclose(chosen.halves, by_name.halves, rtol=1e-3, atol=1e-5)
    assert error(chosen.image, small) < 1.02 * error(
        small.estimates["oidn"].image, small
    )


@needs_oidn
@pytest.mark.slow
def test_the_choice_is_near_the_best(real_frame):
    """On a rendered frame: about the denoised image's error at most, near the best."""
    found = choose(key(), real_frame)
    errors = {
        m: error(combine(key(), real_frame, method=m).image, real_frame)
        for m in CANDIDATES
    }
    assert errors[found.method] < 1.02 * errors["denoised"]
    assert errors[found.method] < 1.1 * min(errors.values())


@pytest.mark.parametrize("truth_is", ["biased", "unbiased"])
def test_a_perfect_image_is_unchanged_and_a_wrong_one_is_not(truth_is):
    noise = jax.random.normal(key(), (2, 48, 48, 3))
    one = jnp.ones((48, 48, 3))
    y = one if truth_is == "biased" else 3 * one
    frame = make_frame(
        1 + 0.1 * noise,
        variance=one * 0.01 / 2,
        estimates={"y": Estimate(y, jnp.stack([y, y]))},
    )
    found = choose(key(), frame, methods=CHEAP)
    assert found.method == ("denoised" if truth_is == "biased" else "whitened")
    scaled = choose(key(), frame.scaled(1e-5), methods=CHEAP)
    assert scaled.method == found.method
    np.testing.assert_allclose(
        scaled.trials[0].change.mean, found.trials[0].change.mean, rtol=1e-4
    )


def test_a_budget_excludes_the_slow(small):
    none = choose(key(), small, budget=0.0, methods=CHEAP)
    assert none.method == "denoised"
    assert "s of 0" in none.trials[0].reason
    large = choose(key(), small, budget=1e9, methods=CHEAP)
    assert large.method == "whitened"


@needs_oidn
def test_what_needs_halves_is_judged_by_quarters(small):
    """Four sub-buffers and a denoiser: its halves have halves of their own."""
    assert small.sub_buffers == 4
    (trial,) = choose(key(), small, methods=["denoised", "dsc"]).trials
    assert trial.change is not None
    two = small.merged(2)
    (trial,) = choose(key(), two, methods=["denoised", "dsc"]).trials
    assert trial.change is None
    assert trial.reason == (
        "dsc needs half buffers: render at least 4 sub-buffers (this frame has 2)"
    )
    assert METHODS["dsc"].needs.missing_for_halves(two.normalised()) in trial.reason
    assert combine(key(), two, method="dsc").halves is None
    photons = Estimate(*small.estimates["oidn"])
    other = small._replace(estimates={"photons": photons})
    trials = choose(key(), other, methods=["denoised", "dsc", "pd"]).trials
    assert "which only a denoiser can make" in trials[0].reason
    assert trials[1].reason == "pd does not take photons"


@needs_oidn
def test_denoisers_and_ensembles_can_be_chosen_from(small):
    """The half of an ensemble has weights of its own; a blur is no better."""
    names = ["denoised", "gaussian", "ensemble"]
    found = choose(key(), small, methods=names)
    assert [trial.reason for trial in found.trials] == ["", ""]
    blur, mixed = (float(trial.change.mean) for trial in found.trials)
    assert mixed < blur
    assert blur > 0


def test_without_halves_nothing_is_judged(glass_frame):
    whitened = methods.Choice("whitened", (), None)
    assert choose(key(), glass_frame.merged(1)) == whitened
    y = glass_frame.estimates["oidn"].image
    alone = glass_frame._replace(estimates={}).with_estimate("y", y)
    assert choose(key(), alone) == whitened
    bare = make_frame(glass_frame.color, estimates={"y": y})
    assert choose(key(), bare) == methods.Choice("denoised", (), None)


def test_invalid_pixels_do_not_decide(glass_frame):
    bad = np.array(glass_frame.buffers.color)
    bad[0, 3, 4], bad[1, 5, 6] = np.nan, np.inf
    frame = glass_frame._replace(
        buffers=glass_frame.buffers._replace(color=jnp.asarray(bad))
    )
    (found,) = choose(key(), frame, methods=CHEAP).trials
    (clean,) = choose(key(), glass_frame, methods=CHEAP).trials
    np.testing.assert_allclose(found.change.mean, clean.change.mean, rtol=0.05)


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


def test_bad_input(glass_frame):
    with pytest.raises(ValueError, match="no biased image 'x': this frame has oidn"):
        choose(key(), glass_frame, biased="x")
    two = glass_frame.with_estimate("other", glass_frame.estimates["oidn"])
    with pytest.raises(ValueError, match="which biased image"):
        choose(key(), two)
    for names in ([], ["denoised", "x"]):
        with pytest.raises(ValueError, match=r"methods \[.*: there are oidn, "):
            choose(key(), glass_frame, methods=names)
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
