"""Table of the positioning stages: inputs, error, gain over the preceding stage, and disabled corrections."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from twin.judge.network_errors import stage_errors


class StageRow(NamedTuple):
    """One positioning stage in the report."""

    stage: str  # key of the stage
    inputs: str  # measurements that the stage uses
    rmse_m: float  # RMS position error of the keyframes [m]
    gain: float | None  # error of the preceding stage / error of this stage; None if one of them is missing or zero
    disabled: str  # note on the corrections that the scenario disables in this stage; "" if there are none


def stage_rows(metrics: Mapping[str, Any], scenario: Mapping[str, Any]) -> list[StageRow]:
    """Returns a row for each positioning stage of metrics.json that has an error."""
    return [
        StageRow(row.stage, _inputs(row.stage, scenario), row.rmse_m, row.gain, _disabled(row.stage, scenario))
        for row in stage_errors(metrics)
    ]


def _inputs(stage: str, scenario: Mapping[str, Any]) -> str:
    """Returns the measurements that a stage uses in this scenario."""
    aiding = list(scenario.get("navigation", {}).get("aiding", []))
    enabled = _enabled(scenario)
    f2m, ga = ["F2M"] if enabled["F2M"] else [], ["previous GA"] if enabled["GA"] else []
    return {
        "f2f": "optical flow between frames",
        "chain": "stereo pairs of consecutive keyframes",
        "online": ", ".join(["chain", *f2m, *aiding, *ga]),
        "final": ", ".join(["all links", *aiding]) if enabled["GA"] else "same as online",
    }[stage]


def _disabled(stage: str, scenario: Mapping[str, Any]) -> str:
    """Returns a note such as "F2M disabled" on the parts of a stage that the scenario disables; "" if none."""
    parts = {"online": ("F2M", "GA"), "final": ("GA",)}.get(stage, ())
    disabled = [part for part in parts if not _enabled(scenario)[part]]
    return f"{' and '.join(disabled)} disabled" if disabled else ""


def _enabled(scenario: Mapping[str, Any]) -> dict[str, bool]:
    """Returns whether the scenario enables F2M and GA."""
    estimate = scenario.get("estimate", {})
    return {"F2M": estimate.get("use_f2m", True), "GA": estimate.get("use_ga", True)}
