"""metrics.json: every figure of a survey, complete also where the survey is not."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from twin.core.records import ElevationMap, StereoRig, SurveyResult, Trajectory, Truth
from twin.core.timing import Stopwatch
from twin.judge.alignment import track_metrics
from twin.judge.consistency import consistency_metrics
from twin.judge.control import control_metrics
from twin.judge.links import link_metrics
from twin.judge.map_error import map_metrics
from twin.judge.overlap import overlap_metrics
from twin.judge.require import check_names, judge_requirements
from twin.judge.stages import stage_metrics
from twin.judge.stereo_quality import stereo_quality
from twin.judge.summary_statistics import finite_tree, number
from twin.judge.trajectory import path_errors, trajectory_metrics

SCHEMA = "twin.metrics/1"


def evaluate(
    result: SurveyResult,
    elevation: ElevationMap | None,
    truth: Truth,
    rig: StereoRig,
    plan_numbers: Mapping[str, Any],
    timing: Mapping[str, Any],
    identity: Mapping[str, Any],
    require: Mapping[str, float] | None = None,
) -> dict[str, Any]:
    """All of metrics.json (DESIGN.md), None where there is nothing to judge, never NaN.

    Args:
        plan_numbers: pattern, overlap_along and overlap_across of the plan.
        timing: wall_s, simulated_s, peak_rss_mb and the stages' summary (`Stopwatch.summary`).
        identity: name, seed, version, scenario_hash, status ("complete" or "aborted"), reason and
            warning: what to beware of ("" if nothing).
        require: limit for each named metric, e.g. {"map.le90_m": 0.05}.

    Raises:
        TwinError: `require` names a metric that does not exist.
    """
    result = _flown(result, truth)
    paths = {"f2f": result.f2f, "online": result.online, "final": result.final}
    grid = elevation.grid if elevation else None
    metrics = {
        "schema": SCHEMA,
        **{
            key: identity.get(key)
            for key in ("name", "seed", "version", "scenario_hash", "status", "reason", "warning")
        },
        "trajectory": {k: trajectory_metrics(path_errors(p, truth.trajectory)) for k, p in paths.items()},
        "tracks": track_metrics(result, truth),
        "map": map_metrics(elevation, truth),
        "consistency": consistency_metrics(result, elevation, truth),
        "links": link_metrics(result, truth),
        "vision": stereo_quality(result),
        "stages": stage_metrics(result, truth),
        "control": control_metrics(truth),
        "overlap": overlap_metrics(result, truth, rig, grid, dict(plan_numbers)),
        "timing": _timing(timing, len(result.online), len(result.keyframe_rows)),
    }
    metrics = finite_tree(metrics)
    return metrics | {"require": judge_requirements(require or {}, metrics)}


def _flown(result: SurveyResult, truth: Truth) -> SurveyResult:
    """Without a keyframe whose frame an interruption left unrecorded."""
    n_frames = min(len(result.online), len(result.final), len(truth.trajectory), len(truth.reference))
    n = int(np.searchsorted(result.keyframe_rows, n_frames))
    return replace(
        result,
        keyframe_rows=result.keyframe_rows[:n],
        track_of_keyframe=result.track_of_keyframe[:n],
        node_cov=result.node_cov[:n],
        links=result.links.kept(result.links.j < n),
        stereo_observations=[look for look in result.stereo_observations if look.row < n_frames],
    )


def check_require(names: Mapping[str, float]) -> None:
    """Refuses unknown metrics in `[require]` before the survey is flown. Raises TwinError."""
    check_names(names, unflown())


def unflown() -> dict[str, Any]:
    """metrics.json of a survey that never began: all keys, no figures."""
    none = Trajectory(np.zeros(0), np.zeros((0, 4, 4)))
    no_keyframes = np.zeros(0, dtype=np.int64)
    result = SurveyResult(none, none, none, no_keyframes, no_keyframes, np.zeros((0, 6, 6)))
    empty = np.zeros((0, 0))
    truth = Truth(none, np.zeros((0, 3)), np.zeros(0, bool), no_keyframes, empty.astype(np.float32), empty.astype(bool))
    rig = StereoRig(1, 1, 1.0, 1.0, 1.0, np.eye(4))
    return evaluate(result, None, truth, rig, {}, {"stages": Stopwatch().summary()}, {})


def _timing(timing: Mapping[str, Any], n_frames: int, n_keyframes: int) -> dict[str, Any]:
    wall, simulated = timing.get("wall_s"), timing.get("simulated_s")
    return {
        "wall_s": number(wall),
        "simulated_s": number(simulated),
        "real_time_factor": number(simulated / wall) if wall and simulated is not None else None,
        "frames": n_frames,
        "keyframes": n_keyframes,
        "peak_rss_mb": number(timing.get("peak_rss_mb")),
        "stages": {name: dict(row) for name, row in timing.get("stages", {}).items()},
    }
