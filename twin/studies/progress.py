"""Progress of a study on stderr: a progress bar on a terminal, and one line per survey on request."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as ProgressBar

from twin.report.number_formats import plain
from twin.studies.flight import Row, has_passed
from twin.studies.statistics import wilson_interval


class StudyProgress:
    """Display of finished, failed and refused surveys and pass probability: a bar, or lines of `print_surveys`."""

    def __init__(self, bar: ProgressBar | None = None, print_surveys: bool = False):
        self.total, self.ended = 0, Counter[str]()
        self.bar, self.print_surveys = bar, print_surveys
        self._task: Any = bar.add_task("", total=None, note="starting workers") if bar else None

    @property
    def done(self) -> int:
        return self.ended["all"]

    def begin(self, total: int) -> None:
        self.total = total
        self._update_bar()

    def print_line(self, text: str) -> None:
        if self.bar:
            self.bar.console.print(text, markup=False, highlight=False)
        else:
            print(text, file=sys.stderr, flush=True)

    def add(self, row: Row) -> None:
        self.ended.update(["all", row["status"]])
        self.ended.update(passed=has_passed(row), unmodelled=bool(row.get("unmodelled")))
        if self.print_surveys:
            line = survey_line(row)
            self.print_line(line if self.bar else f"{self.done}/{self.total} {line}; {self}")
        self._update_bar()

    def _update_bar(self) -> None:
        if self.bar:
            self.bar.update(self._task, total=self.total, completed=self.done, note=str(self))

    def __str__(self) -> str:
        failures = ", ".join(f"{n} {status}" for status in ("failed", "refused") if (n := self.ended[status]))
        evaluated = self.done - self.ended["failed"] - self.ended["refused"]
        if not evaluated:
            return failures
        estimate = wilson_interval(self.ended["passed"], evaluated, unknown=self.ended["unmodelled"])
        passing = f"{100 * estimate.value:.0f} % pass ({100 * estimate.low:.0f} to {100 * estimate.high:.0f} %)"
        return f"{passing}, {failures}" if failures else passing


@contextmanager
def study_progress(print_surveys: bool) -> Iterator[StudyProgress]:
    console = Console(stderr=True)
    if not console.is_terminal:
        yield StudyProgress(print_surveys=print_surveys)
        return
    columns = (TextColumn("surveys"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with ProgressBar(*columns, TextColumn("{task.fields[note]}"), console=console) as bar:
        yield StudyProgress(bar, print_surveys)


def survey_line(row: Row) -> str:
    missed = "" if has_passed(row) else ", requirements not met"
    result = row["status"] + (f" ({row['reason']})" if row["reason"] else missed)
    varied = ", ".join(f"{name[5:]} {plain(value)}" for name, value in row.items() if name.startswith("vary."))
    return f"sample {row['sample']}, seed {row['seed']}: {result}" + (f"; {varied}" if varied else "")
