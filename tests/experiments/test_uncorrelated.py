"""The experiments in `uncorrelated` run, and say what they measured."""

import jax.numpy as jnp
import numpy as np
import pytest

from experiments.uncorrelated import bias, correlation, error
from jscomb import metrics, rendering

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


def test_uncorrelated_kernels_are_measured(tmp_path, vectorised):
    """A scene file is rendered with both kinds of numbers, every method measured."""
    (tmp_path / "box").mkdir()
    (tmp_path / "box" / "scene.xml").write_text(BOX)
    reference = np.full((12, 16, 3), 0.7, np.float32)
    noise = 0 * reference
    np.savez(tmp_path / "box.npz", reference=reference, reference_half_difference=noise)
    config = error.Config(tmp_path, tmp_path, tmp_path / "out", quick=True)
    found = error.run(config)
    row = found["frames"]["box 8"]
    assert all(np.isfinite(list(each.values())).all() for each in row.values())
    settings = rendering.Settings(
        spp=8, width=16, height=12, buffers=4, numbers="common", seed=error.COMMON_SEED
    )
    scene = tmp_path / "box" / "scene.xml"
    image = rendering.render(f"{scene}", settings).color
    expected = metrics.rel_l2(image, jnp.asarray(reference))
    np.testing.assert_allclose(row["error"]["common numbers"], expected, rtol=0.05)
    assert error.run(config)["frames"] == found["frames"]  # kept
    assert found["speed"].keys() == {"7x7"}
    ratio = row["error"]["uncorrelated 7x7"] / row["error"]["path tracing"]
    assert f"(geometric mean of 1 frames), {ratio:.2f} (" in error.report(found).answer
    with pytest.raises(ValueError, match=r"no scene in .* has an archive in"):
        error.run(error.Config(tmp_path, tmp_path / "out", tmp_path))


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


@pytest.mark.slow
def test_bias_of_all_methods(tmp_path, vectorised):
    config = bias.Config(tmp_path, quick=True)
    found = bias.run(config)
    assert len(found) == 2
    for result in found.values():
        assert result.methods.keys() == set(bias.METHODS)
        for one in result.methods.values():
            assert np.isfinite([one.bias, one.bias_error, one.variance]).all()
            assert one.map.shape == (24, 24)
        assert sum(result.gamma.values()) == 12
    said = bias.report(found)
    assert f"{found['cornell-glass'].methods['oidn'].bias:.3g}" in said.body
    assert list(said.figures) == ["Maps of the bias"]
    with pytest.raises(ValueError, match="at least 3 groups of 2 realisations"):
        bias.Config(tmp_path, groups=2)


def test_likeness_of_neighbours(vectorised):
    rows = correlation.run(correlation.Config(quick=True))
    alone, common, _ = rows.values()
    assert abs(alone["correlation, median"]) < 0.2 < 0.5 < common["correlation, median"]
    assert common["ratio, median"] < 0.5 < 0.8 < alone["ratio, median"]
    assert abs(common["frame's mean, standard errors"]) < 5
    said = correlation.report(rows).answer
    assert f"is {common['ratio, median']:.2f} to" in said
