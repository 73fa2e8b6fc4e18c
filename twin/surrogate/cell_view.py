"""Cells of a map that both cameras of a keyframe see, and the heights that are mapped to them (compiled)."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.height_field import HeightField, cast_camera_ray
from twin.kernels import kernel
from twin.surrogate.measured_view import ViewTable, measure_point
from twin.world.observed_cells import DEPTH_TOLERANCE

_LEAST_DESCENT = 0.1  # slope of a ray of the image below which all cells count as within reach


class FloorCells(NamedTuple):
    """Cells of a map, numbered row by row from the north-west one, with the true floor at their centres."""

    #: west_m, north_m: position of the north-west corner.
    west_m: float
    north_m: float
    cell_m: float
    rows: int
    cols: int
    height_m: NDArray[np.float32]  #: (n,) true height
    slope: NDArray[np.float32]  #: (n, 2) slope in x and in y [m/m]
    may_be_hidden: NDArray[np.bool_]  #: (n,) whether relief may hide the cell from a camera
    floor: HeightField  #: the true floor, for ray casting


class Cameras(NamedTuple):
    """Stereo pair at the scale of the matched images."""

    focal_px: float
    cx_px: float
    cy_px: float
    width_px: float
    height_px: float
    baseline_m: float  #: believed baseline
    table: ViewTable  #: measured positions of true points
    estimated_baseline_m: float  #: baseline of self-calibration
    information: Array  #: (rows, cols) 1 / r^2 for `PositionDependence.bounds` r


@kernel
def window_in_reach(cells, cameras, lowest_m, pose):
    """Returns first row, end row, first column and end column of the cells that a left camera at a pose may see."""
    # those in the bounding box of the lowest floor in its image; all if the image shows the horizon
    west, east, south, north = pose[0, 3], pose[0, 3], pose[1, 3], pose[1, 3]
    for u in (-0.5, cameras.width_px - 0.5):
        for v in (-0.5, cameras.height_px - 0.5):
            x, y = (u - cameras.cx_px) / cameras.focal_px, (v - cameras.cy_px) / cameras.focal_px
            down = pose[2, 0] * x + pose[2, 1] * y + pose[2, 2]
            if down >= -_LEAST_DESCENT:
                return 0, cells.rows, 0, cells.cols
            far = (lowest_m - pose[2, 3]) / down
            at_x = pose[0, 3] + far * (pose[0, 0] * x + pose[0, 1] * y + pose[0, 2])
            at_y = pose[1, 3] + far * (pose[1, 0] * x + pose[1, 1] * y + pose[1, 2])
            west, east, south, north = min(west, at_x), max(east, at_x), min(south, at_y), max(north, at_y)
    rows, cols, cell_m = cells.rows, cells.cols, cells.cell_m
    first_row, end_row = int((cells.north_m - north) / cell_m) - 1, int((cells.north_m - south) / cell_m) + 2
    first_col, end_col = int((west - cells.west_m) / cell_m) - 1, int((east - cells.west_m) / cell_m) + 2
    return (
        min(max(first_row, 0), rows),
        min(max(end_row, 0), rows),
        min(max(first_col, 0), cols),
        min(max(end_col, 0), cols),
    )


@kernel
def visible_cells(cells, cameras, window, true, estimated):
    """Returns the cells (n,) of a window whose floor both cameras of a keyframe, true and estimated (4, 4), see."""
    # with the depth [m] (n,) of the floor point that is mapped to each, its distance [px] (n,) from the nearest border
    # of the two images, and the information (n,) at its position in the left image
    first_row, end_row, first_col, end_col = window
    most = max(end_row - first_row, 0) * max(end_col - first_col, 0)
    found, values, n = np.empty(most, np.int64), np.empty((3, most)), 0
    camera_from_world, right, information = geometry.inverse(true), _right_camera(cameras, true), cameras.information
    for row in range(first_row, end_row):
        for cell in range(row * cells.cols + first_col, row * cells.cols + end_col):
            at = _source(cells, cameras, cell, camera_from_world, estimated)
            depth_m, u, v, border_px = _seen(cells, cameras, cell, at, camera_from_world, true, right)
            if border_px < 0:
                continue
            found[n], values[0, n], values[1, n] = cell, depth_m, border_px
            values[2, n] = _interpolated(information, (u + 0.5) / cameras.width_px, (v + 0.5) / cameras.height_px)
            n += 1
    return found[:n], values[0, :n].copy(), values[1, :n].copy(), values[2, :n].copy()


@kernel
def mark_visible(cells, cameras, window, true, marked):
    """Sets the mask `marked` (rows * cols,) for the cells of a window whose centre both cameras of a keyframe see."""
    first_row, end_row, first_col, end_col = window
    camera_from_world, right = geometry.inverse(true), _right_camera(cameras, true)
    for row in range(first_row, end_row):
        for cell in range(row * cells.cols + first_col, row * cells.cols + end_col):
            if not marked[cell]:
                at = _centre(cells, cell)
                marked[cell] = _seen(cells, cameras, cell, at, camera_from_world, true, right)[-1] >= 0


@kernel
def _right_camera(cameras, true):
    right = true.copy()
    right[:3, 3] += true[:3, 0] * cameras.baseline_m
    return right


@kernel(allocates=False, forceinline=True)
def _seen(cells, cameras, cell, point, camera_from_world, left, right):
    """Returns depth, column, row of a cell's floor point on the left, and its distance from a border, < 0 if unseen."""
    focal_px, baseline_m = cameras.focal_px, cameras.baseline_m
    x, y, d = _normalised(camera_from_world, baseline_m, point)
    if not d > 0:  # also NaN
        return 0.0, 0.0, 0.0, -1.0
    seen, depth_m = measure_point(cameras.table, x, y, d), baseline_m / d
    u, v = seen[0] * focal_px + cameras.cx_px, seen[1] * focal_px + cameras.cy_px
    border_px = min(min(v, cameras.height_px - 1 - v), min(cameras.width_px - 1 - u, u - focal_px * seen[2]))
    if not border_px >= 0:
        return depth_m, u, v, -1.0
    if cells.may_be_hidden[cell]:
        nearest_m = (1 - DEPTH_TOLERANCE) * depth_m
        for camera, column in ((left, x), (right, x - d)):
            if cast_camera_ray(cells.floor, camera, column, y) < nearest_m:
                return depth_m, u, v, -1.0
    return depth_m, u, v, border_px


@kernel
def mapped_heights(cells, cameras, index, true, estimated):
    """Returns the heights (n,) of cells without errors of measurement, mapped from the estimated pose of a keyframe."""
    camera_from_world, heights = geometry.inverse(true), np.empty(len(index))
    for k in range(len(index)):
        cell = index[k]
        at = _source(cells, cameras, cell, camera_from_world, estimated)
        x, y, z = _mapped(cameras, camera_from_world, estimated, at)
        centre_x, centre_y, _ = _centre(cells, cell)
        heights[k] = z - (cells.slope[cell, 0] * (x - centre_x) + cells.slope[cell, 1] * (y - centre_y))
    return heights


@kernel
def pose_variances(cells, index, position_m, cov):
    """Returns the variances (n,) of the heights of cells due to the error of a pose; see `surface.pose_variance`."""
    # `cov` (6, 6) is that of a camera at `position_m` (3,) [rotation, translation], in world axes
    variances, jacobian = np.empty(len(index)), np.empty(6)
    for k in range(len(index)):
        x, y, z = _centre(cells, index[k])
        x, y, z = x - position_m[0], y - position_m[1], z - position_m[2]
        a, b = -cells.slope[index[k], 0], -cells.slope[index[k], 1]
        jacobian[0], jacobian[1], jacobian[2] = y - z * b, z * a - x, x * b - y * a
        jacobian[3], jacobian[4], jacobian[5] = a, b, 1.0
        total = 0.0
        for i in range(6):
            for j in range(6):
                total += jacobian[i] * cov[i, j] * jacobian[j]
        variances[k] = total
    return variances


@kernel
def extend_runs(runs, index, border_px, information, following, squared_step):
    """Adds a keyframe to the runs of consecutive keyframes that observe its cells `index` (n,), ascending.

    Returns the positions (m,) in `index` of the cells that the next keyframe, with the cells `following` at a squared
    distance `squared_step`, does not see, and the runs (4, m) of these, which end. `runs` (4, rows * cols) are number
    of keyframes, sum of the squared distances between neighbours, largest distance from the border of the images and
    sum of `information`; 0 for cells whose run has ended.
    """
    ended, n, k = np.empty(len(index), np.int64), 0, 0
    for at in range(len(index)):
        cell = index[at]
        runs[0, cell] += 1
        runs[2, cell] = max(runs[2, cell], border_px[at])
        runs[3, cell] += information[at]
        while k < len(following) and following[k] < cell:
            k += 1
        if k < len(following) and following[k] == cell:
            runs[1, cell] += squared_step
        else:
            ended[n] = at
            n += 1
    of_ended = np.empty((4, n))
    for m in range(n):
        for row in range(4):
            of_ended[row, m] = runs[row, index[ended[m]]]
            runs[row, index[ended[m]]] = 0.0
    return ended[:n], of_ended


@kernel(allocates=False, forceinline=True)
def _source(cells, cameras, cell, camera_from_world, estimated):
    """Returns the true floor point that is mapped to a cell: its centre minus the mapping error."""
    # with calibration errors or an approximated port, the estimated pose determines it
    x, y, z = _centre(cells, cell)
    if not cameras.table.values.size and cameras.table.yaw_rad == 0:
        return x, y, z
    at_x, at_y, _ = _mapped(cameras, camera_from_world, estimated, (x, y, z))
    right, up = at_x - x, at_y - y
    return x - right, y - up, z - (cells.slope[cell, 0] * right + cells.slope[cell, 1] * up)


@kernel(allocates=False, forceinline=True)
def _centre(cells, cell):
    x = cells.west_m + (cell % cells.cols + 0.5) * cells.cell_m
    return x, cells.north_m - (cell // cells.cols + 0.5) * cells.cell_m, np.float64(cells.height_m[cell])


@kernel(allocates=False, forceinline=True)
def _mapped(cameras, camera_from_world, estimated, point):
    """Returns the estimated position of a world point that a keyframe sees."""
    x, y, d = _normalised(camera_from_world, cameras.baseline_m, point)
    seen = measure_point(cameras.table, x, y, d)
    return _transformed(estimated, seen[0], seen[1], 1.0, cameras.estimated_baseline_m / seen[2])


@kernel(allocates=False, forceinline=True)
def _normalised(camera_from_world, baseline_m, point):
    """Returns normalised x, y and disparity of a world point; NaN for a point behind the camera."""
    x, y, z = _transformed(camera_from_world, point[0], point[1], point[2], 1.0)
    z = z if z > 0 else np.nan
    return x / z, y / z, baseline_m / z


@kernel(allocates=False, forceinline=True)
def _transformed(pose, x, y, z, scale):
    return (
        (pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z) * scale + pose[0, 3],
        (pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z) * scale + pose[1, 3],
        (pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z) * scale + pose[2, 3],
    )


@kernel(allocates=False, forceinline=True)
def _interpolated(table, across, down):
    """Returns the value of a table (rows, cols) of blocks of the image, interpolated between their centres."""
    rows, cols = table.shape
    row = min(max(down * rows - 0.5, 0.0), rows - 1.0)
    col = min(max(across * cols - 0.5, 0.0), cols - 1.0)
    i, j = min(int(row), max(rows - 2, 0)), min(int(col), max(cols - 2, 0))
    a, b, k, m = row - i, col - j, min(i + 1, rows - 1), min(j + 1, cols - 1)
    above = (1 - b) * table[i, j] + b * table[i, m]
    return (1 - a) * above + a * ((1 - b) * table[k, j] + b * table[k, m])
