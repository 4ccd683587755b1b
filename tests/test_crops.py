"""Large images by crops and on several devices: equal to the whole, to rounding."""

import functools
import os
import socket
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


def blocks(image):
    """The mean of each block of four by four pixels, everywhere in the block."""
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
    rng = np.random.default_rng(0)
    image = jnp.asarray(rng.normal(size=(*shape, 2)))
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
    rng = np.random.default_rng(0)
    image = jnp.asarray(rng.normal(size=(*shape, 2)))
    made = tiles.map_crops(blocks, image, tile=tile, halo=4, multiple=4)
    np.testing.assert_allclose(made, blocks(image), atol=1e-12)


def test_gradients_go_through_crops(rng):
    image = jnp.asarray(rng.normal(size=(9, 11, 1)))
    square = lambda f: lambda i: jnp.sum(jnp.square(f(i)))
    local = lambda i: window_sum(i, 5)
    by_crops = lambda i: tiles.map_crops(local, i, tile=4, halo=2)
    got = jax.jit(jax.grad(square(by_crops)))(image)
    np.testing.assert_allclose(got, jax.grad(square(local))(image), atol=1e-12)


def test_a_budget_is_kept():
    """By the compiled program of the tile, too."""
    image = jax.ShapeDtypeStruct((600, 500, 3), jnp.float32)
    local = lambda i: window_sum(jnp.square(i), 15)
    whole = tiles.tile_within(local, image, halo=7, budget=2**40)
    assert whole == 600
    budget = 2**20
    tile = tiles.tile_within(local, image, halo=7, budget=budget)
    assert 16 < tile < 600
    crop = jax.ShapeDtypeStruct((tile + 14, tile + 14, 3), jnp.float32)
    used = jax.jit(local).lower(crop).compile().memory_analysis()
    crop_bytes = 2 * 4 * 3 * (tile + 14) ** 2  # the image and its sums
    assert crop_bytes <= used.temp_size_in_bytes + crop_bytes <= budget
    assert crop_bytes > budget / 8  # not much smaller than possible
    with pytest.raises(ValueError, match="the budget is 0 MiB"):
        tiles.tile_within(local, image, halo=7, budget=1000)


@pytest.mark.parametrize("wrong", [{"tile": 0}, {"halo": -1}, {"multiple": 0}])
def test_bad_crops_are_named(wrong):
    options = {"tile": 4, "halo": 1, "multiple": 1} | wrong
    with pytest.raises(ValueError, match=f"{next(iter(wrong))}={wrong.popitem()[1]}"):
        tiles.crops((8, 8), **options)


def test_a_function_of_the_whole_image_is_not_cut():
    image, double = jnp.ones((4, 4, 1)), lambda image: 2 * image
    local = tiles.Local(double, image, None)
    np.testing.assert_array_equal(local.whole(), 2 * image)
    for cut in (
        lambda: tiles.crops(image.shape, tile=2, halo=None),
        lambda: tiles.map_crops(double, image, tile=2, halo=local.halo),
        lambda: next(tiles.stream_crops(double, image, tile=2, halo=local.halo)),
        lambda: tiles.map_shards(double, image, halo=local.halo),
        lambda: tiles.tile_within(double, image, halo=local.halo, budget=2**20),
    ):
        with pytest.raises(ValueError, match=r"^.* whole image .*: combine it whole$"):
            cut()


def test_equal_options_share_one_program():
    traces = []

    def scaled(image, *, factor, shift):
        traces.append(factor)
        return factor * image + shift

    image = jnp.ones((2, 3, 1))
    program = tiles.compiled(scaled, factor=2, shift=1)
    assert tiles.compiled(scaled, shift=1, factor=2) is program
    for _ in range(3):
        again = tiles.compiled(scaled, factor=2, shift=1)
        np.testing.assert_array_equal(again(image), 3 * image)
    assert traces == [2]
    other = tiles.compiled(scaled, factor=5, shift=1)
    assert other is not program
    np.testing.assert_array_equal(other(image), 6 * image)
    assert traces == [2, 5]


def differences(*arguments, devices):
    """Start `on_devices` in a process that has so many devices."""
    count = f"--xla_force_host_platform_device_count={devices}"
    flags = f"{os.environ['XLA_FLAGS']} {count}"
    return subprocess.Popen(
        [sys.executable, "-m", "tests.on_devices", *arguments],
        env=os.environ | {"XLA_FLAGS": flags},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def check(process):
    """The image and three derivatives are those of one device."""
    out, errors = process.communicate(timeout=300)
    assert process.returncode == 0, errors
    numbers = [float(line) for line in out.split("\n") if "e-" in line or line == "0.0"]
    assert len(numbers) == 4
    assert max(numbers) < 1e-12


def test_four_devices_are_one():
    check(differences(devices=4))


def test_two_processes_are_one():
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = "{}:{}".format(*free.getsockname())
    both = [differences(str(i), "2", address, devices=2) for i in range(2)]
    for process in both:
        check(process)


def test_too_many_devices_are_named():
    image = jnp.zeros((4, 4, 1))
    devices = jax.devices() * 3  # as if there were three
    with pytest.raises(ValueError, match="4 rows on 3 devices are 2 each, and 4"):
        tiles.map_shards(lambda i: i, image, halo=2, devices=devices)


@pytest.mark.parametrize("first", [0.0, 1e-8, np.inf, np.nan])
def test_one_pass_is_the_function(first):
    def both(x, y):
        return x * y, {"sum": x + y}

    x, y = jnp.array([first, 2.0, 3.0]), jnp.array([4.0, 5.0, 6.0])
    apart = functools.partial(tiles.in_one_pass, both)
    np.testing.assert_array_equal(jax.jit(apart)(x, y)[0], x * y)
    np.testing.assert_array_equal(jax.vmap(apart)(x, y)[1]["sum"], x + y)
    gradient = jax.grad(lambda x: jnp.sum(apart(x, y)[0]))(x)
    np.testing.assert_array_equal(gradient, y)
    _, tangent = jax.jvp(lambda x: apart(x, y)[0], (x,), (jnp.ones(3),))
    np.testing.assert_array_equal(tangent, y)
    # The compiler must not see that the branch is always taken.
    assert "conditional(" in jax.jit(apart).lower(x, y).compile().as_text()


def test_nothing_is_in_one_pass():
    assert tiles.in_one_pass(jnp.sin, jnp.zeros((0, 2))).shape == (0, 2)
