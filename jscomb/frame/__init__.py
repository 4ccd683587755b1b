"""A rendered frame with its buffers and halves, and the images estimated from it.

A `Frame` stores each quantity once, as K independent sub-buffers on the first axis
(disjoint samples, equally many), and derives the rest: the full image is their mean,
the half buffers are the means of the first and the last K/2. Halves are frames
themselves, so with K = 4 a combiner of halves can be judged by halves again. K = 1 is a
frame too; what needs halves raises an error there.

An `Estimate` is an image of a frame and the same image made from each half alone.
Whoever makes an image of a frame makes an `Estimate`: denoisers, combiners, networks,
files. So a combiner's result goes wherever a denoiser's goes, and every estimate is
judged the same way: by the half that it was not made from. `with_halves` makes one.

All are pytrees of arrays: they jit, vmap and differentiate. Where a frame came from is
not part of it; `exr.read_provenance` returns that.

Units: colour, estimates and reference are linear scene-referred radiance; variance is
of the mean, squared radiance; albedo and visibility are in [0, 1]; normals have unit
length or are 0; depth is a distance, 0 where there is nothing. A frame is *normalised*
when its radiance was divided by its median luminance (`Frame.normalised`). Networks and
regressions have absolute constants, so their functions of frames need that; the front
door `jscomb.combine` normalises once, and scales the result back once.
"""

from jscomb.frame._frame import CHANNELS, Buffers, Estimate, Frame, Reference
from jscomb.frame._halves import Maker, estimates_of, halves_possible, with_halves
from jscomb.frame._make import make_frame
from jscomb.frame._needs import Needs, Package

__all__ = [
    "CHANNELS",
    "Buffers",
    "Estimate",
    "Frame",
    "Maker",
    "Needs",
    "Package",
    "Reference",
    "estimates_of",
    "halves_possible",
    "make_frame",
    "with_halves",
]
