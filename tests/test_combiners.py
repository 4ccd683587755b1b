"""What every combiner promises, whatever its paper."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jscomb import ensemble, james_stein
from jscomb.cli import METHODS
from jscomb.denoisers import smoothing


def ensemble_of(x, y, v, **options):
    """Of x, y and a blurred y; halves that differ by the noise v tells of."""
    noise = jnp.sqrt(jnp.where(v > 0, v, 1e-12 * x**2 + 1e-30)) * (
        1 + 0.1 * y / (y + x)
    )
    bases = lambda sign: jnp.stack([x + sign * noise, y, smoothing.box(y, window=3)])
    halves = bases(1), bases(-1), x + noise, x - noise
    return ensemble.combine(bases(0), *halves, **options)


COMBINERS = {
    "james_stein": james_stein.combine,
    "james_stein whitened": lambda x, y, v: james_stein.combine(x, y, v, whiten=True),
    "james_stein dual": lambda x, y, v: james_stein.combine_dual(
        x, 2 * x - y, y, (x + y) / 2, v
    ),
    "ensemble": lambda x, y, v: ensemble_of(x, y, v),
    "ensemble multi-scale": lambda x, y, v: ensemble_of(
        x, y, v, solver="multi-scale", windows=(7, 11)
    ),
    **{f"command, {name}": method for name, method in METHODS.items()},
}


@pytest.fixture(params=COMBINERS)
def combine(request):
    """A function of x, y and the variance of x."""
    return COMBINERS[request.param]


@pytest.fixture
def images(glass_frame):
    """x, y and variance of a real frame with fireflies, float32."""
    return glass_frame.color, glass_frame.biased["oidn"].full, glass_frame.variance


def test_pure(combine, images):
    """The same again, its arguments untouched, and eager as compiled."""
    before = [np.array(i) for i in images]
    jitted = jax.jit(combine)
    first, second = jitted(*images), jitted(*images)
    np.testing.assert_array_equal(first, second)
    for image, copy in zip(images, before, strict=True):
        np.testing.assert_array_equal(image, copy)
    assert first.shape == images[0].shape
    assert first.dtype == images[0].dtype
    np.testing.assert_allclose(combine(*images), first, rtol=1e-4, atol=1e-6)


def test_no_recompilation(combine, images):
    traces = []

    @jax.jit
    def counted(*data):
        traces.append(1)
        return combine(*data)

    counted(*images)
    counted(*(2 * i for i in images))
    assert len(traces) == 1


def test_vmap_is_a_loop(combine, images):
    batch = [jnp.stack([i, i[::-1], 0.5 * i]) for i in images]
    mapped = jax.jit(jax.vmap(combine))(*batch)
    looped = jnp.stack([jax.jit(combine)(*each) for each in zip(*batch, strict=True)])
    np.testing.assert_allclose(mapped, looped, rtol=1e-4, atol=1e-6)


def test_differentiable(combine, images):
    total = lambda *data: jnp.sum(combine(*data))
    value, gradients = jax.jit(jax.value_and_grad(total, argnums=(0, 1, 2)))(*images)
    assert np.isfinite(value)
    for gradient in gradients:
        assert np.isfinite(gradient).all()
        assert np.any(np.asarray(gradient) != 0)


@pytest.mark.parametrize("scale", [1e-6, 1e-3, 1e3, 1e6])
def test_scale_equivariant(combine, images, scale):
    x, y, v = images
    s = jnp.float32(scale)
    jitted = jax.jit(combine)
    np.testing.assert_allclose(
        jitted(s * x, s * y, s * s * v),
        jitted(x, y, v) * s,
        rtol=2e-5,
        atol=2e-7 * scale,
    )


@pytest.mark.parametrize("bad", [np.nan, np.inf])
@pytest.mark.parametrize("image", [0, 1, 2])
def test_a_bad_pixel_stays_local(combine, images, image, bad):
    """Nothing but finite pixels, and beyond the windows not a bit is changed."""
    poisoned = list(images)
    poisoned[image] = images[image].at[20, 30, 0].set(bad)
    jitted = jax.jit(combine)
    out, clean = jitted(*poisoned), jitted(*images)
    assert np.isfinite(out).all()
    reach = 20  # windows of a window, and pooling before them
    rows, columns = np.ogrid[:64, :64]
    far = (abs(rows - 20) > reach) | (abs(columns - 30) > reach)
    np.testing.assert_array_equal(out[far], clean[far])
    total = lambda *i: combine(*i).sum()
    gradients = jax.jit(jax.grad(total, argnums=(0, 1, 2)))(*poisoned)
    assert all(np.isfinite(g).all() for g in gradients)


@pytest.mark.parametrize("size", [(1, 1), (1, 9), (9, 1), (4, 5)])
def test_any_size(combine, images, size):
    """Also an image smaller than the window."""
    h, w = size
    out = jax.jit(combine)(*(i[30 : 30 + h, 30 : 30 + w] for i in images))
    assert out.shape == (h, w, 3)
    assert np.isfinite(out).all()
