"""The screened Poisson solve against a sparse solver, and where values are missing."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse as sp
from jax.test_util import check_grads
from scipy.sparse.linalg import lsqr, spsolve

from jscomb.numerics.poisson import reconstruct

solve = jax.jit(reconstruct, static_argnames="alpha")
SIZES = [(7, 9), (8, 8), (1, 6), (5, 1), (1, 1), (2, 3)]


def problem(shape, seed=0, channels=2):
    """Random primal image and gradients that are of no image."""
    rng, (h, w) = np.random.default_rng(seed), shape
    sizes = (h, w, channels), (h, w - 1, channels), (h - 1, w, channels)
    return tuple(jnp.asarray(rng.standard_normal(size)) for size in sizes)


def rows(shape, alpha):
    """The least squares problem's matrix."""
    difference = lambda n: sp.diags([-1.0, 1.0], [0, 1], shape=(n - 1, n))
    h, w = shape
    parts = [alpha * sp.eye(h * w)]
    if w > 1:
        parts.append(sp.kron(sp.eye(h), difference(w)))
    if h > 1:
        parts.append(sp.kron(difference(h), sp.eye(w)))
    return sp.vstack(parts).tocsr()


def oracle(primal, gradient_x, gradient_y, alpha):
    """By SciPy's sparse solver, channel by channel; values that are NaN left out."""
    shape, a = primal.shape[:2], rows(primal.shape[:2], alpha)
    solved = []
    for c in range(primal.shape[2]):
        values = [alpha * primal[..., c], gradient_x[..., c], gradient_y[..., c]]
        b = np.concatenate([np.ravel(v) for v in values])
        known = np.isfinite(b)
        m, b = a[known], b[known]
        if known.all():
            u = spsolve((m.T @ m).tocsc(), m.T @ b)
        else:
            u = lsqr(m, b, atol=1e-14, btol=1e-14, iter_lim=10**5)[0]
        solved.append(u.reshape(shape))
    return np.stack(solved, -1)


@pytest.mark.parametrize("shape", SIZES)
@pytest.mark.parametrize("alpha", [0.2, 1e-3, 10.0])
def test_the_sparse_solution(shape, alpha):
    given = problem(shape)
    np.testing.assert_allclose(
        solve(*given, alpha=alpha),
        oracle(*given, alpha),
        rtol=1e-9,
        atol=1e-9 * (1 + 1e-6 / alpha**2),
    )


def test_float32():
    given = tuple(g.astype(jnp.float32) for g in problem((33, 20)))
    u = solve(*given)
    assert u.dtype == jnp.float32
    np.testing.assert_allclose(u, oracle(*given, 0.2), atol=3e-5)


def test_exact_gradients_give_the_image_back():
    u = problem((9, 11))[0]
    found = solve(u, jnp.diff(u, axis=1), jnp.diff(u, axis=0))
    np.testing.assert_allclose(found, u, rtol=1e-11)


def test_limits():
    """Nothing but the primal image counts, or nothing of it but its mean."""
    y, g, h = problem((8, 9))
    np.testing.assert_allclose(solve(y, g, h, alpha=1e5), y, atol=1e-8)
    flat = solve(y, 0 * g, 0 * h, alpha=1e-4)
    mean = jnp.broadcast_to(jnp.mean(y, axis=(0, 1)), y.shape)
    np.testing.assert_allclose(flat, mean, atol=1e-6)


def test_gradients_and_vmap():
    given = problem((4, 5), channels=1)
    check_grads(solve, given, order=1, modes=["fwd", "rev"], rtol=1e-6)
    missing = given[0].at[1, 2].set(jnp.nan), *given[1:]
    both = jax.jit(jax.vmap(reconstruct))(
        *(jnp.stack(pair) for pair in zip(given, missing, strict=True))
    )
    np.testing.assert_allclose(both[0], solve(*given), rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(both[1], solve(*missing), rtol=1e-8, atol=1e-10)


@pytest.mark.parametrize("scale", [1e-25, 1e-8, 1e6, 1e25])
@pytest.mark.parametrize("value", [0.5, np.nan])
def test_scale_equivariant(scale, value):
    """Also where squares leave the range of float32."""
    y, g, h = (g.astype(jnp.float32) for g in problem((16, 12)))
    given = y.at[3, 4].set(value), g, h.at[5, 6, 0].set(value)
    s = jnp.float32(scale)
    np.testing.assert_allclose(
        solve(*(s * g for g in given)),
        s * solve(*given),
        rtol=1e-4,
        atol=2e-6 * scale,
    )


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_missing_values_are_excluded(bad):
    """Of y alone, of one gradient, and of whole pixels; as least squares without."""
    y, g, h = problem((9, 10))
    y = y.at[2, 3, 0].set(bad).at[7, 7].set(bad)
    g = g.at[4, 4, 1].set(bad).at[7, 6:8].set(bad)
    h = h.at[0, 9].set(bad).at[6:8, 7].set(bad)
    found = solve(y, g, h)
    assert np.all(found[7, 7] == 0)  # nothing is known of it
    expected = oracle(*(np.where(np.isfinite(i), i, np.nan) for i in (y, g, h)), 0.2)
    np.testing.assert_allclose(found, expected, atol=1e-7)
    total = lambda *given: jnp.sum(jnp.sin(solve(*given)))
    for gradient in jax.jit(jax.grad(total, argnums=(0, 1, 2)))(y, g, h):
        assert np.isfinite(gradient).all()


def test_a_missing_pixel_of_z_keeps_its_own_estimate():
    """Nothing but y tells of it, so y it is."""
    y, g, h = problem((9, 10))
    cut = g.at[4, 4:6].set(jnp.nan), h.at[3:5, 5].set(jnp.nan)
    np.testing.assert_allclose(solve(y, *cut)[4, 5], y[4, 5], rtol=1e-8)


def test_fireflies():
    y, g, h = (i.astype(jnp.float32) for i in problem((24, 24)))
    y = y.at[10, 12].set(1e6)
    found = solve(y, g, h)
    np.testing.assert_allclose(found, oracle(y, g, h, 0.2), rtol=1e-5, atol=0.2)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"gradient_x": (3, 4, 1)}, r"gradient_x has shape \(3, 4, 1\), expected"),
        ({"gradient_y": (3, 4, 1)}, r"gradient_y has shape .*, expected \(2, 4, 1\)"),
        ({"primal": (3, 4)}, "primal must have shape"),
    ],
)
def test_bad_shapes(change, message, unchecked):
    shapes = {"primal": (3, 4, 1), "gradient_x": (3, 3, 1), "gradient_y": (2, 4, 1)}
    given = {name: jnp.zeros(shape) for name, shape in (shapes | change).items()}
    with pytest.raises(ValueError, match=message):
        reconstruct(**given)


def test_alpha_is_positive():
    with pytest.raises(ValueError, match=r"alpha must be positive, got 0\.0"):
        reconstruct(*problem((3, 4)), alpha=0.0)
