"""Compare a combiner on four devices, of one process or of two, with one device.

Run by test_crops:

python -m tests.on_devices [PROCESS COUNT ADDRESS]
"""

import sys

import jax
import jax.numpy as jnp
import numpy as np

from jscomb import james_stein
from jscomb.numerics import tiles
from jscomb.numerics.windows import reach_of

HALO = reach_of(7, 7, 19)  # the statistics, the mean over windows, the variance


def combine(images):
    """Combine, whitened."""
    x, y, v = images
    robust = james_stein.robust_variance(v)
    return james_stein.combine(x, y, robust, window=7, whiten=True)


def main(height: int) -> None:
    """Print the largest differences: of the image, and of three derivatives."""
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
    found = [sharded(images), jax.grad(square(sharded))(images)]
    expected = [jax.jit(combine)(images), jax.jit(jax.grad(square(combine)))(images)]
    for a, b in zip(gather(found), jax.tree.leaves(expected), strict=True):
        print(float(np.max(np.abs(a - np.asarray(b)))))


if __name__ == "__main__":
    import jax.experimental.multihost_utils

    jax.config.update("jax_enable_x64", True)
    if sys.argv[1:]:
        number, count, address = sys.argv[1:]
        jax.distributed.initialize(address, int(count), int(number))
    main(243)
