"""What every public combiner, denoiser and solver promises, whatever its paper.

The modules beside it import these tests, each for some functions, its `ENTRIES`.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import hypothesis
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jscomb.numerics import tiles
from tests.battery.catalogue import Entry
from tests.battery.rendering import Rendering, mirrored

SIZE = 32  # pixels


class Compiled(NamedTuple):
    """A function, compiled once for all tests, and once more for every other shape.

    Attributes:
        entry: of the catalogue.
        result: the function.
        mapped: over a batch.
        tiled: by crops of 24 pixels and what they need around them.
        everything: the result, and its derivatives: the gradient of its sum, or where
            none goes through it what the result changes by as all images grow.
    """

    entry: Entry
    result: Callable[[Rendering], jax.Array]
    mapped: Callable[[Rendering], jax.Array]
    tiled: Callable[[Rendering], jax.Array]
    everything: Callable[[Rendering], tuple[jax.Array, Any]]


def compiled(entry: Entry) -> Compiled:
    """All programs of an entry."""

    def total(r):
        result = entry.function(r)
        return jnp.sum(result), result

    def everything(r):
        if not entry.backwards:
            return jax.jvp(entry.function, (r,), (jax.tree.map(jnp.ones_like, r),))
        gradient, result = jax.grad(total, has_aux=True)(r)
        return result, gradient

    def tiled(r):
        local = lambda images: entry.function(Rendering(*images, r.unit))
        options = {"halo": entry.reach, "multiple": entry.multiple}
        return tiles.map_crops(local, tuple(r[:-1]), tile=24, **options)

    mapped = jax.vmap(entry.function)
    return Compiled(entry, *map(jax.jit, (entry.function, mapped, tiled, everything)))


def cut(r, height, width):
    """A crop about the caustic, or about the middle of one."""
    top, left = (
        (n - k) // 2 for n, k in zip(r.variance.shape, (height, width), strict=False)
    )
    rows, columns = slice(top, top + height), slice(left, left + width)
    return Rendering(*(i[rows, columns] for i in r[:-1]), r.unit)


def assert_close(got, expected, rounding):
    """Relative to the brightest pixel."""
    largest = np.abs(expected).max()
    np.testing.assert_allclose(got, expected, rtol=0, atol=rounding * largest)


def assert_finite(everything):
    for leaf in jax.tree.leaves(everything):
        assert np.isfinite(leaf).all()


def test_pure(function, plain):
    """The same bits again, its arguments untouched, without another compilation."""
    before = [np.array(i) for i in plain]
    first, second = function.result(plain), function.result(plain)
    np.testing.assert_array_equal(first, second)
    for image, copy in zip(plain, before, strict=True):
        np.testing.assert_array_equal(image, copy)
    assert first.dtype == jnp.float32
    programs = function.result._cache_size()
    function.result(plain.scaled(jnp.float32(2)))
    assert function.result._cache_size() == programs


def test_vmap_is_a_loop(function, plain):
    crop = cut(plain, 4, 5)
    batch = [crop, crop.scaled(jnp.float32(0.5)), jax.tree.map(jnp.flip, crop)]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *batch)
    for got, each in zip(function.mapped(stacked), batch, strict=True):
        assert_close(got, function.result(each), 10 * function.entry.rounding)


def test_differentiable(function, plain):
    """And not by zeros."""
    _, derivatives = function.everything(plain)
    assert_finite(derivatives)
    assert any(np.any(np.asarray(leaf) != 0) for leaf in jax.tree.leaves(derivatives))


AT = slice(None, None, 17), slice(None, None, 13)

HARD = {
    "fireflies": lambda r: r._replace(
        unbiased_a=r.unbiased_a.at[AT].set(1e6), variance=r.variance.at[AT].set(2.5e11)
    ),
    "fireflies, variance silent": lambda r: r._replace(
        unbiased_a=r.unbiased_a.at[AT].set(1e6)
    ),
    "radiance of 1e-8": lambda r: r.scaled(jnp.float32(1e-8)),
    "radiance of 1e6": lambda r: r.scaled(jnp.float32(1e6)),
    "no variance": lambda r: r._replace(
        unbiased_b=r.unbiased_a, variance=jnp.zeros_like(r.variance)
    ),
    "x equals y": lambda r: r._replace(biased_a=r.unbiased_a, biased_b=r.unbiased_b),
    "collinear features": lambda r: r._replace(features=collinear(r.features)),
    "black": lambda r: Rendering(*map(jnp.zeros_like, r[:-1]), r.unit),
    "constant": lambda r: flat(r),
}


def collinear(features):
    """Multiples of the first channel, and one that is zero."""
    count = features.shape[-1]
    return features[..., :1] * jnp.linspace(0, 1, count, dtype="float32")[None, None]


def flat(r):
    """All images alike and constant, so all bases identical and no feature of use."""
    half = jnp.full_like(r.unbiased_a, 0.5)
    return Rendering(*4 * [half], half / 5000, jnp.ones_like(r.features), r.unit)


@pytest.mark.parametrize("case", HARD)
def test_finite_in_hard_cases(function, plain, case):
    assert_finite(function.everything(HARD[case](plain)))


spoilt = st.lists(
    st.tuples(
        st.sampled_from(Rendering._fields[:-1]),
        st.tuples(*2 * [st.integers(0, SIZE - 1)], st.integers(0, 2)),
        st.sampled_from([np.nan, np.inf, 0.0, 1e-8, 1e6]),
    ),
    min_size=1,
    max_size=8,
)


def test_finite_whatever_pixels_hold(function, plain):
    """In any image; variances are at least zero, by contract."""

    @hypothesis.settings(max_examples=5, derandomize=True, deadline=None)
    @hypothesis.given(spoilt)
    def holds(pixels):
        r = plain
        for name, at, value in pixels:
            r = r._replace(**{name: getattr(r, name).at[at].set(value)})
        assert_finite(function.everything(r))

    holds()


@pytest.mark.parametrize("size", [(1, 1), (1, 9), (4, 5)], ids=str)
def test_any_size(function, plain, size):
    result = function.result(cut(plain, *size))
    assert result.shape[:2] == size
    assert_finite(result)


@pytest.mark.slow
def test_one_pixel_has_derivatives(function, plain):
    assert_finite(function.everything(cut(plain, 1, 1)))


@pytest.mark.parametrize("exponent", [-26, -10, 20])
def test_scale_equivariant(function, plain, exponent):
    """By powers of two, which round nothing."""
    scale = jnp.float32(2.0**exponent)
    got = function.result(plain.scaled(scale)) / scale**function.entry.degree
    assert_close(got, function.result(plain), 1e-5)


def test_a_flat_frame_stays_flat(function, plain):
    if function.entry.degree != 1:
        pytest.skip("its result is not a radiance")
    made = function.result(flat(plain))
    np.testing.assert_allclose(made, 0.5, rtol=function.entry.ripple)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_bad_pixel_stays_local(function, plain, whole, bad):
    """Beyond its reach not a bit is changed, and all is finite."""
    reach = function.entry.reach
    r = whole if reach is not None and reach >= SIZE - 4 else plain
    rows, columns = (np.arange(n) for n in r.variance.shape[:2])
    for name in Rendering._fields[:-1]:
        image = getattr(r, name).at[2, 3, 0].set(bad)
        got = function.result(r._replace(**{name: image}))
        assert np.isfinite(got).all()
        if reach is not None:
            far = np.maximum(abs(rows[:, None] - 2), abs(columns - 3)) > reach
            assert far.any()
            clean = function.result(r)
            np.testing.assert_array_equal(got[far], clean[far])


def test_float32_is_float64(function, plain):
    exact = jax.tree.map(lambda i: i.astype(jnp.float64), plain)
    expected = function.result(exact)
    assert_close(function.result(plain), expected, function.entry.rounding)


def test_tiled_is_untiled(function, plain):
    entry = function.entry
    if entry.reach is None:
        pytest.skip("it depends on the whole frame")
    # Larger than a crop, or there would be only one.
    r = mirrored(plain, max(SIZE, 24 + 2 * entry.reach + 16))
    assert_close(function.tiled(r), function.result(r), entry.rounding)
