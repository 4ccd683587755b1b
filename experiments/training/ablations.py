"""Methods with something left out, to be trained like the others."""

import functools

import jax.numpy as jnp

from jscomb import james_stein, metrics
from jscomb.learning import losses, recipes
from jscomb.learning.recipes import RECIPES


def _no_sure(key, frame, estimate, *, make):
    """Return PD's inputs with an error estimated without a derivative."""
    found = make(key, frame, estimate)
    x, y, v = (found[n] for n in ("unbiased", "biased", "variance"))
    return found | {"sure": jnp.square(x - y) - v}


_LOG = recipes.of_mean(losses.log_l2)
_SMAPE = recipes.of_mean(metrics.smape)
_MEAN = recipes.of_mean(metrics.rel_l2)
_NJS, _PD = RECIPES["njs"], RECIPES["pd"]
_QUOTIENT = _PD._replace(options={"form": "quotient"})

ABLATIONS: dict[str, recipes.Recipe] = {
    "njs-paper": _NJS._replace(options={"rule": james_stein.Rule()}, loss=_LOG),
    "njs-log": _NJS._replace(loss=_LOG),
    "njs-mean": _NJS._replace(loss=_MEAN),
    "dsc-smape": RECIPES["dsc"]._replace(loss=_SMAPE),
    "neural-ensemble-halves": RECIPES["neural-ensemble"]._replace(
        loss=losses.relative_l2
    ),
    "pd-mean": _PD._replace(loss=_MEAN),
    "pd-log": _PD._replace(loss=_LOG),
    "pd-quotient": _QUOTIENT,
    "pd-smape": _QUOTIENT._replace(loss=_SMAPE),
    "pd-no-sure": _PD._replace(
        inputs=functools.partial(_no_sure, make=_PD.inputs),
        others=tuple(functools.partial(_no_sure, make=m) for m in _PD.others),
    ),
}
"""njs-paper, dsc-smape and pd-smape are as in the papers; pd-quotient and pd-no-sure
are of PD's table 4, whose third row, without the bound, needs no training; -mean has
relative L2 with the mean of the reference's halves, which their noise biases, -halves
with each half weighted by the other."""
