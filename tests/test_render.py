"""Rendering with Mitsuba 3: statistics that are what they say, and resuming."""

import dataclasses
import types

import jax.numpy as jnp
import numpy as np
import pytest

from jscomb import exr, rendering
from jscomb.cli import _rendering, render_file
from jscomb.denoisers import oidn
from jscomb.frame import Needs, Package
from jscomb.rendering import Settings, _partial, _scenes
from tests.statistics import assert_mean, assert_mean_below

SCENE = "cornell-box"
SETTINGS = Settings(spp=16, size=24, feature_spp=2, reference_spp=64)
SMALL = Settings(spp=4, size=8, feature_spp=1)


@pytest.fixture(scope="module", autouse=True)
def mitsuba():
    """The variant that runs everywhere, whatever LLVM this machine has."""
    import mitsuba as mi

    before = mi.variant()
    mi.set_variant("scalar_rgb")
    yield rendering.mitsuba()
    if before is not None:
        mi.set_variant(before)


@pytest.fixture(scope="module")
def rendered(mitsuba, tmp_path_factory):
    """A frame's file."""
    out = tmp_path_factory.mktemp("rendered") / "frame.exr"
    render_file(SCENE, out, SETTINGS, denoise=False)
    return out


def test_a_frame_with_honest_statistics(rendered):
    frame = exr.read_frame(rendered)
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
    about = exr.read_provenance(rendered)
    assert (about["scene"], about["reference_spp"]) == (SCENE, 64)
    assert about["variant"] == "scalar_rgb"
    assert [p.name for p in rendered.parent.iterdir()] == ["frame.exr"]


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
    settings = Settings(spp=16, size=40, feature_spp=1)
    frame = rendering.render(str(tmp_path / "lamp.xml"), settings)
    a, b = frame.halves()
    difference = np.asarray(a.color - b.color)[..., 1]
    variance = np.asarray(a.variance + b.variance)[..., 1]
    assert variance.min() > 0
    assert_mean(difference, 0.0)
    assert_mean(difference**2 - variance, 0.0)
    assert_mean_below(difference**2 - 2 * variance, 0.0)
    assert_mean_below(variance / 2 - difference**2, 0.0)
    np.testing.assert_allclose(frame.variance[..., 1], variance / 4, rtol=1e-5)


def test_one_sample_a_sub_buffer(mitsuba):
    """Has no variance by itself; the frame's is from the spread of the sub-buffers."""
    frame = rendering.render(SCENE, Settings(spp=4, size=8, buffers=4, feature_spp=1))
    assert frame.sub_buffers == 4
    assert frame.buffers.variance is None
    spread = np.var(frame.buffers.color, axis=0, ddof=1) / 4
    np.testing.assert_allclose(frame.variance, spread, rtol=1e-5)


def test_resumes_where_it_was_stopped(tmp_path, monkeypatch):
    monkeypatch.setattr(_partial, "SAVE_EVERY", 0.0)
    partial = tmp_path / "frame.partial.npz"
    load, launched = rendering.Launcher(SCENE, SETTINGS), []

    def steps(*, stop_after=1000, settings=SETTINGS, partial=partial):
        def launch(one):
            if len(launched) == stop_after:
                raise KeyboardInterrupt
            launched.append(one)
            return load(one)

        return list(
            rendering.render_steps(SCENE, settings, launch=launch, partial=partial)
        )

    _, whole = steps(partial=None)[-1]
    every = rendering.plan_passes(SETTINGS)
    assert launched == every
    launched.clear()
    with pytest.raises(KeyboardInterrupt):
        steps(stop_after=9)
    (done, _), *_, (last, again) = steps()
    assert (done, last) == (9, len(every))
    assert launched == every  # each pass once
    for name, moments in whole.items():
        np.testing.assert_array_equal(moments.mean, again[name].mean)
        np.testing.assert_array_equal(moments.squares, again[name].squares)
    with pytest.raises(ValueError, match="is of another scene or other settings"):
        steps(settings=dataclasses.replace(SETTINGS, spp=18))
    partial.write_text("rubbish")
    with pytest.raises(ValueError, match="not a partial render"):
        steps()


def test_a_reference_is_borrowed_or_refused_before_the_first_pass(rendered, tmp_path):
    again = tmp_path / "again.exr"
    settings = dataclasses.replace(SMALL, size=24, seed=1000)
    borrow = lambda settings, path: render_file(
        SCENE, again, settings, reference_from=path, denoise=False
    )
    frame = borrow(settings, rendered)
    reference = exr.read_frame(rendered).reference
    for read in (frame.reference, exr.read_frame(again).reference):
        np.testing.assert_array_equal(read.image, reference.image)
        np.testing.assert_array_equal(read.half_difference, reference.half_difference)
    about = exr.read_provenance(again)
    assert (about["reference_from"], about["reference_spp"]) == ("frame.exr", 64)
    with pytest.raises(ValueError, match=r"reference is \(24, 24, 3\), the film"):
        borrow(SMALL, rendered)
    with pytest.raises(ValueError, match="give reference_spp or another frame's"):
        borrow(SETTINGS, rendered)
    exr.write_frame(again, frame._replace(reference=None))
    with pytest.raises(ValueError, match=r"again\.exr holds no reference"):
        borrow(settings, again)


def test_every_pass_has_a_stream_of_its_own():
    seeds = [p.seed for p in rendering.plan_passes(SETTINGS)]
    assert len(set(seeds)) == len(seeds)


def test_welford_is_exact_where_sums_of_squares_are_not():
    """At mean 1e4 and deviation 0.1, m2 - m^2 in float32 has no digit left."""
    samples = 1e4 + 0.1 * np.random.default_rng(0).standard_normal((50, 1, 1, 1))
    moments = rendering.Moments()
    for sample in samples:
        moments = moments.add(sample)
    np.testing.assert_allclose(moments.mean, samples.mean(0), rtol=1e-14)
    expected = samples.var(0, ddof=1) / 50
    np.testing.assert_allclose(moments.variance_of_mean, expected, rtol=1e-8)


@pytest.mark.parametrize("name", rendering.SCENES)
def test_own_scenes_render(name, mitsuba):
    scene = rendering.load_scene(name, width=8, height=6)
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
    scene = rendering.load_scene(str(tmp_path / "scene.xml"))
    sensor = scene.sensors()[0]
    assert list(sensor.film().size()) == [10, 7]
    assert "BoxFilter" in str(sensor.film().rfilter())
    assert "Independent" in str(sensor.sampler())
    assert "Path" in str(scene.integrator())
    small = rendering.load_scene(str(tmp_path / "scene.xml"), width=4, height=3)
    assert list(small.sensors()[0].film().size()) == [4, 3]
    assert np.isfinite(np.asarray(mitsuba.render(small, spp=2))).all()


def test_scenes_keep_their_own_meshes(tmp_path, mitsuba):
    """Two folders with a mesh of one name: the second scene's is not the first's."""
    for name, ply in (("one", PLY), ("two", PLY.replace("9", "0.01"))):
        (tmp_path / name).mkdir()
        (tmp_path / name / "scene.xml").write_text(XML)
        (tmp_path / name / "quad.ply").write_text(ply)
        scene = rendering.load_scene(str(tmp_path / name / "scene.xml"))
        wide = scene.bbox().max.x
        assert wide == pytest.approx(9 if name == "one" else 0.01)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"buffers": 3}, "buffers must be 1 or even, got 3"),
        ({"buffers": 4, "spp": 6}, "spp must be a multiple of buffers = 4"),
        ({"reference_spp": 10}, "reference_spp must be a multiple"),
        ({"feature_spp": 0}, "feature_spp must be positive"),
        ({"size": -8}, "must not be negative"),
        ({"reference_spp": 32, "numbers": "common"}, "a reference needs independent"),
        ({"photons": 9, "passes": 3}, "passes must be even and positive, got 3"),
        ({"photons": -1}, "photons and radius must not be negative, got -1"),
        ({"photons": 9, "radius": -1.0}, "photons and radius must not be negative"),
        ({"photons": 9, "numbers": "common"}, "photon mapping needs independent"),
        ({"radius": 0.1}, "of photon mapping: give photons"),
        ({"passes": 8}, "of photon mapping: give photons"),
    ],
)
def test_bad_settings(change, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(SMALL, **change)


def test_bad_scenes(tmp_path):
    with pytest.raises(ValueError, match="neither a file nor one of the scenes"):
        rendering.load_scene("cornel-box")
    (tmp_path / "x.xml").write_text("<scene version='3.0.0'/>")
    with pytest.raises(ValueError, match="has no sensor"):
        rendering.load_scene(str(tmp_path / "x.xml"))
    (tmp_path / "y.xml").write_text("<scene")
    with pytest.raises(ValueError, match=r"y\.xml: not XML"):
        rendering.load_scene(str(tmp_path / "y.xml"))


OPTIONS = "--spp", "4", "--size", "8", "--feature-spp", "1"


def test_the_command_resumes_and_writes_what_the_library_renders(
    jscomb, tmp_path, monkeypatch
):
    monkeypatch.setattr(_partial, "SAVE_EVERY", 0.0)
    out = tmp_path / "frame.exr"
    partial = tmp_path / "frame.exr.partial.npz"
    settings = dataclasses.replace(SMALL, reference_spp=32)
    for done, _ in rendering.render_steps(SCENE, settings, partial=partial):
        if done == 3:
            break
    launched, call = [], rendering.Launcher.__call__
    monkeypatch.setattr(
        rendering.Launcher,
        "__call__",
        lambda self, one: launched.append(one) or call(self, one),
    )
    status, said, _ = jscomb(
        "render", SCENE, "-o", out, *OPTIONS, "--reference-spp", "32"
    )
    assert status == 0
    assert launched == rendering.plan_passes(settings)[3:]
    assert "8x8, 4 samples a pixel in 2 sub-buffers" in said
    assert list(tmp_path.iterdir()) == [out]
    frame = exr.read_frame(out)
    expected = rendering.render(SCENE, settings)
    for name, buffer in expected.buffers._asdict().items():
        np.testing.assert_array_equal(getattr(frame.buffers, name), buffer)
    np.testing.assert_array_equal(frame.reference.image, expected.reference.image)
    about = exr.read_provenance(out)
    assert (about["spp"], about["reference_spp"], about["numbers"]) == (
        4,
        32,
        "independent",
    )
    assert "photons" not in about


@pytest.mark.skipif(not oidn.available(), reason="needs Open Image Denoise")
def test_the_command_denoises(jscomb, tmp_path, monkeypatch):
    out = tmp_path / "frame.exr"
    status, said, _ = jscomb("render", SCENE, "--out", out, *OPTIONS)
    assert (status, ", oidn" in said) == (0, True)
    assert exr.read_frame(out).estimates["oidn"].halves.shape == (2, 8, 8, 3)
    again = ("render", SCENE, "--out", out, *OPTIONS)
    status, _, error = jscomb(*again)
    assert (status, error) == (2, f"jscomb: {out} exists: --force replaces it\n")
    again = (*again, "--force")
    status, said, _ = jscomb(*again, "--no-denoise")
    assert (status, ", oidn" in said) == (0, False)
    assert not exr.read_frame(out).estimates
    nowhere = Needs(package=Package("nowhere", "oidn"))
    for module in (oidn, oidn._denoise):
        monkeypatch.setattr(module, "NEEDS", nowhere)
    status, said, _ = jscomb(*again)
    assert status == 0
    assert (
        'oidn: skipped: needs the package nowhere: pip install "jscomb[oidn]"' in said
    )
    assert not exr.read_frame(out).estimates


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["cornel-box"], "neither a file nor one of the scenes cornell-box"),
        ([SCENE, "--spp", "5"], "spp must be a multiple of buffers = 2"),
        ([SCENE, "--photons", "9"], "photon mapping needs a vectorised variant"),
        ([SCENE, "--numbers", "common"], "common random numbers need a vectorised"),
        ([SCENE, "--numbers", "mine"], "independent"),
        ([SCENE, "--size", "wide"], "--size"),
        ([SCENE, "--sise", "8"], "--sise"),
        ([SCENE, "--reference-from", "nothing.exr"], "nothing.exr"),
        ([SCENE, "-o", "nowhere/frame.exr"], "in a folder that does not exist"),
        ([SCENE, "-o", "."], "is a folder"),
        ([], "SCENE"),
    ],
    ids=lambda argument: " ".join(argument) if isinstance(argument, list) else "",
)
def test_bad_input_of_the_command(jscomb, tmp_path, monkeypatch, arguments, message):
    monkeypatch.chdir(tmp_path)
    out = [] if "-o" in arguments else ["-o", "frame.exr"]
    status, said, error = jscomb("render", *arguments, *out)
    assert (status, said) == (2, "")
    assert error.startswith("jscomb: ")
    assert message in error
    assert error.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_without_mitsuba(jscomb, tmp_path, monkeypatch):
    nowhere = Needs(package=Package("nowhere", "render"))
    monkeypatch.setattr(_scenes, "NEEDS", nowhere)
    assert not rendering.available()
    status, _, error = jscomb("render", SCENE, "-o", tmp_path / "frame.exr")
    assert status == 2
    line = 'jscomb: rendering needs the package nowhere: pip install "jscomb[render]"'
    assert error == f"{line}\n"


def test_the_command_says_what_makes_it_faster(
    jscomb, tmp_path, monkeypatch, glass_frame
):
    """Where there is no LLVM."""
    slow = types.SimpleNamespace(variant=lambda: "scalar_rgb")
    monkeypatch.setattr(rendering, "mitsuba", lambda: slow)
    monkeypatch.setattr(_rendering, "render_file", lambda *_, **__: glass_frame)
    status, said, _ = jscomb("render", SCENE, "-o", tmp_path / "frame.exr")
    assert status == 0
    (line,) = [line for line in said.splitlines() if "LLVM" in line]
    assert "apt install libllvm19" in line
