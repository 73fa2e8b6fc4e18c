"""Heights that their camera cannot have seen: usually mismatches, which are too far away and form islands."""

import numpy as np
from numpy.typing import NDArray

from twin.core.geometry import Array
from twin.core.records import Map, MapGrid, Mask
from twin.estimate.mapping.depth_filter import GATE
from twin.kernels import kernel

LARGEST_ISLAND = 400  #: connected cells of agreeing heights that are an island; larger groups are the surface
#: A line of sight is blocked where it passes this many standard deviations below the surface, in a cell whose eight
#: neighbours are known and as high.
_SIGMAS = 3.0


def main_surface(height: Map, variance: Map) -> Mask:
    """Returns a mask of the known cells in groups of more than `LARGEST_ISLAND` cells of agreeing heights."""
    # neighbours of heights h and k and variances P and Q are connected if (h - k)^2 < GATE (P + Q)
    return _large_groups(height, variance, GATE, LARGEST_ISLAND)


def hidden(height: Map, camera: NDArray[np.int32], cameras_m: Array, surface: tuple[Map, Map], grid: MapGrid) -> Mask:
    """Returns a mask (rows, cols) of the heights [m], NaN where there is none, that their camera cannot have seen.

    The line of sight from a height to its camera, the row of `cameras_m` (n, 3) [m] in `camera` (rows, cols), negative
    if unknown, is followed in steps of one cell. It is blocked where it passes below the lowest height of the `surface`
    in the 3 x 3 cells around it by more than three standard deviations; `surface` is heights (rows, cols) [m] and their
    variance [m2].
    """
    low, variance = surface
    if not len(cameras_m):
        return np.zeros(height.shape, np.bool_)
    corner, highest = (grid.west_m, grid.north_m, grid.cell_m), float(np.fmax.reduce(low, axis=None, initial=-np.inf))
    return _blocked(height, camera, cameras_m, _lowest(low), variance, highest, corner)


def _lowest(height: Map) -> Map:
    """Returns the lowest height (rows, cols) in the 3 x 3 cells around each cell; NaN unless all of them are known."""
    padded = np.pad(height, 1, constant_values=np.nan)
    rows, cols = height.shape
    low = padded[1 : rows + 1, 1 : cols + 1].copy()
    for i in range(3):
        for j in range(3):
            np.minimum(low, padded[i : i + rows, j : j + cols], out=low)  # NaN if either is
    return low


@kernel
def _large_groups(height, variance, gate, largest):
    """Compiled kernel of `main_surface`: groups are filled until they exceed `largest` cells or meet a large one."""
    rows, cols = height.shape
    state = np.zeros((rows, cols), np.int8)  # 0: not visited, 1: in a large group, 2: in a small one, 3: in this group
    group = np.empty((largest, 2), np.int64)
    for row in range(rows):
        for col in range(cols):
            if state[row, col] != 0 or np.isnan(height[row, col]):
                continue
            group[0, 0], group[0, 1], state[row, col] = row, col, 3
            size, done, large = 1, 0, False
            while done < size and not large:
                r, c = group[done]
                done += 1
                for i in range(max(r - 1, 0), min(r + 2, rows)):
                    for j in range(max(c - 1, 0), min(c + 2, cols)):
                        other = height[i, j] - height[r, c]
                        if state[i, j] == 3 or not other * other < gate * (variance[i, j] + variance[r, c]):
                            continue
                        large = large or state[i, j] == 1 or size >= largest
                        if state[i, j] == 0 and not large:
                            group[size, 0], group[size, 1], state[i, j] = i, j, 3
                            size += 1
            for k in range(size):
                state[group[k, 0], group[k, 1]] = 1 if large else 2
    return state == 1


@kernel
def _blocked(height, camera, cameras_m, low, variance, highest, corner):
    """Compiled kernel of `hidden`, with `low` from `_lowest`; a line of sight is free above `highest`."""
    rows, cols = height.shape
    blocked = np.zeros((rows, cols), np.bool_)
    for row in range(rows):
        for col in range(cols):
            k = camera[row, col]
            if k < 0 or np.isnan(height[row, col]):
                continue
            z = height[row, col]
            along_col = (cameras_m[k, 0] - corner[0]) / corner[2] - 0.5 - col
            along_row = (corner[1] - cameras_m[k, 1]) / corner[2] - 0.5 - row
            distance = np.hypot(along_col, along_row)
            for step in range(1, int(distance)):
                share = step / distance
                ray = z + (cameras_m[k, 2] - z) * share
                r, c = int(np.rint(row + along_row * share)), int(np.rint(col + along_col * share))
                if ray > highest or not (0 <= r < rows and 0 <= c < cols):
                    break
                if ray < low[r, c] - _SIGMAS * np.sqrt(variance[r, c]):  # False where unknown
                    blocked[row, col] = True
                    break
    return blocked
