"""Facets of the floor: the normals of the triangles of its height grid, for the shading of the pixels that show them.

The depth of a pixel gives a point in one of the two triangles of a cell, those that are rendered (`floor_raster`).
A normal, which points up, is stored in 32 bits as (nx, ny) / (1 + nz), 16 bits each; its error is below 0.004 deg.
"""

from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from twin.core.geometry import Array
from twin.core.height_field import HeightField
from twin.terrains import Terrain

UNIT = 32767  # integer that represents 1 in a stored normal


#: Grid of floor heights; row 0 = south, column 0 = west.
Heights: TypeAlias = Terrain | HeightField


class FacetView(NamedTuple):
    """Facets of the floor relative to a camera."""

    normals: NDArray[np.int32]  # (rows, cols, 2) stored normals of the south-east and the north-west triangle of cells
    origin: NDArray[np.int32]  # (2,) column and row of a cell near the camera, so that single precision suffices
    # (2, 4) map from a point in the axes of the camera [m] to column and row relative to `origin`
    grid_from_camera: NDArray[np.float32]
    camera_from_world: NDArray[np.float32]  # (3, 3) rotation from world axes to those of the camera


NO_FACETS = FacetView(
    np.zeros((0, 0, 2), np.int32), np.zeros(2, np.int32), np.zeros((2, 4), np.float32), np.zeros((3, 3), np.float32)
)


class Facets:
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
    south_west, south_east, north_west, north_east = height[:-1, :-1], height[:-1, 1:], height[1:, :-1], height[1:, 1:]
    lower = _stored(south_east - south_west, north_east - south_east, spacing)
    return np.stack([lower, _stored(north_east - north_west, north_west - south_west, spacing)], axis=-1)


def _stored(rise_east: Array, rise_north: Array, spacing: float) -> NDArray[np.int32]:
    """Returns stored normals: the upper 16 bits are `UNIT` x / (1 + z), the lower 16 bits `UNIT` y / (1 + z)."""
    per = -UNIT / (spacing + np.sqrt(rise_east * rise_east + rise_north * rise_north + spacing * spacing))
    x, y = np.rint(rise_east * per).astype(np.int32), np.rint(rise_north * per).astype(np.int32)
    return (x << 16) | (y & 0xFFFF)
