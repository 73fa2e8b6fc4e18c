"""True orthomosaic: the albedo of the floor at the pixels of a grid, seen from above."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from twin import terrains
from twin.core.records import Image, MapGrid
from twin.imaging.scene.triplanar import paint_walls_from_above, wall_surface

Layer = NDArray[np.float32]

_BLOCK = 1024  # largest number of rows, and of columns, of samples that are computed at once, to limit memory


def true_albedo(terrain: terrains.Terrain, grid: MapGrid) -> NDArray[np.float32]:
    """Returns the mean albedo (rows, cols, 3) of the floor in the cells of a grid, 255 = white.

    The mean is taken over at least one sample per texel along x and y; samples are interpolated bilinearly, as in a
    rendered image, and walls have their own texture (`imaging.triplanar`). It is NaN in cells whose middle sample lies
    outside the terrain.
    """
    rows, cols, _ = terrain.texture.shape
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
            fine = _samples(terrain.texture, *np.meshgrid(col[of_cols], row[of_rows]))
            if walls is not None:
                paint_walls_from_above(walls, fine, x[of_cols], y[of_rows], step_m)
            part[:] = fine.reshape(len(part), n, -1, n, 3).mean(axis=(1, 3), dtype=np.float32)
    inside_x = (x[n // 2 :: n] >= terrain.west_m) & (x[n // 2 :: n] <= terrain.east_m)
    inside_y = (y[n // 2 :: n] >= terrain.south_m) & (y[n // 2 :: n] <= terrain.north_m)
    out[~(inside_y[:, None] & inside_x)] = np.nan
    return out


def _samples(texture: Image, across: Layer, down: Layer) -> Image:
    """Returns the samples (rows, cols, 3) of a texture (h, w, 3) at columns and rows (rows, cols), bilinearly."""
    resampled = cv2.remap(*_cropped(texture, across, down), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(resampled, np.uint8)


def without_objects(albedo: Layer, grid: MapGrid, objects: NDArray[np.uint16] | None, map_grid: MapGrid) -> Layer:
    """Returns the albedo (rows, cols, 3) of the floor on `grid`, with NaN where an object is the surface of the map.

    Args:
        grid: grid of the albedo, within `map_grid`.
        objects: `TopSurface.objects` on `map_grid`.
    """
    if objects is None:
        return albedo
    x, y = grid.centres()
    cols = np.clip(np.floor((x - map_grid.west_m) / map_grid.cell_m).astype(int), 0, map_grid.cols - 1)
    rows = np.clip(np.floor((map_grid.north_m - y) / map_grid.cell_m).astype(int), 0, map_grid.rows - 1)
    return np.where(objects[np.ix_(rows, cols)][..., None] > 0, np.float32(np.nan), albedo)


def _cropped(texture: Image, across: Layer, down: Layer) -> tuple[Image, Layer, Layer]:
    """Returns the part of a texture around given columns and rows, and these columns and rows relative to that part.

    OpenCV can resample neither from nor to images with more than 32767 pixels along a side.
    """
    rows, cols, _ = texture.shape
    top, left = (int(np.clip(place.min() - 1, 0, n - 1)) for place, n in ((down, rows), (across, cols)))
    end, right = (int(np.clip(place.max() + 3, 1, n)) for place, n in ((down, rows), (across, cols)))
    return texture[top:end, left:right], across - np.float32(left), down - np.float32(top)
