"""Shadows cast by the floor in the light of the lamps; the cameras see them, as lamps and cameras are apart.

A point of the floor is in the shadow of a lamp if the straight ray to the lamp passes below the floor. The floor is the
rendered surface: triangles over a grid of heights. Along a ray, a triangle is highest where the ray crosses one of its
edges, so only edge crossings are tested, and only in blocks of cells that are high enough to reach the ray. A ray that
starts on the floor and rises more steeply than all triangles passed so far is still above the floor.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np
from numba import njit
from numpy.typing import NDArray

from twin.core import geometry
from twin.core.records import StereoRig
from twin.imaging.optics import Depth, Lit
from twin.imaging.row_parallel import in_row_bands

Array = NDArray[np.float64]

BLOCK_CELLS = 8  # side of a block of cells; the highest point and the steepest slope of each block are stored
STRIDE_PX = 4  # spacing of the lattice of pixels tested first; pixels between four equal results take that result
BIAS_M = 1e-4  # the floor must be this much higher than a ray to occlude it, as depth is in single precision


class Heights(Protocol):
    """Grid of floor heights; row 0 = south, column 0 = west."""

    @property
    def height_m(self) -> NDArray[np.float32]: ...
    @property
    def spacing_m(self) -> float: ...
    @property
    def west_m(self) -> float: ...
    @property
    def south_m(self) -> float: ...


class _Grid(NamedTuple):
    """Floor heights prepared for ray casting.

    Args:
        height_m: (ny, nx) heights of the grid nodes; row 0 = south, column 0 = west.
        block_top_m: (rows, cols) height of the highest node of each block of cells.
        block_rise_m: (rows, cols) steepest slope of the triangles of each block [m per cell].
        west_m, south_m: position of the first node.
        spacing_m: distance between neighbouring nodes.
    """

    height_m: NDArray[np.float32]
    block_top_m: NDArray[np.float32]
    block_rise_m: NDArray[np.float32]
    west_m: float
    south_m: float
    spacing_m: float


class Shadows:
    """Shadow casting: determines which pixels each lamp illuminates.

    Args:
        floor: heights of the floor.
        rig: the rendered cameras.
        lamp_positions_m: for each camera (0 left, 1 right), positions (lamps, 3) in its axes.
    """

    def __init__(self, floor: Heights, rig: StereoRig, lamp_positions_m: list[Array]):
        height = np.ascontiguousarray(floor.height_m, np.float32)
        self._grid = _Grid(height, *_blocks(height), floor.west_m, floor.south_m, floor.spacing_m)
        self._rig, self._lamps = rig, lamp_positions_m

    def lit(self, depth: Depth, world_from_camera: Array, camera: int) -> Lit:
        """Returns a mask (lamps, H, W) uint8: 0 where the floor occludes the lamp, else 1 (also without floor).

        Args:
            depth: (H, W) depth along the optical axis [m].
            world_from_camera: (4, 4) pose of this camera.
            camera: 0 left, 1 right.
        """
        lamps = geometry.transform(world_from_camera, self._lamps[camera])
        rows, cols = (-(-n // STRIDE_PX) for n in depth.shape)
        lattice = np.empty((len(lamps), rows + 1, cols + 1), np.uint8)
        out = np.empty((len(lamps), *depth.shape), np.uint8)
        floor, west, south, spacing = self._grid[:3], *self._grid[3:]
        pose = np.ascontiguousarray(world_from_camera)
        scene = *floor, west, south, spacing, depth, self._rig.focal_px, pose, lamps, lattice
        in_row_bands(lambda first, end: _test_lattice(*scene, first, end), rows + 1)
        in_row_bands(lambda first, end: _fill_between(*scene, out, first, end), rows)
        return out


def _blocks(height: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Returns the largest height [m] and the steepest triangle slope [m per cell] of each block of cells."""
    along_x, along_y = np.diff(height, axis=1), np.diff(height, axis=0)
    south_east = np.hypot(along_x[:-1], along_y[:, 1:])
    north_west = np.hypot(along_x[1:], along_y[:, :-1])
    return _highest(height, 1), _highest(np.maximum(south_east, north_west), 0)


def _highest(values: NDArray[np.float32], border: int) -> NDArray[np.float32]:
    """Returns the maximum of each block; with `border` 1, nodes on its north and east borders count too."""
    starts = [np.arange(0, n - border, BLOCK_CELLS) for n in values.shape]
    inner = np.maximum.reduceat(np.maximum.reduceat(values, starts[0], axis=0), starts[1], axis=1)
    if not border:
        return inner
    rows, cols = (np.minimum(s + BLOCK_CELLS, n - 1) for s, n in zip(starts, values.shape, strict=True))
    north = np.maximum.reduceat(values[rows], starts[1], axis=1)
    east = np.maximum.reduceat(values[:, cols], starts[0], axis=0)
    return np.maximum.reduce([inner, north, east, values[np.ix_(rows, cols)]])


@njit(cache=True, nogil=True, error_model="numpy")
def _test_lattice(height, tops, rises, west, south, spacing, depth, focal, pose, lamps, lattice, first, end):
    """Fills rows `first` to `end` of `lattice` (lamps, rows, cols) with 1 = lit or 0, for pixels `STRIDE_PX` apart."""
    for k in range(lamps.shape[0]):
        lamp = (lamps[k, 0] - west) / spacing, (lamps[k, 1] - south) / spacing, lamps[k, 2]
        for i in range(first, end):
            v = min(i * STRIDE_PX, depth.shape[0] - 1)
            for j in range(lattice.shape[2]):
                u = min(j * STRIDE_PX, depth.shape[1] - 1)
                lattice[k, i, j] = _is_lit(height, tops, rises, west, south, spacing, depth, focal, pose, lamp, v, u)


@njit(cache=True, nogil=True, error_model="numpy")
def _fill_between(height, tops, rises, west, south, spacing, depth, focal, pose, lamps, lattice, out, first, end):
    """Fills `out` (lamps, H, W) from the lattice; tests only pixels between lattice points that differ."""
    for k in range(lamps.shape[0]):
        lamp = (lamps[k, 0] - west) / spacing, (lamps[k, 1] - south) / spacing, lamps[k, 2]
        for i in range(first, end):
            low, high = i * STRIDE_PX, min((i + 1) * STRIDE_PX, depth.shape[0])
            out[k, low:high] = lattice[k, i, 0]
            for j in range(lattice.shape[2] - 1):
                known = lattice[k, i, j]
                n_lit = known + lattice[k, i, j + 1] + lattice[k, i + 1, j] + lattice[k, i + 1, j + 1]
                agree = n_lit == 0 or n_lit == 4
                if agree and known == lattice[k, i, 0]:
                    continue
                for v in range(low, high):
                    for u in range(j * STRIDE_PX, min((j + 1) * STRIDE_PX, depth.shape[1])):
                        if agree:
                            out[k, v, u] = known
                        else:
                            out[k, v, u] = _is_lit(
                                height, tops, rises, west, south, spacing, depth, focal, pose, lamp, v, u
                            )


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _is_lit(height, tops, rises, west, south, spacing, depth, focal, pose, lamp, v, u):
    """Returns 0 if the floor occludes `lamp` (column, row, height) as seen from the point in pixel (v, u), else 1."""
    z = np.float64(depth[v, u])
    if not np.isfinite(z):
        return np.uint8(1)
    x = (u - 0.5 * (depth.shape[1] - 1)) * (z / focal)
    y = (v - 0.5 * (depth.shape[0] - 1)) * (z / focal)
    east = pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z + pose[0, 3]
    north = pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z + pose[1, 3]
    up = pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z + pose[2, 3]
    per_m = 1 / spacing
    col, row = (east - west) * per_m, (north - south) * per_m
    to_col, to_row, to_up = lamp[0] - col, lamp[1] - row, lamp[2] - up
    return np.uint8(0 if _occluded(height, tops, rises, col, row, up, to_col, to_row, to_up) else 1)


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _grid_steps(at, along, cell, size):
    """Prepares the grid traversal of a ray `at + t * along` in one dimension, for grid lines `size` apart.

    Returns:
        Step of the cell index (-1, 0 or 1), t at the next grid line, and increment of t from line to line.
    """
    if along == 0:
        return 0, np.inf, np.inf
    per_along = 1 / along
    step = 1 if along > 0 else -1
    return step, ((cell + (along > 0)) * size - at) * per_along, step * size * per_along


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _occluded(height, tops, rises, x, y, z, dx, dy, dz):
    """Returns whether the floor is above the ray from (x, y, z) to (x + dx, y + dy, z + dz); x, y in cells, z [m]."""
    rows, cols = tops.shape
    r = min(max(int(np.floor(y / BLOCK_CELLS)), 0), rows - 1)
    c = min(max(int(np.floor(x / BLOCK_CELLS)), 0), cols - 1)
    size = float(BLOCK_CELLS)
    step_c, at_c, per_c = _grid_steps(x, dx, c, size)
    step_r, at_r, per_r = _grid_steps(y, dy, r, size)
    t, clear = 0.0, dz > 0
    while t < 1 and 0 <= r < rows and 0 <= c < cols:
        leave = min(at_c, at_r, 1.0)
        clear = clear and rises[r, c] ** 2 * (dx * dx + dy * dy) < dz * dz
        if not clear and tops[r, c] > z + min(dz * t, dz * leave) + BIAS_M:
            if _occluded_in_block(height, x, y, z, dx, dy, dz, t, leave, r, c):
                return True
        t = leave
        if at_c < at_r:
            c, at_c = c + step_c, at_c + per_c
        else:
            r, at_r = r + step_r, at_r + per_r
    return False


@njit(cache=True, nogil=True, error_model="numpy")
def _occluded_in_block(height, x, y, z, dx, dy, dz, t, end, block_r, block_c):
    """Same as `_occluded`, for the part of the ray from t to `end`, which lies in one block."""
    first_r, first_c = block_r * BLOCK_CELLS, block_c * BLOCK_CELLS
    last_r = min(first_r + BLOCK_CELLS, height.shape[0] - 1) - 1
    last_c = min(first_c + BLOCK_CELLS, height.shape[1] - 1) - 1
    r = min(max(int(np.floor(y + dy * t)), first_r), last_r)
    c = min(max(int(np.floor(x + dx * t)), first_c), last_c)
    step_c, at_c, per_c = _grid_steps(x, dx, c, 1.0)
    step_r, at_r, per_r = _grid_steps(y, dy, r, 1.0)
    while first_r <= r <= last_r and first_c <= c <= last_c:
        across = dx - dy
        if across != 0.0:  # the cell's diagonal, from south-west to north-east
            s = ((y - r) - (x - c)) / across
            if t < s < min(at_c, at_r, end):
                w = x + dx * s - c
                if height[r, c] + w * (height[r + 1, c + 1] - height[r, c]) > z + dz * s + BIAS_M:
                    return True
        if at_c < at_r:
            t, line = at_c, c + (step_c > 0)
            if t > end + 1e-12:
                return False
            w = y + dy * t - r
            top = height[r, line] + w * (height[r + 1, line] - height[r, line])
            c, at_c = c + step_c, at_c + per_c
        else:
            t, line = at_r, r + (step_r > 0)
            if t > end + 1e-12:
                return False
            w = x + dx * t - c
            top = height[line, c] + w * (height[line, c + 1] - height[line, c])
            r, at_r = r + step_r, at_r + per_r
        if t < 1 and top > z + dz * t + BIAS_M:
            return True
    return False
