"""Keyframes per map cell and height of the cameras above it, from the final poses and the estimated surface."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core.image_coverage import image_coverage
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
    points = np.stack([*np.meshgrid(x, y), heights], axis=-1).reshape(-1, 3)
    keyframes = run.keyframes.map_from_world @ poses[run.keyframes.frames[run.keyframes.frames < len(poses)]]
    found = image_coverage(points, keyframes, rig, rig.baseline_m)
    grid = MapGrid(dem.grid.west_m, dem.grid.north_m, step * dem.grid.cell_m, *heights.shape)
    return KeyframeCoverage(grid, step, found.n_images.reshape(heights.shape), found.height_m.reshape(heights.shape))
