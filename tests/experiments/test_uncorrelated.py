"""The experiments in `uncorrelated` run, and say what they measured."""

import jax.numpy as jnp
import numpy as np
import pytest

from experiments.uncorrelated import bias, correlation, error, rendered, windows
from experiments.uncorrelated.realisations import METHODS, Group
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


@pytest.fixture
def box(tmp_path):
    """A folder with a scene file and an archive with its reference."""
    (tmp_path / "box").mkdir()
    (tmp_path / "box" / "scene.xml").write_text(BOX)
    reference = np.full((12, 16, 3), 0.7, np.float32)
    noise = 0 * reference
    np.savez(tmp_path / "box.npz", reference=reference, reference_half_difference=noise)
    return tmp_path


@pytest.mark.slow
def test_uncorrelated_kernels_are_measured(box, vectorised):
    """A scene file is rendered with both kinds of numbers, every method measured."""
    config = error.Config(box, box, box / "out", quick=True)
    found = error.run(config)
    row = found["frames"]["box 8"]
    assert all(np.isfinite(list(each.values())).all() for each in row.values())
    settings = rendering.Settings(
        spp=8,
        width=16,
        height=12,
        buffers=8,
        numbers="common",
        seed=rendered.COMMON_SEED,
    )
    image = rendering.render(f"{box / 'box' / 'scene.xml'}", settings).color
    expected = metrics.rel_l2(image, jnp.full_like(image, 0.7))
    measured = row["relative L2"]
    np.testing.assert_allclose(measured["common numbers"], expected, rtol=0.05)
    assert error.run(config)["frames"] == found["frames"]  # kept
    said = error.report(found)
    ratio = measured["uncorrelated"] / measured["path tracing"]
    assert f"geometric mean of 1 frames: uncorrelated {ratio:.2f} (" in said.answer
    assert "Of 1 frames gamma of the paper's candidates is " in said.body
    assert all(f"| {name} |" in said.body for name in measured)
    with pytest.raises(ValueError, match=r"no scene in .* has an archive in"):
        error.run(error.Config(box, box / "out", box))


@pytest.mark.slow
def test_windows_are_measured_on_two_films(box, vectorised):
    found = windows.run(windows.Config(box, box, box / "out", quick=True))
    assert found["speed"].keys() == {"5", "7"}
    assert len(found["films"]) == 2
    for rows in found["films"].values():
        assert np.isfinite([*rows["box 8"]["error"].values()]).all()
    said = windows.report(found)
    assert said.answer.count(" pixels wide (5: ") == 2


def test_a_smaller_reference_is_of_means(tmp_path):
    image = np.random.default_rng(0).normal(size=(5, 6, 3)).astype(np.float32)
    np.savez(tmp_path / "a.npz", reference=image, reference_half_difference=2 * image)
    found = rendered.read_reference(tmp_path / "a" / "scene.xml", tmp_path, 2)
    np.testing.assert_allclose(
        found.image[1, 2], image[2:4, 4:6].mean((0, 1)), rtol=1e-5
    )
    assert found.image.shape == (2, 3, 3)
    np.testing.assert_allclose(found.half_difference, 2 * found.image, rtol=1e-5)


def test_bias_is_that_of_known_groups():
    """Of a method that is off by a known amount, from groups with noise."""
    rng, shape = np.random.default_rng(0), (10, 1, 8, 8, 3)
    noise, control = rng.normal(0, 0.1, shape), np.full((8, 8, 3), 2.0)
    groups = [
        Group(2.2 + n, np.full(shape[1:], 0.5), control, control, np.ones(1))
        for n in noise
    ]
    found = bias.summary(groups, 0)
    expected = 0.2**2 / (4 + 0.01)
    assert abs(found.bias - expected) < 5 * found.bias_error < expected
    np.testing.assert_allclose(found.variance, 0.5 / 4.01)
    samples = rng.exponential(size=(40_000, 5, 4, 1))
    size, root = bias.skewness([samples])
    np.testing.assert_allclose([size, root], 3 * (1 - np.log(2)), rtol=0.1)
    differences = list(bias.differences(samples))
    assert [len(i[0]) * len(i[0, 0]) for i in differences][:2] == [5 * 3, 5 * 1]
    np.testing.assert_array_equal(
        differences[0], samples[:, :, 1:] - samples[:, :, :-1]
    )
    size, root = bias.skewness(differences)
    assert root < 0.75 * size < 0.02  # chance adds to the size alone
    assert bias.skewness([0 * samples]) == (0, 0)
    np.testing.assert_allclose(found.plain, 0.2**2, rtol=0.2)


@pytest.mark.slow
def test_bias_of_all_methods(tmp_path, vectorised):
    config = bias.Config(tmp_path, quick=True)
    found = bias.run(config)
    assert len(found) == 2
    assert all(list(each) == [4, 16] for each in found.values())
    for result in (one for each in found.values() for one in each.values()):
        assert result.methods.keys() == set(METHODS)
        for one in result.methods.values():
            assert np.isfinite([one.bias, one.bias_error, one.variance]).all()
            assert one.map.shape == (24, 24)
        assert sum(result.gamma.values()) == 12
    said = bias.report(found)
    few, many = (found["cornell-glass"][n].methods["oidn"] for n in (4, 16))
    assert f"{many.bias:.3g}" in said.body
    assert f"| cornell-glass, oidn | 4 | {few.variance / many.variance:#.3g} |" in (
        said.body
    )
    assert list(said.figures) == ["Maps of the bias"]
    with pytest.raises(ValueError, match="at least 3 groups of 2 realisations"):
        bias.Config(tmp_path, groups=2)
    with pytest.raises(ValueError, match="no frame 'box'; there are 'synthetic, sym"):
        bias.Config(tmp_path, frames=("box",))


def test_likeness_of_neighbours(vectorised):
    rows = correlation.run(correlation.Config(quick=True))
    alone, common, _ = rows.values()
    assert abs(alone["correlation, median"]) < 0.2 < 0.5 < common["correlation, median"]
    assert common["ratio, median"] < 0.5 < 0.8 < alone["ratio, median"]
    assert abs(common["frame's mean, standard errors"]) < 5
    said = correlation.report(rows).answer
    assert f"is {common['ratio, median']:.2f} to" in said
