"""Keyframe errors before and after each global alignment, and the error of the final poses at the far end of tracks."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from twin.core import geometry
from twin.core.records import Alignment, Array, SurveyResult, Truth
from twin.judge.summary_statistics import finite_float, rms
from twin.judge.trajectory import anchor, path_errors

#: The far end of a track consists of the frames whose planned distance from the start of the survey is at least this
#: fraction of the greatest planned distance within the track.
FAR_SHARE = 0.9


def track_metrics(result: SurveyResult, truth: Truth) -> list[dict[str, Any]]:
    """Returns `tracks[]` of metrics.json: one row for each alignment at the end of a track.

    `result.before_ga[k]` and `result.after_ga[k]` hold the keyframe positions (n, 3) before and after
    `result.alignments[k]`: all keyframes up to the end of the track. The alignment of the whole survey at the end has
    no such positions and therefore no row. Errors are computed after anchoring at the first true pose, as for the
    trajectories.
    """
    rows = zip(result.alignments, result.before_ga, result.after_ga, strict=False)
    error_m = path_errors(result.final, truth.trajectory).distance_m
    return [_row(alignment, before, after, result, truth, error_m) for alignment, before, after in rows]


def _row(
    alignment: Alignment, before: Array, after: Array, result: SurveyResult, truth: Truth, error_m: Array
) -> dict[str, Any]:
    """Returns the row of one alignment in `tracks[]` of metrics.json.

    Args:
        before, after: (n, 3) keyframe positions before and after the alignment [m].
        error_m: (n_frames,) position error of the final trajectory [m].
    """
    frames = result.keyframe_rows[result.track_of_keyframe <= alignment.track]
    return {
        "track": int(alignment.track),
        "before_ga_rmse_m": _keyframe_rmse(before, frames, result, truth),
        "after_ga_rmse_m": _keyframe_rmse(after, frames, result, truth),
        "farthest_error_m": farthest_error_m(alignment.track, error_m, truth),
        "ga_ms": finite_float(alignment.ms),
        "nodes": int(alignment.nodes),
        "edges": int(alignment.edges),
    }


def farthest_error_m(track: int, error_m: Array, truth: Truth) -> float | None:
    """Returns the RMS position error at the far end of a track [m]; None if the track has no frames.

    The far end consists of the frames whose planned distance from the start of the survey is at least `FAR_SHARE` of
    the greatest one within the track. Drift is greatest there (Negahdaripour & Madjidi 2003, section III). The error of
    a single frame would be dominated by frame-to-frame noise.

    Args:
        track: number of the track, from 1.
        error_m: (n,) position error of each frame [m].
        truth: source of the reference path and of the track numbers.
    """
    frames = np.flatnonzero(truth.track[: len(error_m)] == track)
    if len(frames) == 0:
        return None
    distance_m = np.linalg.norm(truth.reference[frames] - truth.reference[0], axis=1)
    return rms(error_m[frames[distance_m >= FAR_SHARE * distance_m.max()]])


def _keyframe_rmse(positions: Array, frames: NDArray[np.int64], result: SurveyResult, truth: Truth) -> float | None:
    """Returns the RMS of the position errors of keyframes [m]; None if there are none.

    The arguments are those of `keyframe_errors_m`.
    """
    return rms(keyframe_errors_m(positions, frames, result, truth))


def keyframe_errors_m(positions: Array, frames: NDArray[np.int64], result: SurveyResult, truth: Truth) -> Array:
    """Returns the position errors (min(n, m),) of the first keyframes of a survey [m].

    The positions are anchored at the first true pose before they are compared.

    Args:
        positions: (n, 3) estimated positions of the first n keyframes, not yet anchored [m].
        frames: (m,) frame numbers of the first m keyframes.
        result: output of the estimators, of which the first online pose is used.
        truth: source of the true trajectory.
    """
    n = min(len(positions), len(frames))
    if n == 0:
        return np.zeros(0)
    true_from_estimated = anchor(result.online.world_from_camera[0], truth.trajectory.world_from_camera[0])
    anchored = geometry.transform(true_from_estimated, positions[:n])
    return np.linalg.norm(anchored - truth.trajectory.positions[frames[:n]], axis=1)
