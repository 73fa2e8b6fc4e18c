"""Absolute trajectory errors of estimates that are anchored at the first true pose, without a fitted transform."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core import geometry
from twin.core.records import Array, SurveyResult, Trajectory, Truth
from twin.judge.summary_statistics import finite_float, percentile, rms

#: The far end of a track consists of the frames whose planned distance from the start of the survey is at least this
#: fraction of the greatest planned distance within the track.
FAR_SHARE = 0.9


class PathErrors(NamedTuple):
    """Errors of an estimated trajectory at n frames, estimate minus truth."""

    travelled_m: Array  #: (n,) length of the true path since the first of these frames
    position_m: Array  #: (n, 3) position error in the world
    heading_rad: Array  #: (n,) heading error, wrapped to [-pi, pi)

    @property
    def distance_m(self) -> Array:
        """Returns the norm (n,) of the position error [m]."""
        return np.linalg.norm(self.position_m, axis=1)


def anchor(first_estimated: Array, first_true: Array) -> Array:
    """Returns true_from_estimated (4, 4), which maps the first estimated pose to the first true pose."""
    return first_true @ geometry.inverse(first_estimated)


def pose_errors(estimated: Array, true: Array) -> PathErrors:
    """Returns the errors of poses (n, 4, 4) of the left camera that are given in the world of the true ones."""
    heading = geometry.heading_of_camera(estimated) - geometry.heading_of_camera(true)
    position = estimated[:, :3, 3] - true[:, :3, 3]
    steps_m = np.linalg.norm(np.diff(true[:, :3, 3], axis=0), axis=1)
    travelled_m = np.concatenate([[0.0], np.cumsum(steps_m)])[: len(true)]
    return PathErrors(travelled_m, position, geometry.wrap_angle(heading))


def path_errors(estimate: Trajectory, truth: Trajectory) -> PathErrors:
    """Returns the errors at the frames of both trajectories, with the estimate anchored at the first true pose."""
    n = min(len(estimate), len(truth))
    true = truth.world_from_camera[:n]
    if n == 0:
        return pose_errors(true, true)
    return pose_errors(anchor(estimate.world_from_camera[0], true[0]) @ estimate.world_from_camera[:n], true)


def trajectory_metrics(errors: PathErrors) -> dict[str, float | None]:
    """Returns `trajectory.*` of metrics.json; the drift is the end error in percent of the true path length."""
    distance = errors.distance_m
    end, path = (float(distance[-1]), float(errors.travelled_m[-1])) if len(distance) else (None, None)
    return {
        "ate_rmse_m": rms(distance),
        "ate_max_m": percentile(distance, 100),
        **{f"{axis}_rmse_m": rms(error) for axis, error in zip("xyz", errors.position_m.T, strict=True)},
        "heading_rmse_deg": rms(np.rad2deg(errors.heading_rad)),
        "end_error_m": finite_float(end),
        "drift_percent": 100 * end / path if path and end is not None else None,
        "path_m": finite_float(path),
    }


def track_metrics(result: SurveyResult, truth: Truth) -> list[dict[str, Any]]:
    """Returns `tracks[]` of metrics.json: errors of all keyframes so far, before and after each track's alignment."""
    error_m = path_errors(result.final, truth.trajectory).distance_m
    rows = []
    for alignment, *positions in zip(result.alignments, result.before_ga, result.after_ga, strict=False):
        frames = result.keyframe_rows[result.track_of_keyframe <= alignment.track]
        before_m, after_m = (rms(keyframe_errors_m(some, frames, result, truth)) for some in positions)
        rows.append({
            "track": int(alignment.track),
            "before_ga_rmse_m": before_m,
            "after_ga_rmse_m": after_m,
            "farthest_error_m": farthest_error_m(alignment.track, error_m, truth),
            "ga_ms": finite_float(alignment.ms),
            "nodes": int(alignment.nodes),
            "edges": int(alignment.edges),
        })  # fmt: skip
    return rows


def farthest_error_m(track: int, error_m: Array, truth: Truth) -> float | None:
    """Returns the RMS of the position errors (n,) [m] at the far end of a track; None if the track has no frames.

    These are the frames whose planned distance from the start is at least `FAR_SHARE` of the greatest within the track.
    Drift is greatest there (Negahdaripour & Madjidi 2003, section III); a single frame would show frame-to-frame noise.
    """
    frames = np.flatnonzero(truth.track[: len(error_m)] == track)
    if len(frames) == 0:
        return None
    distance_m = np.linalg.norm(truth.reference[frames] - truth.reference[0], axis=1)
    return rms(error_m[frames[distance_m >= FAR_SHARE * distance_m.max()]])


def keyframe_errors_m(positions: Array, frames: NDArray[np.int64], result: SurveyResult, truth: Truth) -> Array:
    """Returns the position errors (min(n, m),) of the first keyframes [m], anchored at the first true pose.

    `positions` (n, 3) [m] are the estimated ones, not yet anchored, `frames` (m,) frame numbers of the first keyframes.
    """
    n = min(len(positions), len(frames))
    if n == 0:
        return np.zeros(0)
    true_from_estimated = anchor(result.online.world_from_camera[0], truth.trajectory.world_from_camera[0])
    anchored = geometry.transform(true_from_estimated, positions[:n])
    return np.linalg.norm(anchored - truth.trajectory.positions[frames[:n]], axis=1)
