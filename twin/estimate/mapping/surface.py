"""Conversion of a depth map to heights at the cell centres of a grid, with their variances."""

from typing import NamedTuple

import numpy as np

from twin.core.geometry import Array
from twin.core.records import Map, MapGrid, StereoRig
from twin.estimate.mapping.depth_filter import JUMP_PX, DepthMap, variance_along
from twin.kernels import kernel

MIN_COSINE = 0.05  #: between normal and line of sight; a grazing triangle may connect two separate surfaces
#: Standard deviation of the lateral error of the surface [px of the image]; in metres, it is this value times depth /
#: focal length. Fusion does not reduce it, because the matching window smooths relief and displaces edges in similar
#: ways in all views. On a surface of slope s it causes a height error of s times the lateral error.
LATERAL_SIGMA_PX = 0.35


class HeightPatch(NamedTuple):
    """Heights computed from one depth map, in a rectangular window of the grid."""

    #: row, col: row and column, in the grid, of the first (north-west) cell of the window.
    row: int
    col: int
    height_m: Map  #: (rows, cols) height at the cell centres, NaN where the surface does not cover them
    variance_m2: Map  #: (rows, cols) variance due to errors of depth, which enters the map only once: independent
    systematic_m2: Map  #: (rows, cols) variance due to pose and smoothing of slopes, common to all views
    pixel: Map  #: (rows, cols, 2) position (u, v) of the cell centre in the image [px]
    lateral_m: float  #: standard deviation of the lateral error at the mean depth of the depth map [m]
    camera_m: Array | None = None  #: (3,) position of the camera in the frame of the map [m]; None if it is not known
    pose_m2: Map | None = None  #: (rows, cols) part of `systematic_m2` due to the pose; None: all of it


def rasterise(
    depth_map: DepthMap, world_from_camera: Array, pose_cov: Array, rig: StereoRig, grid: MapGrid
) -> HeightPatch | None:
    """Returns the heights at the cell centres of a grid, interpolated linearly in triangles of pixels of a depth map.

    Triangles across a depth discontinuity, downward-facing and grazing ones are omitted, so that no surface appears
    between the edge of a reef and the floor. The variances of depth and pose are propagated to the height at the cell
    centre, with the effect of horizontal errors on slopes. `pose_cov` (6, 6) is [rotation, translation] (rad, m), in
    camera axes. None if the surface does not overlap the grid.
    """
    camera = (rig.focal_px, rig.cx_px, rig.cy_px)
    points, bounds = _grid_points(depth_map.depth_m, world_from_camera, camera, grid.west_m, grid.north_m, grid.cell_m)
    window = _window(bounds, grid)
    if window is None:
        return None
    row, col, rows, cols = window
    lateral = LATERAL_SIGMA_PX * float(np.nanmean(depth_map.depth_m)) / rig.focal_px
    height, variance, systematic, pose = np.full((4, rows, cols), np.nan, np.float32)
    pixel = np.zeros((rows, cols, 2), np.float32)
    patch = HeightPatch(row, col, height, variance, systematic, pixel, lateral, world_from_camera[:3, 3].copy(), pose)
    rotation = np.kron(np.eye(2), world_from_camera[:3, :3])
    view = _ViewGeometry(
        world_from_camera[:3, 3] - [grid.west_m, grid.north_m, 0], world_from_camera[:3, 2].copy(),
        rotation @ pose_cov @ rotation.T, grid.cell_m, rig.focal_px, JUMP_PX / (rig.focal_px * rig.baseline_m),
    )  # fmt: skip
    _triangles(points, *depth_map, view, *patch[:6], pose)
    return patch


class _ViewGeometry(NamedTuple):
    position: Array  #: (3,) position of the camera relative to the north-west corner of the grid at height 0 [m]
    axis: Array  #: (3,) optical axis in the world
    cov: Array  #: (6, 6) covariance of the pose [rotation, translation], in world axes (rad, m)
    cell_m: float  #: cell size [m]
    focal_px: float  #: focal length [px]
    max_jump: float  #: largest difference of inverse depth between the corners of a triangle [1/m]


def _window(bounds: Array, grid: MapGrid) -> tuple[int, int, int, int] | None:
    """Returns first row, first column, numbers of rows and columns of the cells within `bounds`; None if none."""
    if not np.isfinite(bounds).all():
        return None
    low = np.maximum(np.ceil(bounds[:2]), 0)
    high = np.minimum(np.floor(bounds[2:]), [grid.rows - 1, grid.cols - 1])
    rows, cols = (high - low + 1).astype(int)
    return (int(low[0]), int(low[1]), int(rows), int(cols)) if rows > 0 and cols > 0 else None


@kernel
def _grid_points(depth, pose, camera, west, north, cell):
    """Returns points (H, W, 3): row, column (0 at the first cell centre) and height [m], and their bounds (4,)."""
    (focal, cx, cy), (height, width) = camera, depth.shape
    points = np.empty((height, width, 3))
    bounds = np.array([np.inf, np.inf, -np.inf, -np.inf])
    for v in range(height):
        y = (v - cy) / focal
        for u in range(width):
            x, z = (u - cx) / focal, depth[v, u]
            col = (z * (pose[0, 0] * x + pose[0, 1] * y + pose[0, 2]) + pose[0, 3] - west) / cell - 0.5
            row = (north - z * (pose[1, 0] * x + pose[1, 1] * y + pose[1, 2]) - pose[1, 3]) / cell - 0.5
            points[v, u, 0], points[v, u, 1] = row, col
            points[v, u, 2] = z * (pose[2, 0] * x + pose[2, 1] * y + pose[2, 2]) + pose[2, 3]
            if z > 0:
                bounds[0], bounds[1] = min(bounds[0], row), min(bounds[1], col)
                bounds[2], bounds[3] = max(bounds[2], row), max(bounds[3], col)
    return points, bounds


@kernel(inline="always")
def _spans_integer(points, v, u, k):
    a, b, c, e = points[v, u, k], points[v, u + 1, k], points[v + 1, u, k], points[v + 1, u + 1, k]
    return np.ceil(min(min(a, b), min(c, e)) - 1e-9) <= np.floor(max(max(a, b), max(c, e)) + 1e-9)


@kernel
def _triangles(points, depth, variance, view, row, col, height, height_variance, systematic, pixel, pose):
    """Writes the triangles of a depth map, except those that `rasterise` omits, to the layers of a patch, in place."""
    out = (points, depth, variance, view, row, col, height, height_variance, systematic, pixel, pose)
    for v in range(depth.shape[0] - 1):
        for u in range(depth.shape[1] - 1):
            # most squares of pixels contain no cell centre
            if _spans_integer(points, v, u, 0) and _spans_integer(points, v, u, 1):
                _triangle(v, u, v + 1, u, v, u + 1, *out)
                _triangle(v + 1, u + 1, v, u + 1, v + 1, u, *out)


@kernel
def _triangle(
    va, ua, vb, ub, vc, uc, points, depth, variance, view, row, col, height, height_variance, systematic, pixel, pose
):
    """Writes the cells in the triangle of the pixels a, b, c (rows v, columns u); the greatest height is kept."""
    a, b, c = points[va, ua], points[vb, ub], points[vc, uc]
    j0, j1 = np.ceil(min(a[1], b[1], c[1]) - 1e-9), np.floor(max(a[1], b[1], c[1]) + 1e-9)
    i0, i1 = np.ceil(min(a[0], b[0], c[0]) - 1e-9), np.floor(max(a[0], b[0], c[0]) + 1e-9)
    if not (j0 <= j1 and i0 <= i1):  # most triangles contain no cell centre
        return
    za, zb, zc = depth[va, ua], depth[vb, ub], depth[vc, uc]
    if not (za > 0 and zb > 0 and zc > 0) or 1 / min(za, zb, zc) - 1 / max(za, zb, zc) > view.max_jump:
        return
    cell, position, axis = view.cell_m, view.position, view.axis
    bx, by, bz = (b[1] - a[1]) * cell, (a[0] - b[0]) * cell, b[2] - a[2]
    cx, cy, cz = (c[1] - a[1]) * cell, (a[0] - c[0]) * cell, c[2] - a[2]
    nx, ny, nz = by * cz - bz * cy, bz * cx - bx * cz, bx * cy - by * cx
    rx, ry, rz = (a[1] + 0.5) * cell - position[0], -(a[0] + 0.5) * cell - position[1], a[2] - position[2]
    facing = -(nx * rx + ny * ry + nz * rz)
    if nz <= 0 or facing < MIN_COSINE * np.sqrt((nx * nx + ny * ny + nz * nz) * (rx * rx + ry * ry + rz * rz)):
        return
    sx, sy = -nx / nz, -ny / nz  # slope of the surface
    for i in range(max(int(i0), row), min(int(i1), row + height.shape[0] - 1) + 1):
        for j in range(max(int(j0), col), min(int(j1), col + height.shape[1] - 1) + 1):
            x, y = (j - a[1]) * cell, (a[0] - i) * cell
            s, t = (x * cy - y * cx) / nz, (bx * y - by * x) / nz
            h = a[2] + s * bz + t * cz
            if s < -1e-9 or t < -1e-9 or s + t > 1 + 1e-9 or height[i - row, j - col] >= h:
                continue
            px, py, pz = rx + x, ry + y, h - position[2]
            z = px * axis[0] + py * axis[1] + pz * axis[2]
            height_per_depth = (pz - sx * px - sy * py) / z
            p, q = i - row, j - col
            height[p, q] = h
            depth_variance = (1 - s - t) * variance[va, ua] + s * variance[vb, ub] + t * variance[vc, uc]
            height_variance[p, q] = height_per_depth * height_per_depth * depth_variance
            pose[p, q] = pose_variance(px, py, pz, sx, sy, view.cov)
            systematic[p, q] = pose[p, q] + (LATERAL_SIGMA_PX * z / view.focal_px) ** 2 * (sx * sx + sy * sy)
            pixel[p, q, 0] = ua + s * (ub - ua) + t * (uc - ua)
            pixel[p, q, 1] = va + s * (vb - va) + t * (vc - va)


@kernel(inline="always")
def pose_variance(px, py, pz, sx, sy, cov):
    """Returns the variance [m^2] of a surface's height at the x and y of a point, due to the error of the camera pose.

    The point is relative to the camera [m]; (sx, sy) is the slope of the surface; `cov` (6, 6) is that of the pose
    [rotation, translation] (rad, m); all in world axes.
    """
    return variance_along(px, py, pz, -sx, -sy, 1.0, cov)
