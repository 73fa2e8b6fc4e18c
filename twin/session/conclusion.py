"""Conclusion of a survey: final alignment, map, comparison with the truth, and the run folder."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from importlib.metadata import version
from typing import Any, NamedTuple, TypeVar

from twin.core.interrupts import StageGuard
from twin.core.quality import Finding
from twin.core.timing import Stopwatch, timing_summary
from twin.estimate.pipeline import Navigator, finish_in_stage
from twin.judge.metrics import EvaluationInput, evaluate, unevaluated
from twin.plugin.navigator import NOTE
from twin.report.run_result import RunResult
from twin.report.run_writer import PlannedTruth, RunFolder, SurveyRecord
from twin.scenario.idealisations import idealisations
from twin.scenario.model import Scenario
from twin.session.monitor import SurveyMonitor
from twin.session.orthomosaic import is_wanted, make_orthomosaic
from twin.session.survey_check import calibration_notes, survey_findings
from twin.world.floor_forecast import planned_overlap
from twin.world.mission import Mission
from twin.world.world import World

T = TypeVar("T")


class FlownSurvey(NamedTuple):
    """A survey that has been flown.

    Args:
        mission: the survey as planned.
        world: the simulated world, with the ground truth.
        navigator: the estimators, with their estimates.
        stopwatch: durations of the stages.
        guard: limits the effect of an interrupt to one stage; also holds the reason why the flight ended early, if any.
    """

    mission: Mission
    world: World
    navigator: Navigator
    stopwatch: Stopwatch
    guard: StageGuard


def conclude(flight: FlownSurvey, folder: RunFolder, monitor: SurveyMonitor) -> RunResult:
    """Aligns all keyframes, builds the map and the orthomosaic, compares with the truth, and writes the run folder.

    An interrupt ends only the current stage; the survey then has the status "aborted" with a reason that names the
    stage.

    Raises:
        TwinError: metrics.json cannot be written.
    """
    mission, world, navigator, stopwatch, guard = flight
    result = finish_in_stage(navigator, guard)
    for link in navigator.network.history.dropped:
        folder.log("link dropped", i=link.i, j=link.j, overlap=link.overlap, points=link.n_points)
    for alignment in result.alignments:
        folder.log("aligned", **alignment._asdict())
    with stopwatch("map"):
        elevation = guard.attempt(
            "map",
            lambda: navigator.build_map(result, mission.grid, lambda share: monitor.report_stage("map", share)),
        )
    truth, scenario = world.truth(), mission.scenario
    orthomosaic = None
    if elevation is not None and is_wanted(mission, folder):
        tools = stopwatch, partial(monitor.report_stage, "orthomosaic")
        make = partial(make_orthomosaic, mission, navigator, result, elevation, truth, folder, tools)
        orthomosaic = guard.attempt("orthomosaic", lambda: _without_file_errors(guard, make))
        elevation = elevation if orthomosaic is None else orthomosaic.elevation
    wall_s = monitor.wall_s
    along, across = planned_overlap(mission)
    plan = scenario.plan.model_dump(include={"pattern", "overlap_along", "overlap_across"})
    plan |= {"along_median": along, "across_median": across}
    timing = timing_summary(len(result.online) / mission.rig.frame_rate_hz, wall_s, stopwatch)
    findings = survey_findings(mission, result, elevation, truth.reference)
    for finding in findings:
        folder.log("finding", **finding._asdict())
    identity = _identity(mission, guard.reason, findings)
    actions = monitor.actions.times
    survey = EvaluationInput(
        result, elevation, truth, mission.rig, plan, timing, identity, scenario.require,
        [
            *plugin_notes(scenario), *mission.terrain.hole_notes, *world.warnings,
            *calibration_notes(result, mission.rig), *result.quality.repeat_notes,
            *filter(None, [actions.sentence]),
        ],
        idealisations(scenario), actions, None if orthomosaic is None else orthomosaic.metrics,
    )  # fmt: skip
    metrics = guard.attempt("evaluation", lambda: evaluate(survey)) or unevaluated(survey)
    monitor.report_stage("report", 0.0)
    n_frames_per_keyframe = mission.plan.n_frames_per_keyframe
    metrics = folder.finish(
        SurveyRecord(
            result,
            elevation,
            PlannedTruth(truth, mission.grid, mission.start),
            n_frames_per_keyframe,
            stopwatch,
            metrics,
            mission.terrain.georeference,
            orthomosaic is not None,
        ),
        guard,
    )
    return RunResult(metrics["status"], metrics, folder.path)


def plugin_notes(scenario: Scenario) -> list[str]:
    """Returns one note on each plug-in of the survey."""
    notes = (
        (scenario.terrain.plugin, "The heights of the floor are those of the plug-in {}."),
        (scenario.control.plugin, "The vehicle was steered by the plug-in {}."),
        (scenario.estimate.plugin, NOTE),
    )
    return [note.format(name) for name, note in notes if name is not None]


def _without_file_errors(guard: StageGuard, function: Callable[[], T]) -> T | None:
    """Returns the result of a function; if a file cannot be read or written, returns None and records the cause."""
    try:
        return function()
    except OSError as error:
        guard.cause = guard.cause or str(error)
        return None


def _identity(mission: Mission, abort_reason: str, findings: Sequence[Finding]) -> dict[str, Any]:
    """Returns name, seed, program version and scenario hash of the survey, its status, and the reason for the status.

    The status is "aborted" if there is a reason for an abort, otherwise "degraded" if there are findings, otherwise
    "complete".
    """
    scenario = mission.scenario
    reasons = [abort_reason] if abort_reason else [finding.sentence for finding in findings]
    status = "aborted" if abort_reason else "degraded" if findings else "complete"
    return {
        "name": scenario.name,
        "seed": scenario.seed,
        "version": version("seabed-twin"),
        "scenario_hash": scenario.fingerprint(),
        "status": status,
        "reason": "; ".join(reasons),
    }
