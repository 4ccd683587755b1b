"""Methods with something left out, to be trained like the others."""

import jax
import jax.numpy as jnp

from jscomb import james_stein, metrics, progressive
from jscomb.learning import losses, methods
from jscomb.learning.methods import METHODS


def _no_sure(key, frame, name):
    """PD's inputs with what is known of the error without a derivative."""
    taken, _ = METHODS["pd"].variants(key, frame, name)
    x, y, v = (taken[n] for n in ("unbiased", "biased", "variance"))
    s = jnp.square(x - y) - v
    exchanged = {"unbiased": y, "biased": x, "variance": s, "sure": v}
    return [taken | {"sure": s}, exchanged]


def _direct(network, inputs, **options):
    """PD with a sigmoid of one output in place of the form of its equation 9."""

    def outputs(*images):
        share = jax.nn.sigmoid(network(*images)[:, :, :1])
        return jnp.concatenate(
            [share, jnp.zeros_like(share), jnp.ones_like(share)], axis=2
        )

    return progressive.neural_combine(outputs, **inputs, **options)


def _equal(network, inputs, **options):
    """NJS as in its paper: one variance a window, of 15x15."""
    return james_stein.neural_combine(network, **inputs, **options)


ABLATIONS: dict[str, methods.Method] = {
    "njs-equal": METHODS["njs"]._replace(combine=_equal),
    "pd-smape": METHODS["pd"]._replace(loss=metrics.smape),
    "dsc-log": METHODS["dsc"]._replace(loss=losses.log_l2),
    "pd-no-sure": METHODS["pd"]._replace(variants=_no_sure),
    "pd-direct": METHODS["pd"]._replace(combine=_direct),
}
"""njs-equal and pd-smape are as in the papers; pd-no-sure and pd-direct are of PD's
table 4, whose third, without the bound, trains nothing."""
