"""Computing time of each processing stage, compared with the real-time budget of Negahdaripour & Madjidi (2003).

Frame-to-frame motion has to be computed within one frame period, all work on a keyframe within the N frame periods up
to the next keyframe, and global alignment while the vehicle keeps station.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

#: Stages of the estimators that run at each keyframe. Their total time, divided by the number of keyframes, is compared
#: with the budget of a keyframe.
KEYFRAME_STAGES = ("stereo", "f2m", "network", "flow")
#: Key of the row with the total time of `KEYFRAME_STAGES`.
KEYFRAME_WORK = "keyframe"


class StageTime(NamedTuple):
    """Computing time of one stage; a time is None if it is not known."""

    stage: str  #: key of the stage in metrics.json, or `KEYFRAME_WORK`
    n_calls: int  #: number of calls; for `KEYFRAME_WORK` the number of keyframes
    mean_ms: float | None  #: mean duration of a call, for `KEYFRAME_WORK` of the work on a keyframe
    p95_ms: float | None  #: 95th percentile of the duration of a call; None for `KEYFRAME_WORK`
    total_s: float | None  #: total duration of all calls
    budget_ms: float | None  #: largest allowed mean duration; None without a budget

    @property
    def within_budget(self) -> bool | None:
        """Returns whether the mean duration is within the budget; None without a mean or a budget."""
        return None if self.mean_ms is None or self.budget_ms is None else self.mean_ms <= self.budget_ms


def stage_times(
    metrics: Mapping[str, Any], scenario: Mapping[str, Any], n_frames_per_keyframe: int | None
) -> list[StageTime]:
    """Returns the computing time of every stage and, as the last item, of all keyframe work.

    Args:
        metrics: contents of metrics.json.
        scenario: contents of the scenario file, of which rig.frame_rate_hz and control.hold_s are used.
        n_frames_per_keyframe: frames from one keyframe to the next; None if unknown.
    """
    timing = metrics.get("timing") or {}
    stages = timing.get("stages") or {}
    rate_hz = scenario.get("rig", {}).get("frame_rate_hz")
    hold_s = scenario.get("control", {}).get("hold_s")
    budgets_ms = {"f2f": 1e3 / rate_hz if rate_hz else None, "ga": 1e3 * hold_s if hold_s else None}
    keyframe_ms = 1e3 * n_frames_per_keyframe / rate_hz if n_frames_per_keyframe and rate_hz else None
    rows = [
        StageTime(name, row["count"], row["mean_ms"], row["p95_ms"], row["total_s"], budgets_ms.get(name))
        for name, row in stages.items()
    ]
    work_s = sum(stages.get(name, {}).get("total_s") or 0.0 for name in KEYFRAME_STAGES)
    n_keyframes = timing.get("keyframes") or 0
    mean_ms = 1e3 * work_s / n_keyframes if n_keyframes else None
    return [*rows, StageTime(KEYFRAME_WORK, n_keyframes, mean_ms, None, work_s, keyframe_ms)]
