"""How much one pixel counts in the window of another.

Layout: images, guides and features [H,W,*]; windows as in `jscomb.numerics.windows`.
Notation:

    c, i   centre of a window, and a pixel in it
    w_ci   weight of the pixel, at least zero

`weighted_mean` walks the windows and holds one weight a pixel at a time; a regression
needs all weights of a tile at once, as the matrix `tile_weights`.
`denoisers.nonlocal_means` has another kind of weights.
"""

from jscomb.numerics.weights._kinds import (
    bilateral_weights,
    feature_weights,
    gaussian_weights,
    minimum_of,
    noise_free_weights,
    normalised_distance,
)
from jscomb.numerics.weights._pairs import (
    Pairs,
    Weights,
    tile_weights,
    weighted_mean,
)

__all__ = [
    "Pairs",
    "Weights",
    "bilateral_weights",
    "feature_weights",
    "gaussian_weights",
    "minimum_of",
    "noise_free_weights",
    "normalised_distance",
    "tile_weights",
    "weighted_mean",
]
