"""Common random numbers: right in every pixel, alike in neighbours."""

import types

import numpy as np
import pytest

from jscomb.rendering import Launcher, Pass, Settings
from jscomb.rendering import _streams as streams
from tests.statistics import assert_mean

PASSES, SIZE = 64, 64


@pytest.fixture(scope="module")
def samples(vectorised):
    """Single samples of the Cornell box's green channel, [passes,H,W] by kind."""

    def rendered(**options):
        launch = Launcher("cornell-box", Settings(size=SIZE, **options))
        each = (Pass("color0", 1, seed, "path") for seed in range(PASSES))
        return np.stack([launch(one)[..., 1] for one in each])

    return {
        "independent": rendered(),
        "common": rendered(numbers="common"),
        "tiles": rendered(numbers="common", tile=32),
    }


def likeness(samples, axis):
    """Median over neighbours of Var[difference] / sum of variances; 1: unlike."""
    both = samples.take(range(SIZE - 1), axis), samples.take(range(1, SIZE), axis)
    parts = both[1] - both[0], both[0], both[1]
    difference, first, second = (part.var(axis=0) for part in parts)
    return np.median(difference / (first + second + 1e-9), axis=2 - axis)


@pytest.mark.parametrize("axis", [1, 2])
def test_noise_of_neighbours_is_alike(samples, axis):
    alike, unlike = (likeness(samples[k], axis) for k in ("common", "independent"))
    assert np.median(alike) < 0.3
    assert 0.8 < np.median(unlike) < 1.2
    tiles = likeness(samples["tiles"], axis)
    assert tiles[31] > 0.8  # between two tiles
    assert max(tiles[[15, 16, 47, 48]]) < 0.5


def test_every_pixel_is_right(samples):
    """Means over the frame of both kinds, a pass each, and one pixel."""
    independent, common = samples["independent"], samples["common"]
    assert_mean(common.mean(axis=(1, 2)) - independent.mean(axis=(1, 2)), 0.0)
    assert_mean(common[:, 48, 32] - independent[:, 48, 32], 0.0)
    assert common.mean(axis=(1, 2)).std() > 2 * independent.mean(axis=(1, 2)).std()


def test_passes_differ(samples):
    common = samples["common"]
    assert not np.array_equal(common[0], common[1])


def test_samples_of_one_pass_differ(samples):
    """Four samples in one launch are as good as four launches of one."""
    launch = Launcher("cornell-box", Settings(size=8, numbers="common"))
    four = np.stack([launch(Pass("c", 4, k, "path")) for k in range(32)])
    one = np.stack([launch(Pass("c", 1, k, "path")) for k in range(32)])
    ratio = one.var(axis=0).mean() / four.var(axis=0).mean()
    assert 2 < ratio < 8
    np.testing.assert_array_equal(launch(Pass("c", 4, 3, "path")), four[3])


def test_pixel_by_pixel_variants_are_refused():
    with pytest.raises(ValueError, match=r"need a vectorised variant.*scalar_rgb"):
        streams.register(types.SimpleNamespace(variant=lambda: "scalar_rgb"))


@pytest.mark.parametrize("variant", ["vectorised", "scalar"])
def test_samples_rendered_together_are_single_samples(vectorised, variant):
    """Means and variances as of one launch a sample; no two samples are alike."""
    before = vectorised.variant()
    if variant == "scalar":
        vectorised.set_variant("scalar_rgb")
    try:
        launch = Launcher("cornell-box", Settings(spp=4, size=16))
        together = [launch(Pass("", 16, 1000 + k, "samples")) for k in range(16)]
        together = np.concatenate(together)
        alone = np.stack([launch(Pass("", 1, k, "path")) for k in range(256)])
    finally:
        vectorised.set_variant(before)
    assert together.shape == alone.shape
    means = [images.mean(axis=(1, 2, 3)) for images in (together, alone)]
    assert_mean(means[0] - means[1], 0.0)
    spread = [np.log1p(images).var(axis=0).mean() for images in (together, alone)]
    assert spread[0] == pytest.approx(spread[1], rel=0.1)
    assert len(np.unique(together.mean(axis=(1, 2, 3)))) == 256
