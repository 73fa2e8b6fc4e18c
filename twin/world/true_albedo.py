"""True orthomosaic: the albedo of the floor at the pixels of a grid, seen from above."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

import terrains
from twin.core.records import Image, MapGrid

Layer = NDArray[np.float32]

_ROWS = 128  # rows of the grid that are computed at once, to limit memory


def true_albedo(terrain: terrains.Terrain, grid: MapGrid) -> NDArray[np.float32]:
    """Returns the mean albedo (rows, cols, 3) of the floor in the cells of a grid, 255 = white; NaN outside.

    The mean is taken over at least one sample per texel; samples are interpolated bilinearly, as in a rendered image.
    """
    rows, cols, _ = terrain.texture.shape
    texel_m = np.array(terrain.size_m) / [cols, rows]
    n = max(1, int(np.ceil(grid.cell_m / texel_m.min() - 1e-6)))
    step_m = grid.cell_m / n
    x = grid.west_m + (np.arange(grid.cols * n) + 0.5) * step_m
    col = ((x - terrain.west_m) / texel_m[0] - 0.5).astype(np.float32)
    inside_x = (x[n // 2 :: n] >= terrain.west_m) & (x[n // 2 :: n] <= terrain.east_m)
    out = np.empty((grid.rows, grid.cols, 3), np.float32)
    for first in range(0, grid.rows, _ROWS):
        part = out[first : first + _ROWS]
        y = grid.north_m - (first * n + np.arange(len(part) * n) + 0.5) * step_m
        row = ((terrain.north_m - y) / texel_m[1] - 0.5).astype(np.float32)
        across, down = np.meshgrid(col, row)
        fine = cv2.remap(*_cropped(terrain.texture, across, down), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        part[:] = fine.reshape(len(part), n, grid.cols, n, 3).mean(axis=(1, 3), dtype=np.float32)
        inside_y = (y[n // 2 :: n] >= terrain.south_m) & (y[n // 2 :: n] <= terrain.north_m)
        part[~(inside_y[:, None] & inside_x)] = np.nan
    return out


def without_objects(albedo: Layer, grid: MapGrid, objects: NDArray[np.uint16] | None, map_grid: MapGrid) -> Layer:
    """Returns an albedo (rows, cols, 3) of the floor with NaN where an object is the true surface of the map.

    The albedo does not contain the colours of the objects.

    Args:
        albedo: albedo of the floor on `grid`.
        grid: grid of the albedo, within `map_grid`.
        objects: number of the object in each cell of `map_grid`, 0 for the floor; None without objects.
        map_grid: grid of the map.
    """
    if objects is None:
        return albedo
    x, y = grid.centres()
    cols = np.clip(np.floor((x - map_grid.west_m) / map_grid.cell_m).astype(int), 0, map_grid.cols - 1)
    rows = np.clip(np.floor((map_grid.north_m - y) / map_grid.cell_m).astype(int), 0, map_grid.rows - 1)
    return np.where(objects[np.ix_(rows, cols)][..., None] > 0, np.float32(np.nan), albedo)


def _cropped(texture: Image, across: Layer, down: Layer) -> tuple[Image, Layer, Layer]:
    """Returns the part of a texture around given columns and rows, and these columns and rows relative to that part.

    OpenCV cannot resample images with more than 32767 pixels along a side.
    """
    rows, cols, _ = texture.shape
    top, left = (int(np.clip(place.min() - 1, 0, n - 1)) for place, n in ((down, rows), (across, cols)))
    end, right = (int(np.clip(place.max() + 3, 1, n)) for place, n in ((down, rows), (across, cols)))
    return texture[top:end, left:right], across - np.float32(left), down - np.float32(top)
