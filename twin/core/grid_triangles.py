"""Triangulation of a regular grid: two triangles per cell, split along the diagonal from south-west to north-east."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from twin.kernels import kernel


def grid_triangles(vertices: NDArray[Any]) -> NDArray[Any]:
    """Returns the triangles of a grid, counter-clockwise as seen from above, cell by cell.

    Args:
        vertices: (rows, cols) vertex numbers; rows run from south to north, columns from west to east.

    Returns:
        (2 (rows - 1) (cols - 1), 3) vertex numbers, of the same integer type.
    """
    sw, se, ne, nw = vertices[:-1, :-1], vertices[:-1, 1:], vertices[1:, 1:], vertices[1:, :-1]
    return np.stack([sw, se, ne, sw, ne, nw], axis=-1).reshape(-1, 3)


def raster_triangles(valid: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Returns the triangles that connect the centres of valid raster cells, counter-clockwise as seen from above.

    Args:
        valid: (rows, cols) bool; row 0 is the northernmost.

    Returns:
        (n, 3) indices of the cells at the corners, in the flattened (row-major) raster.
    """
    cells = np.arange(valid.size).reshape(valid.shape)
    triangles = grid_triangles(cells[::-1])
    return triangles[valid.reshape(-1)[triangles].all(axis=1)]


@kernel(inline="always")
def rises(south_west, south_east, north_west, north_east, east_part, north_part):
    """Returns the rise over a cell towards east and north of its triangle at a point, given as parts of the cell."""
    lower = east_part >= north_part
    east = south_east - south_west if lower else north_east - north_west
    return east, north_east - south_east if lower else north_west - south_west
