"""The experiments in `james_stein` run, and say what they measured."""

import shutil

import numpy as np
import pytest

from experiments.common import archives
from experiments.james_stein import (
    error,
    lights,
    parts,
    regression,
    weak_denoisers,
)
from jscomb import exr, metrics
from jscomb.denoisers import oidn
from tests.conftest import DATA


def test_errors_are_those_of_the_metrics(folder, glass_frame):
    found = error.run(error.Config(folder, quick=True))
    (name, errors), *_ = found.rows.items()
    assert name == "glass 64"
    assert errors.keys() == {*error.INPUTS, *error.COMBINERS, "auto", "dual"}
    frame = glass_frame.normalised()
    r, noise = frame.reference
    expected = metrics.rel_l2(frame.estimates["oidn"].image, r, half_difference=noise)
    np.testing.assert_allclose(errors["oidn"], expected, rtol=1e-5)
    assert errors["auto"] in (errors["oidn"], errors["whitened"])
    assert error.CEILING in found.seconds
    assert all(seconds > 0 for seconds in found.seconds.values())


@pytest.mark.slow
def test_regression_is_measured(folder, tmp_path):
    config = regression.Config(
        folder, tmp_path / "kept.jsonl", stride=4, window=11, quick=True
    )
    measured = regression.run(config)
    found = measured.rows
    assert found.keys() == {f"glass 64 {b}" for b in (*regression.BASES, "NFOR")}
    kept = config.results.read_text()
    assert all(name in kept for name in found)
    row = found["glass 64 oidn"]
    frame = archives.load(folder / "glass.npz", 64).normalised()
    r, noise = frame.reference
    expected = metrics.rel_l2(frame.estimates["oidn"].image, r, half_difference=noise)
    np.testing.assert_allclose(row["y"], expected, rtol=1e-6)
    assert row["features"] == 8
    image, seconds = regression.regressed(frame, regression.Setting(4, 11), 1)
    error = metrics.rel_l2(image, r, half_difference=noise)
    np.testing.assert_allclose(row["y*"], error, rtol=1e-5)
    assert seconds > 0
    said = regression.report(measured)
    assert f"{row['y*'] / row['y']:.2f} of its error" in said.answer
    assert f"| {row['y']:#.3g} |" in said.body


def test_pixels_beside_lights_are_told_apart(glass_frame, tmp_path):
    """Within three pixels of a bright one, but not the light; of a frame's file."""
    level = np.ones((20, 20, 3), np.float32)
    level[8, 9] = 30
    reference = glass_frame.reference._replace(image=level)
    found = lights.beside_lights(glass_frame._replace(reference=reference))
    expected = np.zeros((20, 20), bool)
    expected[5:12, 6:13] = True
    expected[8, 9] = False
    np.testing.assert_array_equal(found, expected)
    (tmp_path / "test").mkdir()
    exr.write_frame(tmp_path / "test" / "glass-0000-64.exr", glass_frame)
    rows = lights.run(lights.Config(tmp_path))
    for row in rows.values():
        pixels = sum(part["pixels"] for part in row.values())
        assert pixels == glass_frame.color.shape[0] * glass_frame.color.shape[1]
    assert f"In {len(rows)} frames" in lights.report(rows).answer or not rows


def test_useful_operations_are_those_of_clipped_windows():
    r, n = parts.WINDOW // 2, 40
    near = abs(np.subtract.outer(np.arange(n), np.arange(n))) <= r
    assert parts.useful_operations(n) == 2 * 151 * near.sum() ** 2


def test_ratios_are_to_the_first_setting():
    first, other = regression.FIRST, regression.Setting(stride=2)
    found = {first: ([1.0, 2.0], [4.0, 4.0]), other: ([2.0, 1.0], [1.0, 1.0])}
    ratios = regression.ratios(found)
    assert ratios["stride 1, 51x51"] == (1, 1, 1)
    np.testing.assert_allclose(ratios["stride 2"], (1, 2, 0.25))


@pytest.mark.slow
@pytest.mark.skipif(not oidn.available(), reason="needs Open Image Denoise")
def test_weak_denoisers_are_measured(tmp_path):
    (tmp_path / "test").mkdir()
    shutil.copy(DATA / "unseen-random-3004-256.exr", tmp_path / "test")
    found = weak_denoisers.run(weak_denoisers.Config(tmp_path, quick=True))
    (frame, row), *_ = found.items()
    assert frame == "unseen-random-3004 256"
    assert row.keys() == set(weak_denoisers.DENOISERS)
    stored = exr.read_frame(tmp_path / "test" / "unseen-random-3004-256.exr")
    stored = stored.normalised()
    r, noise = stored.reference
    expected = metrics.rel_l2(stored.color, r, half_difference=noise)
    for errors in row.values():
        np.testing.assert_allclose(errors["path-tracing"], expected, rtol=1e-3)
        assert errors["multi-scale"] < 1.001 * errors["alone"]
    ratio = row["nfor"]["multi-scale"] / row["nfor"]["alone"]
    assert f"nfor {ratio:.2f} at 256 samples" in weak_denoisers.report(found).answer
