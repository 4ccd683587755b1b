"""The parts of one windowed regression, for as many tiles, to be timed alone."""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from jscomb.numerics import regression
from jscomb.numerics.weights import gaussian_weights, tile_weights

WINDOW, FEATURES, CHANNELS = 51, 11, 3


def parts(size: int) -> dict[str, Callable]:
    """The regression, and its parts for as many tiles, on random images."""
    keys = iter(jax.random.split(jax.random.key(0), 7))
    shape = lambda channels: (size, size, channels)
    t, g, f = (
        jax.random.uniform(next(keys), shape(c)) for c in (CHANNELS, 3, FEATURES)
    )
    grid = regression._grid(WINDOW, 1)
    tiles, batch = grid.tiles(size) ** 2, grid.batch
    n, m = grid.width(grid.reach) ** 2, grid.side**2
    basis = jax.random.normal(next(keys), (batch, FEATURES + 1, n))
    target, weights = basis[:, :CHANNELS], jax.random.uniform(next(keys), (batch, m, n))
    guide = jax.random.uniform(next(keys), (batch, 3, n))
    inside = grid.inside
    phi = jax.vmap(regression._products)(basis, target)
    b = jax.random.normal(next(keys), (batch, (FEATURES + 1) * CHANNELS + 1, m))

    def repeated(step: Callable, *arrays: jax.Array) -> Callable:
        """As often as there are tiles, in one compiled loop."""

        def loop(*arrays: jax.Array) -> tuple:
            def body(_: jax.Array, state: tuple) -> tuple:
                # Each turn feeds the next, and leaves all of its result: no turn and
                # no element can be left out.
                first, _ = state
                out = step(first, *arrays[1:])
                return first * (1 + 1e-20 * out.ravel()[0]), out

            out = jax.eval_shape(step, *arrays)
            start = arrays[0], jnp.zeros(out.shape, out.dtype)
            return jax.lax.fori_loop(0, tiles // batch, body, start)

        compiled = jax.jit(loop)
        return lambda: compiled(*arrays)

    def weigh(guide: jax.Array) -> jax.Array:
        side = int(np.sqrt(n))
        weights_of = gaussian_weights(jnp.zeros((1, 1, 3)), 0.1)
        one = lambda g: tile_weights(weights_of, g.reshape(3, side, side), grid)
        return jnp.where(inside, jax.vmap(one)(guide), 0.0)

    fit = lambda stride: jax.jit(
        functools.partial(regression.local_linear, bandwidth=0.1, stride=stride)
    )
    whole = {f"stride {s}": fit(s) for s in (1, 2, 4, 8)}
    run = lambda function: lambda: function(t, g, f)
    return {name: run(function) for name, function in whole.items()} | {
        "weights": repeated(weigh, guide),
        "products of features": repeated(jax.vmap(regression._products), basis, target),
        "moments, matrix product": repeated(
            lambda p, w: jnp.einsum("bpn,bmn->bpm", p, w), phi, weights
        ),
        "predictions, matrix product": repeated(
            lambda b, w: jnp.einsum("bpm,bmn->bpn", b, w), b, weights
        ),
    }


PARTS = (
    "weights",
    "products of features",
    "moments, matrix product",
    "predictions, matrix product",
)


def product_operations(size: int) -> float:
    """What the moments' matrix product executes, tiles and neighbourhoods in full."""
    grid = regression._grid(WINDOW, 1)
    n, m, p = grid.width(grid.reach) ** 2, grid.side**2, FEATURES + 1
    turns = grid.tiles(size) ** 2 // grid.batch
    return 2.0 * (p * (p + 1) // 2 + p * CHANNELS) * n * m * turns * grid.batch


def useful_operations(size: int) -> float:
    """2 (moments + predictions) for each pixel of each clipped window."""
    p = FEATURES + 1
    columns = p * (p + 1) // 2 + p * CHANNELS + p * CHANNELS + 1
    at = np.arange(size)
    r = WINDOW // 2
    along = np.minimum(at + r, size - 1) - np.maximum(at - r, 0) + 1
    return 2.0 * columns * float(along.sum()) ** 2
