"""Rendering with Mitsuba 3: statistics that are what they say, and resuming."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from experiments import progressive, render, scenes
from jscomb import exr
from tests.statistics import assert_mean, assert_mean_below


@pytest.fixture(scope="module", autouse=True)
def mitsuba():
    """The variant that runs everywhere, whatever LLVM this machine has."""
    import mitsuba as mi

    mi.set_variant("scalar_rgb")
    return scenes.mitsuba()


@pytest.fixture
def config(tmp_path):
    return render.Config(
        "cornell-box",
        tmp_path / "frame.exr",
        spp=16,
        size=24,
        feature_spp=2,
        reference_spp=64,
        denoise=False,
    )


def test_a_frame_with_honest_statistics(config):
    render.run(config)
    frame = exr.read_frame(config.out)
    assert (frame.samples, frame.sub_buffers, frame.color.shape) == (16, 2, (24, 24, 3))
    a, b = frame.halves()
    assert not np.array_equal(a.color, b.color)
    assert (frame.variance >= 0).all()
    assert_mean((frame.color - frame.reference.image)[..., 1], 0.0)
    assert frame.valid.all()
    assert ((frame.albedo >= 0) & (frame.albedo <= 1)).all()
    assert ((frame.visibility >= 0) & (frame.visibility <= 1)).all()
    assert 0.1 < frame.visibility.mean() < 0.9
    lengths = jnp.linalg.norm(frame.normal, axis=-1)
    assert lengths.max() < 1.01
    assert 3 < frame.depth.max() < 6
    about = exr.read_provenance(config.out)
    assert (about["scene"], about["reference_spp"]) == ("cornell-box", 64)
    assert [p.name for p in config.out.parent.iterdir()] == ["frame.exr"]


LAMP = """
<scene version="3.0.0">
  <sensor type="perspective">
    <film type="hdrfilm"/>
    <float name="fov" value="40"/>
    <transform name="to_world"><lookat origin="0,0,5" target="0,0,0" up="0,1,0"/>
    </transform>
  </sensor>
  <shape type="rectangle"><transform name="to_world"><scale value="9"/></transform>
  </shape>
  <shape type="rectangle">
    <transform name="to_world">
      <rotate x="1" angle="180"/><translate x="4" z="1.5"/>
    </transform>
    <emitter type="area"><rgb name="radiance" value="8"/></emitter>
  </shape>
</scene>
"""


def test_variance_is_that_of_the_mean(tmp_path):
    """Under a near lamp the noise is light-tailed, so half or twice would be seen."""
    (tmp_path / "lamp.xml").write_text(LAMP)
    config = render.Config(
        str(tmp_path / "lamp.xml"), tmp_path / "f.exr", spp=16, size=40, denoise=False
    )
    frame = render.assemble(config, render.render(config))
    a, b = frame.halves()
    difference = np.asarray(a.color - b.color)[..., 1]
    variance = np.asarray(a.variance + b.variance)[..., 1]
    assert variance.min() > 0
    assert_mean(difference, 0.0)
    assert_mean(difference**2 - variance, 0.0)
    assert_mean_below(difference**2 - 2 * variance, 0.0)
    assert_mean_below(variance / 2 - difference**2, 0.0)
    np.testing.assert_allclose(frame.variance[..., 1], variance / 4, rtol=1e-5)


def test_resumes_where_it_was_stopped(config, monkeypatch):
    whole = render.render(config)
    partial = render._Partial(config)
    partial.remove()
    monkeypatch.setattr(render, "SAVE_EVERY", 0.0)
    original, launches = render.Moments.add, []

    def stop_after_nine(self, image):
        launches.append(1)
        if len(launches) == 10:
            raise KeyboardInterrupt
        return original(self, image)

    monkeypatch.setattr(render.Moments, "add", stop_after_nine)
    with pytest.raises(KeyboardInterrupt):
        render.render(config)
    assert partial.load()[0] == 9
    again = render.render(config)
    assert len(launches) - 10 == len(list(render.passes(config))) - 9
    for name, moments in whole.items():
        np.testing.assert_array_equal(moments.mean, again[name].mean)
        np.testing.assert_array_equal(moments.squares, again[name].squares)
    other = dataclasses.replace(config, spp=18)
    with pytest.raises(ValueError, match="belongs to another configuration"):
        render.render(other)
    partial.path.write_text("rubbish")
    with pytest.raises(ValueError, match="not a partial render"):
        render.render(config)


def test_a_reference_is_borrowed_or_refused_before_the_first_pass(config):
    render.run(config)
    again = dataclasses.replace(
        config,
        out=config.out.with_name("again.exr"),
        seed=1000,
        reference_spp=0,
        reference_from=config.out,
    )
    frame = render.run(again)
    reference = exr.read_frame(config.out).reference
    np.testing.assert_array_equal(frame.reference.image, reference.image)
    about = exr.read_provenance(again.out)
    assert (about["reference_from"], about["reference_spp"]) == ("frame.exr", 64)
    with pytest.raises(ValueError, match=r"reference in .* is \(24, 24, 3\), the film"):
        render.render(dataclasses.replace(again, size=16))
    exr.write_frame(again.out, frame._replace(reference=None))
    with pytest.raises(ValueError, match=r"again\.exr holds no reference"):
        render.render(dataclasses.replace(again, reference_from=again.out))


def test_every_pass_has_a_stream_of_its_own(config):
    seeds = [p.seed for p in render.passes(config)]
    assert len(set(seeds)) == len(seeds)


def test_welford_is_exact_where_sums_of_squares_are_not():
    """At mean 1e4 and deviation 0.1, m2 - m^2 in float32 has no digit left."""
    samples = 1e4 + 0.1 * np.random.default_rng(0).standard_normal((50, 1, 1, 1))
    moments = render.Moments(0, np.zeros((1, 1, 1)), np.zeros((1, 1, 1)))
    for sample in samples:
        moments = moments.add(sample)
    np.testing.assert_allclose(moments.mean, samples.mean(0), rtol=1e-14)
    expected = samples.var(0, ddof=1) / 50
    np.testing.assert_allclose(moments.variance_of_mean, expected, rtol=1e-8)


@pytest.mark.parametrize("name", scenes.SCENES)
def test_own_scenes_render(name, mitsuba):
    scene = scenes.load(name, width=8, height=6)
    image = np.asarray(mitsuba.render(scene, spp=4))
    assert image.shape == (6, 8, 3)
    assert np.isfinite(image).all()
    assert image.mean() > 0.01
    assert "BoxFilter" in str(scene.sensors()[0].film().rfilter())


XML = """
<scene version="3.0.0">
  <default name="resx" value="10"/>
  <integrator type="direct"/>
  <sensor type="perspective">
    <film type="hdrfilm">
      <integer name="width" value="$resx"/><integer name="height" value="7"/>
      <rfilter type="gaussian"/>
    </film>
    <sampler type="multijitter"/>
  </sensor>
  <shape type="ply"><string name="filename" value="quad.ply"/></shape>
  <emitter type="constant"/>
</scene>
"""
PLY = """ply
format ascii 1.0
element vertex 3
property float x
property float y
property float z
element face 1
property list uchar int vertex_index
end_header
-9 -9 5
9 -9 5
0 9 5
3 0 1 2
"""


def test_a_scene_file_is_made_standard(tmp_path, mitsuba):
    (tmp_path / "scene.xml").write_text(XML)
    (tmp_path / "quad.ply").write_text(PLY)
    scene = scenes.load(str(tmp_path / "scene.xml"), width=0, height=0)
    sensor = scene.sensors()[0]
    assert list(sensor.film().size()) == [10, 7]
    assert "BoxFilter" in str(sensor.film().rfilter())
    assert "Independent" in str(sensor.sampler())
    assert "Path" in str(scene.integrator())
    small = scenes.load(str(tmp_path / "scene.xml"), width=4, height=3)
    assert list(small.sensors()[0].film().size()) == [4, 3]
    assert np.isfinite(np.asarray(mitsuba.render(small, spp=2))).all()


def test_scenes_keep_their_own_meshes(tmp_path, mitsuba):
    """Two folders with a mesh of one name: the second scene's is not the first's."""
    for name, ply in (("one", PLY), ("two", PLY.replace("9", "0.01"))):
        (tmp_path / name).mkdir()
        (tmp_path / name / "scene.xml").write_text(XML)
        (tmp_path / name / "quad.ply").write_text(ply)
        scene = scenes.load(str(tmp_path / name / "scene.xml"), width=0, height=0)
        wide = scene.bbox().max.x
        assert wide == pytest.approx(9 if name == "one" else 0.01)


def test_bad_configurations(tmp_path):
    out = tmp_path / "x.exr"
    with pytest.raises(ValueError, match="buffers must be 1 or even, got 3"):
        render.Config("cornell-box", out, buffers=3)
    with pytest.raises(ValueError, match="spp must be a multiple of buffers = 4"):
        render.Config("cornell-box", out, buffers=4, spp=6)
    with pytest.raises(ValueError, match="reference_spp must be a multiple"):
        render.Config("cornell-box", out, reference_spp=10)
    with pytest.raises(ValueError, match="feature_spp must be positive"):
        render.Config("cornell-box", out, feature_spp=0)
    with pytest.raises(ValueError, match="must not be negative"):
        render.Config("cornell-box", out, size=-8)
    with pytest.raises(ValueError, match="a reference wants independent"):
        render.Config("cornell-box", out, reference_spp=32, numbers="common")
    with pytest.raises(ValueError, match="neither a file nor one of the scenes"):
        scenes.load("cornel-box", width=0, height=0)
    (tmp_path / "x.xml").write_text("<scene version='3.0.0'/>")
    with pytest.raises(ValueError, match="has no sensor"):
        scenes.load(str(tmp_path / "x.xml"), width=0, height=0)
    (tmp_path / "y.xml").write_text("<scene")
    with pytest.raises(ValueError, match=r"y\.xml: not XML"):
        scenes.load(str(tmp_path / "y.xml"), width=0, height=0)


def test_a_progressive_rendering_knows_its_error(tmp_path):
    """Stages of doubling samples; errors fall; it stops where it was asked to."""
    config = progressive.Config(
        "cornell-box", tmp_path, size=24, spp=32, first=8, reference_spp=256
    )
    found = progressive.run(config)
    assert list(found) == [8, 16, 32]
    for samples, row in found.items():
        assert (tmp_path / f"{samples:05d}.png").stat().st_size > 10_000
        for true, estimated in row.values():
            assert np.isfinite([true, estimated]).all()
        true, estimated = row["samples"]
        assert 0.3 * true < estimated < 3 * true
    assert found[32]["samples"][0] < found[8]["samples"][0]
    assert (tmp_path / "errors.png").exists()
    sooner = dataclasses.replace(config, target=1e9)
    assert list(progressive.run(sooner)) == [32]  # all that was there already
    with pytest.raises(ValueError, match="first must be from 2 to spp = 32: 1"):
        dataclasses.replace(config, first=1)
