"""Large images in parts: cut, worked on, and put together again."""

from jscomb.numerics.tiles._plans import network_plan as network_plan
from jscomb.numerics.tiles.crops import Crop as Crop
from jscomb.numerics.tiles.crops import Local as Local
from jscomb.numerics.tiles.crops import crops as crops
from jscomb.numerics.tiles.crops import map_crops as map_crops
from jscomb.numerics.tiles.crops import stream_crops as stream_crops
from jscomb.numerics.tiles.crops import tile_within as tile_within
from jscomb.numerics.tiles.devices import map_shards as map_shards
from jscomb.numerics.tiles.neighbourhoods import Grid as Grid
from jscomb.numerics.tiles.neighbourhoods import Planes as Planes
from jscomb.numerics.tiles.neighbourhoods import Region as Region
from jscomb.numerics.tiles.neighbourhoods import flat as flat
from jscomb.numerics.tiles.neighbourhoods import fold_rows as fold_rows
from jscomb.numerics.tiles.neighbourhoods import map_rows as map_rows
from jscomb.numerics.tiles.neighbourhoods import sum_over_tiles as sum_over_tiles
from jscomb.numerics.tiles.programs import compiled as compiled
