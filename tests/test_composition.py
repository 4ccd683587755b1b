"""Estimates compose: a combiner's result goes wherever a denoiser's goes."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from jscomb import double_shrinkage, ensemble, james_stein, methods, progressive
from jscomb.denoisers import bilateral, oidn, smoothing
from jscomb.frame import Estimate, make_frame

key = lambda: jax.random.key(0)
needs_oidn = pytest.mark.skipif(not oidn.available(), reason="needs Open Image Denoise")


@pytest.fixture(scope="module")
def frame():
    """Four sub-buffers with variances and features; three estimates with halves.

    The third is like a photon map: blurred, with noise of its own.
    """
    rng = np.random.default_rng(5)
    y, x = np.mgrid[0:24, 0:20] / 10
    truth = (1 + 0.5 * np.sin(5 * x) * np.cos(3 * y))[..., None] * np.ones(3)
    deviation = 0.4 * truth
    color = truth + deviation * rng.normal(size=(4, *truth.shape))
    made = make_frame(
        color,
        variance=np.broadcast_to(deviation**2, color.shape),
        depth=x[..., None],
        samples=64,
    )
    halves = [half.color for half in made.halves()]
    blur = jax.jit(functools.partial(smoothing.gaussian, sigma=1.0))
    photons = [blur(truth) + 0.02 * rng.normal(size=truth.shape) for _ in range(2)]
    return (
        made.with_estimate(
            "blurred", Estimate(blur(made.color), jnp.stack([*map(blur, halves)]))
        )
        .with_estimate("bilateral", bilateral.denoise_frame(made, window=5))
        .with_estimate(
            "photons", Estimate(jnp.mean(jnp.stack(photons), 0), jnp.stack(photons))
        )
        .normalised()
    )


MAKERS = {
    "blurred": functools.partial(smoothing.denoise_frame, sigma=1.0),
    "bilateral": functools.partial(bilateral.denoise_frame, window=5),
}
multi_scale = jax.jit(
    functools.partial(ensemble.solve_weights, solver="multi-scale", windows=(7, 11))
)
mix = functools.partial(ensemble.combine_frame, windows=(7, 11))


def by_hand(frame, estimates):
    """An ensemble's image and halves with the weights of the full frame."""
    full, a, b = (
        jnp.stack([pick(e) for e in estimates.values()])
        for pick in (
            lambda e: e.image,
            lambda e: e.halves[0],
            lambda e: e.halves[1],
        )
    )
    first, second = frame.halves()
    weights = multi_scale(
        *(a, b, first.color, second.color),
        variance_a=first.variance,
        variance_b=second.variance,
    )
    return [jnp.sum(weights * bases, axis=0) for bases in (full, a, b)]


@jax.jit
def whitened(color, biased, variance):
    """James-Stein as frames are combined."""
    v = james_stein.robust_variance(variance)
    return james_stein.combine(color, biased, v, window=7, whiten=True)


def assert_same(estimate, image, *halves):
    np.testing.assert_allclose(estimate.image, image, rtol=1e-9, atol=1e-12)
    for own, expected in zip(estimate.halves, halves, strict=True):
        np.testing.assert_allclose(own, expected, rtol=1e-9, atol=1e-12)


def test_james_stein_of_an_ensemble(frame):
    made = james_stein.combine_frame(frame, mix(frame, frame.estimates))
    image, a, b = by_hand(frame, frame.estimates)
    first, second = frame.halves()
    assert_same(
        made,
        whitened(frame.color, image, frame.variance),
        whitened(first.color, a, first.variance),
        whitened(second.color, b, second.variance),
    )


def test_an_ensemble_with_a_combiner_among_its_bases(frame):
    shrunk = james_stein.combine_frame(frame, frame.estimates["blurred"])
    bases = {**frame.estimates, "shrunk": shrunk}
    assert_same(mix(frame, bases), *by_hand(frame, bases))


def test_double_shrinkage_of_an_ensemble(frame):
    """Made anew of each half, with quarters, the halves have errors of their own."""
    of_ensemble = lambda part: mix(part, MAKERS)
    shrink = functools.partial(double_shrinkage.combine_frame, window=11)
    made = shrink(frame, of_ensemble)
    alone = [shrink(half, of_ensemble(half)).image for half in frame.halves()]
    assert_same(made, shrink(frame, of_ensemble(frame)).image, *alone)
    given = shrink(frame, of_ensemble(frame))
    np.testing.assert_allclose(given.image, made.image, rtol=1e-9)
    assert given.halves is None


@pytest.mark.slow
@needs_oidn
def test_real_denoisers_and_networks_compose(glass_frame):
    """James-Stein on an ensemble of Open Image Denoise, PD and a blur, then DSC."""
    frame = jax.tree.map(
        lambda i: i[..., :40, :40, :] if i.ndim > 2 else i, glass_frame
    ).normalised()
    blurred = smoothing.denoise_frame(frame)
    pd = methods.combine(key(), frame, method="pd")
    bases = {"oidn": frame.estimates["oidn"], "pd": pd, "blurred": blurred}
    mixed = ensemble.combine_frame(frame, bases)
    shrunk = james_stein.combine_frame(frame, mixed)
    dsc = double_shrinkage.combine_frame(frame, shrunk)
    for estimate in (mixed, shrunk):
        assert estimate.halves.shape == (2, 40, 40, 3)
        assert np.isfinite(estimate.halves).all()
    assert np.isfinite(dsc.image).all()
    r = frame.reference.image
    error = lambda image: float(jnp.mean(jnp.square(image - r) / (r**2 + 0.01)))
    assert error(mixed.image) < 1.1 * min(error(e.image) for e in bases.values())
    named = methods.combine(
        key(),
        frame.with_estimate("mixed", mixed),
        method="dsc",
        biased="mixed",
    )
    assert np.isfinite(named.image).all()


def changed(frame, number):
    """The frame with other samples in one half."""
    k = frame.sub_buffers // 2
    here = slice(0, k) if number == 0 else slice(k, None)
    color = frame.buffers.color.at[here].multiply(1.5)
    return frame._replace(buffers=frame.buffers._replace(color=color))


MADE = {
    "whitened": lambda f: james_stein.combine_frame(f, MAKERS["blurred"]),
    "ensemble": lambda f: mix(f, MAKERS),
    "double shrinkage": lambda f: double_shrinkage.combine_frame(
        f, MAKERS["blurred"], window=11
    ),
    "progressive": lambda f: progressive.combine_frame(
        key(), lambda color, frame: smoothing.box(color, window=5), f
    ),
    "James-Stein of an ensemble": lambda f: james_stein.combine_frame(
        f, lambda part: mix(part, MAKERS)
    ),
}


@pytest.mark.parametrize("name", MADE)
def test_a_half_knows_nothing_of_the_other(name, frame):
    """So it can be judged by it: other samples there do not change a bit of it."""
    before = MADE[name](frame).halves
    for number in (0, 1):
        after = MADE[name](changed(frame, number)).halves
        np.testing.assert_array_equal(after[1 - number], before[1 - number])
        assert np.abs(after[number] - before[number]).max() > 1e-3


def test_with_two_sub_buffers_an_ensemble_shares_its_weights(frame):
    two = frame.merged(2)
    made = mix(two, MAKERS)
    bases = {name: maker(two) for name, maker in MAKERS.items()}
    assert_same(made, *by_hand(two, bases))
    other = mix(changed(two, 0), MAKERS).halves[1]
    assert np.abs(other - made.halves[1]).max() > 1e-6


PURE = {
    "James-Stein": lambda f: james_stein.combine_frame(f, f.estimates["photons"]),
    "ensemble": lambda f: mix(f, f.estimates),
    "James-Stein of an ensemble": lambda f: james_stein.combine_frame(
        f, mix(f, f.estimates)
    ),
    "an ensemble of James-Stein": lambda f: mix(
        f, {"shrunk": PURE["James-Stein"](f), "blurred": f.estimates["blurred"]}
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", PURE)
def test_compositions_jit_vmap_and_differentiate(name, frame):
    compose = PURE[name]
    eager = compose(frame)
    jitted = jax.jit(compose)
    assert_same(jitted(frame), eager.image, *eager.halves)
    other = changed(frame, 0)
    both = jax.tree.map(lambda *leaves: jnp.stack(leaves), frame, other)
    mapped = jax.jit(jax.vmap(compose))(both)
    for number, each in enumerate((frame, other)):
        expected = jitted(each)
        np.testing.assert_allclose(mapped.image[number], expected.image, rtol=1e-8)
        np.testing.assert_allclose(mapped.halves[number], expected.halves, rtol=1e-8)

    @jax.jit
    def loss(step):
        y = frame.estimates["photons"]
        moved = frame.with_estimate(
            "photons", jax.tree.map(lambda i: i + step * jnp.sin(7 * i), y)
        )
        estimate = compose(moved)
        return jnp.sum(jnp.square(estimate.image)) + jnp.sum(estimate.halves)

    # A small step: weights and shares have kinks.
    both = {"order": 1, "modes": ["fwd", "rev"]}
    check_grads(loss, (jnp.array(0.01),), **both, eps=1e-7, rtol=1e-4)


def test_gradients_stay_finite_at_corrupt_pixels(frame):
    """Fireflies, NaN and black pixels in one half."""
    color = frame.buffers.color
    color = color.at[0, 3, 4].set(1e6).at[1, 9, 2].set(jnp.nan).at[:, 12, 12].set(0.0)
    bad = frame._replace(buffers=frame.buffers._replace(color=color))
    compose = PURE["James-Stein of an ensemble"]

    def total(y):
        made = compose(bad.with_estimate("photons", y))
        return jnp.sum(made.image) + jnp.sum(made.halves)

    value, gradient = jax.jit(jax.value_and_grad(total))(bad.estimates["photons"])
    for leaf in jax.tree.leaves((value, gradient)):
        assert np.isfinite(leaf).all()


def test_bad_compositions_say_what_is_missing(frame):
    image = frame.estimates["blurred"].image
    with pytest.raises(ValueError, match="estimates with halves: 'flat' has none"):
        ensemble.combine_frame(frame, {"flat": Estimate(image)})
    with pytest.raises(ValueError, match="at least one estimate"):
        ensemble.combine_frame(frame, {})
    with pytest.raises(ValueError, match="double_shrinkage needs an estimate with h"):
        double_shrinkage.combine_frame(frame, Estimate(image))
    with pytest.raises(ValueError, match="ensemble needs half buffers: render at l"):
        ensemble.combine_frame(frame.merged(1), frame.estimates)
