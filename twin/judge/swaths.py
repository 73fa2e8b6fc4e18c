"""Swaths of a survey, its legs or loops: how well they are flown, and the overlap of their images.

The overlap of two keyframes is the fraction of the floor in the first image that the second image also shows, by ray
casting. Forecasts (from planned poses) and metrics (from true poses) use the same functions.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from twin.core.height_field import HeightField, height_field, image_overlap, map_height_field
from twin.core.records import Array, MapGrid, StereoRig, SurveyResult, Truth
from twin.judge.summary_statistics import finite_float, percentile, rms

#: A frame belongs to a leg if |cos| of the angle between its direction of travel and the axis of the legs exceeds
#: this value (angle below 26 deg).
ON_LEG_COSINE = 0.9
#: Change of the planned heading between two frames above which they belong to a turn [rad].
TURNING_STEP = 1e-9
MOST_PAIRS = 500  #: largest number of pairs of images, evenly along the path, from which an overlap is measured


def travel_direction(reference: Array) -> Array:
    """Returns horizontal unit vectors (n, 2) of the steps from reference positions (n, 3) to the next.

    A step without horizontal length has the direction of the last one before it that has a length, or else of the
    first; [1, 0] without any.
    """
    n = len(reference)
    if n == 0:
        return np.zeros((0, 2))
    step = np.diff(reference[:, :2], axis=0, append=reference[-1:, :2])
    length = np.linalg.norm(step, axis=1)
    moving = np.flatnonzero(length > 1e-9)
    if len(moving) == 0:
        return np.tile([1.0, 0.0], (n, 1))
    last_moving = np.maximum(np.searchsorted(moving, np.arange(n), side="right") - 1, 0)
    row = moving[last_moving]
    return step[row] / length[row, None]


def swath_numbers(
    reference: Array, yaw: Array | None, track: NDArray[np.int64], planned: Mapping[str, Any]
) -> NDArray[np.int64]:
    """Returns the leg, or the track of loops, of each frame (n,), from 0; -1 between legs, on turns and cross lines.

    Before a leg after a gap in the area, a number is left out: the swaths beside the gap are no neighbours.

    Args:
        reference, yaw, track: planned positions (n, 3), headings (n,) or None, and numbers (n,) of the tracks, from 1.
        planned: `pattern` and `SurveyPlan.swath_notes`.
    """
    away = np.isin(track, planned.get("other_tracks", [])) | (track > planned.get("last_track", np.inf))
    if planned.get("pattern") == "loops":
        return np.where(away, -1, track - 1 - np.searchsorted(planned.get("other_tracks", []), track))
    off_leg = away | (track == planned.get("cross_track"))
    if yaw is not None:
        off_leg |= is_turning(yaw)
    legs = np.full(len(track), -1)
    numbered = ~away
    if yaw is not None:  # without arcs, which cross the direction of the legs
        numbered &= ~(is_turning(yaw) & (np.abs(np.diff(reference, axis=0, append=reference[-1:])).max(axis=1) > 1e-9))
    legs[numbered] = leg_numbers(reference[numbered])
    return np.where(off_leg, -1, legs + np.searchsorted(planned.get("legs_after_gaps", ()), legs, side="right"))


def is_turning(yaw: Array) -> NDArray[np.bool_]:
    """Returns a mask (n,) of the frames whose planned heading [rad] differs from the previous or the next one."""
    steps = np.abs(np.diff(yaw)) > TURNING_STEP
    turning = np.zeros(len(yaw), np.bool_)
    turning[1:] |= steps
    turning[:-1] |= steps
    return turning


def leg_numbers(reference: Array) -> NDArray[np.int64]:
    """Returns the leg (n,) of each frame, from 0, or -1 between legs, from reference positions (n, 3)."""
    # Legs are parallel to the first step; one ends where the direction of travel reverses or a short segment begins.
    direction = travel_direction(reference)
    cosine = direction @ direction[0] if len(direction) else np.zeros(0)
    on_leg = np.where(np.abs(cosine) > ON_LEG_COSINE, np.sign(cosine), 0.0)
    starts = (on_leg != 0) & (np.diff(on_leg, prepend=0.0) != 0)
    return np.where(on_leg != 0, np.cumsum(starts) - 1, -1).astype(np.int64)


def control_metrics(truth: Truth) -> dict[str, float | None]:
    """Returns `control.*` of metrics.json, without slowed_s and held_s.

    The horizontal cross-track error is over the frames in which the vehicle travels, the altitude error over all
    frames, the station-keeping error (3-D distance) over those at which it keeps station. Of a path that follows the
    floor, the height error is that from `plan.altitude_m` above the true floor, smoothed over an image.
    """
    n = min(len(truth.trajectory), len(truth.reference))
    offset = truth.trajectory.positions[:n] - truth.reference[:n]
    holding, direction = truth.holding[:n], travel_direction(truth.reference[:n])
    across = direction[:, 0] * offset[:, 1] - direction[:, 1] * offset[:, 0]
    height = {"height_error_rmse_m": None, "least_height_m": None}
    if truth.heights_to_follow is not None and n:
        x, y, z = truth.trajectory.positions[:n].T
        wanted_m, floor_m = truth.heights_to_follow(x, y)
        error_m, above_m = (part[np.isfinite(part)] for part in (z - wanted_m, z - floor_m))  # NaN beyond the terrain
        height = {"height_error_rmse_m": rms(error_m), "least_height_m": percentile(above_m, 0)}
    return {
        "cross_track_rmse_m": rms(across[~holding]),
        "altitude_rmse_m": rms(offset[:, 2]),
        **height,
        "station_keeping_rmse_m": rms(np.linalg.norm(offset[holding], axis=1)),
    }


class KeyframePoses(NamedTuple):
    """Poses, directions of travel and swaths of n keyframes."""

    world_from_camera: Array  #: (n, 4, 4) poses of the left camera
    travel: Array  #: (n, 2) horizontal unit vectors of the planned motion
    swath: NDArray[np.int64]  #: (n,) number of the leg or loop, from 0; -1 for keyframes between legs and during turns

    @property
    def position_m(self) -> Array:
        return self.world_from_camera[:, :3, 3]


class ImagePairs(NamedTuple):
    """Pairs of images whose overlap is computed."""

    #: first, second: (m, 4, 4) world_from_camera of both images.
    first: Array
    second: Array


def thinned(pairs: ImagePairs, most: int) -> ImagePairs:
    kept = np.unique(np.linspace(0, len(pairs.first) - 1, min(most, len(pairs.first))).astype(int))
    return ImagePairs(pairs.first[kept], pairs.second[kept])


def overlap_metrics(
    result: SurveyResult, truth: Truth, rig: StereoRig, grid: MapGrid | None, planned: Mapping[str, Any]
) -> dict[str, float | None]:
    """Returns `overlap.*` of metrics.json, from at most 500 pairs of images in each direction.

    Args:
        grid: cells of `truth.height_m`; None: the floor is taken to be level, at the mean height.
        planned: `pattern`, `cross_track` and `legs_after_gaps` of the plan, whether overlaps count `both_ways`
            (`image_pairs`), requested `overlap_along` and `overlap_across`, and `along_median` and `across_median`,
            forecast from the planned poses over the floor; 0 to 1.
    """
    rows = result.keyframe_rows
    travel = travel_direction(truth.reference)[rows]
    swath = swath_numbers(truth.reference, truth.reference_yaw, truth.track, planned)[rows]
    poses = KeyframePoses(truth.trajectory.world_from_camera[rows], travel, swath)
    field, found = _true_floor(truth, grid), {}
    both = image_pairs(poses, planned.get("both_ways", False))
    for direction, pairs in zip(("along", "across"), both, strict=True):
        overlap = np.zeros(0) if field is None else image_overlap(field, *thinned(pairs, MOST_PAIRS), rig)
        overlap = overlap[np.isfinite(overlap)]  # not finite if the first image shows no floor
        found |= {
            f"{direction}_asked": finite_float(planned.get(f"overlap_{direction}")),
            f"{direction}_planned": finite_float(planned.get(f"{direction}_median")),
            f"{direction}_median": percentile(overlap, 50),
            f"{direction}_p05": percentile(overlap, 5),
        }
    return found


def image_pairs(poses: KeyframePoses, both_ways: bool = False) -> tuple[ImagePairs, ImagePairs]:
    """Returns the pairs of consecutive keyframes of a swath, and those of neighbouring swaths (`_across_pairs`).

    With `both_ways`, each pair is returned a second time in the other order: over a slope, the upper image shows more
    of the lower one than the lower one of the upper one.
    """
    first = np.flatnonzero((poses.swath[:-1] == poses.swath[1:]) & (poses.swath[1:] >= 0))
    along = ImagePairs(poses.world_from_camera[first], poses.world_from_camera[first + 1])
    across = _across_pairs(poses)
    if not both_ways:
        return along, across
    doubled = [ImagePairs(*map(np.concatenate, zip(p, p[::-1], strict=True))) for p in (along, across)]
    return doubled[0], doubled[1]


def _across_pairs(poses: KeyframePoses) -> ImagePairs:
    """Returns pairs of a keyframe and an image with the pose of the next swath's nearest keyframe, moved abreast."""
    # not the keyframes themselves, as the sidelap would depend on where they happen to lie
    pairs = [_nearest_in_next(poses, swath) for swath in range(int(poses.swath.max(initial=-1)))]
    first, second = np.concatenate(pairs, axis=1) if pairs else np.zeros((2, 0), np.int64)
    abreast, travel = poses.world_from_camera[second], poses.travel[first]
    offset = poses.position_m[second, :2] - poses.position_m[first, :2]
    abreast[:, :2, 3] -= np.einsum("ni,ni->n", offset, travel)[:, None] * travel
    return ImagePairs(poses.world_from_camera[first], abreast)


def _nearest_in_next(poses: KeyframePoses, swath: int) -> NDArray[np.int64]:
    """Returns pairs (2, m) of keyframe indices: each keyframe of a swath, and the nearest one of the next swath."""
    here, there = np.flatnonzero(poses.swath == swath), np.flatnonzero(poses.swath == swath + 1)
    if len(here) == 0 or len(there) == 0:
        return np.zeros((2, 0), dtype=np.int64)
    _, nearest = KDTree(poses.position_m[there, :2]).query(poses.position_m[here, :2])
    return np.stack([here, there[nearest]])


def _true_floor(truth: Truth, grid: MapGrid | None) -> HeightField | None:
    """Returns the true floor; None without heights or true poses; level at the mean height without a grid of cells."""
    height, known = truth.height_m, np.isfinite(truth.height_m)
    if not known.any() or not len(truth.trajectory):
        return None
    if grid is not None and min(height.shape) > 1:
        return map_height_field(height, grid)
    reach_m = 1e4 + float(np.abs(truth.trajectory.positions).max())
    level = np.full((2, 2), np.nanmean(height, dtype=np.float64))
    return height_field(level, 2 * reach_m, -reach_m, -reach_m)
