"""Combine unbiased and biased Monte Carlo renderings into one better image, in JAX.

Each paper is one module of pure functions, and each has the verb `combine`::

    from jscomb import exr, james_stein
    frame = exr.read_frame("frame.exr")
    denoised = frame.estimates["oidn"].image
    image = james_stein.combine(frame.color, denoised, frame.variance)
"""

from jscomb import denoisers as denoisers
from jscomb import double_shrinkage as double_shrinkage
from jscomb import ensemble as ensemble
from jscomb import exr as exr
from jscomb import features as features
from jscomb import frame as frame
from jscomb import james_stein as james_stein
from jscomb import learning as learning
from jscomb import metrics as metrics
from jscomb import numerics as numerics
from jscomb import progressive as progressive
from jscomb import uncorrelated as uncorrelated

__version__ = "0.1.0"
