"""Every denoiser and combiner by its name, with what it needs; and the default.

`combine` makes an estimate of a frame by one of them. The table `METHODS` is the only
place that names methods: the command, the sweep, the tests and these pages read it. To
add one, assign a `Method`.

Without a name it takes the default method: an ensemble of all estimates that the frame
allows, in `TIERS` of cost. Nothing is chosen by trial: the half that an estimate was
not made from says how large its error is, and the weights follow. `combine_tier` tells
what was combined, and the estimated error.
"""

from jscomb.methods._combine import combine, plan
from jscomb.methods._inputs import input_name, inputs, with_inputs
from jscomb.methods._table import BASES, METHODS, Method, table
from jscomb.methods._tiers import TIERS, Combined, Tier, combine_tier

__all__ = [
    "BASES",
    "METHODS",
    "TIERS",
    "Combined",
    "Method",
    "Tier",
    "combine",
    "combine_tier",
    "input_name",
    "inputs",
    "plan",
    "table",
    "with_inputs",
]

__doc__ = f"{__doc__}\n{table()}\n"
