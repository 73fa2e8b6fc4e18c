"""Forecast of a survey plan: keyframes, duration, overlaps, depth noise and clearance."""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from twin.controllers.survey_plan import SurveyPlan
from twin.core.geometry import Array

#: Largest number of floor heights that `least_clearance` samples.
MAX_CLEARANCE_SAMPLES = 20_000_000
_ROWS_AT_ONCE = 32  # limits the memory on a large floor


class Forecast(NamedTuple):
    """Predicted properties of a survey, for a floor at the reference plane z = 0."""

    n_frames_per_keyframe: int  # N, frames from one keyframe to the next
    keyframes_per_swath: int  # M, number of keyframes on a leg of mean length or on a loop
    n_tracks: int  # L, number of planned tracks
    #: Numbers of keyframes and frames, duration, and horizontal length of the path, without station keeping.
    n_keyframes: int
    n_frames: int
    duration_s: float
    path_m: float
    speed_mps: float  # cruise speed along the swaths
    footprint_m: tuple[float, float]  # width (across the heading) and height of the image on the floor
    keyframe_spacing_m: float  # distance between consecutive keyframes
    swath_spacing_m: float  # greatest distance between neighbouring swaths
    overlap_along: float  # overlap of consecutive keyframes, as a fraction of `SurveyPlan.side_along_m`
    overlap_across: float  # sidelap of neighbouring swaths, as a fraction of `SurveyPlan.side_across_m`
    disparity_px: float  # expected disparity of the reference plane
    depth_sigma_m: float  # expected standard deviation of the depth from one stereo pair


def forecast(plan: SurveyPlan, baseline_m: float, disparity_sigma_px: float) -> Forecast:
    """Computes the forecast of a plan (Negahdaripour & Madjidi 2003, section III-A): sigma_Z = Z^2 / (f b) sigma_d."""
    tracks = range(1, plan.n_tracks + 1)
    keyframes = np.concatenate([plan.frames_of_track(track)[1] for track in tracks])
    keyframe_spacing_m = plan.n_frames_per_keyframe * plan.speed_mps / plan.request.frame_rate_hz
    return Forecast(
        n_frames_per_keyframe=plan.n_frames_per_keyframe,
        keyframes_per_swath=max(1, round(plan.swath_length_m / keyframe_spacing_m)), n_tracks=plan.n_tracks,
        n_keyframes=int(keyframes.sum()), n_frames=len(keyframes),
        duration_s=sum(plan.track_duration_s(t) for t in tracks), path_m=sum(plan.track_length_m(t) for t in tracks),
        speed_mps=plan.speed_mps, footprint_m=plan.request.footprint_m, keyframe_spacing_m=keyframe_spacing_m,
        swath_spacing_m=plan.swath_spacing_m, overlap_along=max(0.0, 1 - keyframe_spacing_m / plan.side_along_m),
        overlap_across=max(0.0, 1 - plan.swath_spacing_m / plan.side_across_m),
        disparity_px=plan.request.focal_px * baseline_m / plan.request.altitude_m,
        depth_sigma_m=plan.request.altitude_m**2 / (plan.request.focal_px * baseline_m) * disparity_sigma_px,
    )  # fmt: skip


class Clearance(NamedTuple):
    least_m: float  # least height of the camera above the highest floor near it; infinite if no floor was found
    #: Where the clearance is least: floor point of a level path, or camera of a path that follows the floor.
    x_m: float
    y_m: float
    inside: bool  # whether every point (x, y) of the path lies within the extent of the terrain


def least_clearance(plan: SurveyPlan, height_at: Callable[[Array, Array], Array], sample_m: float = 0.02) -> Clearance:
    """Returns the clearance of a level path above the highest floor in the footprints and between the swaths."""
    # `height_at` returns heights of the floor [m] at arrays x and y [m]; NaN outside the terrain, a rectangle.
    outline = plan.outline()[:, :2]
    path = np.column_stack(plan.area.to_legs(*outline.T))
    along_m, across_m = (side / 2 for side in plan.request.footprint_m[::-1])  # the image height lies along the legs
    south, north = path[:, 1].min() - across_m, path[:, 1].max() + across_m
    area_m2 = (north - south) * (np.ptp(path[:, 0]) + 2 * along_m)
    sample_m = max(sample_m, math.sqrt(area_m2 / MAX_CLEARANCE_SAMPLES))
    path = _without_gaps(path, 2 * across_m)

    def row(y: float) -> Array:
        near = path[np.abs(path[:, 1] - y) <= across_m + 1e-9, 0]
        west, east = near.min() - along_m, near.max() + along_m
        x = np.linspace(west, east, round((east - west) / sample_m) + 2)
        return np.stack([x, np.full_like(x, y)])

    across, tops = np.linspace(south, north, round((north - south) / sample_m) + 2).tolist(), []
    for k in range(0, len(across), _ROWS_AT_ONCE):
        x, y = np.concatenate([row(at) for at in across[k : k + _ROWS_AT_ONCE]], axis=1)
        height_m = np.nan_to_num(height_at(*plan.area.to_scene(x, y)), nan=-np.inf)
        tops.append(np.array([height_m, x, y])[:, height_m.argmax()].tolist())
    height, u, v = max(tops)
    x, y = (float(c) for c in plan.area.to_scene(u, v))
    return Clearance(plan.request.altitude_m - height, x, y, inside=bool(np.isfinite(height_at(*outline.T)).all()))


def _without_gaps(path: Array, max_step_m: float) -> Array:
    """Returns a path (n, 2) of points (u, v) [m] with points added so that no step changes v by over `max_step_m`."""
    n_steps = np.maximum(1, np.ceil(np.abs(np.diff(path[:, 1])) / max_step_m)).astype(int)
    if (n_steps == 1).all():
        return path
    segment = np.repeat(np.arange(len(n_steps)), n_steps)
    step = np.arange(len(segment)) - (np.cumsum(n_steps) - n_steps)[segment]
    at, known = np.append(segment + step / n_steps[segment], len(path) - 1), np.arange(len(path))
    return np.column_stack([np.interp(at, known, path[:, k]) for k in range(2)])
