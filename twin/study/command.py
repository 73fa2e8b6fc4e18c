"""`twin study`: from the words of the command line to its exit status."""

from __future__ import annotations

import json
from contextlib import AbstractContextManager
from pathlib import Path
from typing import NamedTuple

from twin.app import console
from twin.errors import TwinError
from twin.study import campaign, findings, tuning, tuning_report, wording
from twin.study.campaign import Ended
from twin.study.engine import Engine, connect
from twin.study.progress import shown
from twin.study.study_file import Study, load_study


class Options(NamedTuple):
    """The words of the command line."""

    out: Path | None = None
    jobs: int | None = None
    scheduler: str | None = None
    slurm: bool = False
    resume: bool = False
    live: bool = False
    as_json: bool = False

    def engine(self) -> AbstractContextManager[Engine]:
        """The engine asked for. Raises TwinError."""
        if self.scheduler and self.slurm:
            raise TwinError("--slurm", "there is a --scheduler already", "one of both")
        return connect(self.jobs, self.scheduler, self.slurm)


def run(file: str, options: Options) -> int:
    """Runs the study of a file and shows what it found; returns the exit status.

    Raises:
        TwinError: bad file or usage; nothing was flown.
    """
    study = load_study(file)
    folder = (options.out or Path("runs") / f"study-{study.name}").absolute()  # workers may run elsewhere
    with options.engine() as engine, shown(options.live) as progress:
        ended = campaign.conduct(study, folder, options.resume, engine, progress)
    for fault in ended.unwritten:
        console.fault(f"{folder}: {fault}; once there is space, --resume flies what is missing")
    if options.as_json:
        identity = {"name": study.name, "out": str(folder), "pace": ended.pace._asdict()}
        print(json.dumps(findings.summary(ended.findings, identity), indent=1))
    else:
        _show(study, ended)
    return exit_status(ended)


def tune(file: str, options: Options) -> int:
    """Runs the search of a file and shows the plan that it recommends; returns the exit status.

    Raises:
        TwinError: bad file or usage; nothing was flown.
    """
    study = load_study(file)
    plan = tuning.plan_of(study)
    folder = (options.out or Path("runs") / f"tune-{study.name}").absolute()
    with options.engine() as engine, shown(options.live) as progress:
        tuned = tuning.tune(study, folder, options.resume, engine, progress)
    tuning_report.write_all(study, plan, tuned, folder)
    if options.as_json:
        print(json.dumps(tuning_report.summary(study, plan, tuned), indent=1))
    else:
        print(tuning_report.headline(study, plan, tuned))
        print(f"Report: {folder / 'tuning.html'}")
        if tuned.recommended:
            print(f"Plan: {folder / 'recommended.toml'}")
    return 130 if tuned.interrupted else 0 if tuned.recommended else 1


def _show(study: Study, ended: Ended) -> None:
    """A summary on stdout."""
    print(wording.headline(study, ended.findings))
    rows = [
        (
            wording.name_of(level.name),
            wording.interval(level.name, level.median),
            wording.interval(level.name, level.bound),
        )
        for level in ended.findings.levels
    ]
    console.table(f"{study.name}: median, and what 95 % of surveys keep", rows)
    if ended.pace.surveys:
        print(wording.pace(*ended.pace))
    if ended.page.is_file():
        print(f"Report: {ended.page}")


def exit_status(ended: Ended) -> int:
    """What the shell is told of a study."""
    if ended.interrupted:
        return 130
    found = ended.findings
    return 1 if found.missed or ended.unwritten or not found.ended.any() else 0
