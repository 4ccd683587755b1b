"""The experiments run, on small input, and say what they measured."""

import numpy as np
import pytest

from experiments import (
    bundle,
    frames,
    james_stein_error,
    james_stein_speed,
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


def test_regression_is_measured(folder):
    frame = frames.load(folder / "glass.npz", 64)
    frame = frame.scaled(1 / frame.exposure)
    found = speed_error.errors_of(frame, frame.biased["oidn"], [(4, 21)], 1)
    r, noise = frame.reference
    expected = metrics.rel_l2(frame.biased["oidn"].full, r, half_difference=noise)
    np.testing.assert_allclose(found.base, expected, rtol=1e-6)
    assert found.regressed[4, 21] > 0
    assert found.seconds[4, 21] > 0
    r = speed_error.WINDOW // 2
    pairs = sum(
        abs(a - b) <= r and abs(c - d) <= r for a, b, c, d in np.ndindex(30, 30, 30, 30)
    )
    assert speed_error.useful_operations(30) == 2 * 151 * pairs


def test_a_crop_is_of_every_image(glass_frame):
    crop = bundle.crop(glass_frame, 0, 0)
    np.testing.assert_array_equal(crop.color, glass_frame.color)
    cut = bundle.crop(glass_frame, 10, 20)
    np.testing.assert_array_equal(cut.depth, glass_frame.depth[10:, 20:])
    assert cut.samples == glass_frame.samples
