"""Runs a study: flies the surveys on many workers, logs one row per survey, and writes the table and the report."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import NamedTuple

from twin.errors import TwinError
from twin.study.analysis import StudyAnalysis
from twin.study.engine import Engine, Outcome
from twin.study.flight import Row, fly, row_of
from twin.study.progress import StudyProgress
from twin.study.report import write_report
from twin.study.results_log import ResultsLog, write_parquet
from twin.study.study_file import Study
from twin.study.surveys import Survey, check_samples, survey_keys, surveys
from twin.study.worker import TaskLimits


class Throughput(NamedTuple):
    """Number of surveys flown, elapsed wall time [s], and sum of the run times of all surveys on the workers [s]."""

    surveys: int
    wall_s: float
    worker_s: float


class StudyResult(NamedTuple):
    """Results of a study: analysis, report file, messages of write errors, interrupted by Ctrl-C or not, throughput."""

    analysis: StudyAnalysis
    page: Path
    write_errors: list[str]
    interrupted: bool
    throughput: Throughput


def run_study(
    study: Study,
    folder: Path,
    resume: bool,
    engine: Engine,
    progress: StudyProgress,
    function: Callable[[Survey], Row] = fly,
) -> StudyResult:
    """Flies the surveys for which the folder has no result, and writes results.parquet and study.html.

    Ctrl-C ends the study early; the results obtained until then are written.

    Args:
        folder: results folder, new or empty unless `resume` is set.
        resume: continue the study whose results are in the folder.
        function: flies one survey; must be importable by name on the workers.

    Raises:
        TwinError: the folder is not empty, cannot be written, or belongs to another study.
        ScenarioError: the scenario of a sample is not valid; nothing was flown.
    """
    check_samples(study)
    log = open_folder(folder, resume, surveys(study, folder))
    done, planned = log.done(), set(survey_keys(study))
    progress.begin(len(planned - done))
    missing = (survey for survey in surveys(study, folder) if survey.key not in done)
    run_times_s: list[float] = []

    def add_row(row: Row) -> None:
        run_times_s.append(row.get("timing.survey_s") or 0.0)
        log.add(row)

    start = time.perf_counter()
    interrupted = not fly_surveys(study, missing, add_row, engine, progress, function)
    throughput = Throughput(len(run_times_s), time.perf_counter() - start, sum(run_times_s))

    analysis = StudyAnalysis(log.table(planned), study)
    page = folder / "study.html"
    write_errors = _write_errors(
        log.flush,
        lambda: write_parquet(analysis.rows, folder / "results.parquet"),
        lambda: write_report(study, analysis, page),
    )
    return StudyResult(analysis, page, write_errors, interrupted, throughput)


def open_folder(folder: Path, resume: bool, planned: Iterable[Survey]) -> ResultsLog:
    """Returns the results log of a new folder or, with `resume`, of the folder of an earlier run of the study.

    Raises:
        TwinError: the folder is not empty, cannot be written, or belongs to another study.
    """
    if folder.exists() and not (folder.is_dir() and (resume or not any(folder.iterdir()))):
        raise TwinError("--out", f"{folder} exists and is not empty", "a new or an empty folder, or --resume")
    try:
        (folder / "runs").mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise TwinError("--out", f"{folder} cannot be written: {error}", "a writable folder") from None
    log = ResultsLog(folder)
    hashes = {(row["sample"], row["seed"]): row["scenario_hash"] for row in log.rows()}
    for survey in planned if hashes else ():
        if hashes.get(survey.key, survey.scenario_hash) != survey.scenario_hash:
            raise TwinError("--resume", f"{folder} contains the results of another study", "the folder of this study")
    for leftover in (folder / "runs").glob(".*"):
        shutil.rmtree(leftover, ignore_errors=True)
    return log


def fly_surveys(
    study: Study,
    missing: Iterable[Survey],
    add_row: Callable[[Row], None],
    engine: Engine,
    progress: StudyProgress,
    function: Callable[[Survey], Row] = fly,
) -> bool:
    """Flies surveys and calls `add_row` with the row of each; returns False if interrupted by Ctrl-C."""
    try:
        for outcome in engine.run_many(function, missing, TaskLimits(study.timeout_s, study.retries)):
            row = row_of_outcome(outcome)
            add_row(row)
            progress.add(row)
    except KeyboardInterrupt:
        return False
    return True


def row_of_outcome(outcome: Outcome[Survey, Row]) -> Row:
    """Returns the row of a survey from the outcome of its task; a failed task gives a row with status "failed"."""
    row = outcome.result or row_of(outcome.task, "failed", outcome.failure)
    return row | {"timing.attempts": outcome.attempts}


def _write_errors(*writes: Callable[[], object]) -> list[str]:
    """Calls every function, even if an earlier one failed, and returns the messages of their OSErrors."""
    errors = []
    for write in writes:
        try:
            write()
        except OSError as error:
            errors.append(str(error))
    return errors
