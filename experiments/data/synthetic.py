r"""Images whose truth and noise are exactly known, for sweeps without a renderer.

Only what a method needs of a rendering: edges, texture and a gradient; noise of unlike
size, skewed as Monte Carlo noise is, and common to the pixels of a region as under
common random numbers, and to no others. Notation, for the mean of n samples at pixel i:

    z_i = m_i + v_i^(1/2) n^(-1/2) (r^(1/2) c + (1 - r)^(1/2) e_i)

    m_i, v_i   truth, and variance of one sample
    r          correlation of two pixels of one region
    c, e_i     of mean 0 and variance 1: one number a region, one a pixel

Each is a quadratic of a normal number g, sqrt(1 - 2 b^2) g + b (g^2 - 1), of skewness
6 b - 4 b^3 at b = sqrt(2) sin(t / 3), 2 sqrt(2) sin t. Up to 2.8, and one number a
draw, whatever n.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jscomb.typing import Image, Key

REGIONS = 4
MOST_SKEWED = 2 * 2**0.5


class Scene(NamedTuple):
    """What is to be rendered.

    Attributes:
        truth: m, linear radiance, [H,W,C].
        variance: v of one sample, squared radiance, [H,W,C].
        region: number of the region of each pixel, below `REGIONS`, [H,W].
    """

    truth: Image
    variance: Image
    region: Int[Array, "h w"]


def make_scene(size: int) -> Scene:
    """A disc, a wall, a floor and a window, with a gradient and a texture.

    Args:
        size: height and width in pixels.

    Returns:
        the scene, three channels.
    """
    row, column = np.mgrid[:size, :size] / size
    region = (row > 0.55).astype(int)  # wall, floor
    region[(row - 0.5) ** 2 + (column - 0.3) ** 2 < 0.04] = 2
    region[(abs(row - 0.25) < 0.1) & (abs(column - 0.75) < 0.12)] = 3
    level = np.array([0.5, 0.3, 0.8, 3.0])[region] * (0.6 + 0.8 * column)
    texture = (np.floor(12 * row) + np.floor(12 * column)) % 2
    level = np.where(region == 1, level * (0.4 + texture), level)
    tint = np.array([[1, 0.9, 0.7], [0.8, 0.6, 0.5], [0.4, 0.6, 1], [1, 1, 1]])
    truth = level[..., None] * tint[region]
    # A pixel's noise goes with its radiance, and is worst on the floor.
    relative = np.array([0.8, 1.6, 0.5, 0.1])[region][..., None]
    variance = (relative * truth) ** 2
    return Scene(jnp.asarray(truth), jnp.asarray(variance), jnp.asarray(region))


def draw(
    key: Key,
    scene: Scene,
    samples: int,
    *,
    correlation: float = 0.0,
    skewness: float = 0.0,
) -> Image:
    """The mean of some samples.

    Args:
        key: of the noise.
        scene: what is rendered.
        samples: n.
        correlation: r, in [0, 1].
        skewness: of one sample's noise; that of the mean is n^(-1/2) of it.

    Returns:
        z, linear radiance, [H,W,C]; channels have the same numbers.

    Raises:
        ValueError: if the skewness cannot be had: it grows with the correlation's
            distance from 0 and 1, and c and e have at most `MOST_SKEWED`.
    """
    share = correlation**1.5 + (1 - correlation) ** 1.5
    each = skewness / samples**0.5 / share
    if abs(each) > MOST_SKEWED:
        raise ValueError(
            f"skewness must be at most {MOST_SKEWED * share * samples**0.5:.3g} for "
            f"{samples} samples of this correlation, got {skewness}"
        )
    of_regions, of_pixels = jax.random.split(key)
    common = _skewed(of_regions, (REGIONS,), each)[scene.region]
    own = _skewed(of_pixels, scene.region.shape, each)
    noise = correlation**0.5 * common + (1 - correlation) ** 0.5 * own
    deviation = jnp.sqrt(scene.variance / samples)
    return scene.truth + deviation * noise[..., None]


def _skewed(key: Key, shape: tuple[int, ...], skewness: float) -> Float[Array, "..."]:
    """Independent numbers of mean 0, variance 1 and this skewness."""
    b = 2**0.5 * np.sin(np.arcsin(skewness / MOST_SKEWED) / 3)
    g = jax.random.normal(key, shape)
    return float(np.sqrt(1 - 2 * b**2)) * g + float(b) * (jnp.square(g) - 1)
