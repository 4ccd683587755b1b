"""Makers of biased images."""

from jscomb.denoisers import bilateral as bilateral
from jscomb.denoisers import nfor as nfor
from jscomb.denoisers import nonlocal_means as nonlocal_means
from jscomb.denoisers import oidn as oidn
from jscomb.denoisers import rdfc as rdfc
from jscomb.denoisers import smoothing as smoothing
