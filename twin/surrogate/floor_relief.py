"""Relief of the floor within the windows of dense matching, on the grid of a map: slope, roughness and edges."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, uniform_filter

from twin.core.geometry import Array
from twin.core.height_field import map_slopes
from twin.core.records import StereoRig

Map = NDArray[np.float32]
WINDOW_PX = 11  #: side of the window of dense matching in which relief causes errors
WALL_SLOPE = 1.0  #: rise over run of the least steep wall
_LEAST_SLOPE = 0.1  # slope below which errors near walls do not decrease


class FloorRelief(NamedTuple):
    """Relief of a floor, seen by a camera at a typical depth."""

    slope: Map  #: (rows, cols, 2) slope in x and in y [m/m]
    roughness_m: Map  #: (rows, cols) RMS deviation of the floor from its best-fit plane within the matching window [m]
    #: (rows, cols) strength of the edges, converted from px of disparity to metres [m px^(-1/2)]; see `edge_strength`
    edge_m: Map
    window_cells: float  #: side of the matching window [cells]


def floor_relief(height_m: Map, cell_m: float, rig: StereoRig, depth_m: float) -> FloorRelief:
    """Returns the relief of a floor of heights (rows, cols); in images, NaN is as low as the lowest height."""
    # `rig`: calibration of the images that are matched; `depth_m`: a typical depth along the optical axis
    slope = np.stack(map_slopes(np.asarray(height_m, np.float64), cell_m), axis=-1).astype(np.float32)
    filled = np.where(np.isfinite(height_m), height_m, np.nanmin(height_m)).astype(np.float64)
    window_cells = WINDOW_PX * depth_m / rig.focal_px / cell_m
    per_m = np.float32(rig.focal_px * rig.baseline_m / depth_m**2)
    roughness_m = roughness(filled, window_cells)
    edge_m = edge_strength(roughness_m * per_m, step_slope(filled, cell_m), window_cells) / per_m
    return FloorRelief(slope, roughness_m, edge_m, window_cells)


def roughness(height_m: Array, window_cells: float) -> Map:
    """Returns the RMS deviation (rows, cols) [m] of the floor from the plane that best fits a square window."""
    side, height = _odd(window_cells), height_m - height_m.mean()

    def mean(values: Array) -> Array:
        return uniform_filter(values, side, mode="nearest")

    level = mean(height)
    variance = mean(height**2) - level**2
    for coordinate in np.indices(height.shape, dtype=np.float64):
        covariance = mean(height * coordinate) - level * mean(coordinate)
        variance -= covariance**2 / ((side**2 - 1) / 12)
    return np.sqrt(np.maximum(variance, 0.0)).astype(np.float32)


def step_slope(height_m: Array, cell_m: float) -> Map:
    """Returns the slope (rows, cols) [m/m] of the largest step to a neighbour; a central difference would halve it."""
    down = np.pad(np.abs(np.diff(height_m, axis=0)), ((1, 1), (0, 0)))
    across = np.pad(np.abs(np.diff(height_m, axis=1)), ((0, 0), (1, 1)))
    steps = np.maximum(down[:-1], down[1:]), np.maximum(across[:, :-1], across[:, 1:])
    return (np.hypot(*steps) / cell_m).astype(np.float32)


def edge_strength(roughness_px: Map, slope: Map, window_cells: float) -> Map:
    """Returns the strength of the edges (rows, cols) [px^(1/2)], which determines the errors near walls.

    It is the square root of r s, and 0 where the matching window of the cell shows no wall, a cell steeper than
    `WALL_SLOPE`. The `slope` s of the cell (`step_slope`), at least `_LEAST_SLOPE`, counts because a lateral
    displacement of the matched edge causes a height error on the face of the wall, and hardly any on the level floor
    next to the wall. r is the geometric mean of `roughness_px` [px of disparity] of the cell and the largest of the
    windows that contain it: the error is large if the window of the cell shows two surfaces, or if the cell is matched
    as its neighbours are. The square root is taken because dense matching resolves large structures better.
    """
    side = _odd(window_cells)
    near_wall = maximum_filter(slope, side) > WALL_SLOPE
    mean_px = np.sqrt(roughness_px * np.asarray(maximum_filter(roughness_px, side), np.float32))
    return np.where(near_wall, np.sqrt(mean_px * np.maximum(slope, _LEAST_SLOPE)), 0).astype(np.float32)


def _odd(window_cells: float) -> int:
    """Returns the side of a window, rounded to an odd number of cells, at least 3."""
    return 2 * max(round((window_cells - 1) / 2), 1) + 1
