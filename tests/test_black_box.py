"""Denoisers on the host: estimates, halves, derivatives and SURE of any function."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import ndimage

from jscomb import denoisers, james_stein, progressive
from jscomb.frame import make_frame
from jscomb.numerics import sure
from jscomb.numerics.windows import window_mean
from tests.statistics import assert_mean

SIGMA = 0.3


def blur(color):
    """A mean over 3x3 pixels that are mirrored at the border."""
    return ndimage.uniform_filter(color, (3, 3, 0), mode="mirror")


def curve(color):
    """A denoiser with a curve: of the logarithm."""
    return np.exp(blur(np.log(np.maximum(color, 1e-3))))


def pair(rng, size=24):
    """Two noisy sub-buffers of a flat image."""
    return 1 + SIGMA * 2**0.5 * rng.normal(size=(2, size, size, 3))


@pytest.fixture
def frame(rng):
    noisy = pair(rng)
    return make_frame(noisy, variance=np.full_like(noisy, 2 * SIGMA**2))


def test_makes_an_estimate_with_halves(frame):
    made = denoisers.black_box(curve)(frame)
    np.testing.assert_allclose(made.image, curve(np.asarray(frame.color)))
    for half, image in zip(frame.halves(), made.halves, strict=True):
        np.testing.assert_allclose(image, curve(np.asarray(half.color)))
    combined = james_stein.combine_frame(frame, made)
    assert combined.image.std() < 0.5 * frame.color.std()


def test_is_given_the_guides_it_names(glass_frame):
    seen = []

    def guided(color, *, albedo, variance):
        seen.append((albedo.copy(), variance.copy()))
        color[...] = albedo[...] = 0  # its own arrays: nothing else changes
        return color + 1

    made = denoisers.black_box(guided, guides=("albedo", "variance"))(glass_frame)
    assert (made.image == 1).all()
    parts = (glass_frame, *glass_frame.halves())
    for (albedo, variance), part in zip(seen, parts, strict=True):
        np.testing.assert_array_equal(albedo, part.albedo)
        np.testing.assert_array_equal(variance, part.variance)
    assert float(jnp.max(glass_frame.albedo)) > 0


class Tensor:
    """What a torch tensor has that NumPy cannot take by itself."""

    def __init__(self, values):
        self.values = values

    def detach(self):
        """Return it without its history."""
        return self

    def cpu(self):
        """Return it where NumPy can read it."""
        return self.values


def test_takes_tensors_back(frame):
    box = denoisers.black_box(lambda color: Tensor(blur(color)))
    np.testing.assert_allclose(box(frame).image, blur(np.asarray(frame.color)))


@pytest.mark.parametrize("scale", [1e-8, 1.0, 1e6])
def test_derivative_is_the_true_one(rng, scale):
    """In float32, of a linear denoiser, whatever the radiance and the noise."""
    x = jnp.asarray(scale * rng.uniform(0.5, 1.5, (12, 9, 3)), jnp.float32)
    frame, box = make_frame(x), denoisers.black_box(blur)
    for noise in (1e-6, 1e-3, 1.0):
        b = scale * noise * jnp.asarray(rng.normal(size=x.shape), jnp.float32)
        _, moved = jax.jvp(lambda x: box.denoise(x, frame), (x,), (b,))
        true = blur(np.asarray(b))
        np.testing.assert_allclose(moved, true, atol=2e-3 * np.abs(true).max())
    _, moved = jax.jvp(lambda x: box.denoise(x, frame), (x,), (0 * x,))
    assert (moved == 0).all()


@pytest.mark.slow
def test_sure_is_unbiased():
    """Of a curved denoiser, over many frames, by its standard errors."""
    box = denoisers.black_box(lambda color: blur(color) ** 2 / 1.2)

    def excess(seed):
        x = jnp.asarray(
            1 + SIGMA * np.random.default_rng(seed).normal(size=(16, 16, 1))
        )
        frame, key = make_frame(x), jax.random.key(seed)
        v = jnp.full_like(x, SIGMA**2)
        risk = sure.monte_carlo_sure(key, lambda x: box.denoise(x, frame), x, v)
        return float(jnp.mean(risk.squared_error - jnp.square(risk.denoised - 1)))

    assert_mean(np.array([excess(seed) for seed in range(200)]), 0.0)


def test_jit_and_vmap_are_loops(frame):
    """One image at a time, as a denoiser of its own expects."""
    sizes = []

    def noting(color):
        sizes.append(color.shape)
        return curve(color)

    box = denoisers.black_box(noting)
    x = jnp.stack([frame.color, 2 * frame.color])
    one = lambda x: jax.jvp(lambda x: box.denoise(x, frame), (x,), (x,))
    for batch in (jax.vmap(one)(x), jax.jit(jax.vmap(one))(x)):
        for number, each in enumerate(x):
            for got, expected in zip(batch, one(each), strict=True):
                np.testing.assert_allclose(got[number], expected, rtol=1e-9)
    assert set(sizes) == {(24, 24, 3)}


def test_progressive_takes_it(frame):
    box = denoisers.black_box(blur)
    key, normalised = jax.random.key(0), frame.normalised()
    ours = lambda color, _: jnp.asarray(window_mean(color, 3))
    found, expected = (
        progressive.combine_frame(key, denoise, normalised).image
        for denoise in (box.denoise, ours)
    )
    inner = np.s_[4:-4, 4:-4]
    np.testing.assert_allclose(found[inner], expected[inner], rtol=0.02)


@pytest.mark.parametrize("size", [(1, 1), (1, 7), (9, 8)])
def test_hard_images(rng, size):
    x = rng.uniform(0, 1, (2, *size, 3)).astype("float32")
    x[:, 0, 0] = np.nan
    x[0, -1, -1, 0] = np.inf if size != (1, 1) else np.nan
    made = denoisers.black_box(blur)(make_frame(x))
    assert np.isfinite(made.image).all()
    assert np.isfinite(made.halves).all()
    failing = denoisers.black_box(lambda color: color * np.nan)(make_frame(x))
    assert np.isfinite(failing.image).all()


def test_bad_input_is_said(frame):
    make = denoisers.black_box
    with pytest.raises(ValueError, match="no guide 'motion': there are albedo"):
        make(blur, guides=("motion",))
    with pytest.raises(ValueError, match="step must be positive, got 0"):
        make(blur, step=0.0)
    with pytest.raises(ValueError, match="this black box needs albedo"):
        make(blur, guides=("albedo",))(frame)
    with pytest.raises(ValueError, match=r"made \(23, 24, 3\) of an image of"):
        make(lambda color: color[1:])(frame)
    box = make(blur)
    with pytest.raises(ValueError, match="do not support transpose"):
        jax.grad(lambda x: jnp.sum(box.denoise(x, frame)))(frame.color)
