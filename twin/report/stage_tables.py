"""Tables of stages in reports: error after each positioning stage, and computing time of each processing stage.

The times are compared with the real-time budget of Negahdaripour & Madjidi (2003): frame-to-frame motion within one
frame period, all work on a keyframe within the N frame periods up to the next keyframe, and global alignment while the
vehicle keeps station.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

from twin.judge.network_errors import STAGES

#: Display names of the processing stages in metrics.json (`timing.stages`) and of the sum of all keyframe stages.
PROCESSING_STAGES = {
    "physics": "simulator: physics",
    "render": "simulator: rendering",
    "optics": "simulator: water and sensor",
    "f2f": "frame-to-frame motion (F2F)",
    "f2m": "registration with the mosaic (F2M)",
    "stereo": "stereo matching",
    "flow": "optical flow between keyframes",
    "network": "keyframe network",
    "ga": "global alignment (GA)",
    "map": "elevation map",
    "orthomosaic": "orthomosaic",
    "keyframe": "all keyframe processing",
}
#: Stages of the estimators that run at each keyframe.
KEYFRAME_STAGES = ("stereo", "f2m", "network", "flow")
#: Key of the row with the total time of `KEYFRAME_STAGES`, divided by the number of keyframes.
KEYFRAME_WORK = "keyframe"


class StageRow(NamedTuple):
    """One positioning stage."""

    stage: str  # one of `judge.network_errors.STAGES`
    inputs: str  # measurements that the stage uses
    rmse_m: float  # RMS position error of the keyframes
    gain: float | None  # error of the preceding stage / error of this stage; None if one of them is missing or zero
    disabled: str  # note on the corrections that the scenario disables in this stage; "" if there are none


def stage_rows(metrics: Mapping[str, Any], scenario: Mapping[str, Any]) -> list[StageRow]:
    """Returns a row for each positioning stage of metrics.json that has an error."""
    inputs, notes = _inputs(scenario)
    rows: list[StageRow] = []
    for stage in STAGES:
        rmse_m = ((metrics.get("stages") or {}).get(stage) or {}).get("ate_rmse_m")
        if rmse_m is not None:
            before_m = rows[-1].rmse_m if rows else None
            gain = before_m / rmse_m if before_m and rmse_m else None
            rows.append(StageRow(stage, inputs[stage], rmse_m, gain, notes.get(stage, "")))
    return rows


def _inputs(scenario: Mapping[str, Any]) -> tuple[dict[str, str], dict[str, str]]:
    estimate = scenario.get("estimate", {})
    f2m, ga = estimate.get("use_f2m", True), estimate.get("use_ga", True)
    aiding = list(scenario.get("navigation", {}).get("aiding", []))
    inputs = {
        "f2f": "optical flow between frames",
        "chain": "stereo pairs of consecutive keyframes",
        "online": ", ".join(["chain", *(["F2M"] if f2m else []), *aiding, *(["previous GA"] if ga else [])]),
        "final": ", ".join(["all links", *aiding]) if ga else "same as online",
    }
    disabled = {
        "online": " and ".join([*([] if f2m else ["F2M"]), *([] if ga else ["GA"])]),
        "final": "" if ga else "GA",
    }
    return inputs, {stage: f"{parts} disabled" for stage, parts in disabled.items() if parts}


class StageTime(NamedTuple):
    """Computing time of one stage, or of all `KEYFRAME_WORK`; a time is None if it is not known."""

    stage: str  #: key of the stage in metrics.json, or `KEYFRAME_WORK`
    n_calls: int  #: number of calls; for `KEYFRAME_WORK` the number of keyframes
    mean_ms: float | None  #: mean duration of a call, for `KEYFRAME_WORK` of the work on a keyframe
    p95_ms: float | None  #: 95th percentile of the duration of a call; None for `KEYFRAME_WORK`
    total_s: float | None  #: total duration of all calls
    budget_ms: float | None  #: largest allowed mean duration; None without a budget

    @property
    def within_budget(self) -> bool | None:
        return None if self.mean_ms is None or self.budget_ms is None else self.mean_ms <= self.budget_ms


def stage_times(
    metrics: Mapping[str, Any], scenario: Mapping[str, Any], n_frames_per_keyframe: int | None
) -> list[StageTime]:
    """Returns the computing times of all stages and, as the last item, of all keyframe work, from metrics.json."""
    timing = metrics.get("timing") or {}
    stages = timing.get("stages") or {}
    rate_hz = scenario.get("rig", {}).get("frame_rate_hz")
    hold_s = scenario.get("control", {}).get("hold_s")
    budgets_ms = {"f2f": 1e3 / rate_hz if rate_hz else None, "ga": 1e3 * hold_s if hold_s else None}
    keyframe_ms = 1e3 * n_frames_per_keyframe / rate_hz if n_frames_per_keyframe and rate_hz else None
    rows = [
        StageTime(name, get("count"), get("mean_ms"), get("p95_ms"), get("total_s"), budgets_ms.get(name))
        for name, get in ((name, row.get) for name, row in stages.items())
    ]
    work_s = sum(stages.get(name, {}).get("total_s") or 0.0 for name in KEYFRAME_STAGES)
    n_keyframes = timing.get("keyframes") or 0
    mean_ms = 1e3 * work_s / n_keyframes if n_keyframes else None
    return [*rows, StageTime(KEYFRAME_WORK, n_keyframes, mean_ms, None, work_s, keyframe_ms)]
