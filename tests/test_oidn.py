"""Open Image Denoise behind its guard: real filter, real frames, ugly pixels."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jscomb import metrics
from jscomb.denoisers import oidn
from jscomb.frame import Package, make_frame
from jscomb.metrics import rel_l2
from jscomb.numerics import sure


@pytest.fixture(scope="module")
def frame(glass_frame):
    """The crop, normalised."""
    return glass_frame.normalised()


@pytest.fixture(scope="module")
def denoised(frame):
    return oidn.denoise_frame(frame)


def test_lowers_the_error_of_frame_and_halves(glass_frame, frame, denoised):
    reference, error = glass_frame.reference.image, metrics.rel_l2
    made = denoised.scaled(frame.unit)
    assert error(made.image, reference) < 0.3 * error(glass_frame.color, reference)
    for half, image in zip(glass_frame.halves(), made.halves, strict=True):
        assert error(image, reference) < 0.3 * error(half.color, reference)


def test_features_are_used(frame, denoised):
    """Each changes the result; that it gets better is not promised."""
    without = oidn.denoise_frame(frame, features=False).image
    only_albedo = oidn.denoise(frame.color, albedo=frame.albedo)
    assert jnp.abs(only_albedo - without).max() > 1e-3
    assert jnp.abs(denoised.image - only_albedo).max() > 1e-3


def test_frame_without_sub_buffers(frame):
    plain = make_frame(frame.color).normalised()
    assert oidn.denoise_frame(plain).halves is None


def test_another_colour_of_a_frame(frame, denoised):
    """It is denoised with the frame's features, in the frame's unit."""
    made = oidn.denoise_color(frame.color, frame)
    np.testing.assert_array_equal(made, denoised.image)
    without = oidn.denoise_color(frame.color, frame, features=False)
    np.testing.assert_array_equal(without, oidn.denoise_normalised(frame.color))
    # The unit is the frame's: a brighter colour comes out brighter.
    np.testing.assert_allclose(
        oidn.denoise_color(2 * frame.color, frame).mean(), 2 * made.mean(), rtol=0.01
    )


@pytest.mark.parametrize("scale", [1e-8, 1e-4, 1e6])
def test_scale_equivariant(frame, denoised, scale):
    """The bare filter is not, at radiance 1e-8."""
    scaled = frame.scaled(jnp.float32(scale)).normalised()
    image = oidn.denoise_frame(scaled).scaled(scaled.unit).image
    np.testing.assert_allclose(image, scale * denoised.image, rtol=1e-3)
    features = {"albedo": frame.albedo, "normal": frame.normal}
    image = oidn.denoise(jnp.float32(scale) * frame.color, **features)
    np.testing.assert_allclose(image, scale * denoised.image, rtol=1e-3)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_bad_pixel_stays_local(frame, denoised, bad):
    """The bare filter spreads an infinite pixel over a third of the image."""
    color = frame.color.at[30, 30, 0].set(bad)
    image = oidn.denoise_color(color, frame)
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
    with pytest.raises(ValueError, match="oidn needs a normalised frame"):
        oidn.denoise_frame(glass_frame)
    grey = make_frame(color[..., :1]).normalised()
    with pytest.raises(ValueError, match="oidn needs 3 channels of colour, not 1"):
        oidn.denoise_frame(grey)
    missing = oidn.NEEDS._replace(package=Package("not_installed", "oidn"))
    monkeypatch.setattr(oidn, "NEEDS", missing)
    assert not oidn.available()
    for denoise in (
        lambda: oidn.denoise(color),
        lambda: oidn.denoise_frame(glass_frame.normalised()),
    ):
        with pytest.raises(ImportError, match=r'pip install "jscomb\[oidn\]"'):
            denoise()


def test_it_is_a_jax_function(frame, denoised):
    """Compiled, mapped, and with a forward derivative that is linear."""
    run = lambda x: oidn.denoise_color(x, frame)
    x = frame.color
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


def test_sure_of_it_is_that_of_the_frame(frame):
    """The mean estimate is the mean error, to a few percent, without a reference."""
    r, noise = frame.reference
    run = lambda x: oidn.denoise_color(x, frame)
    risk = sure.monte_carlo_sure(
        jax.random.key(0), run, frame.color, frame.variance, probes=2
    )
    weight = 1 / (jnp.mean(r, axis=-1, keepdims=True) ** 2 + 1)
    mean = lambda square: float(jnp.mean(weight * square))
    truth = mean((risk.denoised - r) ** 2 - noise**2 / 4)
    assert 0.9 * truth < mean(risk.squared_error) < 1.1 * truth
