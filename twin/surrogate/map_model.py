"""Model of the elevation map: samples the grid cells that a keyframe sees and the heights that it contributes.

The heights stand for those from the Kalman depth filter, with one sample per grid cell for all pixels that show the
cell. A cell is visible if its centre projects into both images and no relief hides it from either camera (ray casting).
Where the floor is not a plane within the matching window, e.g. at the edge of a wall, heights have an additional error
that grows with the RMS deviation from the plane (the roughness of the cell), and cells without a height are more
frequent.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, uniform_filter

from twin.core import geometry
from twin.core.floor_rays import HeightField, cast_camera_ray
from twin.core.geometry import Array
from twin.core.records import MapGrid, StereoRig
from twin.estimate.mapping import surface
from twin.estimate.mapping.surface import HeightPatch
from twin.surrogate.error_model import ViewsLaw
from twin.surrogate.measured_view import IDEAL_TABLE, ViewTable, measure_point
from twin.world.coverage import DEPTH_TOLERANCE

Map = NDArray[np.float32]
WINDOW_PX = 11  #: side of the window of dense matching, over which the roughness of a cell is computed
#: Roughness [px of disparity] at which matching follows half of it: dense matching resolves smaller deviations from the
#: plane of the window, while at larger ones the window shows two surfaces.
EDGE_PX = 0.5
_HIDING_SLOPE = 1.0  # rise over run: a floor below this line from a cell cannot hide it from a camera that looks down


class CellErrors(NamedTuple):
    """Errors of the filtered depth: random numbers and standard deviations.

    Args:
        lateral_noise: (rows, cols) standard normal numbers of the lateral error, shared by all views of a cell.
        edge_noise: (rows, cols) standard normal numbers of the error due to roughness, shared by all views of a cell.
        dropout: (rows, cols) uniform numbers in [0, 1); a cell whose number exceeds `completeness` has no depth.
        lateral_sigma_px: standard deviation of the lateral error [px].
        depths_m: (m,) ascending depths of the tabulated values below [m].
        depth_error_px: (m,) true standard deviation of the depth from one keyframe [px of disparity].
        depth_sigma_px: (m,) reported standard deviation of the depth from one keyframe [px of disparity].
        completeness: (m,) fraction of the level cells in view for which the filter provides a depth.
        error_views: `ErrorModel.depth_error_views`.
        sigma_views: `ErrorModel.depth_sigma_views`.
        edge_error_gain: `ErrorModel.edge_error_gain`.
        edge_sigma_gain: `ErrorModel.edge_sigma_gain`.
        edge_half_px: `ErrorModel.edge_half_px`.
    """

    lateral_noise: Map
    edge_noise: Map
    dropout: Map
    lateral_sigma_px: float
    depths_m: Array
    depth_error_px: Array
    depth_sigma_px: Array
    completeness: Array
    error_views: ViewsLaw = ViewsLaw(1.0, 0.0)
    sigma_views: ViewsLaw = ViewsLaw(1.0, 0.0)
    edge_error_gain: float = 0.0
    edge_sigma_gain: float = 0.0
    edge_half_px: float = np.inf


class MapModel:
    """Samples the height patch of each keyframe: true heights of the floor plus errors.

    Args:
        grid: grid of the map.
        height_m: (rows, cols) true height at the cell centres [m].
        rig: believed calibration.
        floor: the same floor as a height field, for ray casting.
        depth_m: typical depth of the floor along the optical axis [m].
        view: positions at which true points are measured.

    Attributes:
        seen: (rows, cols) mask of the cells that at least one keyframe observed; updated by `mark_seen`.
        roughness_m: (rows, cols) RMS deviation of the floor from its best-fit plane within the matching window [m].
        window_cells: side of the matching window [cells].
        views: (rows, cols) number of consecutive keyframes whose depths were fused in the latest height of the cell;
            updated by `sample_patch`.
    """

    def __init__(
        self,
        grid: MapGrid,
        height_m: Map,
        rig: StereoRig,
        floor: HeightField,
        depth_m: float,
        view: ViewTable = IDEAL_TABLE,
    ):
        self.grid, self.height_m, self.seen, self._rig = grid, height_m, np.zeros(height_m.shape, np.bool_), rig
        down, east = np.gradient(np.asarray(height_m, np.float64), grid.cell_m)
        self._slope = np.stack([east, -down], axis=-1).astype(np.float32)
        self._lowest_m = float(np.nanmin(height_m))
        self.depth_m = depth_m
        self._floor, self._may_be_hidden = floor, _may_be_hidden(height_m, grid.cell_m)
        self.window_cells = max(round(WINDOW_PX * depth_m / rig.focal_px / grid.cell_m), 1)
        self.roughness_m = roughness(height_m, WINDOW_PX * depth_m / rig.focal_px / grid.cell_m)
        self.views, self._views_until_now = (np.zeros(height_m.shape, np.int16) for _ in range(2))
        self._geotransform = (grid.west_m, grid.north_m, grid.cell_m)
        self._camera = (
            rig.focal_px, rig.cx_px, rig.cy_px, float(rig.width_px - 1), float(rig.height_px - 1), rig.baseline_m,
            view,
        )  # fmt: skip

    @property
    def steepness(self) -> Map:
        """Returns the magnitude of the slope of the floor (rows, cols) [m/m]."""
        return np.hypot(*np.moveaxis(self._slope, -1, 0))

    def mark_seen(self, world_from_camera: Array) -> None:
        """Marks the cells that both cameras see from the true pose (4, 4) of a keyframe."""
        window = self._window(world_from_camera)
        floor, cells = (self._floor, self._may_be_hidden), (self.height_m, self._geotransform)
        _mark(
            self.seen, *cells, self._camera, _cameras_of([world_from_camera], self._rig.baseline_m)[0], floor, *window
        )

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

        The keyframes must be passed in the order of the path, from the first to the last one: the number of consecutive
        keyframes that observed a cell determines the standard deviation of its height.

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
        cameras = _cameras_of([true, true if is_last else next_true], self._rig.baseline_m)
        estimated_from_true = estimated @ geometry.inverse(true)
        rotation = geometry.adjoint(geometry.pose(estimated[:3, :3], np.zeros(3)))
        depth_m = _sample_patch(
            height, variance, systematic, self.height_m, self._slope, self.roughness_m, self.views,
            self._views_until_now, self._geotransform, self._camera, cameras, (self._floor, self._may_be_hidden),
            is_last, estimated_from_true, estimated[:3, 3].copy(), rotation @ cov @ rotation.T,
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
    """Returns the rows and columns of the map that the image can show; compiled kernel of `MapModel._window`."""
    focal, cx, cy = camera[:3]
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
    focal, cx, cy, right, bottom, baseline, view = camera
    m = camera_from_world
    depth = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3]
    if not depth > 0:
        return -1.0
    true_x = (m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3]) / depth
    true_y = (m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3]) / depth
    seen_x, seen_y, disparity = measure_point(view, true_x, true_y, baseline / depth)
    u, v = focal * seen_x + cx, focal * seen_y + cy
    if 0 <= v <= bottom and u <= right and u - focal * disparity >= 0:
        return depth
    return -1.0


@njit(cache=True, nogil=True, inline="always")
def _source(camera_from_world, camera, estimated_from_true, point, slope):
    """Returns the true floor point (x, y, z) that is mapped to a cell: the cell's centre less the error of its mapping.

    Without calibration errors this is the centre itself; pose errors are much smaller than a cell.
    """
    x, y, z = point
    if camera[6].values.size == 0:
        return x, y, z
    px, py, _ = _estimated_position(camera_from_world, camera, estimated_from_true, x, y, z)
    return 2 * x - px, 2 * y - py, z + slope[0] * (x - px) + slope[1] * (y - py)


@njit(cache=True, nogil=True, inline="always")
def _estimated_position(camera_from_world, camera, estimated_from_true, x, y, z):
    """Returns the estimated world position of a world point that the camera sees from its true pose."""
    m = estimated_from_true
    qx, qy, qz = _measured_position(camera_from_world, camera, x, y, z)
    return (
        m[0, 0] * qx + m[0, 1] * qy + m[0, 2] * qz + m[0, 3],
        m[1, 0] * qx + m[1, 1] * qy + m[1, 2] * qz + m[1, 3],
        m[2, 0] * qx + m[2, 1] * qy + m[2, 2] * qz + m[2, 3],
    )


@njit(cache=True, nogil=True, inline="always")
def _measured_position(camera_from_world, camera, x, y, z):
    """Returns the world position at which a world point is measured from the true pose of the camera."""
    baseline, view, m = camera[5], camera[6], camera_from_world
    if view.values.size == 0:
        return x, y, z
    depth = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3]
    true_x = (m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3]) / depth
    true_y = (m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3]) / depth
    seen_x, seen_y, disparity = measure_point(view, true_x, true_y, baseline / depth)
    far = baseline / disparity
    cx, cy, cz = far * seen_x - m[0, 3], far * seen_y - m[1, 3], far - m[2, 3]
    return (
        m[0, 0] * cx + m[1, 0] * cy + m[2, 0] * cz,
        m[0, 1] * cx + m[1, 1] * cy + m[2, 1] * cz,
        m[0, 2] * cx + m[1, 2] * cy + m[2, 2] * cz,
    )


def _cameras_of(poses: list[Array], baseline_m: float) -> Array:
    """Returns (n, 3, 4, 4): for each left pose (4, 4), its inverse, the pose itself, and that of the right camera."""
    right_from_left = geometry.pose(np.eye(3), np.array([baseline_m, 0.0, 0.0]))
    return np.stack([np.stack([geometry.inverse(pose), pose, pose @ right_from_left]) for pose in poses])


def _may_be_hidden(height_m: Map, cell_m: float) -> NDArray[np.bool_]:
    """Returns the mask (rows, cols) of the cells above whose `_HIDING_SLOPE` line some floor rises.

    Only these cells can be hidden by relief; for the others, no rays are cast. The floor is examined in rings with
    radii that double, up to the one at which the relief cannot reach the line.
    """
    height = np.where(np.isfinite(height_m), height_m, np.nanmin(height_m))
    hidden, radius, relief_m = np.zeros(height.shape, np.bool_), 1, float(np.ptp(height))
    while radius * cell_m * _HIDING_SLOPE < relief_m:
        hidden |= maximum_filter(height, 4 * radius + 1) - height > radius * cell_m * _HIDING_SLOPE
        radius *= 2
    return hidden


def roughness(height_m: Map, window_cells: float) -> Map:
    """Returns the RMS deviation (rows, cols) of the floor from its best-fit plane within a square window [m].

    The variance of the heights minus the part that a linear regression on the two coordinates explains.

    Args:
        height_m: (rows, cols) heights; NaN is replaced by the lowest height.
        window_cells: side of the window in cells; rounded to an odd number, at least 3.
    """
    side = 2 * max(round((window_cells - 1) / 2), 1) + 1
    height = np.where(np.isfinite(height_m), height_m, np.nanmin(height_m)).astype(np.float64)
    height -= height.mean()
    row, col = np.indices(height.shape, dtype=np.float64)

    def mean(values: Array) -> Array:
        return uniform_filter(values, side, mode="nearest")

    level = mean(height)
    variance = mean(height**2) - level**2
    for coordinate in (row, col):
        covariance = mean(height * coordinate) - level * mean(coordinate)
        variance -= covariance**2 / ((side**2 - 1) / 12)
    return np.sqrt(np.maximum(variance, 0.0)).astype(np.float32)


@njit(cache=True, nogil=True, inline="always")
def _observed_depth(poses, camera, floor, x, y, z, i, j):
    """Returns the depth of the floor point of cell (i, j) in the left camera; -1 if not both cameras see the point."""
    field, may_be_hidden = floor
    depth = _depth_in(poses[0], camera, x, y, z)
    if depth < 0 or not may_be_hidden[i, j]:
        return depth
    m = poses[0]
    a = (m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3]) / depth
    b = (m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3]) / depth
    nearest = (1 - DEPTH_TOLERANCE) * depth
    if cast_camera_ray(field, poses[1], a, b) < nearest:
        return -1.0
    if cast_camera_ray(field, poses[2], a - camera[5] / depth, b) < nearest:
        return -1.0
    return depth


@njit(cache=True, nogil=True, inline="always")
def _is_left(next_poses, camera, floor, cell, source, i, j):
    """Returns whether cell (i, j) is left to the next keyframe.

    Calibration errors may map another point to the cell there, so both the cell and its source have to be in view.
    """
    if _observed_depth(next_poses, camera, floor, source[0], source[1], source[2], i, j) < 0:
        return False
    return camera[6].values.size == 0 or _depth_in(next_poses[0], camera, cell[0], cell[1], cell[2]) > 0


@njit(cache=True, nogil=True)
def _mark(seen, height, geotransform, camera, poses, floor, row, end_row, col, end_col):
    """Sets `seen` for the cells of a window that both cameras see."""
    west, north, cell = geotransform
    for i in range(row, end_row):
        y = north - (i + 0.5) * cell
        for j in range(col, end_col):
            if not seen[i, j]:
                x = west + (j + 0.5) * cell
                seen[i, j] = _observed_depth(poses, camera, floor, x, y, height[i, j], i, j) > 0


@njit(cache=True, nogil=True)
def _sample_patch(
    out, variance, systematic, height, slope, roughness, views, views_until_now, geotransform, camera, cameras, floor,
    is_last, estimated_from_true, position, cov, depth_noise, errors, row, col,
):  # fmt: skip
    """Compiled kernel of `MapModel.sample_patch`; returns the mean depth [m].

    Writes the heights to `out`, their variances due to depth errors to `variance`, and their variances due to the pose,
    the lateral error and the roughness to `systematic`.
    """
    (west, north, cell), m = geotransform, estimated_from_true
    total, count = 0.0, 0
    for i in range(row, row + out.shape[0]):
        y = north - (i + 0.5) * cell
        for j in range(col, col + out.shape[1]):
            x, z = west + (j + 0.5) * cell, height[i, j]
            sx, sy = np.float64(slope[i, j, 0]), np.float64(slope[i, j, 1])
            tx, ty, tz = _source(cameras[0, 0], camera, m, (x, y, z), (sx, sy))
            depth = _observed_depth(cameras[0], camera, floor, tx, ty, tz, i, j)
            if depth < 0:
                continue
            views_until_now[i, j] += 1
            if not is_last and _is_left(cameras[1], camera, floor, (x, y, z), (tx, ty, tz), i, j):
                continue
            views[i, j], views_until_now[i, j] = views_until_now[i, j], 0
            k, fraction = _interval(errors.depths_m, depth)
            per_px = depth * depth / (camera[0] * camera[5])
            rough_px = roughness[i, j] / per_px
            complete = _interpolate(errors.completeness, k, fraction) / (1 + (rough_px / errors.edge_half_px) ** 2)
            if errors.dropout[i, j] > complete:
                continue
            error_share = _relative_variance(errors.error_views, views[i, j])
            sigma_share = _relative_variance(errors.sigma_views, views[i, j])
            # estimated position of the floor at this cell, and the height of its tangent plane at the cell's centre
            px, py, pz = _estimated_position(cameras[0, 0], camera, m, tx, ty, tz)
            value = pz - sx * (px - x) - sy * (py - y)
            steep = np.sqrt(sx * sx + sy * sy)
            error_px = np.sqrt(error_share) * _interpolate(errors.depth_error_px, k, fraction)
            value += per_px * error_px * depth_noise[i - row, j - col]
            unresolved_m = roughness[i, j] * rough_px**2 / (rough_px**2 + EDGE_PX**2)
            value += unresolved_m * errors.edge_error_gain * errors.edge_noise[i, j]
            value += steep * errors.lateral_sigma_px * depth / camera[0] * errors.lateral_noise[i, j]
            out[i - row, j - col] = value
            sigma_px = _interpolate(errors.depth_sigma_px, k, fraction)
            variance[i - row, j - col] = sigma_share * (per_px * sigma_px) ** 2
            systematic[i - row, j - col] = surface.pose_variance(
                x - position[0], y - position[1], z - position[2], sx, sy, cov
            )
            systematic[i - row, j - col] += (surface.LATERAL_SIGMA_PX * depth / camera[0] * steep) ** 2
            systematic[i - row, j - col] += (unresolved_m * errors.edge_sigma_gain) ** 2
            total += depth
            count += 1
    return total / max(count, 1)


@njit(cache=True, nogil=True, inline="always")
def _relative_variance(law, n_views):
    """Compiled form of `ViewsLaw.__call__`."""
    return law.common + (1 - law.common) / (1 + law.gain * (n_views - 1))


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
