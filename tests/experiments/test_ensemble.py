"""The experiments in `ensemble` run, and say what they measured."""

import numpy as np
import pytest

from experiments.ensemble import (
    bases,
    dependence,
    searching,
    solvers,
    subsets,
    truth,
    weights,
)
from jscomb import exr, metrics
from jscomb.denoisers import oidn


def test_scores_are_ranks():
    """The best of three candidates scores 3, the worst 1; means over the frames."""
    rows = [{"a": 0.1, "b": 0.2, "c": 0.3}, {"a": 9.0, "b": 1.0, "c": 5.0}]
    assert subsets.scores(rows, ["a", "b", "c"]) == {"b": 2.5, "a": 2.0, "c": 1.5}


@pytest.mark.slow
@pytest.mark.skipif(not oidn.available(), reason="needs Open Image Denoise")
def test_ensembles_are_measured(folder, glass_frame):
    rows = weights.run(weights.Config((folder,), quick=True))
    (row,) = rows.values()
    r, noise = glass_frame.normalised().reference
    base = glass_frame.normalised().estimates["oidn"].image
    expected = metrics.rel_l2(base, r, half_difference=noise)
    np.testing.assert_allclose(row["oidn"], expected, rtol=1e-5)
    said = weights.report(rows)
    ours = row["multi-scale"] / min(row[base] for base in bases.BASES)
    low = "100%" if ours < 1 else "0%"
    expected = (
        f"{ours:.2f} (worst {ours:.2f}; below 1 in {low} of the frames) with multi"
    )
    assert expected in said.answer
    assert f"| fig. 8 | {weights.PAPER} |" in said.body


def test_cases_are_won_where_errors_are_less():
    """An ensemble of half its best base's error wins, and more bases score more."""
    rng = np.random.default_rng(0)
    rows = {}
    for samples in (4, 16):
        row = {n: rng.uniform(1, 2) for n in (subsets.NOISY, *bases.BASES)}
        for name, some in subsets.SUBSETS.items():
            best = min(row[base] for base in some)
            row |= {f"{name}: {form}": 2 * best for form in subsets.FORMS}
            row[f"{name}: {subsets.PAPER}"] = best / len(some)
        row |= {name + subsets.DSSIM: 3 - error for name, error in row.items()}
        rows[f"test/random {samples}"] = row
    said = subsets.report(rows)
    assert "filter errors before in 100.0 % (by DSSIM 0.0 %; multi" in said.answer
    assert "| all | 100.0 | 100.0 | 100.0 |" in said.body
    ranked = subsets.scored(rows, subsets.PAPER)
    assert next(iter(ranked)) == " + ".join(bases.BASES)
    assert ranked[" + ".join(bases.BASES)]["mean"] == len(ranked)


def test_the_narrowest_window_is_chosen_by_the_first_folder():
    """A pixel less costs 0.2 % there, half of it elsewhere, and a unit of time."""
    rows = {}
    for frame, cost in ("train/a 4", 0.002), ("train/b 16", 0.002), ("test/c 4", 0.001):
        row = {f"{w} s": float(w) for w in searching.WIDTHS}
        for tier in searching.ENSEMBLES:
            errors = {str(w): 1 + cost * (21 - w) for w in searching.WIDTHS}
            errors[searching.WITHOUT] = 1 + 21 * cost
            row |= {f"{tier} {name}": error for name, error in errors.items()}
        rows[frame] = row
    said = searching.report(rows).answer
    assert "Of 2 frames a window of 17 pixels" in said
    assert "1.008 (worst 1.01); on 1 others `balanced` has 1.004" in said
    assert "without the filter 1.021" in said
    assert f"takes {17 / 21:.2f} of the time" in said


@pytest.mark.slow
@pytest.mark.skipif(not oidn.available(), reason="needs Open Image Denoise")
def test_windows_are_measured(folder):
    (row,) = searching.run(searching.Config((folder,), quick=True)).values()
    ratios = searching.of_tier({"f/a 4": row}, "best")["f/a 4"]
    assert ratios["21"] == 1
    assert ratios["7"] != 1
    assert all(0.5 < ratio < 2 for ratio in ratios.values())
    assert row["21 s"] > 0


@pytest.mark.slow
@pytest.mark.skipif(not oidn.available(), reason="needs Open Image Denoise")
def test_all_subsets_are_measured(folder):
    rows = subsets.run(subsets.Config((folder,), quick=True))
    (row,) = rows.values()
    worst = max(row[base] for base in bases.BASES)
    for name in subsets.SUBSETS:  # a convex mean is no worse than the worst base
        assert 0 < row[f"{name}: {subsets.AVERAGE}"] < worst


@pytest.mark.slow
def test_no_solver_is_below_the_least(folder):
    """The exact one is there, more steps of the paper's bring it nearer."""
    found = solvers.run(solvers.Config(folder, "glass", 64, quick=True))
    (gaps,) = found.gaps.values()
    assert min(gap.min() for gap in gaps.values()) > -1e-6
    assert gaps["hull"].max() < 1e-6 < gaps["iterative, 64 steps"].max()
    assert "times the time of 3 bases" in solvers.report(found).answer


@pytest.mark.slow
@pytest.mark.skipif(not oidn.available(), reason="needs Open Image Denoise")
def test_true_matrices_are_better_than_estimates(tmp_path):
    config = truth.Config(("cornell-box",), tmp_path, quick=True)
    rows = truth.run(config)
    row = rows["cornell-box"]
    assert row[truth.TRUE] < row[truth.OURS]
    assert truth.run(config) == rows  # what was rendered is kept
    assert "(mean of 1 scenes)" in truth.report(rows).answer


@pytest.mark.slow
@pytest.mark.skipif(not oidn.available(), reason="needs Open Image Denoise")
def test_shared_weights_are_measured_beside_own_ones(glass_frame, tmp_path):
    """An ensemble is better than its first base, which the halves underestimate."""
    path = tmp_path / "glass.exr"
    exr.write_frame(path, glass_frame)
    rows = dependence.run(dependence.Config((str(path),)))
    (row,) = rows.values()
    for estimated, true in (row["shared"], row["own"]):
        assert true < estimated < 0
    assert row["shared"] != row["own"]
    said = dependence.report(rows)
    assert f"and {row['own'][0] - row['own'][1]:+.2f} (" in said.answer
    exr.write_frame(path, glass_frame.merged(2))
    with pytest.raises(ValueError, match="needs a reference and four sub-buffers"):
        dependence.run(dependence.Config((str(path),)))
