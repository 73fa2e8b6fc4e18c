"""Local 2.5-D mosaic, and the registration of frames with it (F2M) in six degrees of freedom over any relief.

A cell has brightness, elevation and number of the oldest keyframe that saw it, whose pose has drifted least. Textured
cells are aligned directly with the frame (Gauss-Newton, Huber weights). Their residuals are correlated (heights,
light): with independent cells, the computed standard deviation of the rotation was 0.4 mrad at an error of 1.4 to 6
mrad, so the covariance is that of clustered data (Liang & Zeger 1986), with image blocks as clusters.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.interpolation import bilinear
from twin.core.records import Map, StereoRig
from twin.estimate.vision import matching, two_view_motion
from twin.estimate.vision.tiles import TiledRaster
from twin.kernels import kernel

_MAX_CELLS = 4000
_MIN_CELLS = 300
_MIN_GRADIENT = 4.0  # grey levels per cell
_MAX_RESIDUAL = 40.0  # grey levels; residuals of inliers are far smaller (standard deviation of a normalised image: 36)
_ITERATIONS = 8
_BLOCKS = (6, 8)  # rows and columns of image blocks; a block is about as wide as the normalisation window
#: Largest ratio of the 99th percentile and the median of depths: cells of the median's resolution would else have to
#: cover more than 25 times the area of an image, as where a camera looks along a floor.
_MOST_DEPTH_RATIO = 5.0
_MAX_TILT_RAD = np.deg2rad(45.0)  # of the optical axis from straight down, for heights along z of the world


def viewing_plane(world_from_camera: Array) -> Array:
    """Returns the transformation plane_from_world (4, 4) to axes in which heights are measured along z."""
    # the identity if the camera looks down within 45 degrees, else the smallest rotation that turns its axis to -z
    axis = world_from_camera[:3, 2]
    angle = float(np.arccos(np.clip(-axis[2], -1.0, 1.0)))
    if angle <= _MAX_TILT_RAD:
        return np.eye(4)
    turn = np.cross(axis, [0.0, 0.0, -1.0])
    length = np.linalg.norm(turn)
    direction = np.array([1.0, 0.0, 0.0]) if length < 1e-9 else turn / length  # straight up: any horizontal axis
    return geometry.pose(geometry.so3_exp(direction * angle), np.zeros(3))


def can_represent(depth_m: Map) -> bool:
    """Returns whether a mosaic can represent the scene of an image, from its depths (H, W) [m], NaN where unknown."""
    known = depth_m[np.isfinite(depth_m)]
    return known.size > 0 and bool(np.quantile(known, 0.99) <= _MOST_DEPTH_RATIO * np.median(known))


class Registration(NamedTuple):
    #: pose of the camera at its estimated pose, relative to the camera at its predicted pose
    #: (predicted_from_estimated); `n_points` is the number of compared cells, `residual` is in normalised grey levels.
    correction: two_view_motion.Motion
    reference_keyframe: int  #: median of the keyframe numbers of the compared cells


class Mosaic:
    """Raster of brightness, elevation [m] and keyframe number, in tiles, on disk in `folder`.

    The cell size `cell_m` [m] is about the ground sample distance. The south-west corner of cell (0, 0) is the origin
    of the world, and row numbers increase to the north.
    """

    def __init__(self, cell_m: float, folder: Path):
        self.cell_m, self.cells = cell_m, TiledRaster(3, folder)

    def add(self, number: int, image: matching.Image, depth_m: Map, world_from_camera: Array, rig: StereoRig) -> None:
        """Fills empty cells by a normalised image and depth (H, W) [m] that it `can_represent`. Raises OSError."""
        known = depth_m[np.isfinite(depth_m)]
        farthest_m = 1.2 * float(np.quantile(known, 0.99))  # the maximum may be a mismatch
        reach_m = farthest_m * np.hypot(rig.width_px, rig.height_px) / rig.focal_px / 2
        row, col, side = self._window(world_from_camera[:3, 3], reach_m)
        cells = self.cells.read(row, col, side, side)
        _insert(
            image, depth_m, world_from_camera, geometry.inverse(world_from_camera), rig.focal_px, rig.cx_px, rig.cy_px,
            col * self.cell_m, row * self.cell_m, self.cell_m, number, cells[0], cells[1], cells[2],
        )  # fmt: skip
        self.cells.write(row, col, cells)

    def register(
        self, image: matching.Image, depth_m: Map, world_from_camera: Array, half_window_m: float, rig: StereoRig
    ) -> Registration | None:
        """Registers a frame with the mosaic; None if too few textured cells are visible at a known depth and agree.

        The normalised `image` (H, W) has the `depth_m` of its own stereo pair, NaN where unknown, and the predicted
        pose `world_from_camera` (4, 4). The cells are those of a square below the camera, of half side `half_window_m`
        [m]. Raises OSError if a tile could not be read or written.
        """
        cells = self._textured_cells(world_from_camera[:3, 3], half_window_m)
        if cells is None:
            return None
        points, brightness, keyframe = cells
        frame = image.astype(np.float32)
        camera, current = (rig.focal_px, rig.cx_px, rig.cy_px), world_from_camera
        normal, scatter, sigma, n_used, used = np.eye(6), np.eye(6), 0.0, 0, np.zeros(0, np.bool_)
        for _ in range(_ITERATIONS):
            camera_from_world = geometry.inverse(current)
            *linearised, used = _linearise(points, brightness, frame, depth_m, camera_from_world, camera, _MAX_RESIDUAL)
            n_used = int(np.count_nonzero(used))
            if n_used < _MIN_CELLS:
                return None
            normal, right, scatter, sigma = _normal_equations(*linearised)
            step = np.asarray(np.linalg.solve(normal, right), np.float64)
            current = current @ geometry.exp(step)
            if np.abs(step).max() < 1e-6:
                break
        inverse = np.linalg.inv(normal)
        cov = np.asarray(inverse @ scatter @ inverse.T, np.float64)
        correction = geometry.inverse(world_from_camera) @ current
        median = np.partition(keyframe[used], n_used // 2)[n_used // 2]  # unlike np.median, an existing number
        return Registration(two_view_motion.Motion(correction, cov, n_used, sigma), int(median))

    def _window(self, centre: Array, half_m: float) -> tuple[int, int, int]:
        """Returns first row, first column and side [cells] of the square of half side `half_m` [m] around `centre`."""
        half = int(np.ceil(half_m / self.cell_m))
        return int(centre[1] / self.cell_m) - half, int(centre[0] / self.cell_m) - half, 2 * half

    def _textured_cells(self, centre: Array, half_m: float) -> tuple[Array, Map, Map] | None:
        """Returns positions (n, 3) [m], brightness and keyframe (n,) of textured cells in a square; None if too few."""
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


def _gradient(bright: Map, height: Map) -> Map:
    """Returns the magnitude (rows, cols) of the brightness gradient [grey levels per cell]; 0 where it is not known."""
    strength = np.zeros_like(bright)
    across, along = bright[1:-1, 2:] - bright[1:-1, :-2], bright[2:, 1:-1] - bright[:-2, 1:-1]
    known = height[1:-1, 2:] + height[1:-1, :-2] + height[2:, 1:-1] + height[:-2, 1:-1] + height[1:-1, 1:-1]
    strength[1:-1, 1:-1] = np.where(np.isfinite(known), np.hypot(across, along) / 2, 0)
    return strength


@kernel
def _insert(image, depth, pose, inverse, focal, cx, cy, west, south, cell, keyframe, brightness, height, number):
    """Fills the empty cells of a window from one keyframe, in place, given its south-west corner and cell size [m]."""
    # mean height of the pixels, and brightness at the projection of the centre: that of the pixels, which are not at
    # the centre, would bias registered positions by 5 mm
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
            height[row, col], number[row, col] = z, keyframe
            brightness[row, col] = bilinear(image, i, j, v - i, u - j)


@kernel
def _linearise(points, brightness, frame, depth, camera_from_world, camera, max_residual):
    """Linearises the brightness residuals (cell minus frame) of the n cells visible in the frame at a known depth."""
    # Jacobians (m, 6) with respect to an increment [rotation, translation] of the pose in camera axes, with the depth
    # from the mosaic and from the frame; residuals (m,) and their image blocks; mask (n,) of the m cells used
    focal, cx, cy = camera
    n, m, (high, wide) = len(points), 0, _BLOCKS
    jacobian, frame_jacobian, residuals, block = np.empty((n, 6)), np.empty((n, 6)), np.empty(n), np.empty(n, np.int64)
    used = np.zeros(n, np.bool_)
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
        residual = brightness[k] - bilinear(frame, i, j, a, b)
        frame_depth = depth[int(v + 0.5), int(u + 0.5)]
        if abs(residual) > max_residual or not frame_depth > 0:
            continue
        grad_u = focal * (bilinear(frame, i, j + 1, a, b) - bilinear(frame, i, j - 1, a, b)) / 2
        grad_v = focal * (bilinear(frame, i + 1, j, a, b) - bilinear(frame, i - 1, j, a, b)) / 2
        jacobian[m, 0] = grad_u * x * y + grad_v * (1 + y * y)
        jacobian[m, 1] = -grad_u * (1 + x * x) - grad_v * x * y
        jacobian[m, 2] = grad_u * y - grad_v * x
        jacobian[m, 3] = -grad_u / p[2]
        jacobian[m, 4] = -grad_v / p[2]
        jacobian[m, 5] = (grad_u * x + grad_v * y) / p[2]
        for c in range(3):
            frame_jacobian[m, c], frame_jacobian[m, 3 + c] = jacobian[m, c], jacobian[m, 3 + c] * p[2] / frame_depth
        residuals[m], used[k] = residual, True
        block[m] = i * high // frame.shape[0] * wide + j * wide // frame.shape[1]
        m += 1
    return jacobian[:m], frame_jacobian[:m], residuals[:m], block[:m], used


@kernel
def _normal_equations(jacobian, frame_jacobian, residuals, block):
    """Returns normal matrix, right-hand side, its covariance from the scatter over image blocks, and robust sigma."""
    # Huber weights; the Jacobian with the frame's depth gives instrumental variables, free of the mosaic's depth errors
    normal, right, scatter = np.zeros((6, 6)), np.zeros(6), np.zeros((6, 6))
    if len(jacobian) < 6:
        return normal, right, scatter, 0.0
    n_blocks = _BLOCKS[0] * _BLOCKS[1]
    sums, filled = np.zeros((n_blocks, 6)), np.zeros(n_blocks, np.bool_)
    sigma = 1.4826 * np.median(np.abs(residuals)) + 1e-3
    for k in range(len(jacobian)):
        size = abs(residuals[k]) / sigma
        weight = 1.0 if size < 1.5 else 1.5 / size
        filled[block[k]] = True
        for i in range(6):
            sums[block[k], i] += weight * frame_jacobian[k, i] * residuals[k]
            for j in range(6):
                normal[i, j] += weight * frame_jacobian[k, i] * jacobian[k, j]
    n_filled = filled.sum()
    for block_sum in sums:
        right += block_sum
        scatter += np.outer(block_sum, block_sum) * (n_filled / max(n_filled - 6, 1))
    return normal, right, scatter, sigma
