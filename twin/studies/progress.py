"""Progress of a study on stderr: a bar on a terminal, one line a minute elsewhere, and one per survey on request."""

import math
import sys
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Event, Thread
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn
from rich.progress import Progress as ProgressBar

from twin.report.number_formats import duration, plain
from twin.studies.flight import Row, has_passed
from twin.studies.statistics import wilson_interval

_INTERVAL_S = 60.0  # between two lines where there is no terminal


class StudyProgress:
    """Display of finished, failed, refused surveys, pass probability and time to `end_s` [s since the epoch]."""

    def __init__(self, bar: ProgressBar | None = None, print_surveys: bool = False, end_s: float = math.inf):
        self.total, self.ended = 0, Counter[str]()
        self.bar, self.print_surveys, self.end_s = bar, print_surveys, end_s
        self._begin = time.monotonic(), 0  # of the present surveys: time, and number of surveys done before
        self._task: Any = bar.add_task("", total=None, note="starting workers") if bar else None

    @property
    def done(self) -> int:
        return self.ended["all"]

    def begin(self, total: int) -> None:
        self.total, self._begin = total, (time.monotonic(), self.done)
        self._update_bar()

    def print_line(self, text: str) -> None:
        if self.bar:
            self.bar.console.print(text, markup=False, highlight=False)
        else:
            print(text, file=sys.stderr, flush=True)

    def add(self, row: Row) -> None:
        self.ended.update(["all", row["status"]])
        self.ended.update(passed=has_passed(row), unknown=row["status"] == "failed" or bool(row.get("unmodelled")))
        if self.print_surveys:
            line = survey_line(row)
            self.print_line(line if self.bar else f"{self.done}/{self.total} {line}; {self}")
        self._update_bar()

    def time_left(self) -> str:
        """Returns the expected time until the planned surveys are done, or the one after which they are stopped."""
        begin_s, done_before = self._begin
        n_done, n_left = self.done - done_before, self.total - self.done
        pace_s = (time.monotonic() - begin_s) / n_done if n_done else math.inf
        expected_s, most_s = (pace_s * n_left if n_left else 0.0), max(0.0, self.end_s - time.time())
        if math.isinf(expected_s) and math.isinf(most_s):
            return "time left not known yet"
        return f"{'about' if expected_s < most_s else 'at most'} {duration(min(expected_s, most_s))} left"

    def state(self) -> str:
        """Returns the number of surveys done, the results so far and the time left as one line."""
        return ", ".join(filter(None, (f"{self.done} of {self.total} surveys", str(self), self.time_left())))

    def _update_bar(self) -> None:
        if self.bar:
            note = ", ".join(filter(None, (self.time_left(), str(self))))
            self.bar.update(self._task, total=self.total, completed=self.done, note=note)

    def __str__(self) -> str:
        failures = ", ".join(f"{n} {status}" for status in ("failed", "refused") if (n := self.ended[status]))
        evaluated = self.done - self.ended["failed"] - self.ended["refused"]
        if not evaluated:
            return failures
        estimate = wilson_interval(self.ended["passed"], evaluated, unknown=self.ended["unknown"])
        most = f" to {100 * estimate.most:.0f}" if estimate.most > estimate.value else ""
        passing = f"{100 * estimate.value:.0f}{most} % pass ({100 * estimate.low:.0f} to {100 * estimate.high:.0f} %)"
        return f"{passing}, {failures}" if failures else passing


@contextmanager
def study_progress(print_surveys: bool, end_s: float = math.inf) -> Iterator[StudyProgress]:
    console = Console(stderr=True)
    if console.is_terminal:
        columns = (TextColumn("surveys"), BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[note]}"))
        with ProgressBar(*columns, console=console) as bar:
            yield StudyProgress(bar, print_surveys, end_s)
        return
    progress, stopped = StudyProgress(print_surveys=print_surveys, end_s=end_s), Event()
    lines = Thread(target=_print_regularly, args=(progress, stopped), daemon=True)
    lines.start()
    try:
        yield progress
    finally:
        stopped.set()


def _print_regularly(progress: StudyProgress, stopped: Event) -> None:
    while not stopped.wait(_INTERVAL_S):
        progress.print_line(progress.state())


def survey_line(row: Row) -> str:
    missed = "" if has_passed(row) else ", requirements not met"
    result = row["status"] + (f" ({row['reason']})" if row["reason"] else missed)
    varied = ", ".join(f"{name[5:]} {plain(value)}" for name, value in row.items() if name.startswith("vary."))
    return f"sample {row['sample']}, seed {row['seed']}: {result}" + (f"; {varied}" if varied else "")
