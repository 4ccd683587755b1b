"""Scenes drawn at random, synthetic frames, crops and training frames of `data`."""

import dataclasses

import jax
import numpy as np
import pytest

from experiments.data import bundle, dataset, development, synthetic, variations
from jscomb import exr, rendering
from jscomb.denoisers import oidn
from tests.statistics import assert_mean

TRIALS = 20_000


def test_a_crop_is_of_every_image(glass_frame):
    crop = bundle.crop(glass_frame, 0, 0)
    np.testing.assert_array_equal(crop.color, glass_frame.color)
    cut = bundle.crop(glass_frame, 10, 20)
    np.testing.assert_array_equal(cut.depth, glass_frame.depth[10:, 20:])
    assert cut.samples == glass_frame.samples


@pytest.mark.parametrize(
    ("samples", "correlation", "skewness"),
    [(1, 0.0, 2.0), (4, 0.9, 3.0), (2, 0.5, 0.0)],
)
def test_moments(samples, correlation, skewness):
    scene = synthetic.make_scene(8)
    draw = lambda key: synthetic.draw(
        key, scene, samples, correlation=correlation, skewness=skewness
    )
    keys = jax.random.split(jax.random.key(0), TRIALS)
    noise = np.asarray(jax.jit(jax.vmap(draw))(keys)) - np.asarray(scene.truth)
    unit = noise / np.sqrt(np.asarray(scene.variance) / samples)
    region = np.asarray(scene.region)
    pixels = [np.argwhere(region == k)[0] for k in (0, 1, 2)]
    pixels.append(np.argwhere(region == 0)[5])
    unit = [unit[:, *pixel, 1] for pixel in pixels]
    for one in unit:
        assert_mean(one, 0.0)
        assert_mean(one**2, 1.0)
        assert_mean(one**3, skewness / samples**0.5)
    assert_mean(unit[0] * unit[3], correlation)
    assert_mean(unit[0] * unit[1], 0.0)


def test_what_a_scene_has():
    scene = synthetic.make_scene(32)
    assert scene.truth.shape == scene.variance.shape == (32, 32, 3)
    assert set(np.unique(scene.region)) == set(range(synthetic.REGIONS))
    assert np.all(scene.truth > 0)


def test_too_skewed():
    with pytest.raises(ValueError, match=r"skewness must be at most 2\.83 for 1 samp"):
        synthetic.draw(jax.random.key(0), synthetic.make_scene(8), 1, skewness=3.0)


def rendered(mi, seed):
    """A small picture of a random scene."""
    scene = rendering.load_scene(f"random-{seed}", width=24, height=16)
    return np.asarray(mi.render(scene, spp=4, seed=0))


def test_a_seed_is_a_scene(vectorised):
    first, again, other = (rendered(vectorised, seed) for seed in (3, 3, 4))
    np.testing.assert_array_equal(first, again)
    assert first.shape == (16, 24, 3)
    assert np.abs(first - other).max() > 0.1


@pytest.mark.slow
def test_scenes_are_lit_and_differ(vectorised):
    """Ten seeds: light everywhere but where the camera sees past the walls."""
    pictures = [rendered(vectorised, seed) for seed in range(10)]
    assert all(np.isfinite(p).all() for p in pictures)
    lit = [float((p.max(-1) > 0).mean()) for p in pictures]
    assert min(lit) > 0.3
    assert np.median(lit) > 0.95
    means = np.array([p.mean() for p in pictures])
    assert 1e-2 < means.min() < means.max() < 1e2
    assert len(set(means)) == 10


def test_splits_share_no_scene(tmp_path):
    config = dataset.Config(tmp_path, scenes=tmp_path)
    every = dataset.views(config)
    assert len(set(every)) == len(every)
    assert len({view.name for view in every}) == len(every)
    owners: dict[str, set[str]] = {}
    for view in every:
        scene = view.name if view.scene == "random" else view.scene
        owners.setdefault(scene, set()).add(view.split)
    assert all(len(splits) == 1 for splits in owners.values())
    numbers = {view.name: dataset.counts(view) for view in every}
    assert sum(map(len, numbers.values())) >= 600
    assert {n for each in numbers.values() for n in each} >= {4, 64, 1024, 4096}
    assert dataset.counts(every[0]) == dataset.counts(every[0])


def test_bad_configurations_of_a_dataset(tmp_path):
    with pytest.raises(ValueError, match="no split training; there are train, val"):
        dataset.Config(tmp_path, scenes=tmp_path, splits=("training",))
    with pytest.raises(ValueError, match="no frames there"):
        list(dataset.frames(tmp_path, "train"))


@pytest.mark.slow
@pytest.mark.skipif(not oidn.available(), reason="needs Open Image Denoise")
def test_a_dataset_is_made_once(tmp_path, vectorised, capsys):
    config = dataset.Config(tmp_path, scenes=tmp_path, splits=("train",), quick=True)
    files = dataset.run(config)
    assert "7 frames made" in capsys.readouterr().out
    frames = [exr.read_frame(file) for file in files]
    for frame in frames:
        np.testing.assert_array_equal(frame.reference.image, frames[0].reference.image)
        assert frame.reference.half_difference is not None
        assert frame.sub_buffers == 4
        for name in ("oidn", "photons"):
            assert frame.estimates[name].halves.shape == (2, 16, 16, 3)
        assert frame.visibility is not None
    assert np.abs(frames[0].color - frames[1].color).max() > 0
    times = [file.stat().st_mtime_ns for file in files]
    files[1].unlink()
    assert dataset.run(config) == files
    assert "1 frames made" in capsys.readouterr().out
    assert files[0].stat().st_mtime_ns == times[0]
    found = list(dataset.frames(tmp_path, "train"))
    assert {path for *_, path in found} == set(files)
    missing = dataclasses.replace(config, quick=False, splits=("test",))
    with pytest.raises(ValueError, match=r"living-room/scene\.xml: no such file"):
        dataset.run(missing)


ROOM = """<scene version="3.0.0">
<sensor type="perspective"><float name="fov" value="50"/>
<transform name="to_world"><lookat origin="0, 0, 3.5" target="0, 0, 0" up="0, 1, 0"/>
</transform><film type="hdrfilm"/></sensor>
<bsdf type="twosided" id="Red"><bsdf type="diffuse">
<rgb name="reflectance" value="0.8 0.1 0.1"/></bsdf></bsdf>
<bsdf type="twosided" id="Metal"><bsdf type="roughconductor">
<float name="alpha" value="0.2"/></bsdf></bsdf>
<shape type="cube"><boolean name="flip_normals" value="true"/>
<transform name="to_world"><scale value="4"/></transform><ref id="Red"/></shape>
<shape type="cube"><ref id="Metal"/></shape>
<shape type="sphere"><point name="center" x="2" y="2" z="2"/>
<float name="radius" value="0.5"/>
<emitter type="area"><rgb name="radiance" value="9 9 9"/></emitter></shape>
</scene>"""


@pytest.mark.slow
def test_variations_of_a_scene(vectorised, tmp_path):
    """A seed is one variation; cameras, lights and materials differ; all see light."""
    original = tmp_path / "scene.xml"
    original.write_text(ROOM)
    texts = []
    for seed in (0, 0, 1):
        out = tmp_path / "out.xml"
        assert variations.write_variation(original, seed, out)
        texts.append(out.read_text())
        scene = rendering.load_scene(str(out), width=24, height=24)
        image = np.asarray(vectorised.render(scene, spp=16))
        assert np.median(image) > 0
    assert texts[0] == texts[1] != texts[2]
    for changing in ("lookat", "radiance"):
        first, second = (
            [line for line in text.split("<") if changing in line] for text in texts[1:]
        )
        assert first != second
    dark = ROOM.replace('value="9 9 9"', 'value="0 0 0"')
    original.write_text(dark)
    assert not variations.write_variation(original, 0, tmp_path / "dark.xml")
    assert not (tmp_path / "dark.xml").exists()
    assert not list(tmp_path.glob("*.tmp.xml"))


@pytest.mark.slow
@pytest.mark.skipif(not rendering.available(), reason="needs Mitsuba")
def test_development_frames_are_rendered_once(tmp_path, monkeypatch):
    config = development.Config(tmp_path / "out", scenes=tmp_path, quick=True)
    (path,) = development.run(config)
    before = path.stat().st_mtime_ns
    assert development.run(config) == [path]
    assert path.stat().st_mtime_ns == before
    assert list(development.frames(config.out)) == [("cornell-glossy", 16, path)]
    frame = exr.read_frame(path)
    assert (frame.sub_buffers, float(frame.samples)) == (4, 16)
    r, noise = frame.normalised().reference
    weight = np.square(r) + 0.01
    expected = np.mean(np.square(noise) / 4 / weight)
    assert development.noise(path) == pytest.approx(float(expected), rel=1e-4)
    missing = dataclasses.replace(config, quick=False)
    with pytest.raises(ValueError, match=r"veach-mis/scene\.xml: no such file"):
        development.run(missing)
    with pytest.raises(ValueError, match="no frames there"):
        list(development.frames(tmp_path))
