"""The experiments run, on small input, and say what they measured."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments import (
    bias,
    bundle,
    correlation,
    dependence,
    double_shrinkage,
    double_shrinkage_speed,
    ensemble,
    frames,
    james_stein_error,
    james_stein_speed,
    learned,
    learned_speed,
    regression_error,
    speed_error,
    uncorrelated,
)
from experiments.rendering import UNTRAINED
from jscomb import exr, metrics
from jscomb.denoisers import oidn
from jscomb.learning import networks, recipes

BOX = """<scene version="3.0.0">
  <integrator type="path"/>
  <sensor type="perspective">
    <film type="hdrfilm">
      <integer name="width" value="16"/><integer name="height" value="12"/>
    </film>
    <transform name="to_world"><lookat origin="0,0,5" target="0,0,0" up="0,1,0"/>
    </transform>
  </sensor>
  <shape type="sphere"/>
  <shape type="rectangle"><transform name="to_world"><translate z="-2"/></transform>
  </shape>
  <emitter type="constant"/>
</scene>
"""


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
    assert errors.keys() == {"path tracing", "oidn", *UNTRAINED, "auto", "dual"}
    frame = glass_frame.normalised()
    r, noise = frame.reference
    expected = metrics.rel_l2(frame.estimates["oidn"].image, r, half_difference=noise)
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
    frame = frames.load(folder / "glass.npz", 64).normalised()
    r, noise = frame.reference
    expected = metrics.rel_l2(frame.estimates["oidn"].image, r, half_difference=noise)
    np.testing.assert_allclose(row["y"], expected, rtol=1e-6)
    assert row["features"] == 8
    image, seconds = speed_error.regressed(frame, speed_error.Setting(4, 11), 1)
    error = metrics.rel_l2(image, r, half_difference=noise)
    np.testing.assert_allclose(row["y*"], error, rtol=1e-5)
    assert seconds > 0


def test_uncorrelated_kernels_are_measured(tmp_path, vectorised):
    """A scene file is rendered with both kinds of numbers, every method measured."""
    (tmp_path / "box").mkdir()
    (tmp_path / "box" / "scene.xml").write_text(BOX)
    reference = np.full((12, 16, 3), 0.7, np.float32)
    noise = 0 * reference
    np.savez(tmp_path / "box.npz", reference=reference, reference_half_difference=noise)
    config = uncorrelated.Config(tmp_path, tmp_path, tmp_path / "out", quick=True)
    found = uncorrelated.run(config)
    row = found["frames"]["box 8"]
    assert all(np.isfinite(list(each.values())).all() for each in row.values())
    image = exr.read_frame(tmp_path / "out" / "box-8-common.exr").color
    expected = metrics.rel_l2(image, jnp.asarray(reference))
    np.testing.assert_allclose(row["error"]["common numbers"], expected, rtol=0.05)
    assert uncorrelated.run(config)["frames"] == found["frames"]  # kept
    assert found["speed"].keys() == {"7x7"}
    with pytest.raises(ValueError, match=r"no scene in .* has an archive in"):
        uncorrelated.run(uncorrelated.Config(tmp_path, tmp_path / "out", tmp_path))


def test_bias_is_that_of_known_groups():
    """Of a method that is off by a known amount, from groups with noise."""
    rng, shape = np.random.default_rng(0), (10, 1, 8, 8, 3)
    noise, control = rng.normal(0, 0.1, shape), np.full((8, 8, 3), 2.0)
    groups = [
        bias.Group(2.2 + n, np.full(shape[1:], 0.5), control, control, np.ones(1))
        for n in noise
    ]
    found = bias.summary(groups, 0)
    expected = 0.2**2 / (4 + 0.01)
    assert abs(found.bias - expected) < 5 * found.bias_error < expected
    np.testing.assert_allclose(found.variance, 0.5 / 4.01)
    samples = rng.exponential(size=(40_000, 5, 4, 1))
    np.testing.assert_allclose(bias.skewness(samples), 3 * (1 - np.log(2)), rtol=0.1)
    assert bias.skewness_of_differences(samples, 1) < 0.1
    assert np.all(bias.skewness(0 * samples) == 0)


def test_bias_of_all_methods(tmp_path, vectorised):
    config = bias.Config(tmp_path, quick=True)
    found = bias.run(config)
    assert len(found) == 2
    for result in found.values():
        assert result["methods"].keys() == set(bias.METHODS)
        for one in result["methods"].values():
            assert np.isfinite([one.bias, one.bias_error, one.variance]).all()
            assert one.map.shape == (24, 24)
        assert sum(result["gamma"].values()) == 12
    assert (tmp_path / "bias.png").stat().st_size > 10_000
    with pytest.raises(ValueError, match="at least 3 groups of 2 realisations"):
        bias.Config(tmp_path, groups=2)


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


def test_likeness_of_neighbours(vectorised):
    rows = correlation.run(correlation.Config(quick=True))
    alone, common, _ = rows.values()
    assert abs(alone["correlation, median"]) < 0.2 < 0.5 < common["correlation, median"]
    assert common["ratio, median"] < 0.5 < 0.8 < alone["ratio, median"]
    assert abs(common["frame's mean, standard errors"]) < 5


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


@pytest.mark.slow
@pytest.mark.skipif(not oidn.available(), reason="needs Open Image Denoise")
def test_networks_are_measured_beside_the_rest(folder, glass_frame):
    rows = learned.run(learned.Config(folder, quick=True))
    errors = rows["glass", 64]
    assert {"path tracing", "oidn", "whitened", "njs", "dsc", "pd"} <= errors.keys()
    frame, recipe = glass_frame.normalised(), recipes.RECIPES["dsc"]
    inputs = recipe.inputs(jax.random.key(0), frame, frame.estimates["oidn"])
    image, (r, noise) = recipe.combine(recipes.shipped("dsc"), inputs), frame.reference
    expected = metrics.rel_l2(image, r, half_difference=noise)
    np.testing.assert_allclose(errors["dsc"], expected, rtol=1e-3)
    table = learned.summary(rows)
    np.testing.assert_allclose(
        table["njs"]["64"], errors["njs"] / errors["oidn"], rtol=1e-6
    )
    assert table["oidn"] == {"64": 1.0, "worst": 1.0}


def test_the_cost_of_networks_is_their_convolutions():
    costs = learned_speed.run(learned_speed.Config(quick=True))
    assert all(cost.seconds > 0 for cost in costs.values())
    assert 0 < costs["njs light"].memory < 2000
    # 5x5 of 18 to 48, four 3x3 of 48, 3x3 of 48 to 9: twice a multiplication.
    network = networks.MixingNetwork(jax.random.key(0))
    full = 2 * (25 * 18 * 48 + 4 * 9 * 48 * 48 + 9 * 48 * 9)
    assert learned_speed.operations(network) == full
    assert costs["pd light"].operations < full / 3


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
