"""Methods with something left out, to be trained like the others."""

import jax.numpy as jnp

from jscomb import james_stein, metrics, progressive
from jscomb.learning import losses, methods
from jscomb.learning.methods import METHODS


def _no_sure(key, frame, name):
    """PD's inputs with what is known of the error without a derivative."""
    taken = METHODS["pd"].inputs(key, frame, name)
    x, y, v = (taken[n] for n in ("unbiased", "biased", "variance"))
    return taken | {"sure": jnp.square(x - y) - v}


def _quotient(network, inputs, **options):
    """PD as in its paper: alpha in the form of its equation 9, and its bound."""
    return progressive.neural_combine(network, **inputs, **options)


def _equal(network, inputs, **options):
    """NJS as in its paper: one variance a window, of 15x15."""
    return james_stein.neural_combine(network, **inputs, **options)


# The bound needs an x without bias, which half of those that training draws are not.
_PD = METHODS["pd"]._replace(combine=_quotient, training={"bound": False})

ABLATIONS: dict[str, methods.Method] = {
    "njs-equal": METHODS["njs"]._replace(combine=_equal),
    "dsc-log": METHODS["dsc"]._replace(loss=losses.log_l2),
    "pd-quotient": _PD,
    "pd-smape": _PD._replace(loss=metrics.smape),
    "pd-no-sure": _PD._replace(inputs=_no_sure, other=methods.exchanged(_no_sure)),
}
"""njs-equal and pd-smape are as in the papers; pd-quotient and pd-no-sure are of PD's
table 4, whose third, without the bound, trains nothing."""
