"""True heights at the cells of a map whose frame is not that of the truth, such as that of a replay."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from twin.core import geometry
from twin.core.records import Array, ElevationMap, MapGrid, Trajectory, Truth
from twin.judge.map_error import KEYS, map_metrics

_MOST_STEPS = 20
_CONVERGED_M = 1e-5
_LEAST_COSINE = 0.7  # of the angle between the axes of height; a map of a wall is not compared with a height grid
_ROWS_PER_CALL = 256
#: Metrics of the map that need to know which cells the cameras saw, which area was asked for or where objects are.
_UNKNOWN = [key for key in KEYS if key.startswith(("completeness", "le90_area", "floor_", "objects_"))]


class TrueMap(NamedTuple):
    """True heights in the frame of the true trajectory."""

    grid: MapGrid  #: cells of the heights
    height_m: Array  #: (rows, cols) heights at the centres of the cells; NaN where unknown


def true_heights(elevation: ElevationMap, true: TrueMap, true_from_world: Array) -> NDArray[np.float32] | None:
    """Returns the true height at the centres of the cells of a map (rows, cols) [m], NaN where unknown.

    The heights are along the axis of height of the map; None if those of map and truth are not within 45 degrees. The
    height h of a cell at (x, y) is found by iteration, from the height of the map: the point (x, y, h), moved to the
    frame of the truth, is compared with the true height there, interpolated bilinearly, and h is reduced by the
    difference. In a frame that is level, one step is exact; with a tilt t it converges where the slope is below
    1 / tan t.

    Args:
        elevation: the map.
        true: true heights.
        true_from_world: (4, 4) transform from the world of the estimates to the frame of the truth (`recorded`).
    """
    true_from_map = true_from_world @ geometry.inverse(elevation.map_from_world)
    cosine = float(true_from_map[2, 2])
    if cosine < _LEAST_COSINE:
        return None
    x, y = elevation.grid.centres()
    height = np.empty(elevation.height_m.shape, np.float32)
    known = elevation.height_m[np.isfinite(elevation.height_m)]
    middle = float(np.median(known)) if len(known) else 0.0
    for row in range(0, len(y), _ROWS_PER_CALL):
        part = slice(row, row + _ROWS_PER_CALL)
        level = np.where(np.isfinite(elevation.height_m[part]), elevation.height_m[part], middle).astype(np.float64)
        points = np.stack([*np.meshgrid(x, y[part]), level], axis=-1).reshape(-1, 3)
        for _ in range(_MOST_STEPS):
            moved = geometry.transform(true_from_map, points)
            step = (moved[:, 2] - _height_at(true, moved[:, 0], moved[:, 1])) / cosine
            points[:, 2] -= step
            if not np.nanmax(np.abs(step), initial=0.0) > _CONVERGED_M:
                break
        height[part] = points[:, 2].reshape(level.shape)
    return height


def _height_at(true: TrueMap, x: Array, y: Array) -> Array:
    """Returns true heights (n,) at positions, interpolated bilinearly; NaN outside and beside unknown cells."""
    grid = true.grid
    rows, cols = (grid.north_m - y) / grid.cell_m - 0.5, (x - grid.west_m) / grid.cell_m - 0.5
    return map_coordinates(true.height_m, [rows, cols], order=1, mode="constant", cval=np.nan)


def recorded_map_metrics(elevation: ElevationMap, heights: NDArray[np.float32]) -> dict[str, float | None]:
    """Returns `map.*` of metrics.json for a map and its true heights (rows, cols) (`true_heights`).

    Errors are those of all cells that have an estimated and a true height. The metrics that need more than heights,
    completeness among them, are None: which cells the cameras saw is not known.
    """
    cells = np.isfinite(heights)
    return map_metrics(elevation, truth_without_flight(heights, cells, np.zeros_like(cells))) | dict.fromkeys(_UNKNOWN)


def truth_without_flight(height_m: NDArray[np.float32], seen: NDArray[np.bool_], asked: NDArray[np.bool_]) -> Truth:
    """Returns a truth of the floor (rows, cols) without frames."""
    none = Trajectory(np.zeros(0), np.zeros((0, 4, 4)))
    return Truth(none, np.zeros((0, 3)), np.zeros(0, bool), np.zeros(0, np.int64), height_m, seen, asked)
