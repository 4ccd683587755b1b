"""The experiments in `ensemble` run, and say what they measured."""

import pytest

from experiments.ensemble import dependence, ensemble
from jscomb import exr
from jscomb.denoisers import oidn


def test_scores_are_ranks():
    """The best of three candidates scores 3, the worst 1; means over the frames."""
    rows = [{"a": 0.1, "b": 0.2, "c": 0.3}, {"a": 9.0, "b": 1.0, "c": 5.0}]
    assert ensemble.scores(rows, ["a", "b", "c"]) == {"b": 2.5, "a": 2.0, "c": 1.5}


def test_shared_weights_are_measured_beside_own_ones(glass_frame, tmp_path):
    """An ensemble is better than its first base, which the halves underestimate."""
    if not oidn.available():
        pytest.skip("needs Open Image Denoise")
    path = tmp_path / "glass.exr"
    exr.write_frame(path, glass_frame)
    rows = dependence.run(dependence.Config((path, path), quick=True))
    (row,) = rows.values()
    for estimated, true in (row["shared"], row["own"]):
        assert true < estimated < 0
    assert row["shared"] != row["own"]
    assert len(dependence.table(rows)) == 5
    exr.write_frame(path, glass_frame.merged(2))
    with pytest.raises(ValueError, match="needs a reference and four sub-buffers"):
        dependence.run(dependence.Config((path,)))
