"""The images of a scene in equal time, and the shares that double shrinkage takes."""

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure

from jscomb import double_shrinkage
from jscomb.frame import Frame
from jscomb.metrics import tone_map
from jscomb.rendering import PHOTONS
from jscomb.typing import Image


def picture(whole: Frame, half: Frame, images: Mapping[str, Image]) -> Figure:
    """Draw the images, and what share the biased image and the prior have.

    Args:
        whole: path tracing in all the time, with a reference.
        half: in half of it, with a photon-mapped image.
        images: by method.

    Returns:
        the picture.
    """
    assert whole.reference is not None
    found = double_shrinkage.make_inputs(half, half.estimates[PHOTONS])
    share = double_shrinkage.factors(found.variance, found.mse, found.prior_mse)
    shown = {
        "reference": whole.reference.image,
        "path tracing, all the time": images["path tracing alone"],
        "photon mapping, all the time": images["photon mapping alone"],
        "prior": found.prior,
        "double shrinkage": images["double shrinkage"],
        "james-stein, whitened": images["james-stein, whitened"],
    }
    figure = Figure(figsize=(14, 7.4), layout="compressed")
    axes = figure.subplots(2, 4)
    for axis, (name, image) in zip(axes.flat, shown.items(), strict=False):
        axis.imshow(np.asarray(tone_map(image)), interpolation="nearest")
        axis.set_title(name, fontsize=9)
    shares = {"share of photons, k1": share.biased, "of the prior, k2": share.prior}
    for axis, (name, image) in zip(axes.flat[6:], shares.items(), strict=True):
        drawn = axis.imshow(np.mean(image, axis=-1), cmap="coolwarm", vmin=0, vmax=1)
        axis.set_title(name, fontsize=9)
        figure.colorbar(drawn, ax=axis, shrink=0.7)
    for axis in axes.flat:
        axis.axis("off")
    return figure
