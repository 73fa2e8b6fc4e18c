"""The paper's processing budget: frame-to-frame within a frame, keyframe work within N frames (P26)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

#: Stages of the estimators at a keyframe; the others are the simulator's or come after the survey.
KEY_POINT_STAGES = ("stereo", "f2m", "network", "flow")
STAGE_LABELS = {
    "physics": "simulator: physics",
    "render": "simulator: rendering",
    "optics": "simulator: water and sensor",
    "f2f": "frame to frame",
    "f2m": "frame to mosaic",
    "stereo": "stereo",
    "flow": "flow between keyframes",
    "network": "network",
    "ga": "global alignment",
    "map": "elevation map",
}


class BudgetRow(NamedTuple):
    """Time of a stage or of all keyframe work: mean and p95 of a call [ms], total [s], what it may take [ms]."""

    what: str
    n_calls: int
    mean_ms: float | None
    p95_ms: float | None
    total_s: float | None
    budget_ms: float | None

    @property
    def within(self) -> bool | None:
        return None if self.mean_ms is None or self.budget_ms is None else self.mean_ms <= self.budget_ms


def budget(
    metrics: Mapping[str, Any], scenario: Mapping[str, Any], n_frames_per_keyframe: int | None
) -> list[BudgetRow]:
    """Stages with the paper's budget: F2F 1 / frame rate, keyframe work N / frame rate, GA the station keeping."""
    timing = metrics.get("timing") or {}
    stages = timing.get("stages") or {}
    rate_hz = scenario.get("rig", {}).get("frame_rate_hz")
    hold_s = scenario.get("control", {}).get("hold_s")
    limits = {"f2f": 1e3 / rate_hz if rate_hz else None, "ga": 1e3 * hold_s if hold_s else None}
    rows = [_row(STAGE_LABELS[name], row, limits.get(name)) for name, row in stages.items()]
    keyframe_ms = 1e3 * n_frames_per_keyframe / rate_hz if n_frames_per_keyframe and rate_hz else None
    return [*rows, _keyframe_work(stages, timing.get("keyframes") or 0, keyframe_ms)]


def _row(label: str, row: Mapping[str, Any], limit_ms: float | None) -> BudgetRow:
    return BudgetRow(label, row["count"], row["mean_ms"], row["p95_ms"], row["total_s"], limit_ms)


def _keyframe_work(stages: Mapping[str, Any], n_keyframes: int, limit_ms: float | None) -> BudgetRow:
    total_s = sum(stages.get(name, {}).get("total_s") or 0.0 for name in KEY_POINT_STAGES)
    return BudgetRow(
        "all work at a keyframe",
        n_keyframes,
        1e3 * total_s / n_keyframes if n_keyframes else None,
        None,
        total_s,
        limit_ms,
    )
