"""Cells of a map that objects hide from the cameras, found by ray casting in the estimated map."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from twin.core.geometry import Array
from twin.core.height_field import cast_ray, map_height_field
from twin.core.records import MapGrid, StereoRig
from twin.kernels import kernel

#: A floor point is hidden if its ray meets the map earlier by more than this fraction of the distance to the camera.
HIDDEN_BEFORE = 1e-3


def hidden_cells(height_m: NDArray[np.floating], grid: MapGrid, poses: Array, rig: StereoRig) -> NDArray[np.bool_]:
    """Returns a mask (rows, cols) of the cells without a height whose floor an object hides in every stereo pair.

    The floor of a cell is visible in a pair if it lies in both images and no object is between it and one of the
    cameras. The level floor has the median height of the map; the objects are the heights of the map. A cell on top of
    an object is not hidden, so that a cell in the mask is floor beside an object. Cells whose floor lies in no pair of
    images are not in the mask.

    Args:
        height_m: (rows, cols) heights of the map [m]; NaN where unknown.
        grid: grid of the map.
        poses: (n, 4, 4) estimated world_from_camera of the left images.
        rig: calibration.
    """
    unknown = np.isnan(height_m)
    if unknown.all():
        return np.zeros(height_m.shape, np.bool_)
    floor_m = float(np.nanmedian(height_m))
    field = map_height_field(np.where(unknown, floor_m, height_m), grid)
    x, y = (axis[unknown] for axis in np.meshgrid(*grid.centres()))
    camera = (rig.fx_px, rig.fy_px, rig.cx_px, rig.cy_px, rig.width_px - 1.0, rig.height_px - 1.0, rig.baseline_m)
    hidden = np.zeros(height_m.shape, np.bool_)
    hidden[unknown] = _hidden(field, np.ascontiguousarray(poses, np.float64), camera, x, y, floor_m)
    return hidden


@kernel
def _hidden(field, poses, camera, xs, ys, z):
    """Compiled kernel of `hidden_cells`, for the floor points (xs, ys, z)."""
    fx, fy, cx, cy, last_u, last_v, baseline = camera
    hidden = np.zeros(len(xs), np.bool_)
    for k in range(len(xs)):
        x, y = xs[k], ys[k]
        for pose in poses:
            dx, dy, dz = x - pose[0, 3], y - pose[1, 3], z - pose[2, 3]
            depth = pose[0, 2] * dx + pose[1, 2] * dy + pose[2, 2] * dz
            if depth <= 0:
                continue
            u = fx * (pose[0, 0] * dx + pose[1, 0] * dy + pose[2, 0] * dz) / depth + cx
            v = fy * (pose[0, 1] * dx + pose[1, 1] * dy + pose[2, 1] * dz) / depth + cy
            if not (u <= last_u and 0 <= v <= last_v and u - fx * baseline / depth >= 0):
                continue
            hidden[k] = False
            for shift in (0.0, baseline):
                ox, oy, oz = (pose[0, 3] + shift * pose[0, 0], pose[1, 3] + shift * pose[1, 0],
                              pose[2, 3] + shift * pose[2, 0])  # fmt: skip
                if cast_ray(field, ox, oy, oz, x - ox, y - oy, z - oz) < 1 - HIDDEN_BEFORE:
                    hidden[k] = True
            if not hidden[k]:
                break
    return hidden
