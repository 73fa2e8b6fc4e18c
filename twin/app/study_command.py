"""Commands `twin study` and `twin tune`."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

from twin.app import console
from twin.errors import TwinError
from twin.study import analysis, tuning, tuning_report, wording
from twin.study.engine import Engine
from twin.study.local_engine import LocalEngine, default_jobs
from twin.study.progress import study_progress
from twin.study.runner import StudyResult, run_study
from twin.study.study_file import Study, load_study

SLURM = "slurm"  #: value of --scheduler that starts SLURM jobs


class StudyOptions(NamedTuple):
    """Command-line options of `twin study` and `twin tune`."""

    out: Path | None = None
    jobs: int | None = None
    scheduler: str | None = None
    resume: bool = False
    live: bool = False
    as_json: bool = False

    def engine(self) -> AbstractContextManager[Engine]:
        """Returns the engine that these options select; see `open_engine`."""
        return open_engine(self.jobs, self.scheduler)


@contextmanager
def open_engine(jobs: int | None = None, scheduler: str | None = None) -> Iterator[Engine]:
    """Yields an engine that runs surveys in parallel; the workers that it started are stopped when the context ends.

    Args:
        jobs: number of local processes or SLURM jobs; None: one per core.
        scheduler: None for processes on this machine; "slurm" for SLURM jobs; else the address of a running Dask
            scheduler, e.g. tcp://host:8786, whose workers must have this package installed.

    Raises:
        TwinError: the scheduler does not answer, or a package that it needs is not installed.
    """
    jobs = jobs or default_jobs()
    if scheduler:
        if find_spec("distributed") is None:
            raise TwinError("--scheduler", "Dask is not installed", "pip install 'seabed-twin[cluster]'")
        from twin.study import dask_engine

        is_slurm = scheduler == SLURM
        with dask_engine.start_slurm_jobs(jobs) if is_slurm else dask_engine.connect_scheduler(scheduler) as engine:
            yield engine
        return
    engine = LocalEngine(jobs)
    try:
        yield engine
    finally:
        engine.pool.close()


def run(file: str, options: StudyOptions) -> int:
    """Runs a study and prints its results; returns the exit status.

    Raises:
        TwinError: the study file or an option is invalid; no survey was run.
    """
    study = load_study(file)
    folder = (options.out or Path("runs") / f"study-{study.name}").absolute()  # workers run in other folders
    with options.engine() as engine, study_progress(options.live) as progress:
        result = run_study(study, folder, options.resume, engine, progress)
    for error in result.write_errors:
        console.print_error(f"{folder}: {error}; free some disk space and continue with --resume")
    if options.as_json:
        identity = {"name": study.name, "out": str(folder), "throughput": result.throughput._asdict()}
        print(json.dumps(analysis.summary(result.analysis, identity), indent=1))
    else:
        _print_result(study, result)
    return exit_status(result)


def tune(file: str, options: StudyOptions) -> int:
    """Optimises the plan as a study file defines it, and prints the result.

    Returns:
        The exit status: 130 if interrupted; 1 if no plan is recommended; 0 otherwise.

    Raises:
        TwinError: the study file or an option is invalid; no survey was run.
    """
    study = load_study(file)
    config = tuning.tuning_config(study)
    folder = (options.out or Path("runs") / f"tune-{study.name}").absolute()
    with options.engine() as engine, study_progress(options.live) as progress:
        result = tuning.tune(study, folder, options.resume, engine, progress)
    tuning_report.write_tuning_report(study, config, result, folder)
    if options.as_json:
        print(json.dumps(tuning_report.summary(study, config, result), indent=1))
    else:
        print(tuning_report.headline(study, config, result))
        print(f"Report: {folder / 'tuning.html'}")
        if result.recommended:
            print(f"Plan: {folder / 'recommended.toml'}")
    return 130 if result.interrupted else 0 if result.recommended else 1


def _print_result(study: Study, result: StudyResult) -> None:
    print(wording.headline(study, result.analysis))
    rows = [
        (
            wording.metric_name(metric.name),
            wording.metric_interval(metric.name, metric.median),
            wording.metric_interval(metric.name, metric.bound),
        )
        for metric in result.analysis.metric_summaries
    ]
    console.print_table(f"{study.name}: median and 95 % bound of the surveys", rows)
    if result.throughput.surveys:
        print(wording.throughput(*result.throughput))
    if result.page.is_file():
        print(f"Report: {result.page}")


def exit_status(result: StudyResult) -> int:
    """Returns the exit status of a study.

    130 if interrupted; 1 if too few surveys passed, none could be evaluated, or results could not be written;
    0 otherwise.
    """
    if result.interrupted:
        return 130
    analysis = result.analysis
    return 1 if analysis.requirement_missed or result.write_errors or not analysis.evaluated.any() else 0
