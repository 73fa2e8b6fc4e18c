"""The composite elevation map (parts P18 to P20 of the method): depth maps rasterised as surfaces, fused cell by cell."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from twin.estimate.depth_filter import GATE, JUMP_PX, DepthMap, Mask
from twin.records import ElevationMap, Image, MapGrid, StereoRig

Array = NDArray[np.float64]
Map = NDArray[np.float32]

#: Least cosine between a triangle's normal and the ray to it: below, it is seen so much from the side that it may as
#: well be a web between two surfaces.
LEAST_COSINE = 0.05
#: What no filter averages away, as a lateral error of the surface [px on the floor]: the matching window smooths relief
#: the same way in every view. On a slope s it is an error of s times this in height.
LATERAL_PX = 0.35


class Patch(NamedTuple):
    """One depth map seen from above: the cells of the grid from (row, col) on whose centres it covers.

    Args:
        height_m: (rows, cols) height at the cell centres, NaN where the surface does not cover them.
        variance_m2: (rows, cols) by the depth's variance alone, independent from one retired map to the next.
        common_m2: (rows, cols) by what views share: the pose's covariance and the smoothing of slopes.
        pixel: (rows, cols, 2) where the cell lies in the image, (u, v).
    """

    row: int
    col: int
    height_m: Map
    variance_m2: Map
    common_m2: Map
    pixel: Map


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
    depth = depth_map.depth_m
    world = _world_points(depth, world_from_camera, rig)
    window = _window(world, grid)
    if window is None:
        return None
    row, col, rows, cols = window
    patch = Patch(row, col, *(np.full((rows, cols), np.nan, np.float32) for _ in range(3)), np.zeros((rows, cols, 2), np.float32))
    origin = np.array([grid.west_m + (col + 0.5) * grid.cell_m, grid.north_m - (row + 0.5) * grid.cell_m, grid.cell_m])
    eye = world_from_camera[:3, 3].copy()
    rotation = world_from_camera[:3, :3]
    world_cov = np.block([[rotation, np.zeros((3, 3))], [np.zeros((3, 3)), rotation]])
    world_cov = world_cov @ pose_cov @ world_cov.T
    jump = JUMP_PX / (rig.focal_px * rig.baseline_m)
    _triangles(world, depth, depth_map.variance_m2, eye, rotation[:, 2].copy(), world_cov, jump, rig.focal_px, origin, *patch[2:])
    return patch


def _world_points(depth: Map, world_from_camera: Array, rig: StereoRig) -> Array:
    """(H, W, 3) points of a depth map in the world [m]."""
    u = (np.arange(depth.shape[1]) - rig.cx_px) / rig.focal_px
    v = (np.arange(depth.shape[0]) - rig.cy_px) / rig.focal_px
    rays = world_from_camera[:3, 0] * u[None, :, None] + world_from_camera[:3, 1] * v[:, None, None] + world_from_camera[:3, 2]
    return rays * depth[..., None] + world_from_camera[:3, 3]


def _window(world: Array, grid: MapGrid) -> tuple[int, int, int, int] | None:
    """First row and column, number of rows and columns of the cells that a depth map can touch."""
    known = world[np.isfinite(world[..., 0])]
    if known.size == 0:
        return None
    west, south = known[:, :2].min(axis=0)
    east, north = known[:, :2].max(axis=0)
    col, row = max(0, int((west - grid.west_m) / grid.cell_m)), max(0, int((grid.north_m - north) / grid.cell_m))
    last_col = min(grid.cols, int((east - grid.west_m) / grid.cell_m) + 1)
    last_row = min(grid.rows, int((grid.north_m - south) / grid.cell_m) + 1)
    return (row, col, last_row - row, last_col - col) if last_row > row and last_col > col else None


@njit(cache=True, nogil=True)
def _triangles(world, depth, variance, eye, axis, cov, jump, focal, origin, height, spread, common, pixel):
    for v in range(depth.shape[0] - 1):
        for u in range(depth.shape[1] - 1):
            for half in range(2):
                v0, u0 = v + half, u + half
                args = (world, depth, variance, eye, axis, cov, jump, focal, origin, height, spread, common, pixel)
                if half == 0:
                    _triangle(v0, u0, v + 1, u, v, u + 1, *args)
                else:
                    _triangle(v0, u0, v, u + 1, v + 1, u, *args)


@njit(cache=True, nogil=True)
def _triangle(va, ua, vb, ub, vc, uc, world, depth, variance, eye, axis, cov, jump, focal, origin, height, spread, common, pixel):
    """Writes the cells under one triangle of pixels a, b, c; of two surfaces over one cell the higher is seen."""
    za, zb, zc = depth[va, ua], depth[vb, ub], depth[vc, uc]
    if not (za > 0 and zb > 0 and zc > 0):
        return
    if 1 / min(za, zb, zc) - 1 / max(za, zb, zc) > jump:
        return
    a, b, c = world[va, ua], world[vb, ub], world[vc, uc]
    bx, by, bz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    cx, cy, cz = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    nx, ny, nz = by * cz - bz * cy, bz * cx - bx * cz, bx * cy - by * cx
    rx, ry, rz = a[0] - eye[0], a[1] - eye[1], a[2] - eye[2]
    if nz <= 0:
        return
    along = nx * rx + ny * ry + nz * rz
    if -along < LEAST_COSINE * np.sqrt((nx * nx + ny * ny + nz * nz) * (rx * rx + ry * ry + rz * rz)):
        return
    west, north, cell = origin
    j0 = max(0, int(np.ceil((min(a[0], b[0], c[0]) - west) / cell - 1e-9)))
    j1 = min(height.shape[1] - 1, int(np.floor((max(a[0], b[0], c[0]) - west) / cell + 1e-9)))
    i0 = max(0, int(np.ceil((north - max(a[1], b[1], c[1])) / cell - 1e-9)))
    i1 = min(height.shape[0] - 1, int(np.floor((north - min(a[1], b[1], c[1])) / cell + 1e-9)))
    for i in range(i0, i1 + 1):
        for j in range(j0, j1 + 1):
            x, y = west + j * cell - a[0], north - i * cell - a[1]
            s, t = (x * cy - y * cx) / nz, (bx * y - by * x) / nz
            if s < -1e-9 or t < -1e-9 or s + t > 1 + 1e-9:
                continue
            h = a[2] + s * bz + t * cz
            if height[i, j] >= h:
                continue
            sx, sy = -nx / nz, -ny / nz  # slope of the surface
            px, py, pz = rx + x, ry + y, h - eye[2]
            z = px * axis[0] + py * axis[1] + pz * axis[2]
            lift = (pz - sx * px - sy * py) / z  # change of height per change of depth
            height[i, j] = h
            spread[i, j] = lift * lift * ((1 - s - t) * variance[va, ua] + s * variance[vb, ub] + t * variance[vc, uc])
            common[i, j] = _pose_part(px, py, pz, sx, sy, cov) + (LATERAL_PX * z / focal) ** 2 * (sx * sx + sy * sy)
            pixel[i, j, 0] = ua + s * (ub - ua) + t * (uc - ua)
            pixel[i, j, 1] = va + s * (vb - va) + t * (vc - va)


@njit(cache=True, nogil=True, inline="always")
def _pose_part(px, py, pz, sx, sy, cov):
    """Variance of height at a point (from the eye) of a surface by the pose's covariance, both in world axes."""
    row = (-sx, -sy, 1.0)
    full = (py * row[2] - pz * row[1], pz * row[0] - px * row[2], px * row[1] - py * row[0], row[0], row[1], row[2])
    total = 0.0
    for i in range(6):
        for j in range(6):
            total += full[i] * cov[i, j] * full[j]
    return total


class ElevationMapper:
    """Fuses patches into the cells of a grid; memory is that of the grid, however long the survey.

    A cell keeps up to two hypotheses of its height (a steep cell is seen now at the foot, now at the edge): each patch
    updates the one whose gate (z - h)^2 < GATE (P + R) it passes and that fits best, or opens the second, or replaces it if it knows
    more than the weaker. The better known one is the result.

    Variance has two parts. That of depth is independent from map to map and shrinks with each fusion. That of the pose
    and of smoothed slopes is shared by all cells of a leg, and largely by all legs: it is carried beside as the
    weighted mean of what came in, so it never averages away. The sum is told.
    """

    def __init__(self, grid: MapGrid):
        shape = (grid.rows, grid.cols)
        self.grid = grid
        self._height = np.full((2, *shape), np.nan, np.float32)
        self._variance = np.full((2, *shape), np.inf, np.float32)
        self._common = np.zeros((2, *shape), np.float32)
        self._colour = np.zeros((*shape, 4), np.float32)

    def add_heights(self, patch: Patch, retired: Mask) -> None:
        """Fuses the cells of a patch whose nearest pixel is retired."""
        _fuse_cells(*patch, retired, GATE, self._height, self._variance, self._common)

    def add_colours(self, patch: Patch, rgb: Image, gain: Map) -> None:
        """Adds the image to the mosaic: a weighted mean that prefers what lies near the middle of the image."""
        _paint(patch.row, patch.col, patch.height_m, patch.pixel, rgb, gain, self._colour)

    def result(self) -> ElevationMap:
        """The better known hypothesis of every cell, its standard deviation and the mosaic."""
        best = self._variance[1] < self._variance[0]
        pick = lambda layers: np.where(best, layers[1], layers[0])  # noqa: E731
        height = pick(self._height)
        sigma = np.sqrt(pick(self._variance) + pick(self._common))
        sigma[np.isnan(height)] = np.nan
        weight = self._colour[..., 3:]
        mosaic = np.divide(self._colour[..., :3], weight, out=np.zeros_like(self._colour[..., :3]), where=weight > 0)
        return ElevationMap(self.grid, height, sigma.astype(np.float32), np.clip(mosaic + 0.5, 0, 255).astype(np.uint8))


@njit(cache=True, nogil=True)
def _fuse_cells(row, col, height, variance, common, pixel, retired, gate, heights, variances, commons):
    for i in range(height.shape[0]):
        for j in range(height.shape[1]):
            z = height[i, j]
            if np.isnan(z) or not retired[int(pixel[i, j, 1] + 0.5), int(pixel[i, j, 0] + 0.5)]:
                continue
            r, q = variance[i, j], common[i, j]
            a, b = row + i, col + j
            best, least = -1, gate
            for n in range(2):
                if np.isnan(heights[n, a, b]):
                    continue
                fit = (z - heights[n, a, b]) ** 2 / (variances[n, a, b] + r + commons[n, a, b] + q)
                if fit < least:
                    best, least = n, fit
            if best < 0:
                weaker = 0 if variances[0, a, b] > variances[1, a, b] else 1
                if r < variances[weaker, a, b]:
                    heights[weaker, a, b], variances[weaker, a, b], commons[weaker, a, b] = z, r, q
                continue
            p = variances[best, a, b]
            gain = p / (p + r)
            heights[best, a, b] += gain * (z - heights[best, a, b])
            commons[best, a, b] += gain * (q - commons[best, a, b])
            variances[best, a, b] = p * r / (p + r)


@njit(cache=True, nogil=True)
def _paint(row, col, height, pixel, rgb, gain, colour):
    rows, cols = rgb.shape[0] - 1, rgb.shape[1] - 1
    for i in range(height.shape[0]):
        for j in range(height.shape[1]):
            if np.isnan(height[i, j]):
                continue
            x, y = pixel[i, j, 0], pixel[i, j, 1]
            u, v = min(int(x), cols - 1), min(int(y), rows - 1)
            s, t = x - u, y - v
            off = (2 * x / cols - 1) ** 2 + (2 * y / rows - 1) ** 2
            weight = np.exp(-4 * off) + 1e-4
            for k in range(3):
                top = (1 - s) * rgb[v, u, k] * gain[v, u, k] + s * rgb[v, u + 1, k] * gain[v, u + 1, k]
                low = (1 - s) * rgb[v + 1, u, k] * gain[v + 1, u, k] + s * rgb[v + 1, u + 1, k] * gain[v + 1, u + 1, k]
                colour[row + i, col + j, k] += weight * ((1 - t) * top + t * low)
            colour[row + i, col + j, 3] += weight
