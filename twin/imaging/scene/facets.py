"""Facets of the floor: the normals of the triangles of its height grid, for the shading of the pixels that show them.

The depth of a pixel gives a point in one of the two triangles of a cell, those that are rendered (`twin.scenes.floor`).
A normal, which points up, is stored in 32 bits as (nx, ny) / (1 + nz), 16 bits each; its error is below 0.004 deg.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

UNIT = 32767  # integer that represents 1 in a stored normal


class Heights(Protocol):
    """Grid of floor heights; row 0 = south, column 0 = west. Its south-west node is at `west_m`, `south_m`."""

    @property
    def height_m(self) -> NDArray[np.floating]: ...
    @property
    def spacing_m(self) -> float: ...
    @property
    def west_m(self) -> float: ...
    @property
    def south_m(self) -> float: ...


class FacetView(NamedTuple):
    """Facets of the floor relative to a camera."""

    # (rows, cols, 2) int32 stored normals of the two triangles of each cell, south-east and north-west of the diagonal
    # from the cell's south-west to its north-east node
    normals: NDArray[np.int32]
    # (2,) column and row of the cell near the camera to which `grid_from_camera` refers, so that single precision
    # suffices
    origin: NDArray[np.int32]
    # (2, 4) map from a point in the axes of the camera [m] to column and row relative to `origin`
    grid_from_camera: NDArray[np.float32]
    camera_from_world: NDArray[np.float32]  # (3, 3) rotation from world axes to those of the camera


class Facets:
    """Facets of a floor, for cameras in any pose."""

    def __init__(self, floor: Heights):
        self._normals = _stored_normals(floor.height_m.astype(np.float32).astype(np.float64), floor.spacing_m)
        self._corner_m, self._spacing_m = np.array([floor.west_m, floor.south_m]), floor.spacing_m

    def seen_from(self, world_from_camera: Array) -> FacetView:
        """Returns the facets relative to a camera with the pose `world_from_camera` (4, 4)."""
        grid = np.array(world_from_camera[:2])
        grid[:, 3] -= self._corner_m
        grid /= self._spacing_m
        rows, cols, _ = self._normals.shape
        origin = np.clip(np.floor(grid[:, 3]), 0, [cols - 1, rows - 1])
        grid[:, 3] -= origin
        camera_from_world = np.ascontiguousarray(world_from_camera[:3, :3].T, np.float32)
        return FacetView(self._normals, origin.astype(np.int32), grid.astype(np.float32), camera_from_world)


def _stored_normals(height: Array, spacing: float) -> NDArray[np.int32]:
    """Returns the stored normals (rows, cols, 2) of the triangles of a height grid (rows + 1, cols + 1)."""
    south_west, south_east, north_west, north_east = height[:-1, :-1], height[:-1, 1:], height[1:, :-1], height[1:, 1:]
    lower = _stored(south_east - south_west, north_east - south_east, spacing)
    return np.stack([lower, _stored(north_east - north_west, north_west - south_west, spacing)], axis=-1)


def _stored(rise_east: Array, rise_north: Array, spacing: float) -> NDArray[np.int32]:
    """Returns stored normals (x, y, z), with x east and y north.

    Their upper 16 bits are `UNIT` x / (1 + z), their lower 16 bits `UNIT` y / (1 + z).
    """
    per = -UNIT / (spacing + np.sqrt(rise_east * rise_east + rise_north * rise_north + spacing * spacing))
    x, y = np.rint(rise_east * per).astype(np.int32), np.rint(rise_north * per).astype(np.int32)
    return (x << 16) | (y & 0xFFFF)
