"""A depth map seen from above: its surface rasterised at the cell centres of a grid, with what it does not know."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from twin.core.records import MapGrid, StereoRig
from twin.estimate.mapping.depth_filter import JUMP_PX, DepthMap

Array = NDArray[np.float64]
Map = NDArray[np.float32]

#: Least cosine between a triangle's normal and the ray to it: below, it is seen so much from the side that it may as
#: well be a web between two surfaces.
LEAST_COSINE = 0.05
#: What no filter averages away, as a lateral error of the surface [px on the floor]: the matching window smooths relief
#: and spills over edges in much the same way in every view. On a slope s it is an error of s times this in height.
LATERAL_PX = 0.35


class Patch(NamedTuple):
    """One depth map seen from above: the cells of the grid from (row, col) on whose centres it covers.

    Args:
        height_m: (rows, cols) height at the cell centres, NaN where the surface does not cover them.
        variance_m2: (rows, cols) by the depth's variance alone, independent from one retired map to the next.
        common_m2: (rows, cols) by what views share: the pose's covariance and the smoothing of slopes.
        pixel: (rows, cols, 2) where the cell lies in the image, (u, v).
        lateral_m: the lateral error at the map's mean depth [m].
    """

    row: int
    col: int
    height_m: Map
    variance_m2: Map
    common_m2: Map
    pixel: Map
    lateral_m: float


def rasterise(
    depth_map: DepthMap, world_from_camera: Array, pose_cov: Array, rig: StereoRig, grid: MapGrid
) -> Patch | None:
    """Heights of a depth map at the cell centres of a grid, linear within the triangles between neighbouring pixels.

    Each square of four pixels makes two triangles; none spans a jump of depth, is seen from below or almost along its
    face, so no surface is invented between a reef's edge and the floor behind it. The variance of depth is projected
    along the ray to the height of the surface, and so is the pose's covariance (with the slope's part of a horizontal
    error).

    Args:
        pose_cov: (6, 6) covariance of the pose [rotation, translation], in the camera (rad, m).
    """
    points, bounds = _grid_points(
        depth_map.depth_m, world_from_camera, rig.focal_px, grid.west_m, grid.north_m, grid.cell_m
    )
    window = _window(bounds, grid)
    if window is None:
        return None
    row, col, rows, cols = window
    lateral = LATERAL_PX * float(np.nanmean(depth_map.depth_m)) / rig.focal_px
    patch = Patch(row, col, *_blank(rows, cols), lateral)
    rotation = np.kron(np.eye(2), world_from_camera[:3, :3])
    view = _View(
        world_from_camera[:3, 3] - [grid.west_m, grid.north_m, 0],
        world_from_camera[:3, 2].copy(),
        rotation @ pose_cov @ rotation.T,
        grid.cell_m,
        rig.focal_px,
        JUMP_PX / (rig.focal_px * rig.baseline_m),
    )
    _triangles(points, *depth_map, view, *patch[:6])
    return patch


class _View(NamedTuple):
    """Eye relative to the grid's corner [m], optical axis, covariance in world axes, cell, focal length, jump [1/m]."""

    eye: Array
    axis: Array
    cov: Array
    cell_m: float
    focal_px: float
    jump: float


def _blank(rows: int, cols: int) -> tuple[Map, Map, Map, Map]:
    unknown = np.full((rows, cols), np.nan, np.float32)
    return unknown, unknown.copy(), unknown.copy(), np.zeros((rows, cols, 2), np.float32)


def _window(bounds: Array, grid: MapGrid) -> tuple[int, int, int, int] | None:
    """First row and column, number of rows and columns of the cells within bounds (cells); None if there are none."""
    if not np.isfinite(bounds).all():
        return None
    low = np.maximum(np.ceil(bounds[:2]), 0)
    high = np.minimum(np.floor(bounds[2:]), [grid.rows - 1, grid.cols - 1])
    rows, cols = (high - low + 1).astype(int)
    return (int(low[0]), int(low[1]), int(rows), int(cols)) if rows > 0 and cols > 0 else None


@njit(cache=True, nogil=True)
def _grid_points(depth, pose, focal, west, north, cell):
    """Points of a depth map as (row, column, height), in cells from the centre of cell (0, 0) and metres; bounds."""
    height, width = depth.shape
    points = np.empty((height, width, 3))
    bounds = np.array([np.inf, np.inf, -np.inf, -np.inf])
    for v in range(height):
        y = (v - (height - 1) / 2) / focal
        for u in range(width):
            x, z = (u - (width - 1) / 2) / focal, depth[v, u]
            col = (z * (pose[0, 0] * x + pose[0, 1] * y + pose[0, 2]) + pose[0, 3] - west) / cell - 0.5
            row = (north - z * (pose[1, 0] * x + pose[1, 1] * y + pose[1, 2]) - pose[1, 3]) / cell - 0.5
            points[v, u, 0], points[v, u, 1] = row, col
            points[v, u, 2] = z * (pose[2, 0] * x + pose[2, 1] * y + pose[2, 2]) + pose[2, 3]
            if z > 0:
                bounds[0], bounds[1] = min(bounds[0], row), min(bounds[1], col)
                bounds[2], bounds[3] = max(bounds[2], row), max(bounds[3], col)
    return points, bounds


@njit(cache=True, nogil=True, inline="always")
def _between(a, b, c, e):
    """True if a whole number lies among four."""
    return np.ceil(min(min(a, b), min(c, e)) - 1e-9) <= np.floor(max(max(a, b), max(c, e)) + 1e-9)


@njit(cache=True, nogil=True)
def _triangles(points, depth, variance, view, row, col, height, spread, common, pixel):
    out = (points, depth, variance, view, row, col, height, spread, common, pixel)
    for v in range(depth.shape[0] - 1):
        for u in range(depth.shape[1] - 1):
            # most squares of pixels have no cell centre below them
            if not _between(points[v, u, 0], points[v, u + 1, 0], points[v + 1, u, 0], points[v + 1, u + 1, 0]):
                continue
            if not _between(points[v, u, 1], points[v, u + 1, 1], points[v + 1, u, 1], points[v + 1, u + 1, 1]):
                continue
            _triangle(v, u, v + 1, u, v, u + 1, *out)
            _triangle(v + 1, u + 1, v, u + 1, v + 1, u, *out)


@njit(cache=True, nogil=True)
def _triangle(va, ua, vb, ub, vc, uc, points, depth, variance, view, row, col, height, spread, common, pixel):
    """Writes the cells under one triangle of pixels a, b, c; of two surfaces over one cell the higher is seen."""
    a, b, c = points[va, ua], points[vb, ub], points[vc, uc]
    j0, j1 = np.ceil(min(a[1], b[1], c[1]) - 1e-9), np.floor(max(a[1], b[1], c[1]) + 1e-9)
    i0, i1 = np.ceil(min(a[0], b[0], c[0]) - 1e-9), np.floor(max(a[0], b[0], c[0]) + 1e-9)
    if not (j0 <= j1 and i0 <= i1):  # no cell centre below it: most triangles end here
        return
    za, zb, zc = depth[va, ua], depth[vb, ub], depth[vc, uc]
    if not (za > 0 and zb > 0 and zc > 0) or 1 / min(za, zb, zc) - 1 / max(za, zb, zc) > view.jump:
        return
    cell, eye, axis = view.cell_m, view.eye, view.axis
    bx, by, bz = (b[1] - a[1]) * cell, (a[0] - b[0]) * cell, b[2] - a[2]
    cx, cy, cz = (c[1] - a[1]) * cell, (a[0] - c[0]) * cell, c[2] - a[2]
    nx, ny, nz = by * cz - bz * cy, bz * cx - bx * cz, bx * cy - by * cx
    rx, ry, rz = (a[1] + 0.5) * cell - eye[0], -(a[0] + 0.5) * cell - eye[1], a[2] - eye[2]
    facing = -(nx * rx + ny * ry + nz * rz)
    if nz <= 0 or facing < LEAST_COSINE * np.sqrt((nx * nx + ny * ny + nz * nz) * (rx * rx + ry * ry + rz * rz)):
        return
    sx, sy = -nx / nz, -ny / nz  # slope of the surface
    for i in range(max(int(i0), row), min(int(i1), row + height.shape[0] - 1) + 1):
        for j in range(max(int(j0), col), min(int(j1), col + height.shape[1] - 1) + 1):
            x, y = (j - a[1]) * cell, (a[0] - i) * cell
            s, t = (x * cy - y * cx) / nz, (bx * y - by * x) / nz
            h = a[2] + s * bz + t * cz
            if s < -1e-9 or t < -1e-9 or s + t > 1 + 1e-9 or height[i - row, j - col] >= h:
                continue
            px, py, pz = rx + x, ry + y, h - eye[2]
            z = px * axis[0] + py * axis[1] + pz * axis[2]
            lift = (pz - sx * px - sy * py) / z  # change of height per change of depth
            p, q = i - row, j - col
            height[p, q] = h
            spread[p, q] = lift * lift * ((1 - s - t) * variance[va, ua] + s * variance[vb, ub] + t * variance[vc, uc])
            common[p, q] = pose_part(px, py, pz, sx, sy, view.cov)
            common[p, q] += (LATERAL_PX * z / view.focal_px) ** 2 * (sx * sx + sy * sy)
            pixel[p, q, 0] = ua + s * (ub - ua) + t * (uc - ua)
            pixel[p, q, 1] = va + s * (vb - va) + t * (vc - va)


@njit(cache=True, nogil=True, inline="always")
def pose_part(px, py, pz, sx, sy, cov):
    """Variance of height at a point (from the eye) of a surface by the pose's covariance, both in world axes."""
    row = (-sx, -sy, 1.0)
    full = (py * row[2] - pz * row[1], pz * row[0] - px * row[2], px * row[1] - py * row[0], row[0], row[1], row[2])
    total = 0.0
    for i in range(6):
        for j in range(6):
            total += full[i] * cov[i, j] * full[j]
    return total
