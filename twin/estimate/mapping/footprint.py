"""Grid of a map that covers the keyframe images of a survey."""

from __future__ import annotations

import numpy as np

from twin.core import geometry
from twin.core.records import MapGrid, StereoRig, SurveyResult

_MOST_CELLS = 4e7  # the cells of a map with more cells are enlarged, to limit its memory
_CELL_PX = 3.0  # side of a map cell in pixels at the median depth, so that several disparities support each height


def footprint_grid(result: SurveyResult, rig: StereoRig) -> MapGrid:
    """Returns the grid that covers all keyframe images, each projected to the median depth of its matched points.

    A cell is as large as three pixels at the median depth of all keyframes, or larger to limit the grid to about 4e7
    cells.

    Args:
        result: result of a survey with at least one keyframe, whose final trajectory is in the axes of the map.
        rig: calibration of the images.
    """
    depth_m = result.keyframe_depth_m
    cell = _CELL_PX * float(np.median(depth_m)) / rig.focal_px
    corners = np.array([[0, 0], [rig.width_px, 0], [0, rig.height_px], [rig.width_px, rig.height_px]], np.float64)
    rays = np.column_stack([rig.normalised(corners - 0.5), np.ones(4)])
    poses = result.final.world_from_camera[result.keyframe_rows]
    seen = np.concatenate([geometry.transform(p, rays * d)[:, :2] for p, d in zip(poses, depth_m, strict=True)])
    size_m = np.ptp(seen, axis=0) + 2 * cell
    cell = max(cell, float(np.sqrt(size_m[0] * size_m[1] / _MOST_CELLS)))
    west, south = np.floor(seen.min(axis=0) / cell) * cell
    east, north = np.ceil(seen.max(axis=0) / cell) * cell
    return MapGrid(float(west), float(north), cell, round((north - south) / cell), round((east - west) / cell))
