"""Read what renderers write as a `Frame`; write frames and images as EXR.

`read_frame` recognises who wrote a file or directory and converts it to the conventions
of the toolkit: linear RGB, variance of the mean, an explicit sample count; pixels
without data are not finite. `write_frame` writes jscomb's own multi-part format, which
stores a whole frame bit by bit.

Every error is an `OSError` or a `ValueError` of one line that names the file and says
what is wrong with it. Writing is atomic: an existing file is replaced only by a
complete one.
"""

from jscomb.exr._read import bundled, read_frame, read_image, read_provenance
from jscomb.exr._write import write_frame, write_image

__all__ = [
    "bundled",
    "read_frame",
    "read_image",
    "read_provenance",
    "write_frame",
    "write_image",
]
