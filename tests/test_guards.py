"""Safe division and invalid pixels."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from jscomb.numerics import guards


@pytest.mark.parametrize("d", [1e-30, 1e-8, 1.0, 1e18])
def test_derivatives_survive_where_squares_leave_the_range(d):
    """In float32 1/d^2 is infinite below 1e-19, the derivative itself is not."""
    n, d = jnp.float32(3 * d), jnp.float32(d)

    def quotient(n, d):
        return guards.divide(n, d, where=d > 0)

    np.testing.assert_allclose(quotient(n, d), 3, rtol=1e-6)
    for transform in (lambda f: f, jax.jit):
        for grad in (jax.grad, jax.jacfwd):
            dn, dd = transform(grad(quotient, argnums=(0, 1)))(n, d)
            np.testing.assert_allclose([dn * d, dd * d], [1, -3], rtol=1e-6)


def test_second_derivative():
    quotient = lambda n, d: guards.divide(n, d, where=d > 0)
    check_grads(jax.jit(quotient), (2.0, 3.0), order=2, rtol=1e-4)


def test_nothing_passes_where_it_does_not_divide():
    quotient = lambda n, d: guards.divide(n, d, where=d > 1, otherwise=7.0)
    n, d = jnp.float64(1), jnp.float64(0)
    assert quotient(n, d) == 7
    np.testing.assert_array_equal(jax.grad(quotient, argnums=(0, 1))(n, d), (0, 0))


def test_first_finite_chooses_whole_pixels():
    nan, inf = jnp.nan, jnp.inf
    a = jnp.array([[[1.0, 2.0], [nan, 2.0], [nan, 2.0]]])
    b = jnp.array([[[3.0, 4.0], [3.0, 4.0], [3.0, -inf]]])
    expected = [[[1, 2], [3, 4], [0, 0]]]
    np.testing.assert_array_equal(guards.first_finite(a, b), expected)
    np.testing.assert_array_equal(guards.finite(a, b)[0, :, 0], [True, False, False])


def test_shapes_are_named():
    with pytest.raises(ValueError, match=r"noise has shape \(2, 3, 1\), color has"):
        guards.check_same_shape(color=jnp.ones((2, 3, 3)), noise=jnp.ones((2, 3, 1)))
    with pytest.raises(ValueError, match=r"color must have shape \[H, W, C\]"):
        guards.check_same_shape(color=jnp.ones((2, 3)))


def test_this_jax_adds_up():
    """Compiled sums of large arrays: one release of JAX gets them wrong on CPUs."""
    rng = np.random.default_rng(0)
    t, u = (
        rng.normal(size=s).astype(np.float32) for s in ((3, 40_000), (3, 2, 40_000))
    )
    found = jax.jit(lambda t, u: jnp.sum(t[:, None] * u, axis=0))(t, u)
    np.testing.assert_allclose(found, (t[:, None] * u).sum(axis=0), atol=1e-5)
