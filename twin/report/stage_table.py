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
    notes = {stage: f"{parts} disabled" for stage, parts in disabled.items() if parts}
    return [
        StageRow(row.stage, inputs[row.stage], row.rmse_m, row.gain, notes.get(row.stage, ""))
        for row in stage_errors(metrics)
    ]
