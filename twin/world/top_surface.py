"""True surface as seen from above: the highest of floor and objects at each cell of the map.

The truth of a map is the height of the highest surface, floor or object, on the vertical line through each cell centre.
The objects are drawn in a parallel projection. Below an overhang, the map has the height of the object, not that of the
floor. Plants are upright, as in still water.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core.records import Array, MapGrid
from twin.imaging.scene.mesh_raster import DrawnMesh, Projection, Target, draw_meshes
from twin.terrains.objects.model import PlacedObject

OVERHANG_M = 0.01  #: least gap between the floor and an object that overhangs it
_ROWS_PER_BLOCK = 256  # normals and colours, which are not kept, take 15 bytes per cell


class TopSurface(NamedTuple):
    """Surface as seen from above; all arrays are (rows, cols).

    Args:
        height_m: float32, height of the highest surface [m].
        objects: uint16, 1 + number (from 0) of the object at the top; 0: the floor.
        overhung: bool, whether the floor is hidden below an object with a gap of more than OVERHANG_M.
    """

    height_m: NDArray[np.float32]
    objects: NDArray[np.uint16]
    overhung: NDArray[np.bool_]


def top_surface(grid: MapGrid, floor_m: NDArray[np.float32], objects: Sequence[PlacedObject]) -> TopSurface:
    """Returns the surface of floor and objects as seen from above.

    Args:
        floor_m: (rows, cols) height of the floor at the cell centres [m].
        objects: the objects; at most 65,535.
    """
    surface = TopSurface(floor_m.copy(), np.zeros(floor_m.shape, np.uint16), np.zeros(floor_m.shape, np.bool_))
    for first in range(0, grid.rows, _ROWS_PER_BLOCK):
        rows = slice(first, min(first + _ROWS_PER_BLOCK, grid.rows))
        block = TopSurface(surface.height_m[rows], surface.objects[rows], surface.overhung[rows])
        _fill(block, grid, first, objects)
    return surface


def _fill(block: TopSurface, grid: MapGrid, first: int, objects: Sequence[PlacedObject]) -> None:
    """Adds the objects to a block of rows of the surface, in place; `first` is the row number at which it starts."""
    shape, floor_m = block.height_m.shape, block.height_m.copy()
    view = Projection(
        1 / grid.cell_m, -grid.west_m / grid.cell_m - 0.5, grid.north_m / grid.cell_m - 0.5 - first, -np.inf, False
    )
    above = Target(-floor_m, np.empty((*shape, 3), np.uint8), np.empty((*shape, 3), np.float32), block.objects)
    below = Target(np.full(shape, np.inf, np.float32))
    north_m = grid.north_m - first * grid.cell_m
    south_m = north_m - shape[0] * grid.cell_m
    seen_from_above, seen_from_below = [], []
    for number, item in enumerate(objects):
        y, reach_m = item.centre_m[1], item.radius_m
        if south_m - reach_m <= y <= north_m + reach_m:
            mesh, _, parts = item.model.levels[0]
            pose, closed = item.world_from_object, item.model.closed
            seen_from_above.append(DrawnMesh(mesh, FROM_ABOVE @ pose, number + 1, closed, parts))
            seen_from_below.append(DrawnMesh(mesh, FROM_BELOW @ pose, parts=parts))
    draw_meshes(seen_from_above, view, above)
    draw_meshes(seen_from_below, view, below)
    block.height_m[:] = -above.depth
    block.overhung[:] = (block.objects > 0) & (below.depth - floor_m > OVERHANG_M)


FROM_ABOVE: Array = np.diag([1.0, -1.0, -1.0, 1.0])  # axes east, south, down
FROM_BELOW: Array = np.diag([1.0, -1.0, 1.0, 1.0])  # axes east, south, up, so that the lowest surface is the nearest
