"""Terminal output: results on stdout, progress and errors on stderr."""

import errno
import io
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.progress import BarColumn, TaskProgressColumn, TextColumn
from rich.progress import Progress as Bar
from rich.table import Table

from twin.errors import TwinError

if TYPE_CHECKING:
    from twin.planning.summary import PlanSummary
    from twin.session.monitor import SurveyProgress

_OF_THE_MACHINE = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EMFILE, errno.ENFILE, errno.EIO, errno.EROFS)
_COMPILED_LATE = {"rendered": "twin.estimate.mapping.orthophoto", "surrogate": "twin.surrogate.sampling"}
_ADDRESS_SPACE = 3_000_000_000  # smallest limit under which a small survey ends [bytes]


def print_error(text: str) -> None:
    """Prints a text on stderr, without line wrapping or colours; unprintable characters become escape sequences."""
    printable = (c if c.isprintable() or c == "\n" else repr(c)[1:-1] for c in text)
    print("".join(printable), file=sys.stderr)


def prepare_streams() -> None:
    """Opens the null device in place of closed standard streams, whose numbers the next files would get.

    Sets stdout to print a backslash escape for each character that its encoding cannot represent. Hides the traceback
    that rasterio prints if GDAL's message quotes bytes of a damaged file that are not UTF-8.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            os.dup2(os.open(os.devnull, os.O_RDWR), number)
            setattr(sys, name, open(number, "w" if number else "r", encoding="utf-8", closefd=False))
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")
    default = sys.unraisablehook

    def hook(failure: "sys.UnraisableHookArgs") -> None:
        if failure.object != "rasterio._env.log_error":
            default(failure)

    sys.unraisablehook = hook


def refuse_little_memory() -> None:
    """Raises TwinError if the address space is limited to less than the libraries of a survey map: they would crash."""
    if sys.platform == "win32":
        return
    import resource

    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    if 0 <= limit < _ADDRESS_SPACE:
        raise TwinError("memory", f"the limit of the address space (ulimit -v) is {limit / 1e9:.2g} GB", "3 GB or more")


@contextmanager
def machine_errors() -> Iterator[None]:
    """Raises TwinError in place of an error that a full disk, too little memory or too few file descriptors cause."""
    try:
        try:
            yield
        finally:
            sys.stdout.flush()
    except (MemoryError, ImportError) as error:
        if isinstance(error, ImportError) and "failed to map" not in str(error):  # a library does not fit in memory
            raise
        raise TwinError("memory", "is used up", "more memory, or a smaller survey") from None
    except OSError as error:
        if error.errno not in _OF_THE_MACHINE:
            raise
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # else the flush at the end of the program fails again
        raise TwinError(str(error.filename or "stdout"), str(error.strerror), "one that can be written") from None


@contextmanager
def _bar(task: str, *columns: TextColumn) -> Iterator[Callable[..., None]]:
    console = Console(stderr=True)
    if not console.is_terminal:
        yield lambda **_: None
        return
    with Bar(TextColumn("{task.description:>7}"), BarColumn(), TaskProgressColumn(), *columns, console=console) as bar:
        shown = bar.add_task(task, total=1.0, note="")
        yield lambda **fields: bar.update(shown, **fields)


def note_first_use(fidelity: str) -> None:
    """Prints a note on stderr if the code of a survey is still to be compiled."""
    from twin.kernels import has_code

    if not has_code(_COMPILED_LATE[fidelity]):
        print_error(f"The first {fidelity} survey on this computer compiles its code, which takes some minutes.")


@contextmanager
def progress_bar() -> "Iterator[Callable[[SurveyProgress], None]]":
    with _bar("survey", TextColumn("{task.fields[note]}")) as update:
        yield lambda now: update(completed=now.share, description=now.stage, note=progress_note(now))


@contextmanager
def replay_bar() -> Iterator[Callable[[str, float], None]]:
    """Shows a progress bar if stderr is a terminal; yields the function that updates it with stage and fraction."""
    with _bar("replay") as update:
        yield lambda stage, share: update(completed=share, description=stage)


def progress_note(now: "SurveyProgress") -> str:
    """Returns the progress of a survey as text: during the flight, with real-time factor and position uncertainty."""
    if not now.simulated_s:
        return f"{now.wall_s:.0f} s"
    factor = now.simulated_s / max(now.wall_s, 1e-3)
    return f"{now.simulated_s:.1f} s simulated, {factor:.2f} x real time, position ± {100 * now.sigma_m:.1f} cm"


def print_table(title: str, rows: list[tuple[str, ...]]) -> None:
    """Prints a table on stdout, at most as wide as the terminal, or as 120 characters if stdout is not a terminal."""
    console = Console(width=None if sys.stdout.isatty() else 120, markup=False, emoji=False)
    grid = Table(title=title, title_justify="left", show_header=False)
    for row in rows:
        grid.add_row(*row)
    console.print(grid)


def print_plan(summary: "PlanSummary") -> None:
    from twin.planning import summary as plan_summary
    from twin.report.headline import input_rows

    print_table(f"Plan of {summary.mission.scenario.name}", plan_summary.rows(summary))
    if stated := input_rows(summary.mission.stated_input):
        print_table("Input", [*stated])
    print_table("Over the floor", plan_summary.floor_rows(summary))
    if summary.require:
        print_requirements(summary.require, " expected", "ok")
    for sentence in summary.warnings:
        print_error(f"Warning: {sentence}.")


def print_requirements(require: dict[str, dict[str, Any]], suffix: str, passed: str) -> None:
    """Prints a table of the requirements; `passed` is the word for a limit that is met."""
    from twin.report.number_formats import with_unit

    rows = [
        (name, with_unit(name, row["value"]) + suffix, f"limit {with_unit(name, row['limit'])}",
         passed if row["passed"] else "MISSED")
        for name, row in require.items()
    ]  # fmt: skip
    print_table("Required", rows)


def print_metrics(metrics: dict[str, Any]) -> None:
    from twin.report.headline import badge, first_lines, key_figures, results

    seed = "" if metrics["seed"] is None else f", seed {metrics['seed']}"
    print(f"{metrics['name']}{seed}: {badge(metrics).text}")
    if metrics.get("replay"):
        print(results(metrics))
    for sentence in first_lines(metrics):
        print(f"- {sentence}")
    print_table("Key figures", [tuple(figure) for figure in key_figures(metrics)])
    if metrics["require"]:
        print_requirements(metrics["require"], "", "passed")


def print_outputs(folder: Path) -> None:
    if (folder / "report.html").is_file():
        print(f"Report: {folder / 'report.html'}")
    if (folder / "run.rrd").is_file():
        print(f"Open the recording: twin view {folder}")
