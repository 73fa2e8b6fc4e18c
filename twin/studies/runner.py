"""Runs a study: flies the surveys on many workers, logs one row per survey, and writes the table and the report."""

import math
import shutil
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from itertools import chain, takewhile
from pathlib import Path
from typing import NamedTuple

from twin.core.checkpoint import check_inputs
from twin.core.output_folder import LOCK_FILE, NEW_FOLDER, sole_writer
from twin.engines.engine import Engine
from twin.engines.worker import OUT_OF_TIME, Outcome, TaskLimits
from twin.errors import EngineLostError, TwinError
from twin.report.number_formats import duration
from twin.scenario.file import input_files
from twin.studies.analysis import StudyAnalysis
from twin.studies.flight import Row, fly, refused_row, row_of
from twin.studies.progress import StudyProgress
from twin.studies.report import write_agreement, write_report
from twin.studies.results_log import JOURNAL_FILE, ResultsLog, key_of, write_parquet
from twin.studies.run_time import rendered_time
from twin.studies.study_file import FIDELITY, Study
from twin.studies.surveys import Survey, refusals, rendered, samples, seeds_of_sample, survey_keys, surveys


class Throughput(NamedTuple):
    """Number of surveys flown, elapsed wall time [s], and sum of the run times of these surveys on the workers [s]."""

    surveys: int
    wall_s: float
    worker_s: float


class StudyResult(NamedTuple):
    analysis: StudyAnalysis
    page: Path  #: file of the report
    write_errors: list[str]  #: messages of the errors that occurred while the results were written
    interrupted: bool  #: whether Ctrl-C, or the loss of the engine, ended the study
    throughput: Throughput  #: number of surveys flown by this call, and their run times


class Fleet(NamedTuple):
    """Workers that fly surveys in parallel."""

    engine: Engine
    progress: StudyProgress
    function: Callable[[Survey], Row] = fly  #: flies one survey; must be importable by name on the workers
    end_s: float = math.inf  #: time [s since the epoch] at which the budget is used up and surveys are stopped

    @property
    def out_of_time(self) -> bool:
        return time.time() >= self.end_s

    def fly(self, study: Study, missing: Iterable[Survey], add_row: Callable[[Row], None]) -> bool:
        """Flies surveys of a study and calls `add_row` with the row of each; returns False if interrupted.

        Ctrl-C and the loss of the engine interrupt. At the end of the budget, surveys without a result are left out.
        """
        limits = TaskLimits(study.timeout_s, study.retries, self.end_s)
        try:
            in_time = takewhile(lambda _: not self.out_of_time, missing)
            for outcome in self.engine.run_many(self.function, in_time, limits):
                if outcome.failure == OUT_OF_TIME:
                    continue
                row = row_of_outcome(outcome)
                add_row(row)
                self.progress.add(row)
        except KeyboardInterrupt:
            return False
        except EngineLostError as error:
            self.progress.print_line(str(error))
            return False
        return True


def run_study(study: Study, folder: Path, resume: bool, fleet: Fleet, render_refused: bool = False) -> StudyResult:
    """Flies the surveys for which the folder has no result; writes results.parquet, study.html and any agreement.

    With `render_refused`, surveys that only the surrogate refuses are then flown with rendered images. Ctrl-C, the end
    of the budget or the loss of the engine ends the study early; the results obtained until then are written. Raises
    TwinError if the folder is not empty and `resume` is not set, is written by another process, cannot be written or
    belongs to another study; ScenarioError, before any flight, if no sample has a valid scenario.
    """
    if render_refused and FIDELITY in study.varied_keys:
        raise TwinError("--render-refused", f"this study varies {FIDELITY}", "a study with the surrogate alone")
    refused, planned, run_times_s = refusals(study), set(survey_keys(study)), []
    with open_folder(folder, resume) as log:
        missing = _missing(study, folder, refused, log, shuffled=math.isfinite(fleet.end_s))
        if refused:
            fleet.progress.print_line(refusal_notice(refused))
        fleet.progress.begin(len(planned - log.done()))

        def add_row(row: Row) -> None:
            run_times_s.append(row.get("timing.survey_s") or 0.0)
            log.add(row)

        start = time.perf_counter()
        interrupted = not fleet.fly(study, missing, add_row)
        if render_refused and not interrupted:
            interrupted = not _render_refused(study, folder, log, fleet, add_row)
        throughput = Throughput(len(run_times_s), time.perf_counter() - start, sum(run_times_s))
        analysis, page = StudyAnalysis(log.table(planned), study, len(planned)), folder / "study.html"
        write_errors = list[str]()
        for write in (
            log.flush,
            lambda: write_parquet(analysis.rows, folder / "results.parquet"),
            lambda: write_report(analysis, page),
            lambda: write_agreement(analysis, folder),
        ):
            try:
                write()
            except OSError as error:
                write_errors.append(str(error))
        return StudyResult(analysis, page, write_errors, interrupted, throughput)


def _render_refused(study: Study, folder: Path, log: ResultsLog, fleet: Fleet, add_row: Callable[[Row], None]) -> bool:
    """Flies rendered what only the surrogate refused, keeping scenario hashes; False if interrupted by Ctrl-C."""
    rows = {key_of(row): row for row in log.rows()}
    refused = {key: row["scenario_hash"] for key, row in rows.items() if row.get("unmodelled")}
    samples_of = {sample for sample, _ in refused}
    others = {sample.number for sample in samples(study)} - samples_of
    chosen = [rendered(survey) for survey in surveys(study, folder, others, shuffled=True) if survey.key in refused]
    if not chosen:
        return True
    longest_s = max((row.get("timing.simulated_s") or 0.0 for row in rows.values()), default=0.0)
    survey_s, source = rendered_time(rows.values(), chosen[0].scenario, longest_s)
    time_told = f"about {duration(survey_s)} on one core each ({source}), {duration(survey_s * len(chosen))} in total"
    fleet.progress.print_line(
        f"Flying rendered what the surrogate refuses, {len(chosen)} of {len(rows)} surveys: "
        + (time_told if longest_s else "their time is not known before the first one")
    )
    fleet.progress.begin(fleet.progress.done + len(chosen))

    def add_known(row: Row) -> None:
        if row["status"] != "failed":
            add_row(row | {"scenario_hash": refused[key_of(row)]})

    return fleet.fly(study, chosen, add_known)


def _missing(study: Study, folder: Path, refused: dict[int, str], log: ResultsLog, shuffled: bool) -> Iterator[Survey]:
    """Logs the refused surveys and returns the others that have no result; refuses the log of another study."""
    hashes = {survey.key: survey.scenario_hash for survey in surveys(study, folder, without=refused)}
    refusals_of = [sample for sample in samples(study) if sample.number in refused]
    rows = [refused_row(one, seed, refused[one.number]) for one in refusals_of for seed in seeds_of_sample(study, one)]
    hashes |= {key_of(row): "" for row in rows}
    check_results(log, hashes)
    check_inputs(folder, chain.from_iterable(input_files(one.scenario) for one in surveys(study, folder, refused)))
    done = log.done()
    if done and done.isdisjoint(hashes):
        raise _another_study(log)
    for row in rows:
        if key_of(row) not in done:
            log.add(row)
    return (survey for survey in surveys(study, folder, refused, shuffled) if survey.key not in done)


def refusal_notice(refused: dict[int, str]) -> str:
    number, reason = min(refused.items())
    if len(refused) == 1:
        return f"1 sample cannot be flown and is left out: sample {number}: {reason}"
    return f"{len(refused)} samples cannot be flown and are left out, e.g. sample {number}: {reason}"


@contextmanager
def open_folder(folder: Path, resume: bool, search: bool = False) -> Iterator[ResultsLog]:
    """Locks a new folder or, with `resume`, that of an earlier run without unfinished surveys; yields its results log.

    Raises TwinError if it is not empty and `resume` is not set, is in use, cannot be written, or has other contents.
    """
    with sole_writer(folder, used=resume, allowed=f"{NEW_FOLDER}, or --resume"):
        log = ResultsLog(folder)
        names = {path.name for path in folder.iterdir()} - {LOCK_FILE}
        has_journal = JOURNAL_FILE in names  # of a search, which has it before its first row
        is_own = log.file.name in names and (has_journal == search or (search and not any(log.rows())))
        if names and not is_own:
            kind = "search" if search else "study"
            raise TwinError("--resume", f"{folder} is not the folder of a {kind}", f"the folder of this {kind}")
        try:
            log.file.touch()
            (folder / "runs").mkdir(exist_ok=True)
        except OSError as error:
            raise TwinError("--out", f"{folder} cannot be written: {error}", "a writable folder") from None
        _remove_unfinished(folder / "runs")
        try:
            yield log
        finally:
            _remove_unfinished(folder / "runs")


def _remove_unfinished(runs: Path) -> None:
    for unfinished in runs.glob(".*"):
        shutil.rmtree(unfinished, ignore_errors=True)


def check_results(log: ResultsLog, planned: Mapping[tuple[int, int], str]) -> None:
    """Raises TwinError if the log has a row of another scenario than planned: {(sample, seed): scenario hash}."""
    flown = {key_of(row): row["scenario_hash"] for row in log.rows()}
    if any(planned.get(key, scenario_hash) != scenario_hash for key, scenario_hash in flown.items()):
        raise _another_study(log)


def _another_study(log: ResultsLog) -> TwinError:
    problem = f"{log.file.parent} contains the results of another study"
    return TwinError("--resume", problem, "the folder of this study")


def row_of_outcome(outcome: Outcome[Survey, Row]) -> Row:
    row = outcome.result or row_of(outcome.task, "failed", outcome.failure)
    return row | {"timing.attempts": outcome.attempts}
