"""Model of the elevation map: samples the grid cells that a keyframe sees and the heights that it contributes.

The heights stand for those from the Kalman depth filter, with one sample per grid cell for all pixels that show the
cell. A cell is visible if its centre projects into both images; occlusion by relief is not modelled.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.records import MapGrid, StereoRig
from twin.estimate.mapping import surface
from twin.estimate.mapping.surface import HeightPatch

Map = NDArray[np.float32]


class CellErrors(NamedTuple):
    """Errors of the filtered depth: random numbers and standard deviations.

    Args:
        lateral_noise: (rows, cols) standard normal numbers of the lateral error, shared by all views of a cell.
        dropout: (rows, cols) uniform numbers in [0, 1); a cell whose number exceeds `completeness` has no depth.
        lateral_sigma_px: standard deviation of the lateral error [px].
        depths_m: (m,) ascending depths of the tabulated values below [m].
        depth_error_px: (m,) true standard deviation of the depth [px of disparity].
        depth_sigma_px: (m,) reported standard deviation of the depth [px of disparity].
        completeness: (m,) fraction of the cells in view for which the filter provides a depth.
    """

    lateral_noise: Map
    dropout: Map
    lateral_sigma_px: float
    depths_m: Array
    depth_error_px: Array
    depth_sigma_px: Array
    completeness: Array


class MapModel:
    """Samples the height patch of each keyframe: true heights of the floor plus errors.

    Args:
        grid: grid of the map.
        height_m: (rows, cols) true height at the cell centres [m].
        rig: true calibration.

    Attributes:
        seen: (rows, cols) mask of the cells that at least one keyframe observed; updated by `mark_seen`.
    """

    def __init__(self, grid: MapGrid, height_m: Map, rig: StereoRig):
        self.grid, self.height_m, self.seen, self._rig = grid, height_m, np.zeros(height_m.shape, np.bool_), rig
        down, east = np.gradient(np.asarray(height_m, np.float64), grid.cell_m)
        self._slope = np.stack([east, -down], axis=-1).astype(np.float32)
        self._lowest_m = float(np.nanmin(height_m))
        self._geotransform = (grid.west_m, grid.north_m, grid.cell_m)
        self._camera = (
            rig.focal_px, rig.cx_px, rig.cy_px, float(rig.width_px - 1), float(rig.height_px - 1), rig.baseline_m,
        )  # fmt: skip

    @property
    def steepness(self) -> Map:
        """Returns the magnitude of the slope of the floor (rows, cols) [m/m]."""
        return np.hypot(*np.moveaxis(self._slope, -1, 0))

    def mark_seen(self, world_from_camera: Array) -> None:
        """Marks the cells that both cameras see from the true pose (4, 4) of a keyframe."""
        window = self._window(world_from_camera)
        camera_from_world = geometry.inverse(world_from_camera)
        _mark(self.seen, self.height_m, self._geotransform, self._camera, camera_from_world, *window)

    def sample_patch(
        self,
        true: Array,
        next_true: Array | None,
        estimated: Array,
        cov: Array,
        errors: CellErrors,
        rng: np.random.Generator,
    ) -> HeightPatch | None:
        """Samples the height patch of a keyframe: the heights of the cells that it sees and the next keyframe does not.

        Args:
            true: (4, 4) true pose of the keyframe.
            next_true: (4, 4) true pose of the next keyframe; None for the last one.
            estimated: (4, 4) estimated pose of the keyframe.
            cov: (6, 6) covariance of the estimated pose, in camera axes.
            errors: distribution of the depth errors, and their part that is common to all keyframes.
            rng: random generator of the depth errors that are independent between keyframes.

        Returns:
            The patch, or None if the field of view does not overlap the grid.
        """
        row, end_row, col, end_col = self._window(true)
        if row >= end_row or col >= end_col:
            return None
        shape = (end_row - row, end_col - col)
        height = np.full(shape, np.nan, np.float32)
        variance, systematic = height.copy(), height.copy()
        is_last = next_true is None
        camera_from_world = np.stack([geometry.inverse(true), geometry.inverse(true if is_last else next_true)])
        estimated_from_true = estimated @ camera_from_world[0]
        rotation = geometry.adjoint(geometry.pose(estimated[:3, :3], np.zeros(3)))
        depth_m = _sample_patch(
            height, variance, systematic, self.height_m, self._slope, self._geotransform, self._camera,
            camera_from_world, is_last, estimated_from_true, estimated[:3, 3].copy(), rotation @ cov @ rotation.T,
            rng.standard_normal(shape, np.float32), errors, row, col,
        )  # fmt: skip
        lateral = surface.LATERAL_SIGMA_PX * depth_m / self._rig.focal_px
        return HeightPatch(row, col, height, variance, systematic, np.zeros((*shape, 2), np.float32), lateral)

    def _window(self, world_from_camera: Array) -> tuple[int, int, int, int]:
        """Returns (first row, end row, first column, end column) of the cells that may be in view; ends are exclusive.

        They cover the footprint of the image on a plane at the lowest height of the floor.
        """
        size = (self.grid.rows, self.grid.cols)
        return _window(world_from_camera, self._camera, self._geotransform, self._lowest_m, size)


@njit(cache=True, nogil=True)
def _window(pose, camera, geotransform, lowest, size):
    """Compiled kernel of `MapModel._window`."""
    focal, cx, cy, _, _, _ = camera
    west, north, cell = geotransform
    rows, cols = size
    x_low = x_high = pose[0, 3]
    y_low = y_high = pose[1, 3]
    for u, v in ((-cx, -cy), (cx, -cy), (-cx, cy), (cx, cy)):
        a, b = u / focal, v / focal
        dx = pose[0, 0] * a + pose[0, 1] * b + pose[0, 2]
        dy = pose[1, 0] * a + pose[1, 1] * b + pose[1, 2]
        dz = pose[2, 0] * a + pose[2, 1] * b + pose[2, 2]
        if dz >= -0.1:  # the view (nearly) reaches the horizon: take the whole grid
            return 0, rows, 0, cols
        far = (lowest - pose[2, 3]) / dz
        x_low, x_high = min(x_low, pose[0, 3] + far * dx), max(x_high, pose[0, 3] + far * dx)
        y_low, y_high = min(y_low, pose[1, 3] + far * dy), max(y_high, pose[1, 3] + far * dy)
    first_row, end_row = max(int((north - y_high) / cell) - 1, 0), min(int((north - y_low) / cell) + 2, rows)
    first_col, end_col = max(int((x_low - west) / cell) - 1, 0), min(int((x_high - west) / cell) + 2, cols)
    return first_row, end_row, first_col, end_col


@njit(cache=True, nogil=True, inline="always")
def _depth_in(camera_from_world, camera, x, y, z):
    """Returns the depth of a world point in the left camera; -1 if the point is behind it or outside either image."""
    focal, cx, cy, right, bottom, baseline = camera
    m = camera_from_world
    depth = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3]
    if not depth > 0:
        return -1.0
    u = focal * (m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3]) / depth + cx
    v = focal * (m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3]) / depth + cy
    if 0 <= v <= bottom and u <= right and u - focal * baseline / depth >= 0:
        return depth
    return -1.0


@njit(cache=True, nogil=True)
def _mark(seen, height, geotransform, camera, camera_from_world, row, end_row, col, end_col):
    """Sets `seen` for the cells of a window that project into both images."""
    west, north, cell = geotransform
    for i in range(row, end_row):
        y = north - (i + 0.5) * cell
        for j in range(col, end_col):
            if not seen[i, j]:
                x = west + (j + 0.5) * cell
                seen[i, j] = _depth_in(camera_from_world, camera, x, y, height[i, j]) > 0


@njit(cache=True, nogil=True)
def _sample_patch(
    out, variance, systematic, height, slope, geotransform, camera, camera_from_world, is_last, estimated_from_true,
    position, cov, depth_noise, errors, row, col,
):  # fmt: skip
    """Compiled kernel of `MapModel.sample_patch`; returns the mean depth [m].

    Writes the heights to `out`, their variances due to depth errors to `variance`, and their variances due to the pose
    and the lateral error to `systematic`.
    """
    (west, north, cell), m = geotransform, estimated_from_true
    total, count = 0.0, 0
    for i in range(row, row + out.shape[0]):
        y = north - (i + 0.5) * cell
        for j in range(col, col + out.shape[1]):
            x, z = west + (j + 0.5) * cell, height[i, j]
            depth = _depth_in(camera_from_world[0], camera, x, y, z)
            if depth < 0 or (not is_last and _depth_in(camera_from_world[1], camera, x, y, z) > 0):
                continue
            k, fraction = _interval(errors.depths_m, depth)
            if errors.dropout[i, j] > _interpolate(errors.completeness, k, fraction):
                continue
            sx, sy = np.float64(slope[i, j, 0]), np.float64(slope[i, j, 1])
            # estimated position of the floor at this cell, and the height of its tangent plane at the cell's centre
            px = m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3]
            py = m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3]
            pz = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3]
            value = pz - sx * (px - x) - sy * (py - y)
            per_px = depth * depth / (camera[0] * camera[5])
            steep = np.sqrt(sx * sx + sy * sy)
            value += per_px * _interpolate(errors.depth_error_px, k, fraction) * depth_noise[i - row, j - col]
            value += steep * errors.lateral_sigma_px * depth / camera[0] * errors.lateral_noise[i, j]
            out[i - row, j - col] = value
            variance[i - row, j - col] = (per_px * _interpolate(errors.depth_sigma_px, k, fraction)) ** 2
            systematic[i - row, j - col] = surface.pose_variance(
                x - position[0], y - position[1], z - position[2], sx, sy, cov
            )
            systematic[i - row, j - col] += (surface.LATERAL_SIGMA_PX * depth / camera[0] * steep) ** 2
            total += depth
            count += 1
    return total / max(count, 1)


@njit(cache=True, nogil=True, inline="always")
def _interval(ascending, value):
    """Returns the index of the interval that contains a value, and the value's relative position (0 to 1) in it."""
    k = 0
    while k < len(ascending) - 2 and value > ascending[k + 1]:
        k += 1
    return k, min(max((value - ascending[k]) / (ascending[k + 1] - ascending[k]), 0.0), 1.0)


@njit(cache=True, nogil=True, inline="always")
def _interpolate(values, k, fraction):
    """Returns the tabulated value interpolated linearly at a relative position within interval k."""
    return (1 - fraction) * values[k] + fraction * values[k + 1]
