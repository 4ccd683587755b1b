"""Random scenes and the frames to train on that are rendered of them."""

import dataclasses

import numpy as np
import pytest

from experiments import dataset, render, scenes, train
from jscomb import exr
from jscomb.denoisers import oidn


def rendered(mi, seed):
    """A small picture of a random scene."""
    scene = scenes.load(f"random-{seed}", width=24, height=16)
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
    frames = list(dataset.renders(config, 7))
    again = list(dataset.renders(config, 7))
    assert frames == again
    counts = [frame.spp for frame in frames]
    assert counts == sorted(counts, reverse=True)
    assert set(counts) <= set(dataset.COUNTS)
    assert len(set(counts)) == 3
    assert [frame.reference_spp for frame in frames] == [1024, 0, 0]
    assert [frame.reference_from for frame in frames[1:]] == [frames[0].out] * 2
    # No stream is used twice: the inputs are independent of the reference.
    streams = [p.seed for frame in frames for p in render.passes(frame)]
    assert len(streams) == len(set(streams))


def test_bad_configurations(tmp_path):
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
