"""What every combiner promises, whatever its paper."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jscomb import (
    double_shrinkage,
    ensemble,
    james_stein,
    progressive,
    uncorrelated,
)
from jscomb.choice import UNTRAINED
from jscomb.denoisers import smoothing
from jscomb.learning import networks


def ensemble_of(x, y, v, **options):
    """Of x, y and a blurred y; halves that differ by the noise that v tells of."""
    some, sign = v > 0, jax.random.rademacher(jax.random.key(0), x.shape, x.dtype)
    noise = jnp.where(some, jnp.sqrt(jnp.where(some, v, 1.0)), 0.0) * sign
    bases = lambda sign: jnp.stack([x + sign * noise, y, smoothing.box(y, window=3)])
    halves = bases(1), bases(-1), x + noise, x - noise
    return ensemble.combine(bases(0), *halves, **options)


def uncorrelated_of(x, y, v):
    """Of x as the independent and y as the correlated estimates; their halves apart."""
    away = 1e-2 * jnp.stack([x - y, y - x])
    gamma = 1 / v[0, 0, 0]  # far from all that is done to the frame
    return uncorrelated.combine(x[None] + away, y[None] + away, gamma, 1)


NETWORK = networks.JamesSteinNetwork(jax.random.key(0), size="light")

COMBINERS = {
    "james_stein": james_stein.combine,
    "james_stein whitened": lambda x, y, v: james_stein.combine(x, y, v, whiten=True),
    "james_stein dual": lambda x, y, v: james_stein.combine_dual(
        x, 2 * x - y, y, (x + y) / 2, v
    ),
    "james_stein corrected": lambda x, y, v: james_stein.combine(
        x, y, v, whiten=True, divergence=v / 4
    ),
    "james_stein neural": lambda x, y, v: james_stein.neural_combine(
        NETWORK, x, y, (x + y) / 2, v
    ),
    "ensemble": lambda x, y, v: ensemble_of(x, y, v),
    "ensemble multi-scale": lambda x, y, v: ensemble_of(
        x, y, v, solver="multi-scale", windows=(7, 11)
    ),
    "uncorrelated": uncorrelated_of,
    "double_shrinkage": lambda x, y, v: double_shrinkage.combine(
        0.9 * y, x, y, v, v / 2, v / 3
    ),
    "progressive": lambda x, y, v: progressive.combine(x, y, v, v / 2),
    **{f"command, {name}": method for name, method in UNTRAINED.items()},
}


class Combiner(NamedTuple):
    """A function of x, y and the variance of x; compiled once for all tests."""

    function: Callable
    jitted: Callable
    gradient: Callable


def compiled(function) -> Combiner:
    """The function and its gradient."""
    total = lambda *images: jnp.sum(function(*images))
    gradient = jax.value_and_grad(total, argnums=(0, 1, 2))
    return Combiner(function, jax.jit(function), jax.jit(gradient))


COMPILED = {name: compiled(function) for name, function in COMBINERS.items()}


@pytest.fixture(params=COMBINERS)
def combine(request):
    """One of them."""
    return COMPILED[request.param]


@pytest.fixture
def images(glass_frame):
    """x, y and variance of a real frame with fireflies, float32."""
    return glass_frame.color, glass_frame.biased["oidn"].full, glass_frame.variance


def test_pure(combine, images):
    """The same again, its arguments untouched, and eager as compiled."""
    before = [np.array(i) for i in images]
    first, second = combine.jitted(*images), combine.jitted(*images)
    np.testing.assert_array_equal(first, second)
    for image, copy in zip(images, before, strict=True):
        np.testing.assert_array_equal(image, copy)
    assert first.shape == images[0].shape
    assert first.dtype == images[0].dtype
    small = [i[:20, :21] for i in images]
    np.testing.assert_allclose(
        combine.function(*small), combine.jitted(*small), rtol=1e-4, atol=1e-6
    )


def test_no_recompilation(combine, images):
    traces = []

    @jax.jit
    def counted(*data):
        traces.append(1)
        return combine.function(*data)

    counted(*images)
    counted(*(2 * i for i in images))
    assert len(traces) == 1


def test_vmap_is_a_loop(combine, images):
    batch = [jnp.stack([i, i[::-1], 0.5 * i]) for i in images]
    mapped = jax.jit(jax.vmap(combine.function))(*batch)
    looped = jnp.stack([combine.jitted(*each) for each in zip(*batch, strict=True)])
    np.testing.assert_allclose(mapped, looped, rtol=1e-4, atol=1e-6)


def test_differentiable(combine, images):
    value, gradients = combine.gradient(*images)
    assert np.isfinite(value)
    for gradient in gradients:
        assert np.isfinite(gradient).all()
        assert np.any(np.asarray(gradient) != 0)


@pytest.mark.parametrize("scale", [1e-6, 1e-3, 1e3, 1e6])
def test_scale_equivariant(combine, images, scale, request):
    x, y, v = images
    # Rounding moves the weights of bases that hardly differ.
    loose = 100 if "ensemble" in request.node.name else 1
    s = jnp.float32(scale)
    np.testing.assert_allclose(
        combine.jitted(s * x, s * y, s * s * v),
        combine.jitted(x, y, v) * s,
        rtol=2e-5 * loose,
        atol=2e-7 * loose * scale,
    )


@pytest.mark.parametrize("bad", [np.nan, np.inf])
@pytest.mark.parametrize("image", [0, 1, 2])
def test_a_bad_pixel_stays_local(combine, images, image, bad, request):
    """Nothing but finite pixels, and beyond the windows not a bit is changed."""
    poisoned = list(images)
    poisoned[image] = images[image].at[20, 30, 0].set(bad)
    out, clean = combine.jitted(*poisoned), combine.jitted(*images)
    assert np.isfinite(out).all()
    reach = 20  # windows of a window, and pooling before them
    rows, columns = np.ogrid[:64, :64]
    far = (abs(rows - 20) > reach) | (abs(columns - 30) > reach)
    # The frame is one of the scales; its mean noise sets the bound's width; a network
    # sees half the crop, and the exposure all of it.
    by_frame = {"multi-scale": 0.02, "progressive": 1e-4, "neural": 0.02}
    loose = [r for name, r in by_frame.items() if name in request.node.name]
    if loose:
        np.testing.assert_allclose(out[far], clean[far], rtol=loose[0], atol=1e-3)
    else:
        np.testing.assert_array_equal(out[far], clean[far])
    _, gradients = combine.gradient(*poisoned)
    assert all(np.isfinite(g).all() for g in gradients)


@pytest.mark.parametrize("size", [(1, 1), (1, 9), (9, 1), (4, 5)])
def test_any_size(combine, images, size):
    """Also an image smaller than the window."""
    h, w = size
    out = combine.jitted(*(i[30 : 30 + h, 30 : 30 + w] for i in images))
    assert out.shape == (h, w, 3)
    assert np.isfinite(out).all()
