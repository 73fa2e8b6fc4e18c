"""Ray casting against the floor without OpenGL, for surrogate surveys."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from terrains import Terrain
from twin.core.geometry import Array
from twin.core.records import StereoRig

Depth = NDArray[np.float32]

_MAX_STEPS = 200
_TOLERANCE_M = 1e-4  # a ray intersects the floor where it is less than this height above it


class FloorRayCaster:
    """Ray caster against the triangles of a terrain.

    Sphere tracing over a height field (Hart 1996). The length of a step is the height of the ray above the floor,
    divided by the largest rate at which this height can decrease, which follows from the steepest slope of the
    terrain. Hence no step passes through the floor.
    """

    def __init__(self, terrain: Terrain):
        height = np.ascontiguousarray(terrain.height_m, np.float64)
        rise, run = (float(np.abs(np.diff(height, axis=k)).max()) for k in (0, 1))
        self._height_field = (
            height, terrain.spacing_m, terrain.west_m, terrain.south_m, terrain.highest_m,
            float(np.hypot(rise, run)) / terrain.spacing_m,
        )  # fmt: skip

    def depth_at(self, pixels: Array, world_from_camera: Array, rig: StereoRig) -> Array:
        """Returns the depth (n,) along the optical axis [m] at pixels (n, 2); inf where a ray misses the floor."""
        return _depth_at(self._height_field, pixels, world_from_camera, rig.focal_px, rig.cx_px, rig.cy_px)

    def depth(self, world_from_camera: Array, rig: StereoRig) -> Depth:
        """Returns the depth image (height_px, width_px) along the optical axis [m]; inf where rays miss the floor."""
        grid = np.indices((rig.height_px, rig.width_px), dtype=np.float64)
        pixels = np.stack([grid[1].ravel(), grid[0].ravel()], axis=1)
        depth = self.depth_at(pixels, world_from_camera, rig)
        return depth.reshape(rig.height_px, rig.width_px).astype(np.float32)


@njit(cache=True, nogil=True)
def _depth_at(height_field, pixels, pose, focal, cx, cy):
    depth = np.empty(len(pixels))
    for k in range(len(pixels)):
        depth[k] = _ray_depth(height_field, pose, (pixels[k, 0] - cx) / focal, (pixels[k, 1] - cy) / focal)
    return depth


@njit(cache=True, nogil=True)
def _ray_depth(height_field, pose, a, b):
    """Returns the depth at which the camera ray through (a, b, 1) intersects the floor; inf if it does not."""
    height, spacing, west, south, highest, steepest = height_field
    dx = pose[0, 0] * a + pose[0, 1] * b + pose[0, 2]
    dy = pose[1, 0] * a + pose[1, 1] * b + pose[1, 2]
    dz = pose[2, 0] * a + pose[2, 1] * b + pose[2, 2]
    if dz >= 0:
        return np.inf
    closing = -dz + steepest * np.sqrt(dx * dx + dy * dy)
    depth = max(0.0, (highest - pose[2, 3]) / dz)
    for _ in range(_MAX_STEPS):
        floor = _height_at(height, spacing, west, south, pose[0, 3] + depth * dx, pose[1, 3] + depth * dy)
        gap = pose[2, 3] + depth * dz - floor
        if np.isnan(gap):
            return np.inf
        if gap < _TOLERANCE_M:
            return depth
        depth += gap / closing
    return np.inf


@njit(cache=True, nogil=True, inline="always")
def _height_at(height, spacing, west, south, x, y):
    """Compiled kernel of `Terrain.height_at`: linear on the two triangles of a cell, NaN outside the terrain."""
    col, row = (x - west) / spacing, (y - south) / spacing
    rows, cols = height.shape
    if not (0 <= col <= cols - 1 and 0 <= row <= rows - 1):
        return np.nan
    c, r = min(int(col), cols - 2), min(int(row), rows - 2)
    u, v = col - c, row - r
    h00, h11 = height[r, c], height[r + 1, c + 1]
    if u >= v:
        h01 = height[r, c + 1]
        return h00 + u * (h01 - h00) + v * (h11 - h01)
    h10 = height[r + 1, c]
    return h00 + v * (h10 - h00) + u * (h11 - h10)
