"""Quadratic programs on the simplex: exact against a general solver."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from jscomb.numerics import simplex
from jscomb.numerics.simplex import _quadratic
from jscomb.numerics.simplex._pivots import free_by_pivots

hull = jax.jit(simplex.hull)
quadratic = jax.jit(simplex.quadratic)
reference = jax.jit(simplex.reference)
iterative = jax.jit(simplex.iterative, static_argnames="steps")


def problems(rng, n, kind, count=300):
    """Points and targets of both halves; every kind of trouble."""
    a, b = rng.normal(size=(2, n, count))
    w = rng.dirichlet(np.full(n, 0.2 if kind == "near an edge" else 1.0), count).T
    if kind == "sliver":
        b = a + 1e-4 * b
    if kind == "on a line":
        b = 2 * a + 1
    if kind == "identical bases":
        a[-1], b[-1] = a[0], b[0]
    if kind == "all the same":
        a, b = (np.broadcast_to(i[:1], i.shape) for i in (a, b))
    if kind == "a close pair":
        a[:2], b[:2] = 1e-5 * a[:2], 1e-5 * b[:2]
    target_a, target_b = rng.normal(size=(2, count))
    if kind in ("inside", "near an edge", "sliver", "faint"):
        target_b, target_a = (w * a).sum(0), (w * b).sum(0)
    if kind == "firefly":
        target_a, target_b = 1e6 * target_a, 1e6 * target_b
    scale = {"faint": 1e-8, "bright": 1e6}.get(kind, 1.0)
    return [scale * i for i in (a, b, target_a, target_b)]


KINDS = (
    "anywhere",
    "inside",
    "near an edge",
    "sliver",
    "on a line",
    "identical bases",
    "all the same",
    "a close pair",
    "firefly",
    "faint",
    "bright",
)


def matrix_of(a, b, target_a, target_b):
    """The objective w'Mw of the same problem."""
    d = np.stack([a - target_b, b - target_a], axis=1)
    return np.einsum("ikm,jkm->ijm", d, d)


def optimality(w, a, b, target_a, target_b):
    """Violation of the conditions of an optimum, relative: sum, sign and slopes."""
    size = max(abs(a - a.mean(0)).max(), abs(b - b.mean(0)).max()) or 1.0
    da, db = (a - a.mean(0)) / size, (b - b.mean(0)) / size
    ca, cb = (a.mean(0) - target_b) / size, (b.mean(0) - target_a) / size
    slope = da * ((w * da).sum(0) + ca) + db * ((w * db).sum(0) + cb)
    rise = (w * slope).sum(0) - slope.min(0)
    scale = 1 + abs(ca) + abs(cb)
    return max((rise / scale).max(), abs(w.sum(0) - 1).max(), (-w).max())


def excess(w, best, a, b, target_a, target_b):
    """Objective of w above that of the best, relative; exact for a far target."""
    size = np.maximum(np.abs(a - a.mean(0)).max(0), np.abs(b - b.mean(0)).max(0))
    size = np.where(size > 0, size, 1)
    gap, scale = 0, 1
    for p, t in ((a, target_b), (b, target_a)):
        u, c = (p - p.mean(0)) / size, (p.mean(0) - t) / size
        z, z_best = (w * u).sum(0), (best * u).sum(0)
        gap += (z - z_best) * (z + z_best + 2 * c)
        scale += abs(c)
    return gap / scale


@pytest.mark.parametrize("n", [1, 2, 3, 5])
@pytest.mark.parametrize("kind", KINDS)
def test_hull_is_optimal(n, kind, rng):
    """By an optimum's conditions in float64; as good but for rounding in float32."""
    data = problems(rng, n, kind)
    best = np.asarray(hull(*data))
    assert optimality(best, *data) < 1e-8
    single = [jnp.asarray(i, jnp.float32) for i in data]
    w = hull(*single)
    assert w.dtype == jnp.float32
    w = np.asarray(w, np.float64)
    np.testing.assert_allclose(w.sum(0), 1, atol=1e-6)
    assert w.min() >= 0
    rounded = [np.asarray(i, np.float64) for i in single]
    assert excess(w, np.asarray(hull(*rounded)), *rounded).max() < 1e-6


@pytest.mark.parametrize("n", [2, 4])
@pytest.mark.parametrize("kind", ["anywhere", "inside", "identical bases", "on a line"])
def test_hull_and_quadratic_are_the_reference(n, kind, rng):
    """Of the general solver the weights may differ, the objective not."""
    data = problems(rng, n, kind, 60)
    general = np.asarray(reference(*data))
    assert optimality(general, *data) < 1e-6
    for w in (hull(*data), quadratic(matrix_of(*data))):
        assert abs(excess(np.asarray(w), general, *data)).max() < 1e-7


@pytest.mark.parametrize("n", [5])
def test_inside_the_hull_the_weights_are_nearest_to_uniform(n, rng):
    """Least |w|^2 of all that reach the target: every set of bases, by brute force."""
    a, b, target_a, target_b = problems(rng, n, "inside", 40)
    found = np.asarray(hull(a, b, target_a, target_b))
    for k in range(40):
        equations = np.stack([np.ones(n), a[:, k], b[:, k]])
        goal = np.array([1, target_b[k], target_a[k]])
        best = np.inf
        for size in range(3, n + 1):
            for some in map(list, itertools.combinations(range(n), size)):
                w = np.linalg.lstsq(equations[:, some], goal)[0]
                reached = abs(equations[:, some] @ w - goal).max() < 1e-9
                if reached and w.min() > -1e-12:
                    best = min(best, (w**2).sum())
        np.testing.assert_allclose((found[:, k] ** 2).sum(), best, rtol=1e-9)


def test_the_middle_of_a_square_is_a_quarter_of_each():
    """Though two opposite corners would do."""
    a, b = np.array([[0.0, 2, 0, 2], [0, 0, 2, 2]]).reshape(2, 4, 1)
    for shift in (0.0, 0.5, 1024.0):
        target = np.array([1.0 + shift])
        data = a + shift, b + shift, target, target
        np.testing.assert_allclose(hull(*data), 0.25)
        single = [jnp.asarray(i, jnp.float32) for i in data]
        np.testing.assert_allclose(hull(*single), 0.25, rtol=1e-5)


@pytest.mark.parametrize("n", [3, 4])
def test_bases_at_the_same_point_share_their_weight(n, rng):
    data = problems(rng, n, "identical bases")
    w = np.asarray(hull(*data))
    np.testing.assert_allclose(w[0], w[-1], rtol=1e-9)
    same = np.asarray(hull(*problems(rng, n, "all the same")))
    np.testing.assert_allclose(same, 1 / n, rtol=1e-12)
    matrix = matrix_of(*data)
    w = np.asarray(quadratic(matrix))
    np.testing.assert_allclose(w[0], w[-1], atol=1e-5)


def test_two_is_the_hull(rng):
    data = problems(rng, 2, "anywhere")
    np.testing.assert_allclose(jax.jit(simplex.two)(*data), hull(*data), atol=1e-14)


def test_the_iterative_solver_converges_to_the_hull(rng):
    data = problems(rng, 4, "anywhere", 50)
    best = hull(*data)
    run = lambda steps: np.asarray(iterative(jax.random.key(0), *data, steps=steps))
    gaps = [excess(run(steps), best, *data).max() for steps in (16, 256, 8192)]
    assert gaps[0] > gaps[1] > gaps[2]
    assert gaps[2] < 1e-3
    np.testing.assert_array_equal(run(16), run(16))
    by_matrix = jax.jit(simplex.iterative_quadratic, static_argnames="steps")
    w = by_matrix(jax.random.key(0), matrix_of(*data), steps=8192)
    assert excess(np.asarray(w), best, *data).max() < 1e-3


def random_matrix(rng, n, rank, count=100):
    """Positive semidefinite."""
    d = rng.normal(size=(n, rank, count))
    return np.einsum("irm,jrm->ijm", d, d)


@pytest.mark.parametrize(("n", "rank"), [(2, 1), (3, 3), (4, 2), (8, 3)])
def test_quadratic_is_optimal(n, rank, rng):
    """Slopes of all bases in use are equal and least; also with a number added."""
    matrix = random_matrix(rng, n, rank)
    for constant in (0.0, -3.0, 50.0):
        w = np.asarray(quadratic(matrix + constant))
        slope = np.einsum("ijm,jm->im", matrix, w)
        rise = (w * slope).sum(0) - slope.min(0)
        assert rise.max() < 1e-10
        np.testing.assert_allclose(w.sum(0), 1, rtol=1e-12)
        assert w.min() >= 0
    general = np.asarray(jax.jit(simplex.reference_quadratic)(matrix))
    value = lambda w: np.einsum("im,ijm,jm->m", w, matrix, w)
    np.testing.assert_allclose(value(w), value(general), atol=1e-7)
    single = quadratic(jnp.asarray(matrix, jnp.float32))
    assert abs(value(np.asarray(single, np.float64)) - value(w)).max() < 1e-4


def test_pivots_tell_which_bases_are_in_use(rng):
    matrix = random_matrix(rng, 8, 9, 2000)
    errors = jnp.asarray(np.einsum("iim->im", matrix))
    best = jnp.arange(8)[:, None] == jnp.argmin(errors, axis=0)[None]
    k, linear, _, tolerance = _quadratic.objective_of(jnp.asarray(matrix))
    free = free_by_pivots(k, linear, tolerance, best)
    np.testing.assert_array_equal(free, quadratic(matrix) > 0)


def test_the_search_finds_what_pivots_do_not(rng, monkeypatch):
    matrix = random_matrix(rng, 6, 7)
    w = quadratic(matrix)
    none = lambda matrix, linear, tolerance, best: best
    monkeypatch.setattr(_quadratic, "free_by_pivots", none)
    searched = jax.jit(lambda m: simplex.quadratic(m))(matrix)
    np.testing.assert_allclose(searched, w, atol=1e-9)


def test_a_matrix_that_is_not_semidefinite(rng):
    """No estimate is one, but rounding may make one: feasible weights, gradients."""
    a, d = rng.normal(size=(6, 6, 6000)), rng.normal(size=(6, 6000))
    matrix = np.einsum("im,jm->ijm", d, d) * (1 + a + a.transpose(1, 0, 2))
    for dtype in (jnp.float32, jnp.float64):
        m = jnp.asarray(matrix, dtype)
        w = np.asarray(quadratic(m))
        assert w.min() >= 0
        np.testing.assert_allclose(w.sum(0), 1, atol=1e-6)
        gradient = jax.jit(jax.grad(lambda m: jnp.sum(jnp.sin(simplex.quadratic(m)))))
        assert np.isfinite(gradient(m)).all()


def test_a_bad_base_does_not_drown_two_good_ones():
    good = np.array([[1.0, 0.2], [0.2, 2.0]])
    matrix = np.full((3, 3), 0.1)
    matrix[:2, :2], matrix[2, 2] = good, 1e8
    expected = quadratic(good)
    for dtype in (jnp.float32, jnp.float64):
        w = quadratic(jnp.asarray(matrix, dtype))
        np.testing.assert_allclose(w[:2], expected, atol=1e-4)


def test_affine_weights_have_equal_slopes(rng):
    matrix = random_matrix(rng, 4, 6)
    affine = jax.jit(simplex.affine)
    w = np.asarray(affine(matrix))
    np.testing.assert_allclose(w.sum(0), 1, rtol=1e-10)
    slope = np.einsum("ijm,jm->im", matrix, w)
    np.testing.assert_allclose(slope - slope[:1], 0, atol=1e-8)
    pseudo = np.stack([np.linalg.pinv(matrix[..., k]).sum(0) for k in range(100)], -1)
    np.testing.assert_allclose(w, pseudo / pseudo.sum(0), rtol=1e-5)
    singular = affine(random_matrix(rng, 4, 1))
    assert np.isfinite(singular).all()


def raw_matrices(rng, n, kind, count=4000):
    """<M> of single pixels (ED eq. 11, 12) in a precision, and what was rounded."""
    truth, noise = rng.gamma(2.0, 1.0, count), rng.normal(size=(2, n, count))
    x = truth + 0.3 * rng.normal(size=(2, count))
    y = truth + 0.1 * noise + 0.05 * np.arange(n)[:, None]
    if kind == "x is a base":
        y[:, -1] = x
    if kind == "equal bases":
        y[:, -1] = y[:, 0]
    if kind == "bases hardly differ":
        y = y[:, :1] * (1 + 1e-6 * noise)
    if kind == "black":
        x[:, ::2], y[..., ::2] = 0, 0
    if kind == "fireflies":
        x[0, ::7], y[0, 0, ::7] = 1e6, 1e5
    if kind == "faint":
        x, y = 1e-8 * x, 1e-8 * y
    if kind == "not finite":
        x[0, ::5] = np.nan
    halves = [(y[0], x[0], x[1]), (y[1], x[1], x[0])]
    made = lambda dtype: sum(_raw(*(i.astype(dtype) for i in half)) for half in halves)
    return made, np.maximum(abs(y).max(axis=(0, 1)), abs(x).max(axis=0)) ** 2


def _raw(y, own, other):
    """Half of one half's <M>, in the images' precision."""
    pairs = y[:, None] * y[None] - other * (y[:, None] + y[None])
    return (own * other + pairs) / 2


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("n", [1, 2, 4, 6])
@pytest.mark.parametrize(
    "kind",
    [
        *("x is a base", "equal bases", "bases hardly differ", "black", "fireflies"),
        *("faint", "not finite"),
    ],
)
def test_affine_weights_of_single_pixels_sum_to_one(kind, n, dtype, rng):
    """Of matrices of rank two at most: no guarded solver, no sum, nor any gradient."""
    made, level = raw_matrices(rng, n, kind)
    matrix = made(dtype)
    w = np.asarray(jax.jit(simplex.affine)(matrix), np.float64)
    np.testing.assert_allclose(w.sum(0), 1, atol=1e-3 if dtype == np.float32 else 1e-9)
    assert abs(w).max() <= 1002
    known = np.isfinite(matrix).all(axis=(0, 1))
    np.testing.assert_allclose(w[:, ~known], 1 / n, rtol=1e-6)
    m, w = (i[..., known].astype(np.float64) for i in (matrix, w))
    error = np.einsum("im,ijm,jm->m", w, m, w)
    best = np.stack([m[i, i] for i in range(n)]).min(0)
    size = (1 + abs(w).sum(0)) ** 2 * level[known]
    assert ((error - best) <= 50 * np.finfo(dtype).eps * size).all()
    gradient = jax.jit(jax.grad(lambda m: jnp.sum(jnp.sin(simplex.affine(m)))))
    assert np.isfinite(gradient(matrix)).all()


@pytest.mark.parametrize("n", [2, 4])
@pytest.mark.parametrize("kind", ["anywhere", "inside"])
def test_gradients(n, kind, rng):
    """Of a few problems that are not next to a tie."""
    data = [jnp.asarray(i[..., :6]) for i in problems(rng, n, kind)]
    check_grads(hull, data, order=1, eps=1e-7, rtol=1e-4, atol=1e-4)
    matrix = jnp.asarray(random_matrix(rng, n, n + 2, 6))
    symmetric = lambda m: quadratic((m + jnp.swapaxes(m, 0, 1)) / 2)
    check_grads(symmetric, (matrix,), order=1, eps=1e-7, rtol=1e-4, atol=1e-4)


def numbered(weights):
    """A number that tells the bases apart."""
    number = jnp.arange(len(weights), dtype=weights.dtype)[:, None]
    return jnp.sum(number * weights)


hull_gradient = jax.jit(jax.grad(lambda *i: numbered(hull(*i)), argnums=(0, 1, 2, 3)))
quadratic_gradient = jax.jit(jax.grad(lambda m: numbered(quadratic(m))))


@pytest.mark.parametrize("kind", KINDS)
def test_gradients_are_finite_at_ties(kind, rng):
    for n in (3, 4):
        data = [jnp.asarray(i, jnp.float32) for i in problems(rng, n, kind, 50)]
        assert all(np.isfinite(g).all() for g in hull_gradient(*data))
        if kind not in ("firefly", "bright"):
            matrix = jnp.asarray(matrix_of(*map(np.asarray, data)), jnp.float32)
            assert np.isfinite(quadratic_gradient(matrix)).all()


def test_vmap_and_batch_axes(rng):
    a, b, target_a, target_b = problems(rng, 4, "anywhere", 24)
    whole = hull(a, b, target_a, target_b)
    shaped = hull(*(i.reshape(*i.shape[:-1], 4, 6) for i in (a, b, target_a, target_b)))
    np.testing.assert_allclose(shaped.reshape(4, 24), whole, rtol=1e-12)
    each = lambda solve: jax.jit(jax.vmap(solve, in_axes=-1, out_axes=-1))
    mapped = each(simplex.hull)(a, b, target_a, target_b)
    np.testing.assert_allclose(mapped, whole, rtol=1e-12)
    matrix = random_matrix(rng, 4, 4, 24)
    mapped = each(simplex.quadratic)(matrix)
    np.testing.assert_allclose(mapped, quadratic(matrix), rtol=1e-10, atol=1e-12)


@pytest.mark.usefixtures("unchecked")
def test_bad_input():
    a, t = jnp.ones((3, 5)), jnp.ones(5)
    with pytest.raises(ValueError, match="at least one base, got 0"):
        simplex.hull(a[:0], a[:0], t, t)
    with pytest.raises(ValueError, match=r"target_b has shape \(4,\), expected \(5,\)"):
        simplex.hull(a, a, t, t[:4])
    with pytest.raises(ValueError, match="two takes 2 bases, got 3"):
        simplex.two(a, a, t, t)
    with pytest.raises(ValueError, match=r"matrix must be \[N,N,...\] with N > 0"):
        simplex.quadratic(jnp.ones((3, 2, 4)))
    with pytest.raises(ValueError, match="needs float64, got float32"):
        simplex.reference(*(i.astype(jnp.float32) for i in (a, a, t, t)))


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_problems_that_are_not_finite_say_nothing(bad, rng):
    """Equal weights there, and nothing else is touched; gradients too."""
    a, b = jnp.asarray(rng.normal(size=(2, 3, 5)))
    target = jnp.asarray(rng.normal(size=(2, 5)))
    error = a - target[:1]
    matrix = error[:, None] * error[None] + jnp.eye(3)[..., None]
    for solve, given in (
        (simplex.hull, (a, b, *target)),
        (simplex.quadratic, (matrix,)),
    ):
        solve = jax.jit(solve)
        clean = solve(*given)
        spoilt = [given[0].at[0, ..., 2].set(bad), *given[1:]]
        w = solve(*spoilt)
        np.testing.assert_allclose(w[:, 2], 1 / 3, rtol=1e-12)
        others = np.array([0, 1, 3, 4])
        np.testing.assert_array_equal(w[:, others], clean[:, others])
        first = lambda *g, solve=solve: jnp.sum(solve(*g)[0])
        gradient = jax.jit(jax.grad(first, argnums=tuple(range(len(given)))))
        gradients = gradient(*spoilt)
        assert all(np.isfinite(g).all() for g in gradients)
