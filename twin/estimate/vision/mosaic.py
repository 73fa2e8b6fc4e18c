"""The local 2.5-D mosaic and the registration of a frame with it (F2M, P7): six degrees of freedom over any relief.

The mosaic is a raster in the world: brightness (locally normalised) and elevation per cell, and which keyframe laid
it. A cell keeps what was seen there first: the oldest view has drifted least. A frame is registered by direct
alignment: cells with texture are projected into it, and the pose is moved until their brightness agrees (Gauss-Newton
with Huber weights).

What a registration errs by comes from heights and uneven light more than from the noise of pixels, and neighbouring
cells share it: counted one by one they claimed 0.4 mrad where 1.4 to 6 were true, over a floor of coarse texture. So
the covariance is that of clustered data (Liang & Zeger 1986), by what the blocks of the image disagree about.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.records import StereoRig
from twin.estimate.vision import matching, two_view_motion
from twin.estimate.vision.tiles import TiledRaster

_MAX_CELLS = 4000
_MIN_CELLS = 300
_MIN_GRADIENT = 4.0  # grey levels per cell
_MAX_RESIDUAL = 40.0  # grey levels; matched images of unit contrast (36) leave far less
_ITERATIONS = 8
_BLOCKS = (6, 8)  # of the image, rows and columns: each about a window of the normalisation wide


class Registration(NamedTuple):
    """Where the mosaic shows a frame.

    Args:
        correction: of the predicted pose, predicted_from_true.
        laid_by: number of the keyframe that laid the median cell: half of what was compared with is older.
    """

    correction: two_view_motion.Motion
    laid_by: int


class Mosaic:
    """Brightness, elevation and origin of the floor around the vehicle, in tiles: memory does not grow with the area.

    Args:
        cell_m: cell size, about a pixel's footprint; cell (0, 0) begins at the world's origin, rows run north.
        folder: where tiles are spooled.
    """

    def __init__(self, cell_m: float, folder: Path):
        self.cell_m, self.cells = cell_m, TiledRaster(3, folder)

    def clear(self) -> None:
        """Forgets everything: after a global alignment the mosaic is laid anew."""
        self.cells.clear()

    def add(
        self, number: int, image: matching.Image, depth_m: NDArray[np.float32], world_from_camera: Array, rig: StereoRig
    ) -> None:
        """Lays a keyframe of this number with its depth (height, width), NaN where unknown, into the empty cells."""
        known = depth_m[np.isfinite(depth_m)]
        if known.size == 0:
            return
        farthest_m = 1.2 * float(np.quantile(known, 0.99))  # a mismatch may lie at any depth
        reach_m = farthest_m * np.hypot(rig.width_px, rig.height_px) / rig.focal_px / 2
        row, col, side = self._window(world_from_camera[:3, 3], reach_m)
        cells = self.cells.read(row, col, side, side)
        _lay(
            image, depth_m, world_from_camera, geometry.inverse(world_from_camera), rig.focal_px, rig.cx_px, rig.cy_px,
            col * self.cell_m, row * self.cell_m, self.cell_m, number, cells[0], cells[1], cells[2],
        )  # fmt: skip
        self.cells.write(row, col, cells)

    def register(
        self,
        image: matching.Image,
        depth_m: NDArray[np.float32],
        world_from_camera: Array,
        footprint_m: float,
        rig: StereoRig,
    ) -> Registration | None:
        """Pose correction of a frame, with its covariance; None where too little agrees.

        Args:
            image: normalised frame.
            depth_m: (height, width) as its own pair measures it, NaN where unknown.
            world_from_camera: (4, 4) predicted pose.
            footprint_m: half the extent of the floor to use, around the camera.
        """
        cells = self._textured_cells(world_from_camera[:3, 3], footprint_m)
        if cells is None:
            return None
        points, brightness, laid_by = cells
        frame = image.astype(np.float32)
        camera, current = (rig.focal_px, rig.cx_px, rig.cy_px), world_from_camera
        normal, scatter, sigma, n_used, used = np.eye(6), np.eye(6), 0.0, 0, np.zeros(0, np.bool_)
        for _ in range(_ITERATIONS):
            *told, used = _compare(points, brightness, frame, depth_m, geometry.inverse(current), camera, _MAX_RESIDUAL)
            n_used = int(np.count_nonzero(used))
            if n_used < _MIN_CELLS:
                return None
            normal, right, scatter, sigma = _normal_equations(*told)
            step = np.asarray(np.linalg.solve(normal, right), np.float64)
            current = current @ geometry.exp(step)
            if np.abs(step).max() < 1e-6:
                break
        inverse = np.linalg.inv(normal)
        cov = np.asarray(inverse @ scatter @ inverse.T, np.float64)
        correction = geometry.inverse(world_from_camera) @ current
        median = np.partition(laid_by[used], n_used // 2)[n_used // 2]  # a keyframe's number, not between two
        return Registration(two_view_motion.Motion(correction, cov, n_used, sigma), int(median))

    def _window(self, centre: Array, half_m: float) -> tuple[int, int, int]:
        """First row, first column and side of the square of cells around a place."""
        half = int(np.ceil(half_m / self.cell_m))
        return int(centre[1] / self.cell_m) - half, int(centre[0] / self.cell_m) - half, 2 * half

    def _textured_cells(
        self, centre: Array, half_m: float
    ) -> tuple[Array, NDArray[np.float32], NDArray[np.float32]] | None:
        """World points (n, 3), brightness (n,) and keyframe (n,) of cells with a gradient, within a square."""
        row, col, side = self._window(centre, half_m)
        bright, height, number = self.cells.read(row, col, side, side)
        if side < 8:
            return None
        strength = _gradient(bright, height)
        rows, cols = np.nonzero(strength > _MIN_GRADIENT)
        if len(rows) < _MIN_CELLS:
            return None
        keep = slice(None, None, max(1, len(rows) // _MAX_CELLS))
        rows, cols = rows[keep], cols[keep]
        x = (col + cols + 0.5) * self.cell_m
        y = (row + rows + 0.5) * self.cell_m
        points = np.column_stack([x, y, height[rows, cols]])
        return np.asarray(points, np.float64), bright[rows, cols], number[rows, cols]


def _gradient(bright: NDArray[np.float32], height: NDArray[np.float32]) -> NDArray[np.float32]:
    """Brightness change per cell; zero where a neighbour is unknown."""
    strength = np.zeros_like(bright)
    across, along = bright[1:-1, 2:] - bright[1:-1, :-2], bright[2:, 1:-1] - bright[:-2, 1:-1]
    known = height[1:-1, 2:] + height[1:-1, :-2] + height[2:, 1:-1] + height[:-2, 1:-1] + height[1:-1, 1:-1]
    strength[1:-1, 1:-1] = np.where(np.isfinite(known), np.hypot(across, along) / 2, 0)
    return strength


@njit(cache=True, nogil=True)
def _lay(image, depth, pose, inverse, focal, cx, cy, west, south, cell, laid_by, brightness, height, number):
    """Fills empty cells: the mean height of the pixels that fall in, the brightness where the cell's centre projects.

    Taking a pixel's own brightness would shift the picture by the pixel's place in the cell: 5 mm of bias in position.
    """
    total = np.zeros(height.shape, np.float32)
    count = np.zeros(height.shape, np.int32)
    rows, cols = height.shape
    for v in range(depth.shape[0]):
        for u in range(depth.shape[1]):
            z = depth[v, u]
            if not z > 0:
                continue
            x, y = (u - cx) / focal * z, (v - cy) / focal * z
            col = int(np.floor((pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z + pose[0, 3] - west) / cell))
            row = int(np.floor((pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z + pose[1, 3] - south) / cell))
            if 0 <= row < rows and 0 <= col < cols:
                total[row, col] += pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z + pose[2, 3]
                count[row, col] += 1
    for row in range(rows):
        for col in range(cols):
            if count[row, col] == 0 or not np.isnan(height[row, col]):
                continue
            x, y, z = west + (col + 0.5) * cell, south + (row + 0.5) * cell, total[row, col] / count[row, col]
            depth_here = inverse[2, 0] * x + inverse[2, 1] * y + inverse[2, 2] * z + inverse[2, 3]
            u = focal * (inverse[0, 0] * x + inverse[0, 1] * y + inverse[0, 2] * z + inverse[0, 3]) / depth_here + cx
            v = focal * (inverse[1, 0] * x + inverse[1, 1] * y + inverse[1, 2] * z + inverse[1, 3]) / depth_here + cy
            i, j = int(np.floor(v)), int(np.floor(u))
            if i < 0 or j < 0 or i >= image.shape[0] - 1 or j >= image.shape[1] - 1:
                continue
            height[row, col], number[row, col] = z, laid_by
            brightness[row, col] = _between(image, i, j, v - i, u - j)


@njit(cache=True, nogil=True)
def _compare(points, brightness, frame, depth, camera_from_world, camera, max_residual):
    """What each cell that the frame shows says of the motion.

    Args:
        camera: focal length, column and row of the principal point [px].

    Returns:
        Rows (m, 6) of the motion; the same told by the frame's own depth; residuals (m,); blocks of the image (m,); and
        which cells these are (n,).
    """
    focal, cx, cy = camera
    n, m, (high, wide) = len(points), 0, _BLOCKS
    rows, told, residuals, block = np.empty((n, 6)), np.empty((n, 6)), np.empty(n), np.empty(n, np.int64)
    kept = np.zeros(n, np.bool_)
    rotation, translation = np.ascontiguousarray(camera_from_world[:3, :3]), camera_from_world[:3, 3].copy()
    for k in range(n):
        p = rotation @ points[k] + translation
        if p[2] <= 0.05:
            continue
        x, y = p[0] / p[2], p[1] / p[2]
        u, v = focal * x + cx, focal * y + cy
        i, j = int(np.floor(v)), int(np.floor(u))
        if i < 1 or j < 1 or i >= frame.shape[0] - 2 or j >= frame.shape[1] - 2:
            continue
        a, b = v - i, u - j
        residual = brightness[k] - _between(frame, i, j, a, b)
        near = depth[int(v + 0.5), int(u + 0.5)]
        if abs(residual) > max_residual or not near > 0:
            continue
        grad_u = focal * (_between(frame, i, j + 1, a, b) - _between(frame, i, j - 1, a, b)) / 2
        grad_v = focal * (_between(frame, i + 1, j, a, b) - _between(frame, i - 1, j, a, b)) / 2
        rows[m, 0] = grad_u * x * y + grad_v * (1 + y * y)
        rows[m, 1] = -grad_u * (1 + x * x) - grad_v * x * y
        rows[m, 2] = grad_u * y - grad_v * x
        rows[m, 3] = -grad_u / p[2]
        rows[m, 4] = -grad_v / p[2]
        rows[m, 5] = (grad_u * x + grad_v * y) / p[2]
        for c in range(3):
            told[m, c], told[m, 3 + c] = rows[m, c], rows[m, 3 + c] * p[2] / near
        residuals[m], kept[k] = residual, True
        block[m] = i * high // frame.shape[0] * wide + j * wide // frame.shape[1]
        m += 1
    return rows[:m], told[:m], residuals[:m], block[:m], kept


@njit(cache=True, nogil=True, inline="always")
def _between(image, i, j, a, b):
    """Bilinear value at a share (a, b) of the way from pixel (i, j) to the next row and column."""
    top = image[i, j] * (1 - b) + image[i, j + 1] * b
    bottom = image[i + 1, j] * (1 - b) + image[i + 1, j + 1] * b
    return top * (1 - a) + bottom * a


@njit(cache=True, nogil=True)
def _normal_equations(rows, told, residuals, block):
    """Normal matrix (6, 6), right side (6,), its scatter (6, 6) by the blocks of the image, robust deviation."""
    normal, right, scatter = np.zeros((6, 6)), np.zeros(6), np.zeros((6, 6))
    if len(rows) < 6:
        return normal, right, scatter, 0.0
    n_parts = _BLOCKS[0] * _BLOCKS[1]
    parts, filled = np.zeros((n_parts, 6)), np.zeros(n_parts, np.bool_)
    sigma = 1.4826 * np.median(np.abs(residuals)) + 1e-3
    for k in range(len(rows)):
        size = abs(residuals[k]) / sigma
        weight = 1.0 if size < 1.5 else 1.5 / size
        filled[block[k]] = True
        for i in range(6):
            parts[block[k], i] += weight * told[k, i] * residuals[k]
            for j in range(6):
                normal[i, j] += weight * told[k, i] * rows[k, j]
    n_blocks = filled.sum()
    for part in parts:
        right += part
        scatter += np.outer(part, part) * (n_blocks / max(n_blocks - 6, 1))
    return normal, right, scatter, sigma
