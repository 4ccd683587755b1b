"""The experiments run, on small input, and say what they measured."""

import numpy as np
import pytest

from experiments import (
    bundle,
    ensemble,
    frames,
    james_stein_error,
    james_stein_speed,
    regression_error,
    speed_error,
)
from jscomb import metrics
from jscomb.cli import METHODS
from jscomb.frame import CHANNELS


@pytest.fixture
def folder(glass_frame, tmp_path):
    """An archive of one sample count, made of the crop."""
    arrays = {
        "reference": glass_frame.reference.image,
        "reference_half_difference": glass_frame.reference.half_difference,
        "full_oidn_32": glass_frame.biased["oidn"].full,
    }
    for name, half in zip("ab", glass_frame.halves(), strict=True):
        arrays[f"{name}_color_32"] = half.color
        arrays[f"{name}_variance_32"] = half.variance
        arrays[f"{name}_oidn_32"] = half.biased["oidn"].full
        for feature, channels in CHANNELS.items():
            image = getattr(half, feature)
            arrays[f"{name}_{feature}"] = image[..., 0] if channels == 1 else image
    np.savez(tmp_path / "glass.npz", **arrays)
    return tmp_path


def test_archives_are_frames(folder, glass_frame):
    frame = frames.load(folder / "glass.npz", 64)
    assert frame.samples == 64
    np.testing.assert_allclose(frame.color, glass_frame.color, rtol=1e-6)
    np.testing.assert_allclose(frame.variance, glass_frame.variance, rtol=1e-5)
    np.testing.assert_allclose(frame.depth, glass_frame.depth, rtol=1e-6)
    with pytest.raises(ValueError, match=r"has \[64\] samples, not 128"):
        frames.load(folder / "glass.npz", 128)


def test_errors_are_those_of_the_metrics(folder, glass_frame):
    (key, errors), *_ = james_stein_error.run(
        james_stein_error.Config(folder, quick=True)
    ).items()
    assert key == ("glass", 64)
    assert errors.keys() == {"path tracing", "oidn", *METHODS, "auto", "dual"}
    r, noise = glass_frame.reference
    y = glass_frame.biased["oidn"].full
    expected = metrics.rel_l2(y, r, half_difference=noise)
    np.testing.assert_allclose(errors["oidn"], expected, rtol=1e-5)
    assert errors["auto"] in (errors["oidn"], errors["whitened"])
    with pytest.raises(ValueError, match=r"no \.npz archive"):
        james_stein_error.run(james_stein_error.Config(folder / "none"))


def test_every_function_is_timed():
    medians = james_stein_speed.run(james_stein_speed.Config(quick=True))
    assert {"two window sums", "combine", "combine, whitened"} < medians.keys()
    assert all(seconds > 0 for seconds in medians.values())


def test_regression_is_measured(folder, tmp_path):
    config = regression_error.Config(
        folder, tmp_path / "kept.json", stride=4, window=11, quick=True
    )
    found = regression_error.run(config)
    assert found.keys() == {f"glass 64 {b}" for b in (*regression_error.BASES, "NFOR")}
    assert regression_error.run(config) == found  # kept, and not measured again
    row = found["glass 64 oidn"]
    frame = frames.load(folder / "glass.npz", 64)
    frame = frame.scaled(1 / frame.exposure)
    r, noise = frame.reference
    expected = metrics.rel_l2(frame.biased["oidn"].full, r, half_difference=noise)
    np.testing.assert_allclose(row["y"], expected, rtol=1e-6)
    assert row["features"] == 8
    image, seconds = speed_error.regressed(frame, speed_error.Setting(4, 11), 1)
    error = metrics.rel_l2(image, r, half_difference=noise)
    np.testing.assert_allclose(row["y*"], error, rtol=1e-5)
    assert seconds > 0


def test_useful_operations_are_those_of_clipped_windows():
    r, n = speed_error.WINDOW // 2, 40
    near = abs(np.subtract.outer(np.arange(n), np.arange(n))) <= r
    assert speed_error.useful_operations(n) == 2 * 151 * near.sum() ** 2


def test_ratios_are_to_the_first_setting():
    first, other = speed_error.FIRST, speed_error.Setting(stride=2)
    found = {first: ([1.0, 2.0], [4.0, 4.0]), other: ([2.0, 1.0], [1.0, 1.0])}
    ratios = speed_error.ratios(found)
    assert ratios["stride 1, 51x51"] == (1, 1, 1)
    np.testing.assert_allclose(ratios["stride 2"], (1, 2, 0.25))


def test_a_crop_is_of_every_image(glass_frame):
    crop = bundle.crop(glass_frame, 0, 0)
    np.testing.assert_array_equal(crop.color, glass_frame.color)
    cut = bundle.crop(glass_frame, 10, 20)
    np.testing.assert_array_equal(cut.depth, glass_frame.depth[10:, 20:])
    assert cut.samples == glass_frame.samples


def test_scores_are_ranks():
    """The best of three candidates scores 3, the worst 1; means over the frames."""
    rows = [{"a": 0.1, "b": 0.2, "c": 0.3}, {"a": 9.0, "b": 1.0, "c": 5.0}]
    assert ensemble.scores(rows, ["a", "b", "c"]) == {"b": 2.5, "a": 2.0, "c": 1.5}
