"""The sweep over combiners, and what is read off its results."""

import dataclasses
import sys

import jax
import numpy as np
import pytest

from experiments.common import command, errors
from experiments.comparison import (
    convergence,
    equal_time,
    forms,
    members,
    page,
    pareto,
    pixels,
    stability,
    sweep,
    tiers,
)
from experiments.comparison.combiners import combiners
from jscomb import exr, metrics
from jscomb.denoisers import smoothing
from jscomb.methods import METHODS

FEW = ("path tracing", "oidn", "whitened")


@pytest.fixture
def archive(folder, tmp_path):
    """A sweep of one archive, which has one sample count and one seed."""
    return sweep.Config(
        tmp_path / "work",
        tmp_path / "results.jsonl",
        scenes=(str(folder / "glass.npz"),),
        combiners=FEW,
        scales=(1.0, 4.0),
        repeats=1,
    )


@pytest.mark.slow
def test_sweep_measures_once(archive, glass_frame):
    records = sweep.run(archive)
    found = {(r["combiner"], r["scale"]): r for r in records}
    assert found.keys() == {(name, scale) for name in FEW for scale in (1.0, 4.0)}
    r, noise = glass_frame.reference
    y = glass_frame.estimates["oidn"].image
    unit = glass_frame.median_luminance
    wanted = metrics.rel_l2(y / unit, r / unit, half_difference=noise / unit)
    errors = found["oidn", 1.0]["errors"]
    np.testing.assert_allclose(errors["relative L2"], [wanted], rtol=1e-4)
    assert errors.keys() == {
        "relative L2",
        "RMSE",
        "SMAPE",
        "DSSIM",
        "FLIP",
        "HDR-FLIP",
    }
    assert (
        found["path tracing", 4.0]["errors"]["RMSE"]
        == (found["path tracing", 1.0]["errors"]["RMSE"])
    )
    assert found["whitened", 4.0]["errors"] != (found["whitened", 1.0]["errors"])
    seconds = found["whitened", 1.0]["seconds"]
    assert seconds["sampling"] is None
    assert min(seconds["denoising"], seconds["combining"]) > 0
    rows = pareto.rows_of(records, "RMSE")
    assert rows.keys() == {*FEW, "whitened, variance x 4"}
    before = archive.results.read_text()
    assert sweep.run(archive) == records
    assert archive.results.read_text() == before


@pytest.mark.slow
def test_sweep_goes_on_after_a_line_cut_short(archive):
    records = sweep.run(archive)
    archive.results.write_text(archive.results.read_text()[:-40])
    again = sweep.run(archive)
    about = lambda record: (record["combiner"], record["scale"], record["errors"])
    assert [*map(about, again)] == [*map(about, records)]
    assert again[:-1] == records[:-1]  # not measured again
    assert sweep.results(archive.results) == again


@pytest.mark.slow
def test_quick_form_renders_seeds(vectorised, tmp_path):
    path = tmp_path / "r.jsonl"
    config = page.Config(path, out=tmp_path / "p.html", combiners=FEW, quick=True)
    assert "cornell-box-32-4-0" in page.run(config).read_text()
    records = sweep.results(path)
    of_x = [r for r in records if r["combiner"] == FEW[0] and r["scale"] == 1]
    few, many = (r["errors"]["RMSE"] for r in of_x)
    assert few[0] != few[1]
    assert np.mean(many) < np.mean(few)
    found = equal_time.curves(records, "RMSE")["cornell-box"]
    seconds, _ = found["path tracing"]
    assert seconds[0] < seconds[1]


def test_unknown_combiners_are_named(monkeypatch, capsys, tmp_path):
    with pytest.raises(ValueError, match=r"no combiner \['magic'\]; there are \['path"):
        sweep.Config(tmp_path, tmp_path, combiners=("magic",))
    arguments = ["--work", "x", "--results", "y", "--combiners", "magic"]
    monkeypatch.setattr(sys, "argv", ["sweep", *arguments])
    with pytest.raises(SystemExit):
        command.tool(sweep.Config, sweep.run)
    assert "no combiner ['magic']" in capsys.readouterr().err


def record(combiner, error, seconds, spp=4, denoising=0.0):
    """A line as `sweep` writes it."""
    parts = {"sampling": float(spp), "denoising": denoising, "combining": seconds}
    about = {"scene": "s", "spp": spp, "combiner": combiner, "scale": 1.0}
    return about | {"errors": {"RMSE": [error]}, "seconds": parts}


def test_front_is_what_nothing_cheaper_beats(tmp_path):
    lines = [
        record("path tracing", 4.0, 0.0),
        record("oidn", 2.0, 0.0, denoising=1.0),
        record("good", 1.0, 1.0, denoising=1.0),
        record("slow", 1.0, 5.0, denoising=1.0),
        record("bad", 3.0, 2.0, denoising=1.0),
    ]
    rows = pareto.rows_of(lines, "RMSE")
    assert {name for name, row in rows.items() if row.front} == {
        "path tracing",
        "oidn",
        "good",
    }
    assert rows["good"].errors == {4: 0.5}
    assert (rows["slow"].cost, rows["bad"].worst) == (6.0, 1.5)
    pareto.draw(rows, "RMSE").savefig(tmp_path / "front.svg")
    said = pareto.report(pareto.Found(rows, pareto.Config(tmp_path, metric="RMSE")))
    assert "good 0.50 (worst 0.50) for 2" in said.answer
    assert "slow" in (tmp_path / "front.svg").read_text()
    with pytest.raises(ValueError, match="has no results of oidn"):
        pareto.rows_of(lines[:1], "RMSE")


def test_power_laws_are_found():
    spp = np.array([4.0, 16, 64, 256])
    assert convergence.slope(spp, 3 / spp) == pytest.approx(-1)
    assert np.isnan(convergence.slope(spp[:1], spp[:1]))
    assert equal_time.time_for((spp, 1 / spp), 1 / 32) == (pytest.approx(32), False)
    assert equal_time.time_for((spp, 1 / spp), 1e-9) == (pytest.approx(256), True)
    curves = {"path tracing": (spp, 8 / spp), "oidn": (2 * spp, 4 / spp)}
    factors = equal_time.speedups(curves)["oidn"]
    assert factors["path tracing"] == (pytest.approx(1), False)
    assert factors["oidn"] == (pytest.approx(1), False)


@pytest.mark.slow
def test_a_severely_biased_image_is_kept_out(archive):
    """A 15x15 blur, beside fireflies: the combination is better than it at least."""
    records = sweep.run(
        dataclasses.replace(archive, scales=(1.0,)),
        change=lambda case: case._replace(
            scene="blurred", frames=[convergence.blurred(f) for f in case.frames]
        ),
    )
    assert {r["scene"] for r in records} == {"blurred"}
    curves = convergence.curves(records, "SMAPE")["blurred"]
    errors = {name: float(values[0]) for name, (_, values) in curves.items()}
    assert errors["path tracing"] < errors["whitened"] < errors["oidn"]


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [n for n in combiners() if n.startswith(("ens", "prog"))]
)
def test_combiners_make_images(name, glass_frame):
    """Those that no other test runs; on a corner."""
    corner = jax.tree.map(
        lambda leaf: leaf[..., :40, :40, :] if leaf.ndim >= 3 else leaf, glass_frame
    )
    image = combiners()[name].combine(corner)
    assert image.shape == (40, 40, 3)
    assert np.isfinite(image).all()


@pytest.mark.slow
def test_stability_of_what_has_no_network():
    found = stability.run(stability.Config(quick=True))
    assert all(outcome.finite == (True, True) for outcome in found.values())
    assert found["severely biased", "james-stein"].error < 1.05
    assert found["x equals y", "whitened"].error == 1
    assert found["fireflies of 1e6", "whitened"].error < 2
    said = stability.report(found)
    assert f"finite in {len(found)} of {len(found)} trials" in said.answer


@pytest.mark.slow
def test_tiers_are_measured(glass_frame, tmp_path):
    exr.write_frame(tmp_path / "cornell-glass-64.exr", glass_frame)
    config = tiers.Config(tmp_path, tmp_path / "results.jsonl", quick=True)
    (row,) = tiers.run(config).values()
    better = min(row["path tracing"], row["oidn"])
    assert row["fast"] < better
    assert row["balanced"] < better
    assert row["path-tracing true"] > 0
    assert row["path-tracing plain"] > 0
    assert row["path-tracing weighted"] > 0
    said = tiers.report(tiers.run(config))
    assert f"fast {row['fast'] / better:.2f}" in said.answer
    assert f"{row['balanced estimated']:#.3g} |" in said.body
    frame = glass_frame.normalised()
    x = METHODS["path-tracing"].estimate(jax.random.key(0), frame)
    y = frame.estimates["oidn"]
    parts = tiers.ablation(frame, {"x": x, "y": y})
    for name, other in (("without x", y), ("without y", x)):
        alone = errors.relative_l2(other.image, frame)
        assert parts[name] == pytest.approx(alone, rel=1e-4)


def test_changes_of_pixels_add_up(glass_frame):
    """What was removed less what was added is the change of the mean error."""
    frame = glass_frame.scaled(1 / glass_frame.median_luminance)
    r, y = frame.reference.image, frame.estimates["oidn"].image
    same = pixels.changed(y, frame)
    assert same[1:] == (0, 0, 0, 0)
    perfect = pixels.changed(r, frame)
    assert perfect.worse == perfect.added == 0
    assert perfect.removed == pytest.approx(1)
    x = pixels.changed(frame.color, frame)
    ratio = float(metrics.rel_l2(frame.color, r) / metrics.rel_l2(y, r))
    assert 1 - x.removed + x.added == pytest.approx(ratio, rel=1e-4)
    with pytest.raises(ValueError, match="no reference"):
        pixels.changed(y, frame._replace(reference=None))


def test_members_join_as_long_as_they_pay():
    """By what they bring for their cost; those of little use never."""
    costs = {"path-tracing": 0.0, "oidn": 3.0, "whitened": 0.1, "bilateral": 3.0}
    costs |= {"nonlocal-means": 2.0}
    factor = {"whitened": 0.95, "bilateral": 0.8, "nonlocal-means": 0.995}
    error = lambda some, case: float(np.prod([factor.get(m, 1.0) for m in some]))
    path = members.joined(["a 16", "b 16"], tuple(factor), costs, error)
    assert path.members == (*members.START, "whitened", "bilateral")
    assert path.costs == pytest.approx((3.0, 3.1, 6.1))
    assert path.within(4.0) == (*members.START, "whitened")
    assert path.within(0.0) == members.START
    assert members.cost_of(("whitened",), costs) == pytest.approx(3.1)


@pytest.mark.slow
def test_members_are_judged_without_their_scene(glass_frame, tmp_path):
    for scene in ("a", "b"):
        exr.write_frame(tmp_path / f"{scene}-64.exr", glass_frame)
    config = members.Config(
        tmp_path, tmp_path / "estimates", tmp_path / "results.jsonl", quick=True
    )
    found = members.run(config)
    assert all(0 < error < 1 for error in found["left out"][60.0].values())
    assert found["path"][0][0] == "oidn"
    said = members.report(found)
    assert f"{found['left out'][60.0]['a 64']:.3f}" in said.answer


@pytest.mark.slow
def test_forms_are_measured(glass_frame, tmp_path):
    """Of a frame with two sub-buffers; the paper's bound stands apart from the rest."""
    (tmp_path / "test").mkdir()
    exr.write_frame(tmp_path / "test" / "glass-0000-64.exr", glass_frame)
    rows = forms.run(forms.Config(tmp_path))
    (row,) = rows.values()
    errors_of = row["relative L2"]
    assert np.isfinite(list(errors_of.values())).all()
    frame = glass_frame.normalised()
    r, noise = frame.reference
    expected = metrics.rel_l2(frame.color, r, half_difference=noise)
    assert errors_of["path tracing"] == pytest.approx(float(expected), rel=1e-5)
    box = metrics.rel_l2(
        smoothing.box(frame.color, window=15), r, half_difference=noise
    )
    assert errors_of["box"] == pytest.approx(float(box), rel=1e-4)
    assert -1 <= row["prior"]["rank correlation of eta^2 and the prior's error"] <= 1
    said = forms.report(rows)
    ratio = errors_of["njs, dual"] / errors_of["njs"]
    assert f"the dual form {ratio:.2f} of njs" in said.answer
