"""Read what renderers write as a `Frame`; write frames and images as EXR.

`read_frame` recognises who wrote a file or directory and converts it to the conventions
of the toolkit: linear RGB, variance of the mean, an explicit sample count; pixels
without data are not finite. `write_frame` writes jscomb's own multi-part format, which
stores a whole frame bit by bit.

`read_contents` returns the frame with all else that the file has, and `write_contents`
writes such a file again with another image in place of the noisy one: the same layers,
windows and attributes.

Every error is an `OSError` or a `ValueError` of one line that names the file and says
what is wrong with it. Writing is atomic: an existing file is replaced only by a
complete one.
"""

from jscomb.exr._beside import Feature, align, convert, read_feature
from jscomb.exr._contents import Channels, Contents, open_source, read_contents
from jscomb.exr._files import MAX_BYTES
from jscomb.exr._read import bundled, read_frame, read_image, read_provenance
from jscomb.exr._results import read_result, write_contents
from jscomb.exr._write import write_frame, write_image

__all__ = [
    "MAX_BYTES",
    "Channels",
    "Contents",
    "Feature",
    "align",
    "bundled",
    "convert",
    "open_source",
    "read_contents",
    "read_feature",
    "read_frame",
    "read_image",
    "read_provenance",
    "read_result",
    "write_contents",
    "write_frame",
    "write_image",
]
