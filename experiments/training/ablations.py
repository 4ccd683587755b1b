"""Methods with something left out, to be trained like the others."""

import jax.numpy as jnp

from jscomb import james_stein, metrics, progressive
from jscomb.learning import losses, recipes
from jscomb.learning.recipes import RECIPES


def _no_sure(key, frame, estimate):
    """Return PD's inputs with an error estimated without a derivative."""
    found = RECIPES["pd"].inputs(key, frame, estimate)
    x, y, v = (found[n] for n in ("unbiased", "biased", "variance"))
    return found | {"sure": jnp.square(x - y) - v}


def _quotient(network, inputs, **options):
    """Combine as PD's paper does: alpha in the form of its equation 9, and bounded."""
    options = {"activate": progressive.activation, "bound": True} | options
    return progressive.combine_inputs(network, inputs, **options)


def _equal(network, inputs):
    """Combine as NJS's paper does: one variance a window, of 15x15."""
    return james_stein.combine_inputs(network, inputs, window=15, whiten=False)


# The bound needs an unbiased x, which half of the inputs drawn in training do not have.
_PD = RECIPES["pd"]._replace(combine=_quotient, training={"bound": False})

ABLATIONS: dict[str, recipes.Recipe] = {
    "njs-equal": RECIPES["njs"]._replace(combine=_equal),
    "dsc-log": RECIPES["dsc"]._replace(loss=losses.log_l2),
    "pd-quotient": _PD,
    "pd-smape": _PD._replace(loss=metrics.smape),
    "pd-no-sure": _PD._replace(inputs=_no_sure, other=recipes.exchanged(_no_sure)),
}
"""njs-equal and pd-smape are as in the papers; pd-quotient and pd-no-sure are of PD's
table 4, whose third row, without the bound, needs no training."""
