"""Image overlap along a swath and between neighbouring swaths, over the true floor.

The overlap of two keyframes is the fraction of the floor in the first image that the second image also shows, computed
by ray casting (`core.image_overlap`). Forecasts (from planned poses) and metrics (from true poses) use the same
functions.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from twin.core.height_field import HeightField, height_field, map_height_field
from twin.core.image_overlap import image_overlap
from twin.core.records import Array, MapGrid, StereoRig, SurveyResult, Truth
from twin.judge.flown_path import swath_numbers, travel_direction
from twin.judge.summary_statistics import finite_float, percentile


class KeyframePoses(NamedTuple):
    """Poses, directions of travel and swaths of n keyframes."""

    world_from_camera: Array  #: (n, 4, 4) poses of the left camera
    travel: Array  #: (n, 2) horizontal unit vectors of the planned motion
    swath: NDArray[np.int64]  #: (n,) number of the leg or loop, from 0; -1 for keyframes between legs and during turns

    @property
    def position_m(self) -> Array:
        """Returns the positions (n, 3) [m]."""
        return self.world_from_camera[:, :3, 3]


class ImagePairs(NamedTuple):
    """Pairs of images whose overlap is computed."""

    keyframe: NDArray[np.int64]  #: (m,) index of the keyframe whose image is the first of the pair
    #: first, second: (m, 4, 4) world_from_camera of both images.
    first: Array
    second: Array

    @property
    def distance_m(self) -> Array:
        """Returns the horizontal distances (m,) between the two images [m]."""
        return np.linalg.norm(self.second[:, :2, 3] - self.first[:, :2, 3], axis=1)


def overlap_metrics(
    result: SurveyResult, truth: Truth, rig: StereoRig, grid: MapGrid | None, planned: Mapping[str, Any]
) -> dict[str, float | None]:
    """Returns `overlap.*` of metrics.json.

    Args:
        result: output of the estimators, of which the keyframe numbers are used.
        truth: true and reference poses, and the true floor.
        rig: calibration of the cameras.
        grid: cells of `truth.height_m`; None: the floor is taken to be level, at the mean height.
        planned: by key, `pattern`: the pattern of the plan; `overlap_along` and `overlap_across`: the requested
            overlaps, 0 to 1; `along_median` and `across_median`: the medians forecast from the planned poses over the
            floor, 0 to 1.
    """
    rows, pattern = result.keyframe_rows, planned.get("pattern", "lawnmower")
    travel, swath = travel_direction(truth.reference)[rows], swath_numbers(truth, pattern)[rows]
    poses = KeyframePoses(truth.trajectory.world_from_camera[rows], travel, swath)
    field, found = _true_floor(truth, grid), {}
    for direction, pairs in (("along", along_pairs(poses)), ("across", across_pairs(poses))):
        overlap = np.zeros(0) if field is None else image_overlap(field, pairs.first, pairs.second, rig)
        overlap = overlap[np.isfinite(overlap)]  # not finite if the first image shows no floor
        found |= {
            f"{direction}_asked": finite_float(planned.get(f"overlap_{direction}")),
            f"{direction}_planned": finite_float(planned.get(f"{direction}_median")),
            f"{direction}_median": percentile(overlap, 50),
            f"{direction}_p05": percentile(overlap, 5),
        }
    return found


def along_pairs(poses: KeyframePoses) -> ImagePairs:
    """Returns the pairs of consecutive keyframes of the same swath."""
    first = np.flatnonzero((poses.swath[:-1] == poses.swath[1:]) & (poses.swath[1:] >= 0))
    return ImagePairs(first, poses.world_from_camera[first], poses.world_from_camera[first + 1])


def across_pairs(poses: KeyframePoses) -> ImagePairs:
    """Returns pairs of a keyframe and a hypothetical image abreast of it on the next swath.

    The second image has the pose of the nearest keyframe of the next swath, shifted along the first keyframe's
    direction of travel until the two are abreast. The overlap of such a pair is the sidelap; without the shift it would
    depend on where the keyframes of the two swaths happen to lie along the track.
    """
    pairs = [_nearest_in_next(poses, swath) for swath in range(int(poses.swath.max(initial=-1)))]
    first, second = np.concatenate(pairs, axis=1) if pairs else np.zeros((2, 0), np.int64)
    abreast, travel = poses.world_from_camera[second], poses.travel[first]
    offset = poses.position_m[second, :2] - poses.position_m[first, :2]
    abreast[:, :2, 3] -= np.einsum("ni,ni->n", offset, travel)[:, None] * travel
    return ImagePairs(first, poses.world_from_camera[first], abreast)


def _nearest_in_next(poses: KeyframePoses, swath: int) -> NDArray[np.int64]:
    """Returns pairs (2, m) of keyframe indices: each keyframe of a swath, and the nearest one of the next swath."""
    here, there = np.flatnonzero(poses.swath == swath), np.flatnonzero(poses.swath == swath + 1)
    if len(here) == 0 or len(there) == 0:
        return np.zeros((2, 0), dtype=np.int64)
    _, nearest = KDTree(poses.position_m[there, :2]).query(poses.position_m[here, :2])
    return np.stack([here, there[nearest]])


def _true_floor(truth: Truth, grid: MapGrid | None) -> HeightField | None:
    """Returns the true floor; None without heights or true poses.

    Without a grid, or with one of a single row or column, the floor is level at the mean height.
    """
    height, known = truth.height_m, np.isfinite(truth.height_m)
    if not known.any() or not len(truth.trajectory):
        return None
    if grid is not None and min(height.shape) > 1:
        return map_height_field(height, grid)
    reach_m = 1e4 + float(np.abs(truth.trajectory.positions).max())
    level = np.full((2, 2), np.nanmean(height, dtype=np.float64))
    return height_field(level, 2 * reach_m, -reach_m, -reach_m)
