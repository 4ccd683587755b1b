"""Frames: what is stored, what is derived, what is refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jscomb.frame import Estimate, Reference, make_frame
from tests.statistics import assert_mean

SHAPE = (4, 5, 3)


def random(seed, *shape):
    return jax.random.uniform(jax.random.key(seed), shape)


@pytest.fixture
def frame():
    """Four sub-buffers with everything."""
    return make_frame(
        random(0, 4, *SHAPE),
        variance=random(1, 4, *SHAPE),
        albedo=random(2, 4, *SHAPE),
        normal=random(3, *SHAPE),
        depth=random(4, 4, 4, 5, 1),
        visibility=random(5, 4, 4, 5, 1),
        samples=64,
        estimates={"smooth": Estimate(random(6, *SHAPE), random(7, 2, *SHAPE))},
        reference=Reference(random(8, *SHAPE), random(9, *SHAPE)),
    )


def test_full_images_are_derived(frame):
    b = frame.buffers
    np.testing.assert_allclose(frame.color, np.mean(b.color, 0))
    np.testing.assert_allclose(frame.variance, np.sum(b.variance, 0) / 16)
    np.testing.assert_allclose(frame.depth, np.mean(b.depth, 0))
    np.testing.assert_array_equal(frame.normal, b.normal[0])


def test_halves_are_frames_with_halves(frame):
    a, b = frame.halves()
    np.testing.assert_allclose((a.color + b.color) / 2, frame.color)
    np.testing.assert_allclose((a.variance + b.variance) / 4, frame.variance)
    np.testing.assert_allclose((a.albedo + b.albedo) / 2, frame.albedo)
    np.testing.assert_array_equal(a.normal, b.normal)
    stored = frame.estimates["smooth"].halves
    np.testing.assert_array_equal(b.estimates["smooth"].image, stored[1])
    assert (a.samples, a.sub_buffers, a.reference) == (32, 2, None)
    aa, ab = a.halves()
    np.testing.assert_allclose(aa.color, frame.buffers.color[0])
    np.testing.assert_allclose(ab.color, frame.buffers.color[1])
    with pytest.raises(ValueError, match="no sub-buffers"):
        aa.halves()


def test_merged_keeps_the_full_images(frame):
    merged = frame.merged(2)
    assert merged.sub_buffers == 2
    for name in ("color", "variance", "albedo", "normal", "depth"):
        np.testing.assert_allclose(getattr(merged, name), getattr(frame, name))
    np.testing.assert_allclose(merged.halves()[0].color, frame.halves()[0].color)
    np.testing.assert_allclose(merged.halves()[1].variance, frame.halves()[1].variance)
    with pytest.raises(ValueError, match="cannot be merged into 3"):
        frame.merged(3)
    with pytest.raises(ValueError, match="cannot be merged into 0"):
        frame.merged(0)


def test_variance_of_the_mean_from_single_image_or_spread():
    x, v = random(0, 2, *SHAPE), random(1, *SHAPE)
    np.testing.assert_allclose(make_frame(x, variance=v).variance, v)
    half = make_frame(x, variance=v).halves()[0]
    np.testing.assert_allclose(half.variance, 2 * v)
    np.testing.assert_allclose(make_frame(x).variance, (x[0] - x[1]) ** 2 / 4)
    with pytest.raises(ValueError, match="neither variance nor sub-buffers"):
        _ = make_frame(x[0]).variance


@pytest.mark.parametrize("k", [2, 4])
def test_variance_from_the_spread_is_unbiased(k):
    noise = 0.3 * jax.random.normal(jax.random.key(0), (2000, k, 3, 3, 1))
    v = jax.vmap(lambda c: make_frame(c).variance)(noise)
    assert_mean(v.mean((1, 2, 3)), 0.09 / k)


def test_is_a_pytree(frame):
    doubled = jax.jit(lambda f: f.scaled(2.0))(frame)
    np.testing.assert_allclose(doubled.color, 2 * frame.color)
    np.testing.assert_allclose(doubled.variance, 4 * frame.variance)
    np.testing.assert_allclose(doubled.reference.image, 2 * frame.reference.image)
    np.testing.assert_array_equal(doubled.depth, frame.depth)
    stack = jax.tree.map(lambda *i: jnp.stack(i), frame, doubled)
    exposures = jax.vmap(lambda f: f.median_luminance)(stack)
    np.testing.assert_allclose(exposures[1], 2 * exposures[0])
    gradient = jax.grad(lambda f: f.color.sum())(frame)
    np.testing.assert_allclose(gradient.buffers.color, 0.25)


def test_nothing_is_mutable(frame):
    with pytest.raises(AttributeError):
        frame.samples = 3
    assert "new" in frame.with_estimate("new", frame.color).estimates
    assert "new" not in frame.estimates


@pytest.mark.parametrize("buffer", ["color", "variance", "albedo", "depth"])
def test_valid_sees_every_sub_buffer(frame, buffer):
    assert frame.valid.all()
    stored = getattr(frame.buffers, buffer).at[3, 1, 2, 0].set(jnp.inf)
    bad = frame._replace(buffers=frame.buffers._replace(**{buffer: stored}))
    assert not bad.valid[1, 2, 0]
    assert bad.valid.sum() == frame.valid.size - 1


def test_valid_sees_halves_of_biased_images(frame):
    halves = frame.estimates["smooth"].halves.at[1, 0, 0, 0].set(jnp.nan)
    assert not frame.with_estimate("x", Estimate(frame.color, halves)).valid[0, 0, 0]


def test_exposure_is_robust():
    image = random(0, 9, 9, 3) + 1
    clean = make_frame(image).exposure
    ugly = image.at[0, 0].set(1e6).at[1, 1].set(jnp.nan).at[2, 2].set(jnp.inf)
    np.testing.assert_allclose(make_frame(ugly).exposure, clean, rtol=0.05)
    black = image.at[:, :5].set(0)
    assert 0.7 < make_frame(black).exposure / clean < 1.4
    assert make_frame(jnp.zeros(SHAPE)).exposure == 1
    np.testing.assert_allclose(make_frame(1e-8 * image).exposure, 1e-8 * clean)


def test_plain_image_is_a_frame():
    plain = make_frame(np.ones(SHAPE, np.float32))
    assert plain.sub_buffers == 1
    assert plain.samples is None
    assert plain.albedo is None


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        ({"color": np.ones((4, 5))}, r"color must have shape .* got \(4, 5\)"),
        ({"color": np.ones((0, 5, 3))}, "at least one pixel"),
        ({"color": np.ones((3, *SHAPE))}, "even number of sub-buffers, got 3"),
        ({"variance": np.ones((4, 4, 5, 3))}, r"variance has shape \(4, 4, 5, 3\)"),
        ({"variance": np.ones((4, 5, 1))}, "variance has shape"),
        ({"albedo": np.ones((4, 6, 3))}, r"albedo has shape .*\(2, 4, 5, 3\)"),
        ({"depth": np.ones(SHAPE)}, r"depth has shape .*\(1, 4, 5, 1\) or"),
        ({"biased": {"nlm": np.ones((4, 5, 1))}}, "biased image 'nlm' has shape"),
        (
            {"biased": {"nlm": Estimate(jnp.ones(SHAPE), jnp.ones(SHAPE))}},
            "biased image 'nlm' of halves has shape",
        ),
        ({"samples": -3}, "samples must be positive, got -3"),
        ({"reference": np.ones((5, 4, 3))}, "reference has shape"),
        (
            {"reference": Reference(jnp.ones(SHAPE), jnp.ones((4, 5, 1)))},
            "half_difference has shape",
        ),
    ],
)
def test_errors_name_the_buffer(bad, message):
    arguments = {"color": np.ones((2, *SHAPE))} | bad
    color = arguments.pop("color")
    with pytest.raises(ValueError, match=message):
        make_frame(color, **arguments)
