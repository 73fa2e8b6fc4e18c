"""Keyframes per map cell and height of the cameras above it, from the final poses and the estimated surface."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core import geometry
from twin.core.records import Array, MapGrid, StereoRig
from twin.report.run_folder import Run

#: Longest side of the coverage [cells]; of larger maps every n-th cell is taken.
_CELLS = 250


class KeyframeCoverage(NamedTuple):
    """Coverage of every n-th row and column of a map by stereo pairs, without occlusions."""

    grid: MapGrid  # cells that are n times as large as those of the map
    step: int  # n
    keyframes: NDArray[np.int64]  # (rows, cols) number of keyframes both of whose images show the cell
    range_m: Array  # (rows, cols) mean height of these keyframes above the cell [m]; NaN without one


def keyframe_coverage(run: Run) -> KeyframeCoverage | None:
    """Returns the coverage of the map of a run; None without map, final poses or rig."""
    given, dem = run.scenario.get("rig", {}), run.rasters.get("dem")
    if dem is None or not np.isfinite(dem.values).any() or "final" not in run.trajectories or "hfov_deg" not in given:
        return None
    width_px, tangent = given["image_width_px"], np.tan(np.deg2rad(given["hfov_deg"]) / 2)
    rig = StereoRig(width_px, given["image_height_px"], float(width_px / 2 / tangent), given["baseline_m"])
    poses = run.trajectories["final"].world_from_camera
    step = -(-max(dem.values.shape) // _CELLS)
    heights = dem.values[::step, ::step].astype(float)
    heights = np.where(np.isfinite(heights), heights, np.nanmedian(heights))
    x, y = (centres[::step] for centres in dem.grid.centres())
    points = np.stack([*np.meshgrid(x, y), heights], axis=-1)
    counts, total_m = np.zeros(heights.shape, np.int64), np.zeros(heights.shape)
    for pose in run.keyframes.map_from_world @ poses[run.keyframes.frames[run.keyframes.frames < len(poses)]]:
        rows, cols = _window(rig, pose, x, y, heights.min())
        cells = points[rows, cols]
        shown = _shown(rig, geometry.transform(geometry.inverse(pose), cells.reshape(-1, 3))).reshape(cells.shape[:2])
        counts[rows, cols] += shown
        total_m[rows, cols] += np.where(shown, pose[2, 3] - cells[..., 2], 0.0)
    range_m = np.divide(total_m, counts, out=np.full(counts.shape, np.nan), where=counts > 0)
    grid = MapGrid(dem.grid.west_m, dem.grid.north_m, step * dem.grid.cell_m, *heights.shape)
    return KeyframeCoverage(grid, step, counts, range_m)


def _window(rig: StereoRig, pose: Array, x: Array, y: Array, lowest_m: float) -> tuple[slice, slice]:
    """Returns the rows (y descending) and columns (x ascending) of the cells that an image can show."""
    corners = np.array([(u, v) for u in (-0.5, rig.width_px - 0.5) for v in (-0.5, rig.height_px - 0.5)])
    rays = np.column_stack([rig.normalised(corners), np.ones(4)]) @ pose[:3, :3].T
    if (rays[:, 2] >= 0).any():  # the horizon is in the image
        return slice(None), slice(None)
    # all rays end between the camera and the plane of the lowest cell
    ends = pose[:2, 3] + rays[:, :2] * ((lowest_m - pose[2, 3]) / rays[:, 2:])
    (west, south), (east, north) = (side(np.vstack([ends, pose[:2, 3]]), axis=0) for side in (np.min, np.max))
    cols = slice(int(np.searchsorted(x, west)), int(np.searchsorted(x, east, "right")))
    return slice(int(np.searchsorted(-y, -north)), int(np.searchsorted(-y, -south, "right"))), cols


def _shown(rig: StereoRig, points: Array) -> NDArray[np.bool_]:
    """Returns whether both images show points (n, 3) in the axes of the left camera [m]."""
    u, v = rig.project(points).T
    right = u - rig.focal_px * rig.baseline_m / points[:, 2]
    return (points[:, 2] > 0) & (u <= rig.width_px - 0.5) & (right >= -0.5) & (v >= -0.5) & (v <= rig.height_px - 0.5)
