"""Grid of a map that covers the keyframe images of a survey, and its division into tiles where it has many cells."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.ortho_tiles import window
from twin.core.records import MapGrid, StereoRig, SurveyResult

_MOST_CELLS = 2.5e7  # the cells of a map with more cells are enlarged; at 125 bytes per cell it takes 3.1 GB
_CELL_PX = 3.0  # side of a map cell in pixels at the median depth, so that several disparities support each height
_TILE_CELLS = 1024  # side of a tile; at 100 bytes per cell it takes 100 MB while it is built
_MARGIN = 0.25  # fraction of its size by which an image on the floor may be larger than at the median depth


class MapTile(NamedTuple):
    """Part of a map: a square of cells, cut off at the east and south edges of the map."""

    #: row, col: number of the tile from the north and from the west, from 0.
    row: int
    col: int
    grid: MapGrid  #: its cells, which are cells of the grid of the whole map
    keyframes: NDArray[np.int64]  #: (n,) numbers of the keyframes whose images may show it


def footprint_grid(result: SurveyResult, rig: StereoRig, most_cells: float = _MOST_CELLS) -> MapGrid:
    """Returns the grid, in the axes of the final trajectory, that covers all keyframe images at their median depths."""
    # a cell is as large as three pixels at the median depth of all keyframes, or larger for about `most_cells` cells
    seen = _corners(result, rig).reshape(-1, 2)
    cell = _CELL_PX * float(np.median(result.keyframe_depth_m)) / rig.focal_px
    size_m = np.ptp(seen, axis=0) + 2 * cell
    cell = max(cell, float(np.sqrt(size_m[0] * size_m[1] / most_cells)))
    west, south = np.floor(seen.min(axis=0) / cell) * cell
    east, north = np.ceil(seen.max(axis=0) / cell) * cell
    return MapGrid(float(west), float(north), cell, round((north - south) / cell), round((east - west) / cell))


def footprint_tiles(
    result: SurveyResult, rig: StereoRig, most_cells: float = _MOST_CELLS, side: int = _TILE_CELLS
) -> list[MapTile]:
    """Returns the tiles, of `side` cells of three pixels, that images show; none for up to `most_cells` cells."""
    whole = footprint_grid(result, rig, np.inf)
    if whole.rows * whole.cols <= most_cells * (1 + 1e-3):  # of rounding to whole cells
        return []
    corners, tile_m = _corners(result, rig), side * whole.cell_m
    low, high = corners.min(axis=1), corners.max(axis=1)
    low, high = low - _MARGIN * (high - low), high + _MARGIN * (high - low)
    origin, last = np.array([whole.west_m, whole.north_m]), [-(-whole.cols // side) - 1, -(-whole.rows // side) - 1]
    first = np.clip(np.floor(np.stack([low[:, 0] - origin[0], origin[1] - high[:, 1]], 1) / tile_m), 0, last)
    final = np.clip(np.floor(np.stack([high[:, 0] - origin[0], origin[1] - low[:, 1]], 1) / tile_m), 0, last)
    shown: dict[tuple[int, int], list[int]] = {}
    for number, (a, b) in enumerate(zip(first.astype(int), final.astype(int), strict=True)):
        for row in range(a[1], b[1] + 1):
            for col in range(a[0], b[0] + 1):
                shown.setdefault((row, col), []).append(number)
    tiles = []
    for (row, col), numbers in sorted(shown.items()):
        rows, cols = min(side, whole.rows - row * side), min(side, whole.cols - col * side)
        grid = window(whole, row * side, col * side, rows, cols)
        tiles.append(MapTile(row, col, grid, np.array(numbers, np.int64)))
    return tiles


def steps_between(step_cov: Array, keyframes: NDArray[np.int64]) -> Array:
    """Returns the covariance (m, 6, 6) of each chosen keyframe (m,), m > 0, relative to the chosen one before."""
    # without lever arms, as nothing is propagated between keyframes that are far apart
    first, until = step_cov[keyframes[:1]], step_cov[: keyframes[-1] + 1]
    if len(keyframes) == 1:
        return first
    return np.concatenate([first, np.add.reduceat(until, keyframes[:-1] + 1, axis=0)])


def with_margin(grid: MapGrid, cells: int) -> MapGrid:
    return window(grid, -cells, -cells, grid.rows + 2 * cells, grid.cols + 2 * cells)


def _corners(result: SurveyResult, rig: StereoRig) -> Array:
    """Returns x and y (n, 4, 2) of the corners of the keyframe images, projected to their median depths [m]."""
    pixels = np.array([[0, 0], [rig.width_px, 0], [0, rig.height_px], [rig.width_px, rig.height_px]], np.float64)
    rays = np.column_stack([rig.normalised(pixels - 0.5), np.ones(4)])
    poses = result.final.world_from_camera[result.keyframe_rows]
    return np.array(
        [geometry.transform(p, rays * d)[:, :2] for p, d in zip(poses, result.keyframe_depth_m, strict=True)]
    )
