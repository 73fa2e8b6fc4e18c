"""Progress of a study on stderr: a progress bar on a terminal, and one line per survey on request."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as ProgressBar

from twin.report.wording import plain
from twin.studies.flight import Row, has_passed
from twin.studies.statistics import wilson_interval


class StudyProgress:
    """Display of a study's progress: numbers of finished, failed and refused surveys, and the current pass probability.

    Args:
        bar: progress bar on a terminal; None: no bar.
        print_surveys: whether to print one line per survey.
    """

    def __init__(self, bar: ProgressBar | None = None, print_surveys: bool = False):
        self.total = self.done = self.passed = self.failed = self.refused = self.unmodelled = 0
        self.bar, self.print_surveys = bar, print_surveys
        self._task: Any = bar.add_task("", total=None, note="starting workers") if bar else None

    def begin(self, total: int) -> None:
        """Sets the number of surveys that this run flies in total."""
        self.total = total
        self._update_bar()

    def print_line(self, text: str) -> None:
        """Prints a line on stderr."""
        if self.bar:
            self.bar.console.print(text, markup=False, highlight=False)
        else:
            print(text, file=sys.stderr, flush=True)

    def add(self, row: Row) -> None:
        """Counts a survey that has ended, and updates the display."""
        self.done += 1
        self.passed += has_passed(row)
        self.failed += row["status"] == "failed"
        self.refused += row["status"] == "refused"
        self.unmodelled += bool(row.get("unmodelled"))
        if self.print_surveys and self.bar:
            self.bar.console.print(survey_line(row), markup=False, highlight=False)
        elif self.print_surveys:
            print(f"{self.done}/{self.total} {survey_line(row)}; {self}", file=sys.stderr, flush=True)
        self._update_bar()

    def _update_bar(self) -> None:
        if self.bar:
            self.bar.update(self._task, total=self.total, completed=self.done, note=str(self))

    def __str__(self) -> str:
        evaluated = self.done - self.failed - self.refused
        counts = {"failed": self.failed, "refused": self.refused}
        failures = ", ".join(f"{count} {name}" for name, count in counts.items() if count)
        if not evaluated:
            return failures
        estimate = wilson_interval(self.passed, evaluated, unknown=self.unmodelled)
        passing = f"{100 * estimate.value:.0f} % pass ({100 * estimate.low:.0f} to {100 * estimate.high:.0f} %)"
        return f"{passing}, {failures}" if failures else passing


@contextmanager
def study_progress(print_surveys: bool) -> Iterator[StudyProgress]:
    """Yields the progress of a study, with a progress bar if stderr is a terminal."""
    console = Console(stderr=True)
    if not console.is_terminal:
        yield StudyProgress(print_surveys=print_surveys)
        return
    columns = (TextColumn("surveys"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with ProgressBar(*columns, TextColumn("{task.fields[note]}"), console=console) as bar:
        yield StudyProgress(bar, print_surveys)


def survey_line(row: Row) -> str:
    """Returns one line with a survey's sample, seed, status, reason, and values of the varied keys."""
    missed = "" if has_passed(row) else ", requirements not met"
    result = row["status"] + (f" ({row['reason']})" if row["reason"] else missed)
    varied = ", ".join(f"{name[5:]} {plain(value)}" for name, value in row.items() if name.startswith("vary."))
    return f"sample {row['sample']}, seed {row['seed']}: {result}" + (f"; {varied}" if varied else "")
