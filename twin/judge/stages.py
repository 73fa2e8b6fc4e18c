"""Keyframe errors after each positioning stage: F2F, chain of links, online estimate, final alignment."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core.links import Links
from twin.core.records import Array, SurveyResult, Trajectory, Truth
from twin.judge.links import linked_nodes, node_distance
from twin.judge.summary_statistics import finite_float, rms
from twin.judge.trajectory import path_errors

#: Positioning stages in the order in which they are applied.
STAGES = ("f2f", "chain", "online", "final")


class StageError(NamedTuple):
    """Keyframe error after one positioning stage.

    Args:
        stage: one of `STAGES`.
        rmse_m: RMS position error [m].
        gain: error of the preceding stage that has one / error of this stage; None if there is no such stage or an
            error is 0.
    """

    stage: str
    rmse_m: float
    gain: float | None


def stage_metrics(result: SurveyResult, truth: Truth) -> dict[str, dict[str, float | None]]:
    """Returns `stages` of metrics.json: position errors of the same network nodes after each positioning stage.

    All stages are anchored at the first node.
    """
    nodes = linked_nodes(result.links)
    frames = result.keyframe_rows[nodes]
    paths = {name: getattr(result, name).world_from_camera[frames] for name in ("f2f", "online", "final")}
    paths["chain"] = compose_chain(result.links, nodes)
    true = Trajectory(truth.trajectory.times_s[frames], truth.trajectory.world_from_camera[frames])
    return {stage: _errors(Trajectory(true.times_s, paths[stage]), true) for stage in STAGES}


def compose_chain(links: Links, nodes: NDArray[np.int64]) -> Array:
    """Returns the poses (n, 4, 4) of the nodes relative to the first, by composing the links of consecutive nodes.

    Returns an empty array (0, 4, 4) if a link between consecutive nodes is missing, and one identity matrix (1, 4, 4)
    without nodes.
    """
    chain = links.select(node_distance(links, nodes) == 1)
    motions = dict(zip(zip(chain.i.tolist(), chain.j.tolist(), strict=True), chain.i_from_j, strict=True))
    poses = [np.eye(4)]
    for pair in pairwise(nodes.tolist()):
        if pair not in motions:
            return np.zeros((0, 4, 4))
        poses.append(poses[-1] @ motions[pair])
    return np.array(poses)


def stage_errors(metrics: Mapping[str, Any]) -> list[StageError]:
    """Returns the positioning stages of metrics.json that have an error, each with its gain over the preceding one."""
    rows: list[StageError] = []
    for stage in STAGES:
        rmse_m = ((metrics.get("stages") or {}).get(stage) or {}).get("ate_rmse_m")
        if rmse_m is not None:
            before_m = rows[-1].rmse_m if rows else None
            rows.append(StageError(stage, rmse_m, before_m / rmse_m if before_m and rmse_m else None))
    return rows


def _errors(path: Trajectory, true: Trajectory) -> dict[str, float | None]:
    """Returns RMS and largest position error [m]; both are None if the two paths differ in their number of poses."""
    complete = len(path.world_from_camera) == len(true)
    distance_m = path_errors(path, true).distance_m if complete else np.zeros(0)
    return {"ate_rmse_m": rms(distance_m), "ate_max_m": finite_float(distance_m.max()) if len(distance_m) else None}
