"""What a plan will cost and promise before anything is flown: key points, time, overlaps, depth noise, clearance."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from controllers.lawnmower import SurveyPlan

Array = NDArray[np.float64]


class Forecast(NamedTuple):
    """The plan in numbers, at the reference plane z = 0.

    Args:
        n_frames_per_key: N.
        keys_per_leg: M.
        n_tracks: L.
        n_keys, n_frames: in all, without station keeping.
        duration_s, path_m: of the whole flight, without station keeping.
        footprint_m: width (across track) and height (along track) of the image.
        key_spacing_m, leg_spacing_m: distance of neighbouring key points and legs.
        overlap_along, overlap_across: true shares, along the image height and width.
        disparity_px: expected disparity.
        depth_sigma_m: expected depth noise of one stereo pair.
    """

    n_frames_per_key: int
    keys_per_leg: int
    n_tracks: int
    n_keys: int
    n_frames: int
    duration_s: float
    path_m: float
    footprint_m: tuple[float, float]
    key_spacing_m: float
    leg_spacing_m: float
    overlap_along: float
    overlap_across: float
    disparity_px: float
    depth_sigma_m: float


def forecast(plan: SurveyPlan, baseline_m: float, disparity_sigma_px: float) -> Forecast:
    """The plan's numbers (Negahdaripour & Madjidi 2003, section III-A).

    With d = f b / Z the depth noise is sigma_Z = Z^2 / (f b) sigma_d.
    """
    tracks = range(1, plan.n_tracks + 1)
    duration_s = sum(plan.track_duration_s(t) for t in tracks)
    n_frames = round(duration_s * plan.frame_rate_hz) + 1
    key_spacing_m = plan.n_frames_per_key * plan.speed_mps / plan.frame_rate_hz
    width_m, height_m = plan.footprint_m
    return Forecast(
        n_frames_per_key=plan.n_frames_per_key,
        keys_per_leg=max(1, round(plan.area_m[0] / key_spacing_m)),
        n_tracks=plan.n_tracks,
        n_keys=(n_frames - 1) // plan.n_frames_per_key + 1,
        n_frames=n_frames,
        duration_s=duration_s,
        path_m=sum(plan.track_length_m(t) for t in tracks),
        footprint_m=plan.footprint_m,
        key_spacing_m=key_spacing_m,
        leg_spacing_m=plan.leg_spacing_m,
        overlap_along=max(0.0, 1 - key_spacing_m / height_m),
        overlap_across=max(0.0, 1 - plan.leg_spacing_m / width_m),
        disparity_px=plan.focal_px * baseline_m / plan.altitude_m,
        depth_sigma_m=plan.altitude_m**2 / (plan.focal_px * baseline_m) * disparity_sigma_px,
    )


class Clearance(NamedTuple):
    """How close the path comes to the floor.

    Args:
        least_m: least vertical distance to the floor in sight; infinite where there is none.
        x_m, y_m: the highest spot of the floor in sight.
        inside: whether there is floor below the whole path.
    """

    least_m: float
    x_m: float
    y_m: float
    inside: bool


def least_clearance(plan: SurveyPlan, height_at: Callable[[Array, Array], Array], sample_m: float = 0.02) -> Clearance:
    """How close the planned path comes to the floor under the camera's footprint.

    Args:
        height_at: height of the floor [m] at arrays of x and y [m]; NaN where there is no floor. Floors are rectangles,
            so that the corners of the path tell whether all of it lies inside.
        sample_m: spacing of the heights looked at.
    """
    corners = np.concatenate([plan.waypoints(t) for t in range(1, plan.n_tracks + 1)])[:, :2]
    reach = np.array(plan.footprint_m[::-1]) / 2  # the image height lies along x
    low, high = corners.min(axis=0) - reach, corners.max(axis=0) + reach
    x, y = (np.linspace(a, b, round((b - a) / sample_m) + 2) for a, b in zip(low, high, strict=True))
    # row by row: a large floor at fine spacing would fill the memory
    rows = (np.nan_to_num(height_at(x, np.full_like(x, row_y)), nan=-np.inf) for row_y in y)
    tops = [(float(row.max()), float(x[row.argmax()])) for row in rows]
    k = max(range(len(tops)), key=lambda i: tops[i][0])
    inside = bool(np.isfinite(height_at(*corners.T)).all())
    return Clearance(plan.altitude_m - tops[k][0], tops[k][1], float(y[k]), inside)
