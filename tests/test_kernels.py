"""Means with kernels that are given or predicted."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from jscomb.numerics.kernels import Kernels, kernel_mean, predicted_mean
from jscomb.numerics.tiles import map_rows


def identity(weights, window, reach=1):
    """Kernels whose head returns its features, less the rows around the strip."""
    return Kernels(weights, lambda f: f[reach : f.shape[0] - reach], reach, window)


@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (5, 1), (16, 4), (37, 9)])
@pytest.mark.parametrize("reach", [0, 1])
def test_predicted_is_given_a_strip_at_a_time(shape, reach, rng):
    images = jnp.asarray(rng.random((2, *shape, 3)))
    weights = jnp.asarray(rng.random((*shape, 2 * 25)))
    mask = jnp.asarray(rng.random((*shape, 1)) < 0.8)

    @jax.jit
    def both(images, weights, mask):
        at_once = [
            kernel_mean(image, half, 5, mask=mask)
            for image, half in zip(images, jnp.split(weights, 2, axis=-1), strict=True)
        ]
        return predicted_mean(images, identity(weights, 5, reach), mask=mask), at_once

    for found, expected in zip(*both(images, weights, mask), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-12)


def test_predicted_differentiates_in_both_modes(rng):
    images, weights = jnp.asarray(rng.random((1, 20, 4, 2))), rng.random((20, 4, 9))
    mean = lambda i, w: predicted_mean(i, identity(w, 3))
    check_grads(jax.jit(mean), (images, jnp.asarray(weights)), order=1)


def test_masked_pixels_are_excluded(rng):
    images = jnp.asarray(rng.random((1, 20, 4, 2))).at[0, 3, 1].set(jnp.nan)
    weights, mask = (
        jnp.asarray(rng.random((20, 4, 9))),
        jnp.isfinite(images[0, ..., :1]),
    )
    total = lambda i, w: predicted_mean(i, identity(w, 3), mask=mask).sum()
    run = jax.jit(jax.value_and_grad(total, (0, 1)))
    value, gradients = run(images, weights)
    assert np.isfinite(value)
    assert all(np.isfinite(g).all() for g in gradients)
    assert not gradients[0][0, 3, 1].any()


def test_the_number_of_weights_must_fit(unchecked):
    with pytest.raises(ValueError, match="need 50 weights a pixel, got 25"):
        predicted_mean(jnp.ones((2, 4, 4, 1)), identity(jnp.ones((4, 4, 25)), 5))


def test_memory_does_not_hold_all_weights():
    """225 weights of 32 features a pixel: below 1 GB a megapixel with the features."""
    size = 512
    kernel = jnp.ones((32, 225), jnp.float32)
    features = jax.ShapeDtypeStruct((size, size, 32), jnp.float32)
    image = jax.ShapeDtypeStruct((1, size, size, 3), jnp.float32)
    mean = lambda f, i: predicted_mean(i, Kernels(f, lambda f: f @ kernel, 0, 15))
    memory = jax.jit(mean).lower(features, image).compile().memory_analysis()
    assert memory.temp_size_in_bytes / size**2 < 400
    gradient = jax.jit(jax.grad(lambda f, i: mean(f, i).sum()))
    memory = gradient.lower(features, image).compile().memory_analysis()
    assert memory.temp_size_in_bytes / size**2 < 900


@pytest.mark.parametrize("height", [1, 15, 16, 17, 40])
def test_strips_of_rows_are_the_image(height, rng):
    image, other = (jnp.asarray(rng.random((height, 3, c))) for c in (2, 1))

    def shifted(near, strip):
        """The pixel two rows above and the one three rows below."""
        rows = strip.shape[0]
        return near[1 : 1 + rows] + near[6 : 6 + rows] * strip

    found = jax.jit(lambda a, b: map_rows(shifted, [(a, 3), (b, 0)], rows=16))(
        image, other
    )
    padded = np.pad(image, ((3, 3), (0, 0), (0, 0)))
    expected = padded[1 : 1 + height] + padded[6 : 6 + height] * np.asarray(other)
    np.testing.assert_allclose(found, expected, rtol=1e-14)
