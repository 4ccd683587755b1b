"""Filters of an ensemble's weights, and the selection of one base, from the paper."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jscomb import ensemble
from jscomb.ensemble import Filter
from tests.statistics import assert_mean

H, W, N, C = 8, 9, 2, 2


def gaussian_blur(image, sigma, reach):
    """Gaussian mean over the part of the window inside the image, by loops."""
    out = np.zeros_like(image)
    for r, c in np.ndindex(*image.shape[:2]):
        total, weight = 0, 0
        for i, j in np.ndindex(*image.shape[:2]):
            if max(abs(i - r), abs(j - c)) <= reach:
                k = np.exp(-((i - r) ** 2 + (j - c) ** 2) / (2 * sigma**2))
                total, weight = total + k * image[i, j], weight + k
        out[r, c] = total / weight
    return out


def oracle(w, z, v, albedo, normal, *, blur=0.0, clip=None, standardise=False, r=7):
    """ED eq. 32-34 by loops, with the constants of section 4.2; then the options."""
    if standardise:
        normal = (normal - normal.mean((0, 1))) / normal.std((0, 1))
    if blur:
        v = gaussian_blur(v, blur, round(2 * blur))
    out, near = np.zeros_like(w), {}
    for p in np.ndindex(H, W):
        total, weight, near[p] = 0, 0, []
        for q in np.ndindex(H, W):
            if max(abs(p[0] - q[0]), abs(p[1] - q[1])) > r:
                continue
            near[p].append(q)
            place = sum((a - b) ** 2 for a, b in zip(p, q, strict=True))
            distance = place / (2 * 3.0**2)
            distance += ((z[p] - z[q]) ** 2 / (v[p] + v[q])).sum() / (2 * 2.0**2)
            distance += ((albedo[p] - albedo[q]) ** 2).sum() / (2 * 0.25**2)
            distance += ((normal[p] - normal[q]) ** 2).sum() / (2 * 0.15**2)
            k = np.exp(-distance)
            total, weight = total + k * w[:, *q], weight + k
        out[:, *p] = total / weight
    if clip is None:
        return out
    limited = np.zeros_like(out)
    for p, pixels in near.items():
        around = np.stack([out[:, *q] for q in pixels])
        mean, spread = around.mean(0), around.std(0)
        limited[:, *p] = np.clip(out[:, *p], mean - clip * spread, mean + clip * spread)
    return limited / limited.sum(axis=0)


def images(rng):
    """Weights, z, its variance, albedo and normal."""
    w = np.moveaxis(rng.dirichlet(np.ones(N), (H, W, C)), -1, 0)
    z, v = rng.normal(1, 0.1, (H, W, C)), rng.uniform(0.005, 0.02, (H, W, C))
    return w, z, v, *rng.normal(0.5, 0.1, (2, H, W, 3))


@pytest.mark.parametrize(
    "options",
    [{}, {"blur": 2.0}, {"clip": 0.5}, {"standardise": True, "clip": 1.0, "blur": 1.0}],
)
def test_filter_is_the_loops(options, rng):
    w, z, v, albedo, normal = images(rng)
    expected = oracle(w, z, v, albedo, normal, **options)
    guides = {"albedo": jnp.asarray(albedo), "normal": jnp.asarray(normal)}
    given = map(jnp.asarray, (w, z, v))
    found = ensemble.filter_weights(*given, **guides, **options)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(found.sum(axis=0), 1, rtol=1e-9)


def test_filter_options_survive_bad_pixels(rng):
    """Bad pixels keep their weights; constant normals; finite gradients."""
    w, z, v, _, normal = map(jnp.asarray, images(rng))
    options = {"blur": 2.0, "clip": 1.0, "standardise": True}

    def run(w, v, normal):
        return ensemble.filter_weights(w, z, v, normal=normal, **options)

    bad = v.at[2, 3].set(jnp.nan), normal.at[5, 5].set(jnp.inf)
    for given in ((v, 0 * normal), (0 * v, normal), bad):
        assert np.isfinite(run(w, *given)).all()
        total = jax.jit(jax.grad(lambda w, *g: jnp.sum(jnp.sin(run(w, *g)))))
        assert np.isfinite(total(w, *given)).all()


def test_selection_errors_are_unbiased():
    """Of the image made from all samples, eq. 36, 37; here a blur and x itself."""
    rng, trials, noise = np.random.default_rng(0), 40_000, 0.4
    truth = jnp.asarray(rng.random((1, 5, 1)))
    kernel = jnp.asarray([0.25, 0.5, 0.25])
    smooth = lambda x: jnp.convolve(x[0, :, 0], kernel, "same").reshape(1, 5, 1)
    bases = lambda x: jnp.stack([smooth(x), x])

    def one(key):
        x = truth[None] + noise * jax.random.normal(key, (2, 1, 5, 1))
        y_a, y_b = bases(x[0]), bases(x[1])
        v = jnp.full_like(truth, noise**2)
        full = (y_a + y_b) / 2
        estimate = ensemble.selection_errors(y_a, y_b, x[0], x[1], v, v)
        return estimate - jnp.square(full - truth[None])

    found = jax.jit(jax.vmap(one))(jax.random.split(jax.random.key(0), trials))
    for at in np.ndindex(found.shape[1:]):
        assert_mean(found[:, *at], 0.0)


def test_selection_filtered_as_section_4_2_says(rng):
    """Guided by the selection itself and its halves' difference."""
    y_a, y_b = rng.normal(1, 0.1, (2, 3, H, W, C))
    x_a, x_b = rng.normal(1, 0.1, (2, H, W, C))
    v = np.full((H, W, C), 0.01)
    given = [jnp.asarray(i) for i in ((y_a + y_b) / 2, y_a, y_b, x_a, x_b)]
    errors = ((y_a - x_b) ** 2 + (y_b - x_a) ** 2) / 2 - v - (y_a - y_b) ** 2 / 4
    one = np.argmin(errors, axis=0)[None] == np.arange(3)[:, None, None, None]
    z, z_a, z_b = ((one * y).sum(0) for y in ((y_a + y_b) / 2, y_a, y_b))
    noise = (z_a - z_b) ** 2 / 2
    weights = ensemble.filter_weights(
        *map(jnp.asarray, (one * 1.0, z, noise)), blur=2.0
    )
    options = {"solver": "one-hot", "variance_a": jnp.asarray(v)}
    options |= {"variance_b": jnp.asarray(v)}
    plain = ensemble.combine(*given, **options)
    np.testing.assert_allclose(plain, z, rtol=1e-12)
    found = ensemble.combine(*given, **options, filter=Filter(blur=2.0))
    np.testing.assert_allclose(found, ensemble.average(given[0], weights), rtol=1e-9)


def test_selection_needs_variances():
    x = jnp.ones((2, 2, 1))
    y = jnp.stack([x, x])
    with pytest.raises(ValueError, match="one-hot solver needs variance_a and var"):
        ensemble.combine(y, y, y, x, x, solver="one-hot")
