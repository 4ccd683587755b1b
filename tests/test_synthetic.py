"""Synthetic frames have the moments that they claim."""

import jax
import numpy as np
import pytest

from experiments import synthetic
from tests.statistics import assert_mean

TRIALS = 20_000


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
