"""What a user sees in the terminal: results on stdout, progress and faults on stderr."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.progress import BarColumn, TaskProgressColumn, TextColumn
from rich.progress import Progress as Bar
from rich.table import Table

if TYPE_CHECKING:
    from twin.survey import Progress


def fault(text: str) -> None:
    """A fault, on stderr, as it is: nothing in it is wrapped or coloured."""
    print(text, file=sys.stderr)


@contextmanager
def progress_bar() -> Iterator[Callable[[Progress], None]]:
    """A bar on a terminal, nothing elsewhere; yields what tells it how far the survey is."""
    console = Console(stderr=True)
    if not console.is_terminal:
        yield lambda _: None
        return
    stage, words = TextColumn("{task.description:>7}"), TextColumn("{task.fields[note]}")
    with Bar(stage, BarColumn(), TaskProgressColumn(), words, console=console) as bar:
        task = bar.add_task("survey", total=1.0, note="")
        yield lambda now: bar.update(task, completed=now.share, description=now.stage, note=note(now))


def note(now: Progress) -> str:
    """Simulated time, real-time factor and believed error; after the flight the wall time."""
    if not now.simulated_s:
        return f"{now.wall_s:.0f} s"
    factor = now.simulated_s / max(now.wall_s, 1e-3)
    return f"{now.simulated_s:.1f} s simulated, {factor:.2f} x real time, position ± {100 * now.sigma_m:.1f} cm"


def table(title: str, rows: list[tuple[str, ...]]) -> None:
    """Rows of words on stdout; wide where it is not a terminal, so that no line breaks."""
    console = Console(width=None if sys.stdout.isatty() else 120)
    grid = Table(title=title, title_justify="left", show_header=False)
    for row in rows:
        grid.add_row(*row)
    console.print(grid)


def errors(metrics: dict[str, Any]) -> None:
    """The error table of a survey, and what was required of it."""
    from twin.report.wording import key_figures, plain

    table(f"{metrics['name']}, seed {metrics['seed']}: {metrics['status']}", [tuple(f) for f in key_figures(metrics)])
    if metrics["require"]:
        rows = [
            (name, plain(r["value"]), f"limit {plain(r['limit'])}", "passed" if r["passed"] else "MISSED")
            for name, r in metrics["require"].items()
        ]
        table("Required", rows)


def pictures(folder: Path) -> None:
    """Where the pictures of a run are, as far as they could be written."""
    if (folder / "report.html").is_file():
        print(f"Report: {folder / 'report.html'}")
    if (folder / "run.rrd").is_file():
        print(f"Open the recording: twin view {folder}")
