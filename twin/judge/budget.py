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
    """Computing time of one stage.

    Args:
        stage: key of the stage in metrics.json, or `KEYFRAME_WORK`.
        n_calls: number of calls; for `KEYFRAME_WORK` the number of keyframes.
        mean_ms: mean duration of a call, for `KEYFRAME_WORK` of the work on a keyframe [ms]; None without calls.
        p95_ms: 95th percentile of the duration of a call [ms]; None without calls and for `KEYFRAME_WORK`.
        total_s: total duration of all calls [s].
        budget_ms: largest allowed mean duration [ms]; None if the stage has no budget.
    """

    stage: str
    n_calls: int
    mean_ms: float | None
    p95_ms: float | None
    total_s: float | None
    budget_ms: float | None

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
    rows = [_stage_time(name, row, budgets_ms.get(name)) for name, row in stages.items()]
    keyframe_ms = 1e3 * n_frames_per_keyframe / rate_hz if n_frames_per_keyframe and rate_hz else None
    return [*rows, _keyframe_work(stages, timing.get("keyframes") or 0, keyframe_ms)]


def _stage_time(stage: str, row: Mapping[str, Any], budget_ms: float | None) -> StageTime:
    """Returns the computing time of a stage from its row of `timing.stages` in metrics.json."""
    return StageTime(stage, row["count"], row["mean_ms"], row["p95_ms"], row["total_s"], budget_ms)


def _keyframe_work(stages: Mapping[str, Any], n_keyframes: int, budget_ms: float | None) -> StageTime:
    """Returns the total time of all `KEYFRAME_STAGES` and its mean per keyframe."""
    total_s = sum(stages.get(name, {}).get("total_s") or 0.0 for name in KEYFRAME_STAGES)
    mean_ms = 1e3 * total_s / n_keyframes if n_keyframes else None
    return StageTime(KEYFRAME_WORK, n_keyframes, mean_ms, None, total_s, budget_ms)
