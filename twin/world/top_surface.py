"""Surface as seen from above: the highest of floor and objects at the cells of a grid, and the albedo of the floor.

Below an overhang, the map has the height of the object. Plants are upright, as in still water.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from math import ceil
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from twin.core.records import Array, Image, MapGrid
from twin.imaging.scene.mesh_raster import DrawnMesh, Projection, Target, draw_meshes
from twin.imaging.scene.object_shadows import FROM_ABOVE
from twin.imaging.scene.triplanar import paint_walls_from_above, wall_surface
from twin.terrains import Terrain
from twin.terrains.objects.placed_object import PlacedObject
from twin.terrains.terrain import MAX_NODES

Layer = NDArray[np.float32]

FROM_BELOW: Array = np.diag([1.0, -1.0, 1.0, 1.0])  #: axes east, south, up, so that the lowest surface is the nearest
OVERHANG_M = 0.01  #: least gap between the floor and an object that overhangs it
FINE_M = 0.01  #: largest spacing of the nodes of `with_objects`, unless MAX_NODES requires a larger one
_ROWS_PER_BLOCK = 256  # images of a block, which are not kept, take up to 33 bytes per cell
_HEIGHTS_PER_BLOCK = 64  # the coordinates of heights take several times the memory of the grid
_BLOCK = 1024  # largest number of rows, and of columns, of samples that are computed at once, to limit memory


class TopSurface(NamedTuple):
    """Surface as seen from above; all arrays are (rows, cols)."""

    height_m: Layer  #: height of the highest surface [m]
    objects: NDArray[np.uint16] | None = None  #: 1 + number (from 0) of the object at the top, 0: floor
    #: whether the floor is hidden below an object or a part of the floor, with a gap of more than OVERHANG_M.
    overhung: NDArray[np.bool_] | None = None


def true_heights(grid: MapGrid, height_at: Callable[[Array, Array], Array]) -> Layer:
    """Returns the height of the floor at the cell centres (rows, cols) [m], by a function of arrays x and y [m]."""
    x, y = grid.centres()
    height = np.empty((grid.rows, grid.cols), np.float32)
    for rows in row_blocks(grid, _HEIGHTS_PER_BLOCK):
        height[rows] = height_at(*np.meshgrid(x, y[rows]))
    return height


def row_blocks(grid: MapGrid, size: int | None = None) -> Iterator[slice]:
    size = size or _ROWS_PER_BLOCK
    return (slice(first, min(first + size, grid.rows)) for first in range(0, grid.rows, size))


def view_from_above(grid: MapGrid, first: int = 0) -> Projection:
    column, row = -grid.west_m / grid.cell_m - 0.5, grid.north_m / grid.cell_m - 0.5 - first
    return Projection(1 / grid.cell_m, column, row, -np.inf, False)


def top_surface(grid: MapGrid, floor: TopSurface, objects: Sequence[PlacedObject]) -> TopSurface:
    """Returns the surface of a floor without objects and of at most 65,535 objects as seen from above."""
    height_m, on_top = floor.height_m.copy(), np.zeros(floor.height_m.shape, np.uint16)
    overhung = np.zeros(on_top.shape, np.bool_)
    for rows in row_blocks(grid):
        _add_objects(grid, rows, objects, height_m[rows], on_top[rows], overhung[rows])
    if floor.overhung is not None:
        overhung |= (on_top == 0) & floor.overhung
    return TopSurface(height_m, on_top, overhung)


def _add_objects(
    grid: MapGrid, rows: slice, objects: Sequence[PlacedObject],
    height_m: Layer, on_top: NDArray[np.uint16], overhung: NDArray[np.bool_],
) -> None:  # fmt: skip
    """Adds the objects to a block of rows of the layers of a `TopSurface`, in place."""
    floor_m, view = height_m.copy(), view_from_above(grid, rows.start)
    above = Target(-floor_m, np.empty((*on_top.shape, 3), np.uint8), np.empty((*on_top.shape, 3), np.float32), on_top)
    below = Target(np.full(on_top.shape, np.inf, np.float32))
    north_m = grid.north_m - rows.start * grid.cell_m
    south_m = north_m - len(on_top) * grid.cell_m
    seen_from_above, seen_from_below = [], []
    for number, item in enumerate(objects):
        if south_m - item.radius_m <= item.centre_m[1] <= north_m + item.radius_m:
            mesh, _, parts = item.model.levels[0]
            pose, closed = item.world_from_object, item.model.closed
            seen_from_above.append(DrawnMesh(mesh, FROM_ABOVE @ pose, number + 1, closed, parts))
            seen_from_below.append(DrawnMesh(mesh, FROM_BELOW @ pose, parts=parts))
    draw_meshes(seen_from_above, view, above)
    draw_meshes(seen_from_below, view, below)
    height_m[:] = -above.depth
    overhung[:] = (on_top > 0) & (below.depth - floor_m > OVERHANG_M)


def with_objects(floor: Terrain, objects: Sequence[PlacedObject]) -> Terrain:
    """Returns the terrain whose heights are those of the highest of floor and objects.

    Each cell of the floor is divided into n x n small cells, whose diagonals keep the surface away from the objects as
    it is. The side of an object is a slope between two nodes, and there is no space below overhangs.
    """
    wanted = ceil(floor.spacing_m / FINE_M - 1e-6)
    divisions = max(1, min(wanted, int(np.sqrt(MAX_NODES / floor.height_m.size))))
    spacing_m = floor.spacing_m / divisions
    rows, cols = ((n - 1) * divisions + 1 for n in floor.height_m.shape)
    nodes = MapGrid(floor.west_m - spacing_m / 2, floor.north_m + spacing_m / 2, spacing_m, rows, cols)
    # rounding may place nodes of the border outside
    heights = top_surface(nodes, TopSurface(true_heights(nodes, floor.height_near)), objects).height_m
    known = None if floor.known is None else ~floor.in_hole(*np.meshgrid(*nodes.centres()))[::-1]
    return replace(floor, height_m=np.ascontiguousarray(heights[::-1]), spacing_m=spacing_m, filled=None, known=known)


def true_albedo(terrain: Terrain, grid: MapGrid) -> NDArray[np.float32]:
    """Returns the mean albedo (rows, cols, 3) of the floor in the cells of a grid, 255 = white.

    Over at least one sample per texel along x and y, interpolated bilinearly as in a rendered image; walls have their
    own texture (`imaging.triplanar`). NaN in cells whose middle sample lies outside the terrain.
    """
    rows, cols, _ = terrain.colours.shape
    texel_m = np.array(terrain.size_m) / [cols, rows]
    n = max(1, int(np.ceil(grid.cell_m / texel_m.min() - 1e-6)))
    step_m = grid.cell_m / n
    x = grid.west_m + (np.arange(grid.cols * n) + 0.5) * step_m
    y = grid.north_m - (np.arange(grid.rows * n) + 0.5) * step_m
    col = ((x - terrain.west_m) / texel_m[0] - 0.5).astype(np.float32)
    row = ((terrain.north_m - y) / texel_m[1] - 0.5).astype(np.float32)
    out = np.empty((grid.rows, grid.cols, 3), np.float32)
    side, walls = max(1, _BLOCK // n), wall_surface(terrain)
    for top in range(0, grid.rows, side):
        for left in range(0, grid.cols, side):
            part = out[top : top + side, left : left + side]
            of_cols, of_rows = slice(left * n, (left + side) * n), slice(top * n, (top + side) * n)
            xs, ys = x[of_cols], y[of_rows]
            texture = terrain.texture_within(np.array([xs[0], ys[-1]]), np.array([xs[-1], ys[0]]))
            source = _cropped(texture, *np.meshgrid(col[of_cols], row[of_rows]))
            fine = np.asarray(cv2.remap(*source, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.uint8)
            paint_walls_from_above(terrain, walls, fine, xs, ys, step_m)
            part[:] = fine.reshape(len(part), n, -1, n, 3).mean(axis=(1, 3), dtype=np.float32)
    inside_x = (x[n // 2 :: n] >= terrain.west_m) & (x[n // 2 :: n] <= terrain.east_m)
    inside_y = (y[n // 2 :: n] >= terrain.south_m) & (y[n // 2 :: n] <= terrain.north_m)
    out[~(inside_y[:, None] & inside_x)] = np.nan
    return out


def without_objects(albedo: Layer, grid: MapGrid, objects: NDArray[np.uint16] | None, map_grid: MapGrid) -> Layer:
    """Returns the albedo (rows, cols, 3) on `grid` with NaN where `objects`, on `map_grid`, has an object."""
    if objects is None:
        return albedo
    x, y = grid.centres()
    cols = np.clip(np.floor((x - map_grid.west_m) / map_grid.cell_m).astype(int), 0, map_grid.cols - 1)
    rows = np.clip(np.floor((map_grid.north_m - y) / map_grid.cell_m).astype(int), 0, map_grid.rows - 1)
    return np.where(objects[np.ix_(rows, cols)][..., None] > 0, np.float32(np.nan), albedo)


def _cropped(texture: Image, across: Layer, down: Layer) -> tuple[Image, Layer, Layer]:
    """Returns the part of a texture around columns and rows, and these relative to it: OpenCV takes 32767 px."""
    rows, cols, _ = texture.shape
    top, left = (int(np.clip(place.min() - 1, 0, n - 1)) for place, n in ((down, rows), (across, cols)))
    end, right = (int(np.clip(place.max() + 3, 1, n)) for place, n in ((down, rows), (across, cols)))
    return texture[top:end, left:right], across - np.float32(left), down - np.float32(top)
