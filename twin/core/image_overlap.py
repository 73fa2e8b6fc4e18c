"""Overlap of two images: the share of the floor in the first image that the second image shows too."""

from __future__ import annotations

import numpy as np

from twin.core.geometry import Array
from twin.core.height_field import HeightField, cast_camera_ray, cast_ray, ray_grid
from twin.core.records import StereoRig
from twin.kernels import kernel

#: Columns of the grid of rays. A cell that the edge of the second image cuts is weighted by its fraction inside; the
#: error of an overlap is therefore far smaller than the share of one cell.
RAY_COLUMNS = 24
#: A floor point is occluded if the ray from the camera to it meets the floor earlier by more than this fraction of its
#: range.
HIDDEN_BEFORE = 1e-3


def image_overlap(field: HeightField, first: Array, second: Array, rig: StereoRig) -> Array:
    """Returns the overlap (n,) of pairs of images: the share of the floor in the first that the second shows too.

    The floor at each cell of a grid over the first image (by ray casting) is weighted by the part of the cell that
    projects into the second, 0 if occluded. Cells without floor are left out; NaN if there are no others.

    Args:
        first, second: (n, 4, 4) world_from_camera of the images of each pair.
    """
    pixels = ray_grid(rig, RAY_COLUMNS)
    cell = rig.width_px / RAY_COLUMNS, rig.height_px / (len(pixels) // RAY_COLUMNS)
    camera = (rig.fx_px, rig.fy_px, rig.cx_px, rig.cy_px, float(rig.width_px), float(rig.height_px))
    first, second = (np.ascontiguousarray(p, np.float64).reshape(-1, 4, 4) for p in (first, second))
    return _overlaps(field, first, second, camera, rig.normalised(pixels), cell)


@kernel
def _overlaps(field, first, second, camera, directions, cell):
    """Compiled kernel of `image_overlap`; directions (m, 2) are the normalised coordinates of the rays."""
    result = np.empty(len(first))
    for i in range(len(first)):
        pose, shared, count = first[i], 0.0, 0
        for k in range(len(directions)):
            a, b = directions[k, 0], directions[k, 1]
            depth = cast_camera_ray(field, pose, a, b)
            if depth < np.inf:
                count += 1
                x = pose[0, 3] + depth * (pose[0, 0] * a + pose[0, 1] * b + pose[0, 2])
                y = pose[1, 3] + depth * (pose[1, 0] * a + pose[1, 1] * b + pose[1, 2])
                z = pose[2, 3] + depth * (pose[2, 0] * a + pose[2, 1] * b + pose[2, 2])
                shared += _share_seen(field, second[i], camera, cell, x, y, z, depth)
        result[i] = shared / count if count else np.nan
    return result


@kernel
def _share_seen(field, pose, camera, cell, x, y, z, depth):
    """Returns the share (0 to 1) of a cell of the first image that the second camera sees.

    Args:
        camera: fx, fy, cx, cy, width and height [px].
        cell: width and height of a cell in the first image [px].
        x, y, z: floor point at the centre of the cell [m].
        depth: depth of this point in the first camera [m].
    """
    fx, fy, cx, cy, width, height = camera
    dx, dy, dz = x - pose[0, 3], y - pose[1, 3], z - pose[2, 3]
    depth2 = pose[0, 2] * dx + pose[1, 2] * dy + pose[2, 2] * dz
    if depth2 <= 0:
        return 0.0
    u = fx * (pose[0, 0] * dx + pose[1, 0] * dy + pose[2, 0] * dz) / depth2 + cx + 0.5
    v = fy * (pose[0, 1] * dx + pose[1, 1] * dy + pose[2, 1] * dz) / depth2 + cy + 0.5
    scale = depth / depth2
    in_u = min(max(min(u, width - u) / (scale * cell[0]) + 0.5, 0.0), 1.0)
    in_v = min(max(min(v, height - v) / (scale * cell[1]) + 0.5, 0.0), 1.0)
    if in_u * in_v == 0:
        return 0.0
    seen = cast_ray(field, pose[0, 3], pose[1, 3], pose[2, 3], dx, dy, dz) >= 1 - HIDDEN_BEFORE
    return in_u * in_v if seen else 0.0
