"""The overlap the survey truly had, from true poses and the true floor.

The footprint of a key point is a level rectangle at the height of the floor under it: width W depth / f across the bow
and H depth / f along it, where depth is the camera's height above the mean floor of that very rectangle. Tilt and
relief inside the footprint are left out.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from twin import geometry
from twin.judge.numbers import number, percentile
from twin.judge.path import leg_numbers
from twin.records import Array, MapGrid, StereoRig, SurveyResult, Truth


class Footprints(NamedTuple):
    """Of n key points: centre (n, 2) [m], bow (n, 2) unit vector, width and length (n,) on the floor [m], leg or -1."""

    centre_m: Array
    bow: Array
    width_m: Array
    length_m: Array
    leg: NDArray[np.int64]


def overlap_metrics(
    result: SurveyResult, truth: Truth, rig: StereoRig, grid: MapGrid | None, planned: dict[str, Any]
) -> dict[str, float | None]:
    """`overlap.*` of metrics.json; `planned` holds overlap_along and overlap_across of the plan.

    Along: shared area of consecutive key points of one leg. Across: shared width (sidelap) of a key point and the
    nearest one of the next leg.
    """
    prints = footprints(result.key_frames, truth, rig, grid)
    along, across = along_overlap(prints), across_overlap(prints)
    return {
        "along_planned": number(planned.get("overlap_along")),
        "along_median": percentile(along, 50),
        "across_planned": number(planned.get("overlap_across")),
        "across_median": percentile(across, 50),
        "across_p05": percentile(across, 5),
    }


def footprints(key_frames: NDArray[np.int64], truth: Truth, rig: StereoRig, grid: MapGrid | None) -> Footprints:
    """True footprints of the key points."""
    pose = truth.trajectory.world_from_camera[key_frames]
    heading = geometry.heading_of_camera(pose)
    bow = np.column_stack([np.cos(heading), np.sin(heading)])
    depth = np.array([mean_depth(p[:3, 3], truth.height_m, grid, rig) for p in pose])
    leg = leg_numbers(truth.reference)[key_frames]
    scale = depth / rig.focal_px
    return Footprints(pose[:, :2, 3], bow, rig.width_px * scale, rig.height_px * scale, leg)


def mean_depth(position: Array, height_m: NDArray[np.float32], grid: MapGrid | None, rig: StereoRig) -> float:
    """Height of a camera (3,) above the mean floor in the square it sees [m]; without a grid above the whole floor."""
    whole = float(np.nanmean(height_m)) if np.isfinite(height_m).any() else np.nan
    if grid is None:
        return float(position[2]) - whole
    half = (float(position[2]) - whole) * (rig.width_px + rig.height_px) / (4 * rig.focal_px)
    cells = _window(height_m, grid, position, half)
    return float(position[2]) - (float(np.nanmean(cells)) if np.isfinite(cells).any() else whole)


def _window(height_m: NDArray[np.float32], grid: MapGrid, position: Array, half_m: float) -> NDArray[np.float32]:
    col, row = (position[0] - grid.west_m) / grid.cell_m, (grid.north_m - position[1]) / grid.cell_m
    half = half_m / grid.cell_m
    rows, cols = (
        slice(max(int(row - half), 0), max(int(row + half) + 1, 0)),
        slice(max(int(col - half), 0), max(int(col + half) + 1, 0)),
    )
    return height_m[rows, cols]


def along_overlap(prints: Footprints) -> Array:
    """(m,) shared share of the area of consecutive key points that are on the same leg."""
    first = np.flatnonzero((prints.leg[:-1] == prints.leg[1:]) & (prints.leg[1:] >= 0))
    along, across = _displacement(prints, first, first + 1)
    length, width = _mean_size(prints, first, first + 1)
    return _shared(along, length) * _shared(across, width)


def across_overlap(prints: Footprints) -> Array:
    """(m,) shared share of the width of each key point with the nearest one of the next leg."""
    pairs = [_neighbours(prints, leg) for leg in range(int(prints.leg.max(initial=-1)))]
    if not pairs:
        return np.zeros(0)
    first, second = np.concatenate(pairs, axis=1)
    _, across = _displacement(prints, first, second)
    return _shared(across, _mean_size(prints, first, second)[1])


def _neighbours(prints: Footprints, leg: int) -> NDArray[np.int64]:
    """(2, m) key points of a leg and, for each, the nearest key point of the next leg."""
    here, there = np.flatnonzero(prints.leg == leg), np.flatnonzero(prints.leg == leg + 1)
    if len(here) == 0 or len(there) == 0:
        return np.zeros((2, 0), dtype=np.int64)
    _, nearest = KDTree(prints.centre_m[there]).query(prints.centre_m[here])
    return np.stack([here, there[nearest]])


def _displacement(prints: Footprints, first: NDArray[np.int64], second: NDArray[np.int64]) -> tuple[Array, Array]:
    """How far the second is from the first, along and across the first's bow [m]."""
    step, bow = prints.centre_m[second] - prints.centre_m[first], prints.bow[first]
    return np.einsum("ni,ni->n", step, bow), bow[:, 0] * step[:, 1] - bow[:, 1] * step[:, 0]


def _mean_size(prints: Footprints, first: NDArray[np.int64], second: NDArray[np.int64]) -> tuple[Array, Array]:
    """Mean length and width of two footprints [m]."""
    return (
        (prints.length_m[first] + prints.length_m[second]) / 2,
        (prints.width_m[first] + prints.width_m[second]) / 2,
    )


def _shared(displacement: Array, size: Array) -> Array:
    return np.clip(1 - np.abs(displacement) / size, 0, 1)
