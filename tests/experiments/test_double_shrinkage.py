"""The experiments in `double_shrinkage` run, and say what they measured."""

import numpy as np

from experiments.double_shrinkage import (
    double_shrinkage,
    double_shrinkage_speed,
    photon_error,
)
from jscomb import exr, metrics


def test_double_shrinkage_is_measured(tmp_path, vectorised):
    """One scene, both integrators, in a second; what was rendered is kept."""
    config = double_shrinkage.Config(tmp_path, quick=True)
    (row,) = double_shrinkage.run(config).values()
    for errors in (row["error"], row["ablations"]):
        assert np.isfinite(list(errors.values())).all()
    assert row["ablations"]["double shrinkage"] == row["error"]["double shrinkage"]
    assert row["mse"]["variance alone"][0] <= row["mse"]["by radii"][0]
    whole = exr.read_frame(tmp_path / "cornell-caustic-whole.exr")
    r, noise = whole.reference
    expected = metrics.rel_l2(
        *(i / whole.median_luminance for i in (whole.color, r)),
        half_difference=noise / whole.median_luminance,
    )
    alone = row["error"]["path tracing alone"]
    np.testing.assert_allclose(alone, expected, rtol=1e-4)
    assert (tmp_path / "cornell-caustic.png").stat().st_size > 10_000
    again = double_shrinkage.run(config)["cornell-caustic"]
    assert again["error"] == row["error"]


def test_double_shrinkage_is_timed():
    config = double_shrinkage_speed.Config(quick=True)
    found = double_shrinkage_speed.run(config)
    assert all(ratio > 0 for ratio in found.values())


def test_means_are_compared_with_path_tracing():
    """Against known differences, and for a moment with a real scene."""
    rng = np.random.default_rng(0)
    traced, photons = 1 + 0.1 * rng.standard_normal((2, 200, 4, 4))
    same = photon_error.compare(photons, traced)
    assert abs(same["frame"]) < 5 * same["its error"]
    assert 0.3 < same["blocks, mean square"] < 3
    np.testing.assert_allclose(same["its error"], 0.1 * (2 / 3200) ** 0.5, rtol=0.2)
    off = photon_error.compare(1.1 * photons, traced)
    assert abs(off["frame"] - 0.1) < 5 * off["its error"]
    assert off["blocks, mean square"] > 50


def test_photon_mapping_is_that_of_a_scene(vectorised):
    rows = photon_error.run(photon_error.Config(("cornell-box",), quick=True))
    (row,) = rows.values()
    assert abs(row["frame"]) < 0.2
