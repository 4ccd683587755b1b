"""The experiments in `double_shrinkage` run, and say what they measured."""

import shutil

import jax.numpy as jnp
import numpy as np
import pytest

from experiments.double_shrinkage import error, photon_mapping, photons
from jscomb import metrics
from jscomb.denoisers import oidn
from tests.conftest import DATA


@pytest.mark.slow
@pytest.mark.skipif(not oidn.available(), reason="needs Open Image Denoise")
def test_double_shrinkage_is_measured(tmp_path, vectorised):
    """One scene, both integrators, in a second; what was rendered is kept."""
    config = error.Config(tmp_path, quick=True)
    found = error.run(config)
    (row,) = found.scenes.values()
    for errors in (row.error, row.ablations):
        assert np.isfinite(list(errors.values())).all()
    assert row.ablations["double shrinkage"] == row.error["double shrinkage"]
    assert row.mse["variance alone"][0] <= row.mse["by radii"][0]
    assert all(ratio > 0 for ratio in found.times.values())
    said = error.report(found)
    ratio = row.error["double shrinkage"] / row.error["path tracing alone"]
    assert f"has {ratio:.2f} of path tracing's" in said.answer
    (again,) = error.run(config).scenes.values()
    assert again.error == row.error


def test_photons_errors_are_told_and_true(glass_frame):
    """Of an image that is off by a constant, whose halves do not differ."""
    frame = glass_frame.normalised()
    r, noise = frame.reference
    off = frame.with_estimate(error.PHOTONS, frame.estimates["oidn"]._replace(
        image=r + 0.1, halves=jnp.stack([r + 0.1, r + 0.1])))  # fmt: skip
    found = error.errors_of_photons(off, jnp.full_like(r, 0.01))
    assert found["variance alone"] == [0, 0, 0]
    assert found["by radii"][0] > 0
    own = metrics.rel_l2(r + 0.1, r, half_difference=noise)
    np.testing.assert_allclose(found["true"][0], own, rtol=1e-4)


def test_means_are_compared_with_path_tracing(rng):
    """Against known differences, and for a moment with a real scene."""
    traced, photons = 1 + 0.1 * rng.standard_normal((2, 200, 4, 4))
    same = photon_mapping.compare(photons, traced)
    assert abs(same["frame"]) < 5 * same["its error"]
    assert 0.3 < same["blocks, mean square"] < 3
    np.testing.assert_allclose(same["its error"], 0.1 * (2 / 3200) ** 0.5, rtol=0.2)
    off = photon_mapping.compare(1.1 * photons, traced)
    assert abs(off["frame"] - 0.1) < 5 * off["its error"]
    assert off["blocks, mean square"] > 50


def test_photon_mapping_is_that_of_a_scene(vectorised):
    rows = photon_mapping.run(photon_mapping.Config(("cornell-box",), quick=True))
    (row,) = rows.values()
    assert abs(row["frame"]) < 0.2
    assert "of 1 scenes" in photon_mapping.report(rows).answer


@pytest.mark.slow
def test_combiners_of_photons_are_measured(tmp_path):
    (tmp_path / "test").mkdir()
    shutil.copy(DATA / "unseen-random-3001-256.exr", tmp_path / "test")
    found = photons.run(photons.Config(tmp_path, quick=True))
    (row,) = found.values()
    better = min(row["path-tracing"], row["photons"])
    assert row["dsc"] < row["double-shrinkage"] < better
    said = photons.report(found).answer
    name = "ensemble with James-Stein"
    assert f"{name} {row[name] / better:.3f}" in said
