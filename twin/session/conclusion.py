"""Conclusion of a survey: final alignment, map, comparison with the truth, and the run folder."""

from __future__ import annotations

import resource
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

from twin.core.timing import Stopwatch
from twin.errors import SurveyAborted
from twin.estimate.pipeline import Navigator
from twin.judge.metrics import EvaluationInput, evaluate
from twin.report.run_writer import RunFolder, SurveyRecord
from twin.session.monitor import SurveyMonitor
from twin.world.mission import Mission
from twin.world.world import World


class RunResult(NamedTuple):
    """Outcome of a survey: status "complete" or "aborted", its metrics (metrics.json), and its folder."""

    status: str
    metrics: dict[str, Any]
    folder: Path


class Flight(NamedTuple):
    """A survey that has been flown.

    Args:
        mission: the survey as planned.
        world: the simulated world, with the ground truth.
        navigator: the estimators, with their estimates.
        stopwatch: durations of the stages.
        reason: why the survey was aborted; "" if it is complete.
    """

    mission: Mission
    world: World
    navigator: Navigator
    stopwatch: Stopwatch
    reason: str


def conclude(flight: Flight, folder: RunFolder, monitor: SurveyMonitor) -> RunResult:
    """Aligns all keyframes, builds the map, compares trajectories and map with the truth, and writes the run folder."""
    mission, world, navigator, stopwatch, reason = flight
    try:
        result = navigator.finish()
    except (SurveyAborted, OSError) as error:
        result, reason = navigator.finish(), reason or str(error)
    for link in navigator.network.history.dropped:
        folder.log("link dropped", i=link.i, j=link.j, overlap=link.overlap, points=link.n_points)
    for alignment in result.alignments:
        folder.log("aligned", **alignment._asdict())
    with stopwatch("map"):
        elevation = navigator.build_map(result, mission.grid, lambda share: monitor.report_stage("map", share))
    wall_s = monitor.wall_s
    truth, scenario = world.truth(), mission.scenario
    plan = scenario.plan.model_dump(include={"pattern", "overlap_along", "overlap_across"})
    timing = _timing(len(result.online) / mission.rig.frame_rate_hz, wall_s, stopwatch)
    identity = _identity(mission, reason, "; ".join(world.warnings))
    metrics = evaluate(EvaluationInput(result, elevation, truth, mission.rig, plan, timing, identity, scenario.require))
    monitor.report_stage("report", 0.0)
    n_frames_per_keyframe = mission.plan.n_frames_per_keyframe
    metrics = folder.finish(
        SurveyRecord(result, elevation, truth, mission.grid, mission.start, n_frames_per_keyframe, stopwatch, metrics)
    )
    return RunResult(metrics["status"], metrics, folder.path)


def _timing(simulated_s: float, wall_s: float, stopwatch: Stopwatch) -> dict[str, Any]:
    """Returns simulated and wall time [s], peak memory [MiB], and the durations of the processing stages."""
    return {
        "wall_s": wall_s,
        "simulated_s": simulated_s,
        "peak_rss_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "stages": stopwatch.summary(),
    }


def _identity(mission: Mission, reason: str, warning: str) -> dict[str, Any]:
    """Returns name, seed, program version, scenario hash, status, reason for an abort, and warnings of a survey."""
    scenario = mission.scenario
    return {
        "name": scenario.name,
        "seed": scenario.seed,
        "version": version("seabed-twin"),
        "scenario_hash": scenario.fingerprint(),
        "status": "aborted" if reason else "complete",
        "reason": reason,
        "warning": warning,
    }
