"""The map without images: which cells of the floor a keyframe shows, and what its depth filter hands over of them.

A cell of the grid stands for the pixels that show it. It is seen where it lies in both images and faces the camera; a
cliff that hides what is behind it is not looked for.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.records import MapGrid, StereoRig
from twin.estimate.mapping import surface
from twin.estimate.mapping.surface import Patch

Map = NDArray[np.float32]


class CellErrors(NamedTuple):
    """What a depth filter leaves in the cells that it hands over.

    Args:
        shared: (rows, cols) standard normal: what all views of a cell err by sideways.
        lost: (rows, cols) even between 0 and 1: those above `complete` stay unknown.
        lateral_px: deviation sideways.
        depths_m: (m,) rising, for which the following are given.
        depth_px, claimed_px: (m,) deviation of the depth, and its claim [px of disparity].
        complete: (m,) share of the cells whose depth is known.
    """

    shared: Map
    lost: Map
    lateral_px: float
    depths_m: Array
    depth_px: Array
    claimed_px: Array
    complete: Array


class Chart:
    """The floor by the cells of a grid.

    Args:
        height_m: (rows, cols) true height at their centres.
        rig: true camera.

    Attributes:
        seen: (rows, cols) cells that were marked.
    """

    def __init__(self, grid: MapGrid, height_m: Map, rig: StereoRig):
        self.grid, self.height_m, self.seen, self._rig = grid, height_m, np.zeros(height_m.shape, np.bool_), rig
        down, east = np.gradient(np.asarray(height_m, np.float64), grid.cell_m)
        self._slope = np.stack([east, -down], axis=-1).astype(np.float32)
        self._lowest_m = float(np.nanmin(height_m))
        self._place = (grid.west_m, grid.north_m, grid.cell_m)
        self._camera = (
            rig.focal_px, rig.cx_px, rig.cy_px, float(rig.width_px - 1), float(rig.height_px - 1), rig.baseline_m,
        )  # fmt: skip

    @property
    def steepness(self) -> Map:
        """(rows, cols) slope of the floor."""
        return np.hypot(*np.moveaxis(self._slope, -1, 0))

    def see(self, world_from_camera: Array) -> None:
        """Marks the cells that a keyframe at this true pose sees with both cameras."""
        window = self._window(world_from_camera)
        camera_from_world = geometry.inverse(world_from_camera)
        _mark(self.seen, self.height_m, self._place, self._camera, camera_from_world, *window)

    def hand_over(
        self,
        true: Array,
        next_true: Array | None,
        believed: Array,
        cov: Array,
        errors: CellErrors,
        rng: np.random.Generator,
    ) -> Patch | None:
        """What the filter of a keyframe knows of those cells that the next keyframe does not see.

        Args:
            true, next_true: (4, 4) true poses of the keyframe and the next one; None where there is none.
            believed: (4, 4) its estimated pose, with cov (6, 6).
            errors: of its cells.
            rng: stream of what this view alone errs by.
        """
        row, end_row, col, end_col = self._window(true)
        if row >= end_row or col >= end_col:
            return None
        shape = (end_row - row, end_col - col)
        height = np.full(shape, np.nan, np.float32)
        variance, common = height.copy(), height.copy()
        last = next_true is None
        camera_from_world = np.stack([geometry.inverse(true), geometry.inverse(true if last else next_true)])
        shift = believed @ camera_from_world[0]
        turn = geometry.adjoint(geometry.pose(believed[:3, :3], np.zeros(3)))
        depth_m = _hand_over(
            height, variance, common, self.height_m, self._slope, self._place, self._camera, camera_from_world, last,
            shift, believed[:3, 3].copy(), turn @ cov @ turn.T, rng.standard_normal(shape, np.float32),
            errors, row, col,
        )  # fmt: skip
        lateral = surface.LATERAL_PX * depth_m / self._rig.focal_px
        return Patch(row, col, height, variance, common, np.zeros((*shape, 2), np.float32), lateral)

    def _window(self, world_from_camera: Array) -> tuple[int, int, int, int]:
        """Rows and columns (first, end) that the view reaches on the lowest floor."""
        size = (self.grid.rows, self.grid.cols)
        return _window(world_from_camera, self._camera, self._place, self._lowest_m, size)


@njit(cache=True, nogil=True)
def _window(pose, camera, place, lowest, size):
    focal, cx, cy, _, _, _ = camera
    west, north, cell = place
    rows, cols = size
    x_low = x_high = pose[0, 3]
    y_low = y_high = pose[1, 3]
    for u, v in ((-cx, -cy), (cx, -cy), (-cx, cy), (cx, cy)):
        a, b = u / focal, v / focal
        dx = pose[0, 0] * a + pose[0, 1] * b + pose[0, 2]
        dy = pose[1, 0] * a + pose[1, 1] * b + pose[1, 2]
        dz = pose[2, 0] * a + pose[2, 1] * b + pose[2, 2]
        if dz >= -0.1:  # the horizon is in view: look at everything
            return 0, rows, 0, cols
        far = (lowest - pose[2, 3]) / dz
        x_low, x_high = min(x_low, pose[0, 3] + far * dx), max(x_high, pose[0, 3] + far * dx)
        y_low, y_high = min(y_low, pose[1, 3] + far * dy), max(y_high, pose[1, 3] + far * dy)
    first_row, end_row = max(int((north - y_high) / cell) - 1, 0), min(int((north - y_low) / cell) + 2, rows)
    first_col, end_col = max(int((x_low - west) / cell) - 1, 0), min(int((x_high - west) / cell) + 2, cols)
    return first_row, end_row, first_col, end_col


@njit(cache=True, nogil=True, inline="always")
def _depth_in(camera_from_world, camera, x, y, z):
    """Depth of a point in the left camera where both images show it, else -1."""
    focal, cx, cy, right, bottom, baseline = camera
    m = camera_from_world
    depth = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3]
    if not depth > 0:
        return -1.0
    u = focal * (m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3]) / depth + cx
    v = focal * (m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3]) / depth + cy
    if 0 <= v <= bottom and u <= right and u - focal * baseline / depth >= 0:
        return depth
    return -1.0


@njit(cache=True, nogil=True)
def _mark(seen, height, place, camera, camera_from_world, row, end_row, col, end_col):
    west, north, cell = place
    for i in range(row, end_row):
        y = north - (i + 0.5) * cell
        for j in range(col, end_col):
            if not seen[i, j]:
                x = west + (j + 0.5) * cell
                seen[i, j] = _depth_in(camera_from_world, camera, x, y, height[i, j]) > 0


@njit(cache=True, nogil=True)
def _hand_over(
    out, variance, common, height, slope, place, camera, camera_from_world, last, shift, eye, cov, own, errors, row,
    col,
):  # fmt: skip
    """Fills the patch's heights and variances; returns the mean depth."""
    west, north, cell = place
    total, count = 0.0, 0
    for i in range(row, row + out.shape[0]):
        y = north - (i + 0.5) * cell
        for j in range(col, col + out.shape[1]):
            x, z = west + (j + 0.5) * cell, height[i, j]
            depth = _depth_in(camera_from_world[0], camera, x, y, z)
            if depth < 0 or (not last and _depth_in(camera_from_world[1], camera, x, y, z) > 0):
                continue
            k, share = _between(errors.depths_m, depth)
            if errors.lost[i, j] > _mixed(errors.complete, k, share):
                continue
            sx, sy = np.float64(slope[i, j, 0]), np.float64(slope[i, j, 1])
            # where this bit of floor is believed to be, and the surface there brought back to the cell's centre
            px = shift[0, 0] * x + shift[0, 1] * y + shift[0, 2] * z + shift[0, 3]
            py = shift[1, 0] * x + shift[1, 1] * y + shift[1, 2] * z + shift[1, 3]
            pz = shift[2, 0] * x + shift[2, 1] * y + shift[2, 2] * z + shift[2, 3]
            value = pz - sx * (px - x) - sy * (py - y)
            per_px = depth * depth / (camera[0] * camera[5])
            steep = np.sqrt(sx * sx + sy * sy)
            value += per_px * _mixed(errors.depth_px, k, share) * own[i - row, j - col]
            value += steep * errors.lateral_px * depth / camera[0] * errors.shared[i, j]
            out[i - row, j - col] = value
            variance[i - row, j - col] = (per_px * _mixed(errors.claimed_px, k, share)) ** 2
            common[i - row, j - col] = surface.pose_part(x - eye[0], y - eye[1], z - eye[2], sx, sy, cov)
            common[i - row, j - col] += (surface.LATERAL_PX * depth / camera[0] * steep) ** 2
            total += depth
            count += 1
    return total / max(count, 1)


@njit(cache=True, nogil=True, inline="always")
def _between(rising, value):
    """The last but one index at whose number the value is, and the share of the way to the next; ends hold."""
    k = 0
    while k < len(rising) - 2 and value > rising[k + 1]:
        k += 1
    return k, min(max((value - rising[k]) / (rising[k + 1] - rising[k]), 0.0), 1.0)


@njit(cache=True, nogil=True, inline="always")
def _mixed(numbers, k, share):
    return (1 - share) * numbers[k] + share * numbers[k + 1]
