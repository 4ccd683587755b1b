"""Photon mapping is right: against path tracing, and against itself."""

import dataclasses
import types

import numpy as np
import pytest

from experiments import photon_error, photon_mapping, render, scenes
from jscomb import exr
from tests.statistics import assert_mean

SIZE = 24
LAMP = 18.387, 13.9873, 6.75357  # radiance in Mitsuba's Cornell box


@pytest.fixture
def config(tmp_path, vectorised):
    """A small Cornell box, radii far below what its walls would notice."""
    return photon_mapping.Config(
        "cornell-box",
        tmp_path / "f.exr",
        size=SIZE,
        spp=4,
        passes=4,
        photons=20_000,
        radius=0.05,
        denoise=False,
    )


def test_radii_shrink_in_pairs():
    radii = [photon_mapping.radius_of(2.0, k) for k in range(6)]
    assert radii[0] == radii[1] == 2
    np.testing.assert_allclose(radii[2], 2 * ((1 + 2 / 3) / 2) ** 0.5)
    np.testing.assert_allclose(radii[4] / radii[2], ((2 + 2 / 3) / 3) ** 0.5)
    assert radii[4] == radii[5]


def test_agrees_with_path_tracing(config):
    """Means of regions of the walls, of each pass and of as many path-traced ones."""
    many = dataclasses.replace(config, passes=40, photons=30_000)
    launch = photon_mapping.launcher(many)
    photons = [launch(p)[..., :3] for p in photon_mapping.passes(many)]
    traced = [launch(render.Pass("", 16, k, "path")) for k in range(40)]
    regions = {
        "back wall": (slice(5, 11), slice(7, 17)),
        "red wall": (slice(8, 18), slice(1, 4)),
        "ceiling": (slice(1, 3), slice(3, 7)),
        "floor": (slice(21, 23), slice(2, 10)),
    }
    for rows, columns in regions.values():
        means = [np.stack(i)[:, rows, columns].mean((1, 2)) for i in (photons, traced)]
        difference = means[0] - means[1]
        for channel in range(2):
            assert_mean(difference[:, channel], 0.0)
            error = difference[:, channel].std(ddof=1) / 40**0.5
            assert error < 0.05 * means[1][:, channel].mean()  # and it would be seen


def test_light_of_lamps_is_seen_directly(config):
    """The brightest pixel lies within the lamp; what it reflects besides is little."""
    image = photon_mapping.launcher(config)(photon_mapping.passes(config)[0])
    np.testing.assert_allclose(image[..., :3].max(axis=(0, 1)), LAMP, rtol=0.05)


def test_neither_buckets_nor_room_matter(config, monkeypatch):
    """All photons in one bucket, or a store that is too small at first: the same."""
    launch = photon_mapping.launcher(config)
    first, second = photon_mapping.passes(config)[:2]
    image = launch(first)
    np.testing.assert_array_equal(launch(first), image)
    assert not np.array_equal(launch(second), image)
    small = dataclasses.replace(config, photons=2000)
    launch = photon_mapping.launcher(small)
    expected = launch(first)
    monkeypatch.setattr(photon_mapping, "_hash", lambda x, y, z: 0 * x)
    np.testing.assert_allclose(launch(first), expected, rtol=1e-4, atol=1e-5)
    monkeypatch.undo()
    monkeypatch.setattr(photon_mapping, "ROOM", 0.01)
    launch = photon_mapping.launcher(small)
    np.testing.assert_allclose(launch(first), expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("radius", [0.02, 0.05, 0.1, 1 / 3])
def test_walls_where_cells_meet(config, radius):
    """At these radii walls, 1 from the middle, are borders of cells: no light lost."""
    first = photon_mapping.passes(config)[0]
    images = [
        photon_mapping.launcher(dataclasses.replace(config, radius=r))(first)
        for r in (radius, 1.001 * radius)
    ]
    means = [image[..., :3].mean(axis=(0, 1)) for image in images]
    np.testing.assert_allclose(*means, rtol=5e-3)


def test_weighted_by_squared_radius(config):
    launch = photon_mapping.launcher(config)
    *_, last = photon_mapping.passes(config)
    image = launch(last)
    share = (photon_mapping.radius_of(1.0, 3)) ** 2
    np.testing.assert_allclose(image[..., 3:], share * image[..., :3], rtol=1e-6)


def test_a_frame_with_photons(config):
    frame = photon_mapping.run(config)
    read = exr.read_frame(config.out)
    photons = read.estimates[photon_mapping.PHOTONS]
    np.testing.assert_allclose(
        photons.image, np.mean(photons.halves, axis=0), rtol=1e-5
    )
    assert photons.halves.shape == (2, SIZE, SIZE, 3)
    assert not np.array_equal(*photons.halves)
    np.testing.assert_array_equal(photons.image, frame.estimates["photons"].image)
    assert read.samples == 4
    told = exr.read_provenance(config.out)
    assert (told["photons"], told["passes"], told["radius"]) == (20_000, 4, 0.05)
    assert not list(config.out.parent.glob("*.partial*"))


def test_means_are_compared_with_path_tracing(vectorised):
    """Against known differences, and for a moment with a real scene."""
    rng = np.random.default_rng(0)
    traced, photons = 1 + 0.1 * rng.standard_normal((2, 200, 4, 4))
    same = photon_error.compare(photons, traced)
    assert abs(same["frame"]) < 5 * same["its error"]
    assert 0.3 < same["blocks, mean square"] < 3
    np.testing.assert_allclose(same["its error"], 0.1 * (2 / 3200) ** 0.5, rtol=0.2)
    off = photon_error.compare(1.1 * photons, traced)
    assert abs(off["frame"] - 0.1) < 5 * off["its error"]
    assert off["blocks, mean square"] > 50
    rows = photon_error.run(photon_error.Config(("cornell-box",), quick=True))
    (row,) = rows.values()
    assert abs(row["frame"]) < 0.2


def test_bad_configurations(config, monkeypatch):
    for change, message in (
        ({"passes": 3}, "passes must be even and positive, got 3"),
        ({"photons": 0}, "photons must be positive"),
        ({"radius": -1.0}, "radius at least 0"),
        ({"numbers": "common"}, "independent random numbers"),
    ):
        with pytest.raises(ValueError, match=message):
            dataclasses.replace(config, **change)
    scalar = types.SimpleNamespace(variant=lambda: "scalar_rgb")
    monkeypatch.setattr(scenes, "mitsuba", lambda: scalar)
    with pytest.raises(ValueError, match=r"needs a vectorised.*install LLVM 16"):
        photon_mapping.launcher(config)
