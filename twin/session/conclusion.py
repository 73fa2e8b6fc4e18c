"""After the flight: final alignment, map, judgement, and the run folder."""

from __future__ import annotations

import resource
import time
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from twin.core.geometry import Array
from twin.core.records import ElevationMap, SurveyResult, Truth
from twin.core.timing import Stopwatch
from twin.errors import SurveyAborted
from twin.estimate.pipeline import Navigator
from twin.judge.metrics import evaluate
from twin.report.run_writer import RunFolder
from twin.world.mission import Mission
from twin.world.world import World


class RunResult(NamedTuple):
    """A survey's outcome: "complete" or "aborted", its figures (metrics.json) and its folder."""

    status: str
    metrics: dict[str, Any]
    folder: Path


def conclude(
    mission: Mission,
    folder: RunFolder,
    navigator: Navigator,
    world: World,
    watch: Stopwatch,
    begun: float,
    reason: str,
    say: Callable[[str, float], None],
) -> RunResult:
    """Aligns, maps, judges and writes what was flown; `reason` tells why it ended early ("" if it did not)."""
    try:
        result = navigator.finish()
    except (SurveyAborted, OSError) as error:
        result, reason = navigator.finish(), reason or str(error)
    for link in navigator.dropped:
        folder.log("link dropped", i=link.i, j=link.j, overlap=link.overlap, points=link.n_points)
    for alignment in result.alignments:
        folder.log("aligned", **alignment._asdict())
    with watch("map"):
        elevation = make_map(mission, navigator, result, lambda share: say("map", share))
    wall_s = time.perf_counter() - begun
    truth, said = world.truth(), {"reason": reason, "warning": "; ".join(world.warnings)}
    metrics = _judge(mission, result, elevation, truth, watch, wall_s, said)
    say("report", 0.0)
    metrics = folder.finish(mission, result, elevation, truth, watch, metrics)
    return RunResult(metrics["status"], metrics, folder.path)


def make_map(
    mission: Mission, navigator: Navigator, result: SurveyResult, say: Callable[[float], None]
) -> ElevationMap | None:
    """The map along the final trajectory; None where no keyframe was reached. `say` is told the share done."""
    n_keyframes = len(result.keyframe_rows)
    if n_keyframes == 0:
        return None
    return navigator.vision.build_map(result, mission.grid, _step_cov(result), lambda done: say(done / n_keyframes))


def _step_cov(result: SurveyResult) -> Array:
    """(n, 6, 6) covariance of each keyframe relative to the one before, as their link measured it."""
    cov = np.zeros((len(result.keyframe_rows), 6, 6))
    chain = result.links.j == result.links.i + 1
    cov[result.links.j[chain]] = result.links.own_cov[chain]
    return cov


def _judge(
    mission: Mission,
    result: SurveyResult,
    elevation: ElevationMap | None,
    truth: Truth,
    watch: Stopwatch,
    wall_s: float,
    said: dict[str, str],
) -> dict[str, Any]:
    scenario = mission.scenario
    timing = {
        "wall_s": wall_s,
        "simulated_s": len(result.online) / mission.rig.frame_rate_hz,
        "peak_rss_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "stages": watch.summary(),
    }
    identity = {
        "name": scenario.name,
        "seed": scenario.seed,
        "version": version("seabed-twin"),
        "scenario_hash": scenario.fingerprint(),
        "status": "aborted" if said["reason"] else "complete",
        **said,
    }
    plan = scenario.plan.model_dump(include={"pattern", "overlap_along", "overlap_across"})
    return evaluate(result, elevation, truth, mission.rig, plan, timing, identity, scenario.require)
