"""Shadows that the floor throws in the light of lamps, which do not stand where the eye is.

A point of the floor is in the shadow where the straight way to the lamp passes below the floor. The floor is the very
surface that is drawn: triangles over a grid of heights. Along the way a triangle is highest where the way crosses its
edges, so that only crossings are looked at, and of those only where a block of cells reaches up to the way: a way that
starts on the floor and rises more steeply than any triangle so far is still above it.
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

BLOCK_CELLS = 8  # whose highest point is kept
STRIDE_PX = 4  # between pixels that are looked at first; between four that agree, none is
BIAS_M = 1e-4  # by how much the floor must stand above the way: depth is single precision


class Heights(Protocol):
    """A floor as the terrain's grid of heights has it; row 0 = south, column 0 = west."""

    @property
    def height_m(self) -> NDArray[np.float32]: ...
    @property
    def spacing_m(self) -> float: ...
    @property
    def west_m(self) -> float: ...
    @property
    def south_m(self) -> float: ...


class _Grid(NamedTuple):
    """Heights of nodes (ny, nx); highest node and steepest slope [m a cell] of each block; place and spacing."""

    height_m: NDArray[np.float32]
    block_top_m: NDArray[np.float32]
    block_rise_m: NDArray[np.float32]
    west_m: float
    south_m: float
    spacing_m: float


class Shadows:
    """Which pixels each lamp lights: those whose floor it can see.

    Args:
        lamp_positions_m: for each eye, (lamps, 3) in its axes.
    """

    def __init__(self, floor: Heights, rig: StereoRig, lamp_positions_m: list[Array]):
        height = np.ascontiguousarray(floor.height_m, np.float32)
        self._grid = _Grid(height, *_blocks(height), floor.west_m, floor.south_m, floor.spacing_m)
        self._rig, self._lamps = rig, lamp_positions_m

    def lit(self, depth: Depth, world_from_eye: Array, eye: int) -> Lit:
        """(lamps, H, W) uint8: 0 where the floor stands between lamp and pixel, 1 elsewhere and where no floor is."""
        lamps = geometry.transform(world_from_eye, self._lamps[eye])
        rows, cols = (-(-n // STRIDE_PX) for n in depth.shape)
        lattice = np.empty((len(lamps), rows + 1, cols + 1), np.uint8)
        out = np.empty((len(lamps), *depth.shape), np.uint8)
        floor, west, south, spacing = self._grid[:3], *self._grid[3:]
        pose = np.ascontiguousarray(world_from_eye)
        scene = *floor, west, south, spacing, depth, self._rig.focal_px, pose, lamps, lattice
        in_row_bands(lambda first, end: _look_at_lattice(*scene, first, end), rows + 1)
        in_row_bands(lambda first, end: _look_between(*scene, out, first, end), rows)
        return out


def _blocks(height: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """The highest node [m] and the steepest slope of a triangle [m a cell] of every block, its borders included."""
    along_x, along_y = np.diff(height, axis=1), np.diff(height, axis=0)
    south_east = np.hypot(along_x[:-1], along_y[:, 1:])
    north_west = np.hypot(along_x[1:], along_y[:, :-1])
    return _highest(height, 1), _highest(np.maximum(south_east, north_west), 0)


def _highest(values: NDArray[np.float32], border: int) -> NDArray[np.float32]:
    """Largest value of every block of cells and the nodes on its far border."""
    starts = [np.arange(0, n - border, BLOCK_CELLS) for n in values.shape]
    inner = np.maximum.reduceat(np.maximum.reduceat(values, starts[0], axis=0), starts[1], axis=1)
    if not border:
        return inner
    rows, cols = (np.minimum(s + BLOCK_CELLS, n - 1) for s, n in zip(starts, values.shape, strict=True))
    north = np.maximum.reduceat(values[rows], starts[1], axis=1)
    east = np.maximum.reduceat(values[:, cols], starts[0], axis=0)
    return np.maximum.reduce([inner, north, east, values[np.ix_(rows, cols)]])


@njit(cache=True, nogil=True, error_model="numpy")
def _look_at_lattice(height, tops, rises, west, south, spacing, depth, focal, pose, lamps, lattice, first, end):
    """Fills rows of `lattice` (lamps, rows, cols) with what every fourth pixel, and the last, sees of each lamp."""
    for k in range(lamps.shape[0]):
        place = (lamps[k, 0] - west) / spacing, (lamps[k, 1] - south) / spacing, lamps[k, 2]
        for i in range(first, end):
            v = min(i * STRIDE_PX, depth.shape[0] - 1)
            for j in range(lattice.shape[2]):
                u = min(j * STRIDE_PX, depth.shape[1] - 1)
                lattice[k, i, j] = _sees(height, tops, rises, west, south, spacing, depth, focal, pose, place, v, u)


@njit(cache=True, nogil=True, error_model="numpy")
def _look_between(height, tops, rises, west, south, spacing, depth, focal, pose, lamps, lattice, out, first, end):
    """Fills `out` (lamps, H, W) between rows of the lattice: where four that enclose a pixel agree, with that."""
    for k in range(lamps.shape[0]):
        place = (lamps[k, 0] - west) / spacing, (lamps[k, 1] - south) / spacing, lamps[k, 2]
        for i in range(first, end):
            low, high = i * STRIDE_PX, min((i + 1) * STRIDE_PX, depth.shape[0])
            out[k, low:high] = lattice[k, i, 0]
            for j in range(lattice.shape[2] - 1):
                known = lattice[k, i, j]
                seen = known + lattice[k, i, j + 1] + lattice[k, i + 1, j] + lattice[k, i + 1, j + 1]
                agree = seen == 0 or seen == 4
                if agree and known == lattice[k, i, 0]:
                    continue
                for v in range(low, high):
                    for u in range(j * STRIDE_PX, min((j + 1) * STRIDE_PX, depth.shape[1])):
                        if agree:
                            out[k, v, u] = known
                        else:
                            out[k, v, u] = _sees(
                                height, tops, rises, west, south, spacing, depth, focal, pose, place, v, u
                            )


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _sees(height, tops, rises, west, south, spacing, depth, focal, pose, lamp, v, u):
    """Whether a lamp at (column, row, height) sees the floor of a pixel."""
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
    return np.uint8(0 if _blocked(height, tops, rises, col, row, up, lamp[0] - col, lamp[1] - row, lamp[2] - up) else 1)


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _lines(at, along, cell, size):
    """Of a way at + t along, in a cell of a lattice of lines `size` apart.

    Returns:
        Step of its cells; t where it meets the next line, and from line to line.
    """
    if along == 0:
        return 0, np.inf, np.inf
    per_along = 1 / along
    step = 1 if along > 0 else -1
    return step, ((cell + (along > 0)) * size - at) * per_along, step * size * per_along


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _blocked(height, tops, rises, x, y, z, dx, dy, dz):
    """Whether the floor stands above the way from (x, y, z) to (x + dx, y + dy, z + dz); x, y in cells, z [m]."""
    rows, cols = tops.shape
    r = min(max(int(np.floor(y / BLOCK_CELLS)), 0), rows - 1)
    c = min(max(int(np.floor(x / BLOCK_CELLS)), 0), cols - 1)
    size = float(BLOCK_CELLS)
    step_c, at_c, per_c = _lines(x, dx, c, size)
    step_r, at_r, per_r = _lines(y, dy, r, size)
    t, clear = 0.0, dz > 0
    while t < 1 and 0 <= r < rows and 0 <= c < cols:
        leave = min(at_c, at_r, 1.0)
        clear = clear and rises[r, c] ** 2 * (dx * dx + dy * dy) < dz * dz
        if not clear and tops[r, c] > z + min(dz * t, dz * leave) + BIAS_M:
            if _blocked_in(height, x, y, z, dx, dy, dz, t, leave, r, c):
                return True
        t = leave
        if at_c < at_r:
            c, at_c = c + step_c, at_c + per_c
        else:
            r, at_r = r + step_r, at_r + per_r
    return False


@njit(cache=True, nogil=True, error_model="numpy")
def _blocked_in(height, x, y, z, dx, dy, dz, t, end, block_r, block_c):
    """The same for the part of the way from t to `end`, which lies in one block."""
    first_r, first_c = block_r * BLOCK_CELLS, block_c * BLOCK_CELLS
    last_r = min(first_r + BLOCK_CELLS, height.shape[0] - 1) - 1
    last_c = min(first_c + BLOCK_CELLS, height.shape[1] - 1) - 1
    r = min(max(int(np.floor(y + dy * t)), first_r), last_r)
    c = min(max(int(np.floor(x + dx * t)), first_c), last_c)
    step_c, at_c, per_c = _lines(x, dx, c, 1.0)
    step_r, at_r, per_r = _lines(y, dy, r, 1.0)
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
