"""Image overlap along a swath and between neighbouring swaths, from the true poses and the true floor.

The footprint of a keyframe is a horizontal rectangle at the mean floor height below the camera. For an image of W x H
pixels, the focal length f [px] and the height h of the camera above the mean floor, it is W h / f wide across the
heading and H h / f long along the heading. Camera tilt and relief within the footprint are neglected.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from twin.core import geometry
from twin.core.records import Array, MapGrid, StereoRig, SurveyResult, Truth
from twin.judge.summary_statistics import finite_float, percentile
from twin.judge.swaths import swath_numbers, travel_direction


class Footprints(NamedTuple):
    """Footprints of n keyframes on the floor.

    Args:
        centre_m: (n, 2) position of the camera [m].
        heading, travel: (n, 2) horizontal unit vectors of the vehicle's heading and of the planned motion.
        width_m, length_m: (n,) size of the footprint across and along the heading [m].
        swath: (n,) number of the leg or loop; -1 for keyframes between legs.
    """

    centre_m: Array
    heading: Array
    travel: Array
    width_m: Array
    length_m: Array
    swath: NDArray[np.int64]


def overlap_metrics(
    result: SurveyResult, truth: Truth, rig: StereoRig, grid: MapGrid | None, planned: dict[str, Any]
) -> dict[str, float | None]:
    """Returns `overlap.*` of metrics.json.

    The overlap along a swath (leg or loop) is the area that consecutive keyframes share. The overlap across (sidelap)
    is the area that a keyframe shares with the nearest keyframe of the next swath after their offset along the
    direction of travel is removed. Both are fractions of the footprint area.

    Args:
        grid: cells of `truth.height_m`; None: every footprint is at the mean height of the whole floor.
        planned: pattern, overlap_along and overlap_across of the plan.
    """
    prints = footprints(result.keyframe_rows, truth, rig, grid, planned.get("pattern", "lawnmower"))
    along, across = along_overlap(prints), across_overlap(prints)
    return {
        "along_planned": finite_float(planned.get("overlap_along")),
        "along_median": percentile(along, 50),
        "across_planned": finite_float(planned.get("overlap_across")),
        "across_median": percentile(across, 50),
        "across_p05": percentile(across, 5),
    }


def footprints(
    keyframe_rows: NDArray[np.int64], truth: Truth, rig: StereoRig, grid: MapGrid | None, pattern: str = "lawnmower"
) -> Footprints:
    """Returns the footprints of n keyframes from their true poses; `pattern` (of the plan) defines the swaths."""
    pose = truth.trajectory.world_from_camera[keyframe_rows]
    angle = geometry.heading_of_camera(pose)
    heading = np.column_stack([np.cos(angle), np.sin(angle)])
    mean_height_m = float(np.nanmean(truth.height_m)) if np.isfinite(truth.height_m).any() else np.nan
    depth = np.array([mean_depth(p[:3, 3], truth.height_m, mean_height_m, grid, rig) for p in pose])
    travel, swath = travel_direction(truth.reference)[keyframe_rows], swath_numbers(truth, pattern)[keyframe_rows]
    scale = depth / rig.focal_px
    return Footprints(pose[:, :2, 3], heading, travel, rig.width_px * scale, rig.height_px * scale, swath)


def mean_depth(
    position: Array, height_m: NDArray[np.float32], mean_height_m: float, grid: MapGrid | None, rig: StereoRig
) -> float:
    """Returns the height of a camera above the mean floor height in a square below it [m].

    The side of the square is the mean of the width and the length of the footprint at the height `mean_height_m`.

    Args:
        position: (3,) position of the camera [m].
        height_m: (rows, cols) true heights on `grid`.
        mean_height_m: mean height of the whole floor, used instead if `grid` is None or the square holds no heights.
    """
    if grid is None:
        return float(position[2]) - mean_height_m
    half = (float(position[2]) - mean_height_m) * (rig.width_px + rig.height_px) / (4 * rig.focal_px)
    cells = _window(height_m, grid, position, half)
    return float(position[2]) - (float(np.nanmean(cells)) if np.isfinite(cells).any() else mean_height_m)


def _window(height_m: NDArray[np.float32], grid: MapGrid, position: Array, half_m: float) -> NDArray[np.float32]:
    """Returns the heights in a square with half side `half_m` around a position, clipped to the grid."""
    col, row = (position[0] - grid.west_m) / grid.cell_m, (grid.north_m - position[1]) / grid.cell_m
    half = half_m / grid.cell_m
    rows, cols = (
        slice(max(int(row - half), 0), max(int(row + half) + 1, 0)),
        slice(max(int(col - half), 0), max(int(col + half) + 1, 0)),
    )
    return height_m[rows, cols]


def along_overlap(prints: Footprints) -> Array:
    """Returns the overlap (m,), as a fraction of the area, of consecutive keyframes of the same swath."""
    first = np.flatnonzero((prints.swath[:-1] == prints.swath[1:]) & (prints.swath[1:] >= 0))
    return _shared_area(prints, first, first + 1, prints.centre_m[first + 1] - prints.centre_m[first])


def across_overlap(prints: Footprints) -> Array:
    """Returns the overlap (m,) of each keyframe with the nearest keyframe of the next swath.

    The overlap is a fraction of the area. It is computed from the offset between the two keyframes across the direction
    of travel; the offset along it is ignored. If the vehicle heads along its legs, the overlap is the sidelap.
    """
    pairs = [_nearest_in_next(prints, swath) for swath in range(int(prints.swath.max(initial=-1)))]
    if not pairs:
        return np.zeros(0)
    first, second = np.concatenate(pairs, axis=1)
    port = prints.travel[first][:, ::-1] * [-1, 1]
    sideways = np.einsum("ni,ni->n", prints.centre_m[second] - prints.centre_m[first], port)
    return _shared_area(prints, first, second, sideways[:, None] * port)


def _nearest_in_next(prints: Footprints, swath: int) -> NDArray[np.int64]:
    """Returns pairs (2, m) of footprint indices: each keyframe of a swath, and the nearest one of the next swath."""
    here, there = np.flatnonzero(prints.swath == swath), np.flatnonzero(prints.swath == swath + 1)
    if len(here) == 0 or len(there) == 0:
        return np.zeros((2, 0), dtype=np.int64)
    _, nearest = KDTree(prints.centre_m[there]).query(prints.centre_m[here])
    return np.stack([here, there[nearest]])


def _shared_area(prints: Footprints, first: NDArray[np.int64], second: NDArray[np.int64], offset: Array) -> Array:
    """Returns the overlap (m,), as a fraction of the area, of pairs of footprints.

    Both footprints of a pair are given the mean of their sizes and the orientation of the first.

    Args:
        first, second: (m,) indices of the footprints of each pair.
        offset: (m, 2) offset of the second footprint from the first [m].
    """
    heading = prints.heading[first]
    along = np.einsum("ni,ni->n", offset, heading)
    across = heading[:, 0] * offset[:, 1] - heading[:, 1] * offset[:, 0]
    length = (prints.length_m[first] + prints.length_m[second]) / 2
    width = (prints.width_m[first] + prints.width_m[second]) / 2
    return np.clip(1 - np.abs(along) / length, 0, 1) * np.clip(1 - np.abs(across) / width, 0, 1)
