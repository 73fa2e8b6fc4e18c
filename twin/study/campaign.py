"""A study from its file to its results: planned, flown by many workers, written down row by row, judged, shown."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import NamedTuple

from twin.errors import TwinError
from twin.study.engine import Engine, Outcome
from twin.study.findings import Findings
from twin.study.flight import Row, fly, row_of
from twin.study.ledger import Ledger, write_parquet
from twin.study.progress import Progress
from twin.study.report import write_report
from twin.study.study_file import Study
from twin.study.surveys import Survey, check_samples, keys, surveys
from twin.study.worker import Limits


class Pace(NamedTuple):
    """How many surveys were flown now, in what time, and how long workers were at them [s]."""

    surveys: int
    wall_s: float
    worked_s: float


class Ended(NamedTuple):
    """A study that is over: what was found, its page, what could not be written and why, whether Ctrl-C ended it."""

    findings: Findings
    page: Path
    unwritten: list[str]
    interrupted: bool
    pace: Pace


def conduct(
    study: Study,
    folder: Path,
    resume: bool,
    engine: Engine,
    progress: Progress,
    function: Callable[[Survey], Row] = fly,
) -> Ended:
    """Flies what the folder does not have yet, and leaves results.parquet and study.html; Ctrl-C ends it early.

    Args:
        function: flies one survey; importable by name on the workers.

    Raises:
        TwinError: the folder is taken, cannot be written, or belongs to another study.
        ScenarioError: the faults of the samples; nothing was flown.
    """
    check_samples(study)
    ledger = open_folder(folder, resume, surveys(study, folder))
    done, wanted = ledger.done(), set(keys(study))
    progress.begin(len(wanted - done))
    missing = (survey for survey in surveys(study, folder) if survey.key not in done)
    worked_s: list[float] = []

    def keep(row: Row) -> None:
        worked_s.append(row.get("timing.survey_s") or 0.0)
        ledger.add(row)

    begun = time.perf_counter()
    interrupted = not fly_all(study, missing, keep, engine, progress, function)
    pace = Pace(len(worked_s), time.perf_counter() - begun, sum(worked_s))

    found = Findings(ledger.table(wanted), study)
    page = folder / "study.html"
    unwritten = faults_of_writing(
        ledger.flush,
        lambda: write_parquet(found.rows, folder / "results.parquet"),
        lambda: write_report(study, found, page),
    )
    return Ended(found, page, unwritten, interrupted, pace)


def open_folder(folder: Path, resume: bool, planned: Iterable[Survey]) -> Ledger:
    """The rows of a new folder, or of the same study where it is to go on.

    Raises:
        TwinError: the folder is taken, cannot be written, or belongs to another study.
    """
    if folder.exists() and not (folder.is_dir() and (resume or not any(folder.iterdir()))):
        raise TwinError("--out", f"{folder} is there and not empty", "a new or an empty folder, or --resume")
    try:
        (folder / "runs").mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise TwinError("--out", f"{folder} cannot be written: {error}", "a folder that can") from None
    ledger = Ledger(folder)
    hashes = {(row["sample"], row["seed"]): row["scenario_hash"] for row in ledger.rows()}
    for survey in planned if hashes else ():
        if hashes.get(survey.key, survey.scenario_hash) != survey.scenario_hash:
            raise TwinError("--resume", f"{folder} holds the surveys of another study", "the study that it began with")
    for left in (folder / "runs").glob(".*"):
        shutil.rmtree(left, ignore_errors=True)
    return ledger


def fly_all(
    study: Study,
    missing: Iterable[Survey],
    write: Callable[[Row], None],
    engine: Engine,
    progress: Progress,
    function: Callable[[Survey], Row] = fly,
) -> bool:
    """Flies surveys and writes the row of each as it comes back; False where Ctrl-C ended it."""
    try:
        for outcome in engine.run_many(function, missing, Limits(study.timeout_s, study.retries)):
            row = row_from(outcome)
            write(row)
            progress.add(row)
    except KeyboardInterrupt:
        return False
    return True


def row_from(outcome: Outcome[Survey, Row]) -> Row:
    """The row of a survey, whether it came back or not."""
    row = outcome.result or row_of(outcome.task, "failed", outcome.failure)
    return row | {"timing.attempts": outcome.attempts}


def faults_of_writing(*writes: Callable[[], object]) -> list[str]:
    """Writes all that can be written; tells what cannot."""
    faults = []
    for write in writes:
        try:
            write()
        except OSError as error:
            faults.append(str(error))
    return faults
