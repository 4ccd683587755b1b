"""Large images by crops and on several devices: equal to the whole, to rounding."""

import subprocess
import sys

import hypothesis
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jscomb.numerics import tiles
from jscomb.numerics.windows import window_sum

RNG = np.random.default_rng(0)


def blocks(image):
    """Not local to a pixel but to blocks of four: their mean, everywhere in them."""
    h, w, c = image.shape
    padded = jnp.pad(image, [(0, -h % 4), (0, -w % 4), (0, 0)])
    mean = padded.reshape(padded.shape[0] // 4, 4, -1, 4, c).mean((1, 3))
    return jnp.repeat(jnp.repeat(mean, 4, 0), 4, 1)[:h, :w]


@hypothesis.settings(max_examples=15, derandomize=True, deadline=None)
@hypothesis.given(
    st.tuples(st.integers(1, 40), st.integers(1, 40)),
    st.integers(1, 30),
    st.sampled_from([3, 5, 9]),
)
def test_crops_are_the_whole(shape, tile, window):
    image = jnp.asarray(RNG.normal(size=(*shape, 2)))
    whole = window_sum(image, window)
    options = {"tile": tile, "halo": window // 2}
    local = lambda i: window_sum(i, window)
    np.testing.assert_allclose(
        tiles.map_crops(local, image, **options), whole, atol=1e-12
    )
    streamed = np.full_like(whole, np.nan)
    for where, part in tiles.stream_crops(local, image, **options):
        streamed[where] = part
    np.testing.assert_allclose(streamed, whole, atol=1e-12)


@hypothesis.settings(max_examples=10, derandomize=True, deadline=None)
@hypothesis.given(st.tuples(st.integers(1, 40), st.integers(1, 40)), st.integers(1, 30))
def test_crops_keep_to_blocks(shape, tile):
    image = jnp.asarray(RNG.normal(size=(*shape, 2)))
    made = tiles.map_crops(blocks, image, tile=tile, halo=4, multiple=4)
    np.testing.assert_allclose(made, blocks(image), atol=1e-12)
