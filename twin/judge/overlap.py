"""The overlap the survey truly had, from true poses and the true floor.

The footprint of a keyframe is a level rectangle at the height of the floor under it: width W depth / f across the bow
and H depth / f along it, where depth is the camera's height above the mean floor of that very rectangle. Tilt and
relief inside the footprint are left out.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from twin.core import geometry
from twin.core.records import Array, MapGrid, StereoRig, SurveyResult, Truth
from twin.judge.summary_statistics import number, percentile
from twin.judge.swaths import swath_numbers, travel_direction


class Footprints(NamedTuple):
    """Of n keyframes.

    Args:
        centre_m: (n, 2) position [m].
        bow, travel: (n, 2) unit vectors of heading, and of the planned motion.
        width_m, length_m: (n,) across and along the bow, on the floor [m].
        swath: (n,) number of the leg or loop, or -1.
    """

    centre_m: Array
    bow: Array
    travel: Array
    width_m: Array
    length_m: Array
    swath: NDArray[np.int64]


def overlap_metrics(
    result: SurveyResult, truth: Truth, rig: StereoRig, grid: MapGrid | None, planned: dict[str, Any]
) -> dict[str, float | None]:
    """`overlap.*` of metrics.json; `planned` holds pattern, overlap_along and overlap_across of the plan.

    Along: shared area of consecutive keyframes of one swath (a leg, a loop). Across: sidelap, the area shared with the
    nearest keyframe of the next swath, were it abeam.
    """
    prints = footprints(result.keyframe_rows, truth, rig, grid, planned.get("pattern", "lawnmower"))
    along, across = along_overlap(prints), across_overlap(prints)
    return {
        "along_planned": number(planned.get("overlap_along")),
        "along_median": percentile(along, 50),
        "across_planned": number(planned.get("overlap_across")),
        "across_median": percentile(across, 50),
        "across_p05": percentile(across, 5),
    }


def footprints(
    keyframe_rows: NDArray[np.int64], truth: Truth, rig: StereoRig, grid: MapGrid | None, pattern: str = "lawnmower"
) -> Footprints:
    """True footprints of the keyframes of a survey of this pattern."""
    pose = truth.trajectory.world_from_camera[keyframe_rows]
    heading = geometry.heading_of_camera(pose)
    bow = np.column_stack([np.cos(heading), np.sin(heading)])
    whole = float(np.nanmean(truth.height_m)) if np.isfinite(truth.height_m).any() else np.nan
    depth = np.array([mean_depth(p[:3, 3], truth.height_m, whole, grid, rig) for p in pose])
    travel, swath = travel_direction(truth.reference)[keyframe_rows], swath_numbers(truth, pattern)[keyframe_rows]
    scale = depth / rig.focal_px
    return Footprints(pose[:, :2, 3], bow, travel, rig.width_px * scale, rig.height_px * scale, swath)


def mean_depth(
    position: Array, height_m: NDArray[np.float32], whole_m: float, grid: MapGrid | None, rig: StereoRig
) -> float:
    """Height of a camera (3,) above the mean floor in the square it sees [m]; without a grid above the whole floor's
    mean."""
    if grid is None:
        return float(position[2]) - whole_m
    half = (float(position[2]) - whole_m) * (rig.width_px + rig.height_px) / (4 * rig.focal_px)
    cells = _window(height_m, grid, position, half)
    return float(position[2]) - (float(np.nanmean(cells)) if np.isfinite(cells).any() else whole_m)


def _window(height_m: NDArray[np.float32], grid: MapGrid, position: Array, half_m: float) -> NDArray[np.float32]:
    col, row = (position[0] - grid.west_m) / grid.cell_m, (grid.north_m - position[1]) / grid.cell_m
    half = half_m / grid.cell_m
    rows, cols = (
        slice(max(int(row - half), 0), max(int(row + half) + 1, 0)),
        slice(max(int(col - half), 0), max(int(col + half) + 1, 0)),
    )
    return height_m[rows, cols]


def along_overlap(prints: Footprints) -> Array:
    """(m,) shared share of the area of consecutive keyframes that are on the same swath."""
    first = np.flatnonzero((prints.swath[:-1] == prints.swath[1:]) & (prints.swath[1:] >= 0))
    return _shared(prints, first, first + 1, prints.centre_m[first + 1] - prints.centre_m[first])


def across_overlap(prints: Footprints) -> Array:
    """(m,) shared share of the area of each keyframe with the nearest one of the next swath, were it abeam.

    Where legs run along the bow this is the shared width.
    """
    pairs = [_neighbours(prints, swath) for swath in range(int(prints.swath.max(initial=-1)))]
    if not pairs:
        return np.zeros(0)
    first, second = np.concatenate(pairs, axis=1)
    abeam = prints.travel[first][:, ::-1] * [-1, 1]
    sideways = np.einsum("ni,ni->n", prints.centre_m[second] - prints.centre_m[first], abeam)
    return _shared(prints, first, second, sideways[:, None] * abeam)


def _neighbours(prints: Footprints, swath: int) -> NDArray[np.int64]:
    """(2, m) keyframes of a swath and, for each, the nearest keyframe of the next swath."""
    here, there = np.flatnonzero(prints.swath == swath), np.flatnonzero(prints.swath == swath + 1)
    if len(here) == 0 or len(there) == 0:
        return np.zeros((2, 0), dtype=np.int64)
    _, nearest = KDTree(prints.centre_m[there]).query(prints.centre_m[here])
    return np.stack([here, there[nearest]])


def _shared(prints: Footprints, first: NDArray[np.int64], second: NDArray[np.int64], step: Array) -> Array:
    """Share of the area that footprints of the two's mean size share after a step (m, 2) [m] in the first's axes."""
    bow = prints.bow[first]
    along, across = np.einsum("ni,ni->n", step, bow), bow[:, 0] * step[:, 1] - bow[:, 1] * step[:, 0]
    length = (prints.length_m[first] + prints.length_m[second]) / 2
    width = (prints.width_m[first] + prints.width_m[second]) / 2
    return np.clip(1 - np.abs(along) / length, 0, 1) * np.clip(1 - np.abs(across) / width, 0, 1)
