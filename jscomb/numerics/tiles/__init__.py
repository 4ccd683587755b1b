"""Large images in parts: cut apart, computed a part at a time, joined again."""

from jscomb.numerics.tiles._crops import (
    Crop,
    Local,
    Span,
    crops,
    map_crops,
    stream_crops,
    tile_within,
)
from jscomb.numerics.tiles._devices import map_shards
from jscomb.numerics.tiles._neighbourhoods import (
    Grid,
    Planes,
    Region,
    flat,
    fold_rows,
    map_rows,
    sum_over_tiles,
    tile_side,
)
from jscomb.numerics.tiles._plans import network_plan
from jscomb.numerics.tiles._programs import (
    by_device,
    compiled,
    cut,
    in_memory,
    in_one_pass,
    padded,
)

__all__ = [
    "Crop",
    "Grid",
    "Local",
    "Planes",
    "Region",
    "Span",
    "by_device",
    "compiled",
    "crops",
    "cut",
    "flat",
    "fold_rows",
    "in_memory",
    "in_one_pass",
    "map_crops",
    "map_rows",
    "map_shards",
    "network_plan",
    "padded",
    "stream_crops",
    "sum_over_tiles",
    "tile_side",
    "tile_within",
]
