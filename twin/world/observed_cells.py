"""Cells of the map that both cameras saw in at least one keyframe, computed from true depth images."""

import numpy as np
from numpy.typing import NDArray

from twin.core.height_field import HeightField, cast_pixels, ray_grid
from twin.core.records import Array, MapGrid, StereoRig
from twin.kernels import kernel

#: Four neighbouring pixels whose depths differ by more than this fraction are taken to span an occluding edge. If
#: pixels are 0.2 deg apart, a continuous surface inclined at 86 deg to the image plane reaches this limit.
EDGE_SHARE = 0.05
#: Tolerance of the left-right depth comparison, as a fraction of the depth.
DEPTH_TOLERANCE = 0.005
_COLUMNS = 80  # approximate number of columns of the images of `seen_over`


class Coverage:
    """Observed cells of a grid.

    A cell is observed if its centre lies within the quad between the floor points of four neighbouring pixels of the
    left image, both cameras see these points, and there is no depth edge between them. With `top_m` (rows, cols), the
    true height of the surface seen from above [m], the quad must not lie more than the side of a cell below it;
    without, there are no overhangs.
    """

    def __init__(self, grid: MapGrid, rig: StereoRig, top_m: NDArray[np.float32] | None = None) -> None:
        self.grid, self.rig, self._top_m = grid, rig, top_m
        self.seen = np.zeros((grid.rows, grid.cols), dtype=np.bool_)  #: whether each cell was observed

    def add(self, world_from_left: Array, depth_left: NDArray[np.float32], depth_right: NDArray[np.float32]) -> None:
        """Marks the cells that are observed in a keyframe, from true depths (h, w) along the optical axis [m]."""
        grid, rig = self.grid, self.rig
        camera = (rig.focal_px, rig.cx_px, rig.cy_px, rig.baseline_m)
        raster = (grid.west_m, grid.north_m, grid.cell_m)
        pose = np.ascontiguousarray(world_from_left, dtype=np.float64)
        left, right = np.ascontiguousarray(depth_left, np.float32), np.ascontiguousarray(depth_right, np.float32)
        _mark_seen(self.seen, raster, pose, camera, left, right, self._top_m)


def seen_over(grid: MapGrid, rig: StereoRig, floor: HeightField, poses: Array) -> NDArray[np.bool_]:
    """Returns the cells (rows, cols) of a grid that a rig at poses (n, 4, 4) observes, from images of fewer pixels."""
    small = rig.binned(max(1, rig.width_px // _COLUMNS))
    coverage, pixels = Coverage(grid, small), ray_grid(small, small.width_px)
    shape = small.height_px, small.width_px
    for left in poses:
        pair = cast_pixels(floor, np.stack([left, left @ small.left_from_right]), small, pixels)
        coverage.add(left, *(depth.reshape(shape).astype(np.float32) for depth in pair))
    return coverage.seen


@kernel
def _mark_seen(seen, raster, pose, camera, left, right, top):
    """Projects the floor points of two neighbouring image rows at a time; `top` None removes its code."""
    height, width = left.shape
    col, row, up = np.zeros((2, width)), np.zeros((2, width)), np.zeros((2, width))
    visible = np.zeros((2, width), dtype=np.bool_)
    for v in range(height):
        new, old = v % 2, 1 - v % 2
        for u in range(width):
            visible[new, u] = _in_both(u, v, left, right, camera)
            if visible[new, u]:
                col[new, u], row[new, u], up[new, u] = _floor_point(u, v, left[v, u], pose, camera, raster)
        if v == 0:
            continue
        for u in range(width - 1):
            whole = visible[0, u] and visible[0, u + 1] and visible[1, u] and visible[1, u + 1]
            if whole and _is_surface(left, u, v - 1):
                b = col[old, u + 1], row[old, u + 1], up[old, u + 1]
                c = col[new, u], row[new, u], up[new, u]
                for k, n in ((old, u), (new, u + 1)):
                    _mark_triangle(seen, top, raster[2], (col[k, n], row[k, n], up[k, n]), b, c)


@kernel
def _in_both(u, v, left, right, camera):
    """Returns whether both cameras see the floor point at pixel (u, v) of the left image."""
    # between the depths of the two right pixels next to its projection, within DEPTH_TOLERANCE
    z = left[v, u]
    if not (z > 0 and z < np.inf):
        return False
    k = int(np.floor(u - camera[0] * camera[3] / z))
    if k < 0 or k + 1 >= right.shape[1]:
        return False
    a, b, slack = right[v, k], right[v, k + 1], DEPTH_TOLERANCE * z
    return min(a, b) - slack <= z <= max(a, b) + slack


@kernel
def _floor_point(u, v, z, pose, camera, raster):
    """Returns column and row in the grid (integers are cell centres) and height of the floor point at a pixel."""
    xc, yc = (u - camera[1]) * z / camera[0], (v - camera[2]) * z / camera[0]
    x = pose[0, 0] * xc + pose[0, 1] * yc + pose[0, 2] * z + pose[0, 3]
    y = pose[1, 0] * xc + pose[1, 1] * yc + pose[1, 2] * z + pose[1, 3]
    up = pose[2, 0] * xc + pose[2, 1] * yc + pose[2, 2] * z + pose[2, 3]
    return (x - raster[0]) / raster[2] - 0.5, (raster[1] - y) / raster[2] - 0.5, up


@kernel
def _is_surface(left, u, v):
    a, b, c, d = left[v, u], left[v, u + 1], left[v + 1, u], left[v + 1, u + 1]
    low, high = min(min(a, b), min(c, d)), max(max(a, b), max(c, d))
    return high - low <= EDGE_SHARE * low


@kernel
def _mark_triangle(seen, top, slack, a, b, c):
    """Marks the cells whose centre lies in a triangle with corners (column, row, height), or on its edge."""
    # with `top`, only where it is at most `slack` [m] below it; a triangle without area then marks no cell
    row0, col0 = max(0, int(np.ceil(min(a[1], b[1], c[1])))), max(0, int(np.ceil(min(a[0], b[0], c[0]))))
    row1 = min(seen.shape[0] - 1, int(np.floor(max(a[1], b[1], c[1]))))
    col1 = min(seen.shape[1] - 1, int(np.floor(max(a[0], b[0], c[0]))))
    for i in range(row0, row1 + 1):
        for j in range(col0, col1 + 1):
            if seen[i, j]:
                continue
            p = (b[0] - a[0]) * (i - a[1]) - (b[1] - a[1]) * (j - a[0])
            q = (c[0] - b[0]) * (i - b[1]) - (c[1] - b[1]) * (j - b[0])
            s = (a[0] - c[0]) * (i - c[1]) - (a[1] - c[1]) * (j - c[0])
            inside = (p >= 0 and q >= 0 and s >= 0) or (p <= 0 and q <= 0 and s <= 0)
            if top is None:
                seen[i, j] = inside
            elif inside and p + q + s != 0:
                seen[i, j] = (p * c[2] + q * a[2] + s * b[2]) / (p + q + s) >= top[i, j] - slack
