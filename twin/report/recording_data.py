"""Time series of a run for the recording: times of the snapshots, durations of the stages, subsampling."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core.records import Array
from twin.report.run_folder import Run

#: Largest number of snapshots of growing entities (paths, network, map), and of samples of a time series.
N_SNAPSHOTS, N_SAMPLES = 24, 5000


class FrameTimes(NamedTuple):
    """Frame numbers (n,) and their times (n,) [s]."""

    frames: NDArray[np.int64]
    times_s: Array


def snapshots(run: Run) -> Iterator[tuple[int, tuple[int, float]]]:
    """Yields the last keyframe of each snapshot: (keyframe number, (frame number, time [s]))."""
    path, frames = run.trajectories.get("online"), run.keyframes.frames
    if path is None or not len(frames):
        return
    for k in np.unique(np.linspace(0, len(frames) - 1, min(N_SNAPSHOTS, len(frames))).astype(int)):
        yield int(k), (int(frames[k]), float(path.times_s[frames[k]]))


def stage_durations(run: Run) -> dict[str, tuple[FrameTimes, Array]]:
    """Returns, for each stage, the frames of its calls (at most `N_SAMPLES`) and their durations [ms].

    The stages are global alignment and, of those in `Keyframes.timing_ms`, those called once per frame or keyframe.
    """
    path = run.trajectories.get("online")
    if path is None:
        return {}
    keyframes = run.keyframes.frames
    frames_by_count = {len(keyframes): keyframes, len(path): np.arange(len(path))}
    timing_ms = run.keyframes.timing_ms
    durations = {s: (frames_by_count[len(v)], v) for s, v in timing_ms.items() if len(v) in frames_by_count}
    durations |= _alignment_durations(run)
    thin = {s: (f[:: stride(len(f))], v[:: stride(len(f))]) for s, (f, v) in durations.items()}
    return {stage: (FrameTimes(frames, path.times_s[frames]), values) for stage, (frames, values) in thin.items()}


def _alignment_durations(run: Run) -> dict[str, tuple[NDArray[np.int64], Array]]:
    """Returns {"ga": (frames, durations [ms])} of the global alignments, each at the last keyframe of its track."""
    keys, tracks = run.keyframes, (run.metrics or {}).get("tracks") or []
    timed = [(keys.frames[keys.tracks <= row["track"]], row["ga_ms"]) for row in tracks if row["ga_ms"] is not None]
    rows = [(frames[-1], ms) for frames, ms in timed if len(frames)]
    return {"ga": (np.array([f for f, _ in rows]), np.array([ms for _, ms in rows], dtype=float))} if rows else {}


def stride(n: int, limit: int = N_SAMPLES) -> int:
    """Returns the smallest stride with which at most `limit` of n items are kept."""
    return max(1, -(-n // limit))


def subsampled_rows(n: int) -> NDArray[np.int64]:
    """Returns at most `N_SAMPLES` evenly spaced row numbers out of n."""
    return np.arange(0, n, stride(n))
