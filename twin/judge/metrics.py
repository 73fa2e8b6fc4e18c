"""Contents of metrics.json: all metrics of a survey, with the same keys for complete and aborted surveys."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from twin.core.quality import ActionTimes
from twin.core.records import ElevationMap, StereoRig, SurveyResult, Trajectory, Truth
from twin.core.timing import Stopwatch
from twin.judge import orthomosaic
from twin.judge.alignment import track_metrics
from twin.judge.consistency import consistency_metrics
from twin.judge.control import control_metrics
from twin.judge.links import link_metrics
from twin.judge.map_error import map_metrics
from twin.judge.overlap import overlap_metrics
from twin.judge.require import check_metric_names, judge_requirements
from twin.judge.self_check import self_check_metrics
from twin.judge.stages import stage_metrics
from twin.judge.stereo_quality import stereo_quality
from twin.judge.summary_statistics import finite_float, finite_tree
from twin.judge.trajectory import path_errors, trajectory_metrics
from twin.judge.warnings import metric_warnings

SCHEMA = "twin.metrics/2"
_IDENTITY = ("name", "seed", "version", "scenario_hash", "status", "reason")

_VERDICTS = ("warnings", "warning", "idealisations")  # keys whose values `_judged` sets; None before


@dataclass(frozen=True)
class EvaluationInput:
    """Input of `evaluate`: a survey and its truth.

    Args:
        result: output of the estimators.
        elevation: elevation map; None if none was built.
        truth: true trajectory and floor, and the reference path.
        rig: calibration that the estimators use.
        plan: pattern, requested and forecast overlaps of the plan: the argument `planned` of `overlap_metrics`.
        timing: wall_s, simulated_s, peak_rss_mb, and stages as `Stopwatch.summary` returns them.
        identity: name, seed, version, scenario_hash, status ("complete", "degraded" or "aborted"), and reason, the
            reason for the status ("" if it is "complete").
        require: limit of each required metric, e.g. {"map.le90_m": 0.05}.
        warnings: sentences on limits of the simulation, such as a surrogate used outside the range of its fit.
        idealisations: sentences on effects of a real survey that the scenario leaves out, such as calibration errors.
        actions: durations for which the mission slowed and stopped the vehicle because visual measurements failed.
        orthomosaic: errors of the orthomosaic (`OrthomosaicJudge.metrics`); None if none was made.
    """

    result: SurveyResult
    elevation: ElevationMap | None
    truth: Truth
    rig: StereoRig
    plan: Mapping[str, Any] = field(default_factory=dict)
    timing: Mapping[str, Any] = field(default_factory=dict)
    identity: Mapping[str, Any] = field(default_factory=dict)
    require: Mapping[str, float] = field(default_factory=dict)
    warnings: Sequence[str] = ()
    idealisations: Sequence[str] = ()
    actions: ActionTimes = ActionTimes()
    orthomosaic: Mapping[str, float | None] | None = None


def evaluate(survey: EvaluationInput) -> dict[str, Any]:
    """Returns the contents of metrics.json. A value that cannot be computed is None, never NaN.

    Raises:
        TwinError: `require` names a metric that does not exist.
    """
    result, truth, elevation = _completed(survey.result, survey.truth), survey.truth, survey.elevation
    paths = {"f2f": result.f2f, "online": result.online, "final": result.final}
    grid = elevation.grid if elevation else None
    metrics = {
        "schema": SCHEMA,
        **{key: survey.identity.get(key) for key in _IDENTITY},
        **dict.fromkeys(_VERDICTS),
        "trajectory": {k: trajectory_metrics(path_errors(p, truth.trajectory)) for k, p in paths.items()},
        "tracks": track_metrics(result, truth),
        "map": map_metrics(elevation, truth),
        "orthomosaic": dict(survey.orthomosaic or dict.fromkeys(orthomosaic.KEYS)),
        "consistency": consistency_metrics(result, elevation, truth),
        "links": link_metrics(result, truth),
        "vision": stereo_quality(result),
        "self_check": self_check_metrics(result),
        "stages": stage_metrics(result, truth),
        "control": control_metrics(truth) | survey.actions._asdict(),
        "overlap": overlap_metrics(result, truth, survey.rig, grid, dict(survey.plan)),
        "timing": timing_metrics(survey.timing, len(result.online), len(result.keyframe_rows)),
    }
    return _judged(finite_tree(metrics), survey)


def _judged(metrics: dict[str, Any], survey: EvaluationInput) -> dict[str, Any]:
    """Returns the metrics with `warnings`, `warning` (all warnings as one text), `idealisations` and `require`."""
    warnings = [*survey.warnings, *metric_warnings(metrics)]
    verdicts = {"warnings": warnings, "warning": " ".join(warnings), "idealisations": list(survey.idealisations)}
    return metrics | verdicts | {"require": judge_requirements(survey.require, metrics)}


def unevaluated(survey: EvaluationInput) -> dict[str, Any]:
    """Returns the metrics of a survey that was not compared with the truth.

    They hold schema, identity, timing, warnings, idealisations and requirements; all other metrics are None, 0 or
    empty. A requirement on a metric that is None fails.

    Raises:
        TwinError: `require` names a metric that does not exist.
    """
    result, known = survey.result, {key: survey.identity.get(key) for key in _IDENTITY}
    timing = timing_metrics(survey.timing, len(result.online), len(result.keyframe_rows))
    return _judged(empty_metrics() | finite_tree(known | {"timing": timing}), survey)


def _completed(result: SurveyResult, truth: Truth) -> SurveyResult:
    """Returns the result without keyframes, links and stereo observations of frames that are not fully recorded.

    A frame is fully recorded if it has an online and a final estimate, a true pose and a reference position; the last
    frames of an aborted survey may lack some of these.
    """
    n_frames = min(len(result.online), len(result.final), len(truth.trajectory), len(truth.reference))
    n = int(np.searchsorted(result.keyframe_rows, n_frames))
    observations = [observation for observation in result.stereo_observations if observation.row < n_frames]
    return replace(
        result,
        keyframe_rows=result.keyframe_rows[:n],
        track_of_keyframe=result.track_of_keyframe[:n],
        node_cov=result.node_cov[:n],
        keyframe_depth_m=result.keyframe_depth_m[:n],
        links=result.links.select(result.links.j < n),
        stereo_observations=observations,
    )


def check_require(names: Mapping[str, float]) -> None:
    """Checks before the survey that every name in the scenario's `[require]` table is a metric.

    Raises:
        TwinError: a name is not a metric.
    """
    check_metric_names(names, empty_metrics())


def empty_metrics() -> dict[str, Any]:
    """Returns the metrics of a survey without frames: all keys, with values None, 0 or empty, except the schema."""
    none = Trajectory(np.zeros(0), np.zeros((0, 4, 4)))
    no_keyframes = np.zeros(0, dtype=np.int64)
    result = SurveyResult(none, none, none, no_keyframes, no_keyframes, np.zeros((0, 6, 6)))
    empty = np.zeros((0, 0))
    cells = empty.astype(np.float32), empty.astype(bool), empty.astype(bool)
    truth = Truth(none, np.zeros((0, 3)), np.zeros(0, bool), no_keyframes, *cells)
    rig = StereoRig(1, 1, 1.0, 1.0, 1.0, np.eye(4))
    return evaluate(EvaluationInput(result, None, truth, rig, timing={"stages": Stopwatch().summary()}))


def timing_metrics(timing: Mapping[str, Any], n_frames: int, n_keyframes: int) -> dict[str, Any]:
    """Returns `timing` of metrics.json: times, real-time factor, numbers of frames and keyframes, memory, and stages.

    Args:
        timing: `EvaluationInput.timing`.
        n_frames, n_keyframes: number of frames and of keyframes.
    """
    wall, simulated = timing.get("wall_s"), timing.get("simulated_s")
    return {
        "wall_s": finite_float(wall),
        "simulated_s": finite_float(simulated),
        "real_time_factor": finite_float(simulated / wall) if wall and simulated is not None else None,
        "frames": n_frames,
        "keyframes": n_keyframes,
        "peak_rss_mb": finite_float(timing.get("peak_rss_mb")),
        "stages": {name: dict(row) for name, row in timing.get("stages", {}).items()},
    }
