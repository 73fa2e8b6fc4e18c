"""What a user sees of a study while it runs, on stderr: a bar on a terminal, a line a survey where asked for."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as Bar

from twin.study.flight import Row, has_passed
from twin.study.statistics import wilson


class Progress:
    """How far a study is, and its running estimate."""

    def __init__(self, bar: Bar | None = None, live: bool = False):
        self.total = self.done = self.passed = self.failed = 0
        self.bar, self.live = bar, live
        self._task: Any = bar.add_task("", total=None, note="starting workers") if bar else None

    def begin(self, total: int) -> None:
        """So many surveys will be flown."""
        self.total = total
        self._draw()

    def add(self, row: Row) -> None:
        """One survey came back."""
        self.done += 1
        self.passed += has_passed(row)
        self.failed += row["status"] == "failed"
        if self.live and self.bar:
            self.bar.console.print(line_on(row), markup=False, highlight=False)
        elif self.live:
            print(f"{self.done}/{self.total} {line_on(row)}; {self}", file=sys.stderr, flush=True)
        self._draw()

    def _draw(self) -> None:
        if self.bar:
            self.bar.update(self._task, total=self.total, completed=self.done, note=str(self))

    def __str__(self) -> str:
        ended = self.done - self.failed
        lost = f"{self.failed} failed" if self.failed else ""
        if not ended:
            return lost
        share = wilson(self.passed, ended)
        estimate = f"{100 * share.value:.0f} % pass ({100 * share.low:.0f} to {100 * share.high:.0f} %)"
        return f"{estimate}, {lost}" if lost else estimate


@contextmanager
def shown(live: bool) -> Iterator[Progress]:
    """What shows the progress on this terminal, if it is one."""
    console = Console(stderr=True)
    if not console.is_terminal:
        yield Progress(live=live)
        return
    columns = (TextColumn("surveys"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Bar(*columns, TextColumn("{task.fields[note]}"), console=console) as bar:
        yield Progress(bar, live)


def line_on(row: Row) -> str:
    """A survey in a line."""
    missed = "" if has_passed(row) else ", missed its limits"
    how = row["status"] + (f" ({row['reason']})" if row["reason"] else missed)
    varied = ", ".join(f"{name[5:]} {_short(value)}" for name, value in row.items() if name.startswith("vary."))
    return f"sample {row['sample']}, seed {row['seed']}: {how}" + (f"; {varied}" if varied else "")


def _short(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
