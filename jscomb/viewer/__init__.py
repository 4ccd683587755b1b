"""A viewer of linear images in one HTML page that needs no server and no network.

Two to four panes, zoomed and panned together, flip and slide between images and maps of
their errors, with exposure, tone curve, the values of a pixel, and insets of crops. The
page's address holds what is looked at, so a link shows the same. The images are half
floats, divided by a median luminance, or floats where half floats would cut them;
errors are computed from them in the browser (WebGL 2), but for the maps that a scene
brings.

    page           a file of its own: the command `jscomb view`
    element        a part of another page: the report of `experiments.comparison`
    Cell           the output of a notebook's cell
    send_to_tev    the images alone, to a running tev
"""

from jscomb.viewer._page import Cell, element, page
from jscomb.viewer._scene import Scene, make_scene
from jscomb.viewer._tev import send_to_tev

__all__ = ["Cell", "Scene", "element", "make_scene", "page", "send_to_tev"]
