"""Contents of metrics.json: all metrics of a survey, with the same keys for complete and aborted surveys."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core.quality import ActionTimes, Energy, Gaps
from twin.core.records import ElevationMap, StereoRig, SurveyResult, Trajectory, Truth
from twin.core.timing import Stopwatch
from twin.judge.consistency import consistency_metrics
from twin.judge.map_error import errors_by_cause, map_metrics
from twin.judge.network_errors import NETWORK_KEYS, link_metrics, network_residuals, stage_metrics
from twin.judge.orthomosaic_errors import OrthomosaicJudge
from twin.judge.recorded import (
    RecordedTruth,
    associate,
    in_world,
    recorded_consistency,
    recorded_errors,
    recorded_map_metrics,
    truth_warnings,
    truth_without_flight,
)
from twin.judge.summary_statistics import finite_float, finite_tree
from twin.judge.survey_quality import self_check_metrics, stereo_quality
from twin.judge.swaths import control_metrics, overlap_metrics
from twin.judge.trajectory_errors import path_errors, track_metrics, trajectory_metrics
from twin.judge.verdict import check_metric_names, judge_requirements, metric_warnings

SCHEMA = "twin.metrics/2"
#: `replay` of a replay that was not evaluated, besides the description of its data set.
_NOT_COMPARED = {"alignment": None, "frames_with_truth": 0, "network": dict.fromkeys(NETWORK_KEYS)}
_IDENTITY = ("name", "seed", "version", "scenario_hash", "status", "reason")


class SurveyedTask(NamedTuple):
    """Task of a survey with its map."""

    name: str
    track: int  #: number of its track, from 1
    elevation: ElevationMap | None  #: map from the keyframes of its track
    truth: Truth  #: truth at the cells of this map
    in_area: NDArray[np.bool_]  #: (rows, cols) cells of the map of the area that lie in the asked part of the task


@dataclass(frozen=True)
class EvaluationInput:
    """Input of `evaluate`: a survey and its truth. A replay has a recorded truth and a description of its data set."""

    result: SurveyResult  #: output of the estimators
    elevation: ElevationMap | None  #: elevation map; None if none was built
    truth: Truth | RecordedTruth  #: true trajectory and floor, and the reference path of a simulated survey
    rig: StereoRig  #: calibration that the estimators use
    #: pattern, requested and forecast overlaps of the plan: the argument `planned` of `overlap_metrics`.
    plan: Mapping[str, Any] = field(default_factory=dict)
    #: wall_s, simulated_s, peak_rss_mb, and stages as `Stopwatch.summary` returns them.
    timing: Mapping[str, Any] = field(default_factory=dict)
    #: name, seed, version, scenario_hash, status ("complete", "degraded" or "aborted"), and reason, the reason for the
    #: status ("" if it is "complete").
    identity: Mapping[str, Any] = field(default_factory=dict)
    require: Mapping[str, float] = field(default_factory=dict)  #: limits of metrics, e.g. {"map.le90_m": 0.05}
    warnings: Sequence[str] = ()  #: sentences on limits of the simulation or the data set
    idealisations: Sequence[str] = ()  #: sentences on effects of a real survey that the scenario leaves out
    water: Mapping[str, float] = field(default_factory=dict)  #: visibility_m and secchi_m of a survey
    stated_input: Mapping[str, Any] = field(default_factory=dict)  #: input statement of the files of the floor
    actions: ActionTimes = ActionTimes()  #: durations for which the mission slowed and stopped the vehicle
    gaps: Gaps = Gaps()
    energy: Energy = Energy()
    tasks: Sequence[SurveyedTask] = ()
    orthomosaic: Mapping[str, float | None] | None = None  #: `OrthomosaicJudge.metrics`; None if none was made
    #: description of the data set of a replay (reader, number of skipped frames by reason, etc.); None for a survey.
    source: Mapping[str, Any] | None = None


def evaluate(survey: EvaluationInput) -> dict[str, Any]:
    """Returns the contents of metrics.json. A value that cannot be computed is None, never NaN.

    The metrics of a replay that need more than its recorded truth are None, 0 or empty; its key `replay` holds the
    description of the data set, the alignment, the number of frames with a true pose, and `network_residuals`. Raises
    TwinError if `require` names a metric that does not exist.
    """
    if isinstance(survey.truth, Truth):
        return _contents(survey, _sections(survey, survey.truth))
    path = survey.truth.trajectory
    warnings = [] if path is None else truth_warnings(survey.result.final, path)
    return _contents(survey, _replay_sections(survey, survey.truth), warnings)


def unevaluated(survey: EvaluationInput) -> dict[str, Any]:
    """Returns the metrics of a survey that was not compared with the truth; raises TwinError like `evaluate`.

    They hold schema, identity, timing, description of the data set, warnings, idealisations and requirements; all other
    metrics are None, 0 or empty. A requirement on a metric that is None fails.
    """
    return _contents(survey, {})


def _contents(survey: EvaluationInput, sections: dict[str, Any], warnings: Sequence[str] = ()) -> dict[str, Any]:
    """Returns metrics.json with some evaluated sections and more warnings; all other sections are None, 0 or empty."""
    known = {key: survey.identity.get(key) for key in _IDENTITY}
    known["timing"] = _timing(survey.timing, len(survey.result.online), len(survey.result.keyframe_rows))
    if survey.source is not None:
        known["replay"] = dict(survey.source) | sections.pop("replay", _NOT_COMPARED)
    metrics = empty_metrics() | finite_tree(known | sections)
    found = [*survey.warnings, *warnings, *metric_warnings(metrics)]
    return metrics | {
        "warnings": found,
        "warning": " ".join(found),
        "idealisations": list(survey.idealisations),
        "water": metrics["water"] | finite_tree(dict(survey.water)),
        "input": finite_tree(dict(survey.stated_input)),
        "require": judge_requirements(survey.require, metrics),
    }


def _sections(survey: EvaluationInput, truth: Truth) -> dict[str, Any]:
    result, elevation = _completed(survey.result, truth), survey.elevation
    grid = None if elevation is None else elevation.grid
    return {
        "trajectory": {k: trajectory_metrics(path_errors(p, truth.trajectory)) for k, p in _paths(result).items()},
        "tracks": track_metrics(result, truth),
        "map": map_metrics(elevation, truth),
        "orthomosaic": dict(survey.orthomosaic or OrthomosaicJudge(False).metrics()),
        "consistency": consistency_metrics(result, elevation, truth),
        "links": link_metrics(result, truth),
        "vision": stereo_quality(result),
        "self_check": self_check_metrics(result),
        "stages": stage_metrics(result, truth),
        "control": control_metrics(truth) | survey.actions._asdict(),
        "gaps": survey.gaps._asdict(),
        "energy": survey.energy._asdict(),
        "tasks": [task_metrics(task, result, elevation, truth) for task in survey.tasks],
        "overlap": overlap_metrics(result, truth, survey.rig, grid, survey.plan),
    }


def task_metrics(
    task: SurveyedTask, result: SurveyResult, elevation: ElevationMap | None, truth: Truth
) -> dict[str, Any]:
    """Returns an item of `tasks[]` of metrics.json.

    The keys of `map.*` are those of the map of the task; area_map_le90_m is LE90 of the map of the area over the same
    ground. error_before_m and error_after_m are the errors of the online position at the frames before the first and
    after the last frame of its track: at the place where the survey was broken off.
    """
    error_m, frames = path_errors(result.online, truth.trajectory).distance_m, np.flatnonzero(truth.track == task.track)
    there = replace(truth, seen=truth.seen & task.in_area, asked=truth.asked & task.in_area)
    return {
        "name": task.name,
        "track": task.track,
        **map_metrics(task.elevation, task.truth),
        "area_map_le90_m": map_metrics(elevation, there)["le90_m"],
        "error_before_m": _at(error_m, int(frames[0]) - 1) if len(frames) else None,
        "error_after_m": _at(error_m, int(frames[-1])) if len(frames) else None,
    }


def _at(error_m: NDArray[np.float64], frame: int) -> float | None:
    return float(error_m[frame]) if 0 <= frame < len(error_m) else None


def _replay_sections(survey: EvaluationInput, truth: RecordedTruth) -> dict[str, Any]:
    result, elevation, empty, true = survey.result, survey.elevation, empty_metrics(), truth.trajectory
    true = None if true is None else in_world(true, result.final, truth.alignment)  # axes of errors as in the report
    errors = {} if true is None else {k: recorded_errors(p, true, truth.alignment) for k, p in _paths(result).items()}
    heights = {} if elevation is None else {"cell_m": elevation.grid.cell_m} | errors_by_cause(elevation)
    if elevation is not None and truth.heights_m is not None:
        heights = recorded_map_metrics(elevation, truth.heights_m)
    judged = {} if true is None else recorded_consistency(result, true, truth.alignment)
    return {
        "consistency": empty["consistency"] | judged,
        "trajectory": empty["trajectory"] | {name: trajectory_metrics(error) for name, error in errors.items()},
        "map": empty["map"] | heights,
        "links": empty["links"] | {"bridged": int((result.links.n_points == 0).sum())},
        "vision": stereo_quality(result),
        "self_check": self_check_metrics(result),
        "replay": {
            "alignment": None if true is None else truth.alignment,
            "frames_with_truth": 0 if true is None else len(associate(result.final.times_s, true.times_s).truth),
            "network": network_residuals(result),
        },
    }


def _paths(result: SurveyResult) -> dict[str, Trajectory]:
    return {"f2f": result.f2f, "online": result.online, "final": result.final}


def _completed(result: SurveyResult, truth: Truth) -> SurveyResult:
    """Returns the result without frames that are not fully recorded, as the last ones of an aborted survey may be."""
    n_frames = min(len(result.online), len(result.final), len(truth.trajectory), len(truth.reference))
    n = int(np.searchsorted(result.keyframe_rows, n_frames))
    return replace(
        result, keyframe_rows=result.keyframe_rows[:n], track_of_keyframe=result.track_of_keyframe[:n],
        node_cov=result.node_cov[:n], keyframe_depth_m=result.keyframe_depth_m[:n],
        links=result.links.select(result.links.j < n),
        stereo_observations=[pair for pair in result.stereo_observations if pair.row < n_frames],
    )  # fmt: skip


def check_require(names: Mapping[str, float]) -> None:
    """Raises TwinError if a name in the scenario's `[require]` table is not a metric."""
    check_metric_names(names, empty_metrics())


def empty_metrics() -> dict[str, Any]:
    """Returns the metrics of a survey without frames: all keys, with values None, 0 or empty, except the schema."""
    none = Trajectory(np.zeros(0), np.zeros((0, 4, 4)))
    no_keyframes, no_cells = np.zeros(0, np.int64), np.zeros((0, 0), bool)
    result = SurveyResult(none, none, none, no_keyframes, no_keyframes, np.zeros((0, 6, 6)))
    truth = truth_without_flight(no_cells.astype(np.float32), no_cells, no_cells)
    survey = EvaluationInput(result, None, truth, StereoRig(1, 1, 1.0, 1.0, 1.0))
    return {
        "schema": SCHEMA,
        **dict.fromkeys(_IDENTITY),
        **{"warnings": [], "warning": "", "idealisations": [], "water": {"visibility_m": None, "secchi_m": None}},
        "input": {},
        **finite_tree(_sections(survey, truth)),
        "timing": _timing({"stages": Stopwatch().summary()}, 0, 0),
        "require": {},
    }


def _timing(timing: Mapping[str, Any], n_frames: int, n_keyframes: int) -> dict[str, Any]:
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
