"""Run by test_crops: a combiner on four devices, of one process or of two.

python -m tests.on_devices [PROCESS COUNT ADDRESS]
"""

import sys

import jax
import jax.numpy as jnp
import numpy as np

from jscomb import james_stein
from jscomb.numerics import tiles

HALO = 15  # windows of 7x7 about centres in windows of 7x7, variance of 19x19


def combine(images):
    """Whitened."""
    x, y, v = images
    robust = james_stein.robust_variance(v)
    return james_stein.combine(x, y, robust, window=7, whiten=True)


def main(height: int) -> None:
    """Print the largest difference to one device, of the image and a derivative."""
    rng = np.random.default_rng(0)
    x, y, v = (rng.gamma(1.0, size=(height, 50, 3)) for _ in range(3))
    x[20, 20] = np.nan
    images = x, y, v
    sharded = jax.jit(lambda images: tiles.map_shards(combine, images, halo=HALO))
    square = lambda f: lambda i: jnp.sum(jnp.square(f(i)))
    gather = lambda tree: [
        np.asarray(jax.experimental.multihost_utils.process_allgather(a, tiled=True))
        for a in jax.tree.leaves(tree)
    ]
    made = [sharded(images), jax.grad(square(sharded))(images)]
    wanted = [jax.jit(combine)(images), jax.jit(jax.grad(square(combine)))(images)]
    for got, want in zip(gather(made), jax.tree.leaves(wanted), strict=True):
        print(float(np.max(np.abs(got - np.asarray(want)))))


if __name__ == "__main__":
    import jax.experimental.multihost_utils

    jax.config.update("jax_enable_x64", True)
    if sys.argv[1:]:
        number, count, address = sys.argv[1:]
        jax.distributed.initialize(address, int(count), int(number))
    main(243)
