"""Frames: what is stored, what is derived, what is refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jscomb.frame import (
    Estimate,
    Needs,
    Package,
    Reference,
    halves_possible,
    make_frame,
    with_halves,
)
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


def test_variance_of_one_channel_is_that_of_each():
    x, v = random(0, 2, *SHAPE), random(1, *SHAPE[:2], 1)
    for variance in (v, np.stack([2 * v, 2 * v])):
        found = make_frame(x, variance=variance).variance
        np.testing.assert_allclose(found, np.broadcast_to(v, SHAPE))


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
    units = jax.vmap(lambda f: f.median_luminance)(stack)
    np.testing.assert_allclose(units[1], 2 * units[0])
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


def test_valid_sees_halves_of_estimates(frame):
    halves = frame.estimates["smooth"].halves.at[1, 0, 0, 0].set(jnp.nan)
    assert not frame.with_estimate("x", Estimate(frame.color, halves)).valid[0, 0, 0]


def test_median_luminance_is_robust():
    image = random(0, 9, 9, 3) + 1
    clean = make_frame(image).median_luminance
    ugly = image.at[0, 0].set(1e6).at[1, 1].set(jnp.nan).at[2, 2].set(jnp.inf)
    np.testing.assert_allclose(make_frame(ugly).median_luminance, clean, rtol=0.05)
    black = image.at[:, :5].set(0)
    assert 0.7 < make_frame(black).median_luminance / clean < 1.4
    assert make_frame(jnp.zeros(SHAPE)).median_luminance == 1
    dark = make_frame(1e-8 * image).median_luminance
    np.testing.assert_allclose(dark, 1e-8 * clean)


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
        ({"variance": np.ones((4, 5, 2))}, "variance has shape"),
        ({"color": np.ones((7, 2, *SHAPE))}, "for a batch of frames map make_frame by"),
        ({"albedo": np.ones((4, 6, 3))}, r"albedo has shape .*\(2, 4, 5, 3\)"),
        ({"depth": np.ones(SHAPE)}, r"depth has shape .*\(1, 4, 5, 1\) or"),
        ({"estimates": {"nlm": np.ones((4, 5, 1))}}, "estimate 'nlm' has shape"),
        (
            {"estimates": {"nlm": Estimate(jnp.ones(SHAPE), jnp.ones(SHAPE))}},
            "the halves of estimate 'nlm' has shape",
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


def test_normalised_frames_share_one_unit(frame):
    """All radiance is divided, variances by the square, and halves share the unit."""
    inside = frame.normalised()
    unit = frame.median_luminance
    np.testing.assert_allclose(inside.median_luminance, 1)
    np.testing.assert_allclose(inside.color * inside.unit, frame.color)
    np.testing.assert_allclose(inside.variance * unit**2, frame.variance)
    y = inside.estimates["smooth"].scaled(unit)
    np.testing.assert_allclose(y.halves, frame.estimates["smooth"].halves)
    np.testing.assert_allclose(
        inside.reference.half_difference * unit, frame.reference.half_difference
    )
    np.testing.assert_array_equal(inside.albedo, frame.albedo)
    assert all(half.unit == inside.unit for half in inside.halves())
    assert inside.normalised() is inside
    assert inside.scaled(2.0).unit is None
    assert frame.normalised(0.25).unit == 0.25
    with pytest.raises(ValueError, match="normalised already"):
        inside.normalised(2.0)
    for extreme in (1e-8, 1e6):
        tiny = frame.scaled(extreme).normalised()
        np.testing.assert_allclose(tiny.variance, inside.variance, rtol=1e-6)


@pytest.mark.parametrize(
    ("needs", "sub_buffers", "variance", "missing", "of_halves"),
    [
        (Needs(), 1, False, "", "half buffers: render at least 2 sub-buffers (this"),
        (Needs(variance=True), 1, True, "", "half buffers: render at least 2 sub"),
        (
            Needs(variance=True),
            1,
            False,
            "the variance: render with variances, or",
            "4",
        ),
        (Needs(variance=True), 2, False, "", "the variance: render with variances, o"),
        (Needs(variance=True), 4, False, "", ""),
        (Needs(halves=True), 1, True, "half buffers: render at least 2 sub-b", "4"),
        (Needs(halves=True), 2, False, "", "at least 4 sub-buffers (this frame has 2)"),
        (
            Needs(variance=True, halves=True),
            2,
            False,
            "",
            "with variances, or at least",
        ),
        (Needs(variance_of_halves=True), 2, False, "at least 4 sub-buffers", "8"),
        (Needs(variance_of_halves=True), 2, True, "", "at least 4"),
        (Needs(variance_of_halves=True), 4, False, "", "8 sub-buffers (this frame has"),
        (Needs(channels=1), 2, False, "1 channels of colour, not 3", "1 channels"),
        (Needs(features=("depth",)), 2, False, "depth: render with these fe", "depth"),
        (
            Needs(normalised=True),
            2,
            False,
            "a normalised frame: call frame.n",
            "a norm",
        ),
        (
            Needs(package=Package("no_such_module", "magic")),
            2,
            False,
            'the package no_such_module: pip install "jscomb[magic]"',
            "the package",
        ),
    ],
)
def test_what_a_frame_lacks_is_said_in_one_line(
    needs, sub_buffers, variance, missing, of_halves
):
    color = jnp.ones((sub_buffers, *SHAPE))
    frame = make_frame(color, variance=color if variance else None)
    for found, expected in (
        (needs.missing(frame), missing),
        (needs.missing_for_halves(frame), of_halves),
    ):
        assert expected in found
        assert bool(found) == bool(expected)
        assert "\n" not in found
    if missing:
        kind = ImportError if needs.package else ValueError
        with pytest.raises(kind, match=r"^magic needs "):
            frame.require("magic", needs)
    else:
        frame.require("magic", needs)


def test_halves_are_made_of_what_a_half_has(frame):
    """Estimates pass theirs on, makers are run again; otherwise there are none."""
    add = lambda part, y: part.color + y.image
    y = frame.estimates["smooth"]
    given = with_halves(frame, add, y)
    a, b = frame.halves()
    np.testing.assert_allclose(given.halves[0], a.color + y.halves[0])
    maker = lambda part: with_halves(part, lambda half: 3 * half.color)
    made = with_halves(frame, add, maker)
    np.testing.assert_allclose(made.halves[1], 4 * b.color)
    assert with_halves(frame, add, Estimate(frame.color)).halves is None
    assert with_halves(frame.merged(1), add, maker).halves is None
    needs = Needs(halves=True)
    of_halves = lambda part, y: jnp.mean(y.halves, axis=0)
    assert with_halves(frame, of_halves, y, needs=needs).halves is None
    assert with_halves(frame, of_halves, maker, needs=needs).halves is not None
    assert not halves_possible(frame, y, needs=needs)
    # A maker that itself needs halves has none of them for a quarter.
    twice = lambda part: with_halves(part, of_halves, maker, needs=needs)
    assert with_halves(frame, of_halves, twice, needs=needs).halves is None
