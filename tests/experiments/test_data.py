"""Scenes drawn at random, synthetic frames, crops and training frames of `data`."""

import dataclasses

import jax
import numpy as np
import pytest

from experiments.data import bundle, dataset, development, synthetic
from experiments.training import train
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


def test_renders_share_one_reference(tmp_path):
    config = dataset.Config(tmp_path, scenes=1, counts=3)
    jobs = list(dataset.jobs(config, 7))
    assert list(dataset.jobs(config, 7)) == jobs
    counts = [job.settings.spp for job in jobs]
    assert counts == sorted(counts, reverse=True)
    assert set(counts) <= set(dataset.COUNTS)
    assert len(set(counts)) == 3
    assert [job.settings.reference_spp for job in jobs] == [1024, 0, 0]
    assert [job.reference_from for job in jobs] == [None, *[jobs[0].out] * 2]
    # No stream is used twice: the inputs are independent of the reference.
    streams = [p.seed for job in jobs for p in rendering.plan_passes(job.settings)]
    assert len(streams) == len(set(streams))


def test_bad_configurations_of_a_dataset(tmp_path):
    for wrong in ({"counts": 8}, {"scenes": 0}, {"reference_spp": 512}):
        with pytest.raises(ValueError, match=r"counts must be|dataset wants"):
            dataset.Config(tmp_path, **wrong)


@pytest.mark.slow
@pytest.mark.skipif(not oidn.available(), reason="needs Open Image Denoise")
def test_a_dataset_is_made_once(tmp_path, vectorised, capsys):
    config = dataset.Config(tmp_path, scenes=1, size=16, seed=2)
    files = dataset.run(config)
    assert "2 frames, 0 MB; 2 made" in capsys.readouterr().out
    frames = [exr.read_frame(file) for file in files]
    a, b = (frame.reference for frame in frames)
    np.testing.assert_array_equal(a.image, b.image)
    assert a.half_difference is not None
    for frame in frames:
        assert frame.sub_buffers == 2
        assert frame.estimates["oidn"].halves.shape == (2, 16, 16, 3)
        assert frame.buffers.variance is not None
        assert frame.visibility is not None
    times = [file.stat().st_mtime_ns for file in files]
    files[1].unlink()
    assert dataset.run(config) == files
    assert "1 made" in capsys.readouterr().out
    assert files[0].stat().st_mtime_ns == times[0]
    more = dataclasses.replace(config, scenes=2)
    assert {train.scene_of(f) for f in dataset.run(more)} == {
        "random-00002",
        "random-00003",
    }


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
