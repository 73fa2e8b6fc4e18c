"""Grid and tiles of an orthomosaic, which is made, written and evaluated tile by tile so that memory is bounded."""

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from twin.core.records import Array, Image, MapGrid, Mask

#: Side of a tile [px]. A tile in progress takes 24 bytes per pixel: with its margin, 32 MB.
TILE_PX = 1024
_ROWS = 64  # rows of a grid at whose centres a function is evaluated at once


class OrthoTile(NamedTuple):
    """Rectangular part of an orthomosaic."""

    grid: MapGrid  #: grid of the pixels of the whole orthomosaic
    #: row, col: row and column of the first pixel of the tile in that grid.
    row: int
    col: int
    rgba: Image  #: (rows, cols, 4) uint8; the last band is 255 where the orthomosaic has a colour, otherwise 0

    @property
    def known(self) -> np.ndarray:
        return self.rgba[..., 3] > 0


def finer_grid(grid: MapGrid, pixel_m: float) -> MapGrid:
    """Returns the grid that divides the cells of a map into the fewest squares that are not larger than `pixel_m`."""
    n = max(1, int(np.ceil(grid.cell_m / pixel_m - 1e-9)))
    return replace(grid, cell_m=grid.cell_m / n, rows=grid.rows * n, cols=grid.cols * n)


def tile_side_px(n: int) -> int:
    """Returns the side of a tile [px]: the largest multiple of n up to `TILE_PX`, but at least n."""
    return max(TILE_PX - TILE_PX % n, n)


def mean_colours(tile: OrthoTile, n: int) -> Image:
    """Returns the mean colours (rows // n, cols // n, 3) of the known pixels of squares of n x n pixels, or black."""
    rows, cols = (size // n for size in tile.rgba.shape[:2])
    squares, means = tile.rgba[: rows * n, : cols * n].reshape(rows, n, cols, n, 4), np.empty((rows, cols, 3), np.uint8)
    for row in range(rows):  # one by one: a whole tile in float32 takes 17 MB
        part = squares[row].astype(np.float32)
        known = part[..., 3:] > 0
        total = (part[..., :3] * known).sum(axis=(0, 2))
        means[row] = total / np.maximum(known.sum(axis=(0, 2)), 1) + 0.5
    return means


def at_centres(test: Callable[[Array, Array], Mask], grid: MapGrid) -> Mask:
    """Returns the mask (rows, cols) of the cells of a grid whose centres (x, y) [m] pass a test."""
    # by some rows at a time: those of the terrain take 120 bytes per point
    x, y = grid.centres()
    return np.concatenate([test(*np.meshgrid(x, y[row : row + _ROWS])) for row in range(0, grid.rows, _ROWS)])


def window(grid: MapGrid, row: int, col: int, rows: int, cols: int) -> MapGrid:
    """Returns the grid of `rows` x `cols` cells whose first cell is (row, col) of a grid; it may extend beyond it."""
    west_m, north_m = grid.west_m + col * grid.cell_m, grid.north_m - row * grid.cell_m
    return MapGrid(west_m, north_m, grid.cell_m, rows, cols)
