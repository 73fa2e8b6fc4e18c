"""What the recording shows of a run and when: moments, stages, thinned series."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core.records import Array
from twin.report.run_folder import Run

#: Growing things are logged this often; poses and curves at most this many times.
N_STAGES, N_SAMPLES = 24, 5000


class Moments(NamedTuple):
    """Rows of the trajectories and their times [s]."""

    frames: NDArray[np.int64]
    times_s: Array


def stages_of(run: Run) -> Iterator[tuple[int, tuple[int, float]]]:
    """The last keyframe of each stage, with its frame and time [s]."""
    path, frames = run.trajectories.get("online"), run.keyframes.frames
    if path is None or not len(frames):
        return
    for k in np.unique(np.linspace(0, len(frames) - 1, min(N_STAGES, len(frames))).astype(int)):
        yield int(k), (int(frames[k]), float(path.times_s[frames[k]]))


def stage_times(run: Run) -> dict[str, tuple[Moments, Array]]:
    """Moments and durations [ms] of alignments and of the stages that run once a frame or once a keyframe."""
    path = run.trajectories.get("online")
    if path is None:
        return {}
    keys = run.keyframes.frames
    places = {len(keys): keys, len(path): np.arange(len(path))}
    found = {s: (places[len(v)], v) for s, v in run.keyframes.timing_ms.items() if len(v) in places}
    found |= _alignment_times(run)
    thin = {s: (f[:: step_of(len(f))], v[:: step_of(len(f))]) for s, (f, v) in found.items()}
    return {stage: (Moments(frames, path.times_s[frames]), values) for stage, (frames, values) in thin.items()}


def _alignment_times(run: Run) -> dict[str, tuple[NDArray[np.int64], Array]]:
    """Each alignment at the last keyframe of its track."""
    keys, tracks = run.keyframes, (run.metrics or {}).get("tracks") or []
    ended = [(keys.frames[keys.tracks <= row["track"]], row["ga_ms"]) for row in tracks if row["ga_ms"] is not None]
    rows = [(frames[-1], ms) for frames, ms in ended if len(frames)]
    return {"ga": (np.array([f for f, _ in rows]), np.array([ms for _, ms in rows], dtype=float))} if rows else {}


def step_of(n: int, at_most: int = N_SAMPLES) -> int:
    """The stride that keeps at most so many of n."""
    return max(1, -(-n // at_most))


def sampled(n: int) -> NDArray[np.int64]:
    """Rows out of n, thinned."""
    return np.arange(0, n, step_of(n))
