"""Conclusion of a flown survey or a replay: final alignment, maps, comparison with the truth, and the run folder."""

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from twin.core.checkpoint import Checkpoints
from twin.core.interrupts import StageGuard
from twin.core.quality import Finding
from twin.core.records import ElevationMap, MapGrid, SurveyResult
from twin.core.timing import Stopwatch, timing_summary
from twin.errors import SurveyAborted
from twin.estimate.self_check import with_length_error
from twin.estimate.vision.image_spool import remove_disparities
from twin.judge.metrics import EvaluationInput, evaluate, unevaluated
from twin.report.run_result import RunResult
from twin.report.run_writer import RunFolder, SurveyRecord
from twin.session.assembly import Estimators


class Estimation(NamedTuple):
    """Estimators that have processed all frames, and what the stages after them use."""

    navigator: Estimators
    stopwatch: Stopwatch  #: durations of the stages
    #: limits the effect of an interrupt to one stage; also holds the reason why the frames ended early, if any.
    guard: StageGuard
    folder: RunFolder
    progress: Callable[[str, float], None]  #: called with a stage ("map", "orthomosaic", "report") and its done share
    start_s: float  #: value of `time.perf_counter` at the start of the run

    def build_map(
        self, result: SurveyResult, grid: MapGrid | None, chosen: NDArray[np.bool_] | None = None
    ) -> ElevationMap | None:
        """Returns the elevation map from the chosen keyframes; None without any, or if an interrupt ends the stage."""
        # without the last keyframe if an image cannot be read, as a full disk cut it; None if others cannot be read
        # either; `guard.cause` then says why
        report, test = partial(self.progress, "map"), self.navigator.with_tested_sigma
        before = np.arange(len(result.keyframe_rows)) < len(result.keyframe_rows) - 1
        for used in (chosen, before if chosen is None else chosen & before):
            try:
                found = self.guard.attempt("map", partial(self.navigator.build_map, result, grid, report, used))
                tested = found and self.guard.attempt("height check", partial(test, result, found, used))
                return tested or found
            except OSError as error:
                self.guard.cause = self.guard.cause or str(error)
        return None


class Maps(NamedTuple):
    """Maps of a run."""

    elevation: ElevationMap | None
    orthomosaic: dict[str, float | None] | None = None  #: `orthomosaic.*` of metrics.json; None if none was made
    n_tiles: int = 0  #: number of tiles of a map in tiles
    details: tuple[ElevationMap | None, ...] = ()  #: map of each task of a survey


class RunKind(Protocol):
    """What is special about a flown survey or a replay."""

    def maps(self, estimation: Estimation, result: SurveyResult) -> Maps: ...

    def findings(self, result: SurveyResult, elevation: ElevationMap | None) -> list[Finding]:
        """Returns the failed checks, each a reason not to trust the result."""
        ...

    def evaluation(self, result: SurveyResult, maps: Maps) -> EvaluationInput:
        """Returns the input of the evaluation, with simulated_s as timing and name, seed and hash as identity."""
        ...

    def record(self, survey: EvaluationInput, written: SurveyRecord) -> SurveyRecord:
        """Returns the contents of the run folder, with the truth and the plan."""
        ...


def conclude(estimation: Estimation, run: RunKind) -> tuple[RunResult, EvaluationInput]:
    """Aligns all keyframes, builds the maps, compares with the truth, and writes the run folder.

    An interrupt ends only the current stage; the run then has the status "aborted" with a reason that names the stage.
    Raises TwinError if metrics.json cannot be written.
    """
    navigator, stopwatch, guard, folder, progress, start_s = estimation
    result = finish_in_stage(navigator, guard)
    for link in navigator.network.history.dropped:
        folder.log("link dropped", i=link.i, j=link.j, overlap=link.overlap, points=link.n_points)
    for alignment in result.alignments:
        folder.log("aligned", **alignment._asdict())
    maps = run.maps(estimation, result)
    findings = run.findings(result, maps.elevation)
    for finding in findings:
        folder.log("finding", **finding._asdict())
    result, elevation = with_length_error(result, maps.elevation, findings)
    maps = maps._replace(elevation=elevation)
    survey = run.evaluation(result, maps)
    timing = timing_summary(survey.timing["simulated_s"], time.perf_counter() - start_s, stopwatch)
    identity = dict(survey.identity) | status(guard.reason, findings)
    survey = replace(survey, timing=timing, identity=identity, orthomosaic=maps.orthomosaic)
    metrics = guard.attempt("evaluation", lambda: evaluate(survey)) or unevaluated(survey)
    progress("report", 0.0)
    navigator.close()
    record = run.record(survey, SurveyRecord(result, maps.elevation, None, None, stopwatch, metrics))
    metrics = folder.finish(record, guard)
    return RunResult(metrics["status"], metrics, folder.path), survey


def remove_state(checkpoints: Checkpoints, folder: Path) -> None:
    """Removes what only a run in progress needs: its checkpoints and, on which they depend, the disparities."""
    checkpoints.remove()
    remove_disparities(folder / "keyframes")


def finish_in_stage(navigator: Estimators, guard: StageGuard) -> SurveyResult:
    """Returns the result of the estimators, without the final alignment if the alignment fails or is interrupted.

    The alignment is the stage "alignment" of the guard. Why it failed is stored in `guard.cause`, unless a cause is set
    already; an interrupt adds the stage to `guard.skipped`.
    """
    try:
        if (result := guard.attempt("alignment", navigator.finish)) is not None:
            return result
    except (SurveyAborted, OSError) as error:
        guard.cause = guard.cause or str(error)
    navigator.abandon_alignment()
    return navigator.finish()


def status(abort_reason: str, findings: Sequence[Finding]) -> dict[str, str]:
    """Returns the version of the program, the status of a run ("aborted", "degraded" or "complete"), and its reason."""
    reason = abort_reason or "; ".join(finding.sentence for finding in findings)
    name = "aborted" if abort_reason else "degraded" if findings else "complete"
    return {"version": version("seabed-twin"), "status": name, "reason": reason}
