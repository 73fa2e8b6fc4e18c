"""What each global alignment gained, and how far off each track is at its far end."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from twin.core import geometry
from twin.core.records import Alignment, Array, SurveyResult, Truth
from twin.judge.summary_statistics import number, rms
from twin.judge.trajectory import anchor, path_errors

#: The far end of a track: as planned, at least this share of its greatest distance from the survey's start.
FAR_SHARE = 0.9


def track_metrics(result: SurveyResult, truth: Truth) -> list[dict[str, Any]]:
    """`tracks[]` of metrics.json, a row for each alignment at the end of a track.

    `before_ga[k]` and `after_ga[k]` belong to `alignments[k]`; an alignment beyond them (the truly global one at the
    end) has no row. Their n positions are those of the last n keyframes up to the end of the track (all of
    them, or those of the moving window), anchored at the first true pose like the trajectories.
    """
    rows = zip(result.alignments, result.before_ga, result.after_ga, strict=False)
    error_m = path_errors(result.final, truth.trajectory).distance_m
    return [_row(alignment, before, after, result, truth, error_m) for alignment, before, after in rows]


def _row(
    alignment: Alignment, before: Array, after: Array, result: SurveyResult, truth: Truth, error_m: Array
) -> dict[str, Any]:
    frames = result.keyframe_rows[result.track_of_keyframe <= alignment.track]
    return {
        "track": int(alignment.track),
        "before_ga_rmse_m": _keyframe_rmse(before, frames, result, truth),
        "after_ga_rmse_m": _keyframe_rmse(after, frames, result, truth),
        "farthest_error_m": farthest_error_m(alignment.track, error_m, truth),
        "ga_ms": number(alignment.ms),
        "nodes": int(alignment.nodes),
        "edges": int(alignment.edges),
    }


def farthest_error_m(track: int, error_m: Array, truth: Truth) -> float | None:
    """RMS of the final errors (n,) at a track's far end [m]: the last tenth of its distance from the start.

    There drift is greatest (Negahdaripour & Madjidi 2003, section III). A single frame would tell the noise of its
    frame-to-frame motion instead.
    """
    frames = np.flatnonzero(truth.track[: len(error_m)] == track)
    if len(frames) == 0:
        return None
    distance_m = np.linalg.norm(truth.reference[frames] - truth.reference[0], axis=1)
    return rms(error_m[frames[distance_m >= FAR_SHARE * distance_m.max()]])


def _keyframe_rmse(positions: Array, frames: NDArray[np.int64], result: SurveyResult, truth: Truth) -> float | None:
    """RMSE of the last keyframes of `frames` whose positions (n, 3) are given [m]."""
    n = min(len(positions), len(frames))
    if n == 0:
        return None
    true_from_estimated = anchor(result.online.world_from_camera[0], truth.trajectory.world_from_camera[0])
    moved = geometry.transform(true_from_estimated, positions[-n:])
    return rms(np.linalg.norm(moved - truth.trajectory.positions[frames[-n:]], axis=1))
