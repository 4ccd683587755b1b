"""Open Image Denoise behind its guard: real filter, real frames, ugly pixels."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jscomb import metrics
from jscomb.denoisers import oidn
from jscomb.frame import make_frame
from jscomb.metrics import rel_l2
from jscomb.numerics import sure


@pytest.fixture(scope="module")
def denoised(glass_frame):
    return oidn.denoise_frame(glass_frame)


def test_lowers_the_error_of_frame_and_halves(glass_frame, denoised):
    frame, reference = glass_frame, glass_frame.reference.image
    error = metrics.rel_l2
    assert error(denoised.image, reference) < 0.3 * error(frame.color, reference)
    for half, image in zip(frame.halves(), denoised.halves, strict=True):
        assert error(image, reference) < 0.3 * error(half.color, reference)


def test_features_are_used(glass_frame, denoised):
    """Each changes the result; that it gets better is not promised."""
    without = oidn.denoise_frame(glass_frame, features=False).image
    only_albedo = oidn.denoise(glass_frame.color, albedo=glass_frame.albedo)
    assert jnp.abs(only_albedo - without).max() > 1e-3
    assert jnp.abs(denoised.image - only_albedo).max() > 1e-3


def test_frame_without_sub_buffers(glass_frame):
    plain = make_frame(glass_frame.color)
    assert oidn.denoise_frame(plain).halves is None


@pytest.mark.parametrize("scale", [1e-8, 1e-4, 1e6])
def test_scale_equivariant(glass_frame, denoised, scale):
    """The bare filter is not, at radiance 1e-8."""
    scaled = oidn.denoise_frame(glass_frame.scaled(jnp.float32(scale)))
    np.testing.assert_allclose(scaled.image, scale * denoised.image, rtol=1e-3)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_bad_pixel_stays_local(glass_frame, denoised, bad):
    """The bare filter spreads an infinite pixel over a third of the image."""
    color = glass_frame.color.at[30, 30, 0].set(bad)
    image = oidn.denoise(
        color,
        albedo=glass_frame.albedo,
        normal=glass_frame.normal,
        exposure=glass_frame.median_luminance,
    )
    assert np.isfinite(image).all()
    far = np.ones((64, 64), bool)
    far[20:41, 20:41] = False
    np.testing.assert_allclose(image[far], denoised.image[far], rtol=0.1, atol=1e-3)


def test_nothing_finite_and_nothing_lit(glass_frame):
    black = jnp.zeros_like(glass_frame.color)
    for image in (black, black * jnp.nan):
        np.testing.assert_allclose(oidn.denoise(image), 0, atol=1e-4)


def test_holes_are_filled_from_near_to_far():
    image = jnp.ones((9, 9, 3)).at[:, 5:].set(3.0).at[2:7, 2:7].set(jnp.nan)
    filled = oidn._fill(image)
    assert ((filled >= 1) & (filled <= 3)).all()
    np.testing.assert_allclose(filled[3, 2], 1)
    np.testing.assert_allclose(filled[3, 6], 3)


def test_rejects_bad_input(glass_frame, monkeypatch):
    color = glass_frame.color
    with pytest.raises(ValueError, match=r"color must have shape \[H,W,3\]"):
        oidn.denoise(color[..., :1])
    with pytest.raises(ValueError, match="albedo has shape"):
        oidn.denoise(color, albedo=color[1:])
    with pytest.raises(ValueError, match="normal needs albedo"):
        oidn.denoise(color, normal=color)
    monkeypatch.setattr(oidn, "available", lambda: False)
    with pytest.raises(ImportError, match=r'pip install "jscomb\[oidn\]"'):
        oidn.denoise(color)


def test_it_is_a_jax_function(glass_frame, denoised):
    """Compiled, mapped, and with a forward derivative that is linear."""
    frame = glass_frame
    run = lambda x: oidn.denoise(
        x, albedo=frame.albedo, normal=frame.normal, exposure=frame.median_luminance
    )
    x = frame.color
    # Compiled, x / exposure is a product; the filter computes in half floats.
    np.testing.assert_allclose(jax.jit(run)(x), denoised.image, rtol=2e-5)
    both = jax.jit(jax.vmap(run))(jnp.stack([x, x[::-1]]))
    np.testing.assert_allclose(both[0], denoised.image, rtol=2e-5)
    derivative = jax.jit(lambda x, t: jax.jvp(run, (x,), (t,)))
    y, moved = derivative(x, x)
    np.testing.assert_allclose(y, denoised.image, rtol=2e-5)
    # Scaling the image scales the result, but for the filter's own nonlinearity.
    assert rel_l2(moved, y) < 0.05
    for scale in (1e-4, 1e4):
        _, other = derivative(x, scale * x)
        np.testing.assert_allclose(other / scale, moved, rtol=0.02, atol=2e-3)


def test_sure_of_it_is_that_of_the_frame(glass_frame):
    """The mean estimate is the mean error, to a few percent, without a reference."""
    frame = glass_frame.scaled(1 / glass_frame.median_luminance)
    r, noise = frame.reference
    run = lambda x: oidn.denoise(x, albedo=frame.albedo, normal=frame.normal)
    risk = sure.monte_carlo_sure(
        jax.random.key(0), run, frame.color, frame.variance, probes=2
    )
    weight = 1 / (jnp.mean(r, axis=-1, keepdims=True) ** 2 + 1)
    mean = lambda square: float(jnp.mean(weight * square))
    truth = mean((risk.denoised - r) ** 2 - noise**2 / 4)
    assert 0.9 * truth < mean(risk.squared_error) < 1.1 * truth
