"""Every denoiser and combiner by its name, with what it needs; and which to choose.

`combine` makes an estimate of a frame by one of them; `choose` finds the one of minimum
estimated error. The table `METHODS` is the only place that names methods: the command,
the sweep, the tests and these pages read it. To add one, assign a `Method`.

`choose` needs no reference: each method makes an image of each half, and
`metrics.rel_l2_change` estimates from the other half by how much its error differs from
that of the cheapest method, with fireflies limited. It takes the method of minimum
estimated error, each plus one standard error; the cheapest where none is better. A half
has half the samples, and combining gains more with more samples, so it chooses rather
cautiously.
"""

from jscomb.methods._choose import Choice, Trial, choose
from jscomb.methods._combine import combine, plan
from jscomb.methods._inputs import input_name, inputs
from jscomb.methods._table import BASES, CANDIDATES, METHODS, Method, table

__all__ = [
    "BASES",
    "CANDIDATES",
    "METHODS",
    "Choice",
    "Method",
    "Trial",
    "choose",
    "combine",
    "input_name",
    "inputs",
    "plan",
    "table",
]

__doc__ = f"{__doc__}\n{table()}\n"
