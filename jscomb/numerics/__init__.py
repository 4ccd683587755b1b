"""Mathematics shared by the combiners; nothing here knows about a paper."""

from jscomb.numerics import cholesky as cholesky
from jscomb.numerics import convolution as convolution
from jscomb.numerics import guards as guards
from jscomb.numerics import kernels as kernels
from jscomb.numerics import luminance as luminance
from jscomb.numerics import medians as medians
from jscomb.numerics import poisson as poisson
from jscomb.numerics import regression as regression
from jscomb.numerics import simplex as simplex
from jscomb.numerics import sure as sure
from jscomb.numerics import tiles as tiles
from jscomb.numerics import weights as weights
from jscomb.numerics import windows as windows
