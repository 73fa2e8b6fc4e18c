"""What each stage of positioning bought: the error of the same keyframes after one stage and after the next."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core.links import Links
from twin.core.records import Array, SurveyResult, Trajectory, Truth
from twin.judge.links import node_numbers, steps_back
from twin.judge.summary_statistics import number, rms
from twin.judge.trajectory import path_errors

#: In the order in which they correct one another.
STAGES = ("f2f", "chain", "online", "final")


class StageRow(NamedTuple):
    """A stage in the report: its key, what it works from, its error [m], by what factor that is less than before.

    ``off`` names what the scenario switched off in it ("" for nothing).
    """

    stage: str
    uses: str
    rmse_m: float | None
    gain: float | None
    off: str


def stage_metrics(result: SurveyResult, truth: Truth) -> dict[str, dict[str, float | None]]:
    """`stages` of metrics.json: position errors of the network's nodes after each stage, anchored at the first node."""
    nodes = node_numbers(result.links)
    frames = result.keyframe_rows[nodes]
    paths = {name: getattr(result, name).world_from_camera[frames] for name in ("f2f", "online", "final")}
    paths["chain"] = compose_chain(result.links, nodes)
    true = Trajectory(truth.trajectory.times_s[frames], truth.trajectory.world_from_camera[frames])
    return {stage: _errors(Trajectory(true.times_s, paths[stage]), true) for stage in STAGES}


def compose_chain(links: Links, nodes: NDArray[np.int64]) -> Array:
    """Poses (n, 4, 4) of the nodes in the first one by the motions from each to the next; none if one is missing."""
    chain = links.kept(steps_back(links, nodes) == 1)
    motions = dict(zip(zip(chain.i.tolist(), chain.j.tolist(), strict=True), chain.i_from_j, strict=True))
    poses = [np.eye(4)]
    for step in pairwise(nodes.tolist()):
        if step not in motions:
            return np.zeros((0, 4, 4))
        poses.append(poses[-1] @ motions[step])
    return np.array(poses)


def _errors(path: Trajectory, true: Trajectory) -> dict[str, float | None]:
    whole = len(path.world_from_camera) == len(true)
    distance_m = path_errors(path, true).distance_m if whole else np.zeros(0)
    return {"ate_rmse_m": rms(distance_m), "ate_max_m": number(distance_m.max()) if len(distance_m) else None}


def stage_rows(metrics: Mapping[str, Any], scenario: Mapping[str, Any]) -> list[StageRow]:
    """The stages that have an error, each with its gain over the one before; none of a run judged before there were."""
    rows: list[StageRow] = []
    for stage in STAGES:
        rmse_m = ((metrics.get("stages") or {}).get(stage) or {}).get("ate_rmse_m")
        if rmse_m is not None:
            before_m = rows[-1].rmse_m if rows else None
            gain = before_m / rmse_m if before_m and rmse_m else None
            rows.append(StageRow(stage, _uses(stage, scenario), rmse_m, gain, _off(stage, scenario)))
    return rows


def _uses(stage: str, scenario: Mapping[str, Any]) -> str:
    """What a stage of this scenario works from."""
    aiding = list(scenario.get("navigation", {}).get("aiding", []))
    on = _switches(scenario)
    online = ["chain", *(["mosaic (F2M)"] if on["F2M"] else []), *aiding, *(["GA so far"] if on["GA"] else [])]
    return {
        "f2f": "flow from frame to frame",
        "chain": "stereo pairs of consecutive keyframes",
        "online": ", ".join(online),
        "final": ", ".join(["all links", *aiding]) if on["GA"] else "as online",
    }[stage]


def _off(stage: str, scenario: Mapping[str, Any]) -> str:
    concerned = {"online": ("F2M", "GA"), "final": ("GA",)}.get(stage, ())
    off = [name for name in concerned if not _switches(scenario)[name]]
    return f"{' and '.join(off)} switched off" if off else ""


def _switches(scenario: Mapping[str, Any]) -> dict[str, bool]:
    estimate = scenario.get("estimate", {})
    return {"F2M": estimate.get("use_f2m", True), "GA": estimate.get("use_ga", True)}
