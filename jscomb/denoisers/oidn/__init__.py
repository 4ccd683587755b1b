r"""Open Image Denoise: its networks as JAX functions, its filter on the host, variants.

The filter is a U-Net between two curves:

    x, f   colour, normalised radiance; features, albedo in [0, 1], normal in [-1, 1]
    c      curve that compresses radiance, perceptually uniform; C its inverse
    e      exposure, 0.18: the median luminance becomes middle grey
    N      network

    denoised = C(N(c(e x), f)) / e

The networks are those that the user has installed: they are read from the package's
library (`pretrained`), and each is held against the filter before it is used. They have
exact derivatives of both kinds, also in their weights, run on any device, and by crops
on large images. On a CPU the filter itself may be faster: then it makes the image, and
the network the derivatives. Where a version's weights cannot be read, the filter does
everything, its derivative is a central difference, forward only, and one warning says
so.

Guards: the bare filter is not scale-equivariant at very low radiance, one infinite
pixel corrupts a large area, and NaN counts as black. So images are normalised to a
median luminance of one, and each invalid pixel is filled from its neighbours first.

`tune` fits the network's gains and biases to one frame by its halves.

Images [H,W,3], linear radiance. Needs the extra `oidn` (`pip install "jscomb[oidn]"`).

Source: A. T. Afra, "Intel Open Image Denoise", 2025, version 2.5 (Apache-2.0); its
networks stay in its package. The variants are ours.
"""

from jscomb.denoisers.oidn._denoise import (
    NEEDS,
    available,
    denoise,
    denoise_feature,
    denoise_normalised,
    pretrained,
)
from jscomb.denoisers.oidn._frame import (
    VARIANTS,
    Variant,
    denoise_color,
    denoise_frame,
    denoise_turns,
    denoise_variants,
)
from jscomb.denoisers.oidn._tuning import TUNING_NEEDS, tune, tune_frame

__all__ = [
    "NEEDS",
    "TUNING_NEEDS",
    "VARIANTS",
    "Variant",
    "available",
    "denoise",
    "denoise_color",
    "denoise_feature",
    "denoise_frame",
    "denoise_normalised",
    "denoise_turns",
    "denoise_variants",
    "pretrained",
    "tune",
    "tune_frame",
]
