"""Medians against numpy's."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from jscomb.numerics.medians import median, median_of


@pytest.mark.parametrize("kind", [np.float32, np.float64])
@settings(deadline=None)  # the first example compiles
@given(data=st.data())
def test_the_median_is_that_of_the_valid_values(kind, data):
    width = 8 * np.dtype(kind).itemsize
    # XLA flushes subnormal numbers to 0.
    floats = st.floats(0, 2.0**100, width=width, allow_subnormal=False)
    values = data.draw(arrays.arrays(kind, (3, 4, 1), elements=floats))
    valid = data.draw(arrays.arrays(bool, values.shape))
    broken = jnp.asarray(np.where(valid, values, np.nan))
    expected = np.median(values[valid]) if valid.any() else 0
    found = jax.jit(median)(broken, jnp.asarray(valid))
    assert found.dtype == kind
    limits = np.finfo(kind)  # half of the smallest normal number is 0, too
    np.testing.assert_allclose(found, expected, rtol=8 * limits.eps, atol=limits.tiny)


@pytest.mark.parametrize("count", [10, 11])
def test_the_derivative_is_that_of_the_values_in_the_middle(count, rng):
    values = jnp.asarray(rng.uniform(0, 1, count))
    gradient = jax.grad(median)(values, jnp.ones(count, bool))
    np.testing.assert_allclose(gradient, jax.grad(jnp.median)(values))


def test_equal_values_share_the_derivative():
    values = jnp.array([0.0, 2.0, 2.0, 9.0, jnp.inf])
    gradient = jax.grad(median)(values, jnp.isfinite(values))
    np.testing.assert_allclose(gradient, [0, 0.5, 0.5, 0, 0])


@pytest.mark.parametrize("count", range(1, 8))
def test_the_median_of_images(count, rng):
    images = rng.normal(size=(count, 50, 3)).round(1)
    found = median_of(jnp.asarray(images))
    np.testing.assert_allclose(found, np.median(images, axis=0), rtol=1e-15)
