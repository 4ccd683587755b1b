"""Errors of an image against a reference.

Layout: images [H,W,C], linear radiance. Errors are means over pixels and channels.
Nothing is left out silently: a pixel that is not finite makes the error NaN or
infinite. A `mask` [H,W,1] says which pixels count; `numerics.guards.finite(image,
reference)` is the usual one, and the count of the others belongs beside the error.
"""

from jscomb.metrics.display import dssim as dssim
from jscomb.metrics.display import flip as flip
from jscomb.metrics.display import hdr_flip as hdr_flip
from jscomb.metrics.display import tone_map as tone_map
from jscomb.metrics.errors import Change as Change
from jscomb.metrics.errors import mean_change as mean_change
from jscomb.metrics.errors import rel_l2 as rel_l2
from jscomb.metrics.errors import rel_l2_change as rel_l2_change
from jscomb.metrics.errors import rmse as rmse
from jscomb.metrics.errors import smape as smape
