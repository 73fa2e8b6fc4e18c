"""The chapter "How true is it?" of docs/paper.md, generated from the results of `twin reproduce all`."""

from collections.abc import Sequence
from pathlib import Path

from twin.core.user_files import read_text
from twin.errors import TwinError
from twin.reproduce.exhibit import Exhibit, Table

BEGIN = "<!-- begin: written by `twin reproduce chapter`, do not edit -->"
END = "<!-- end: written by `twin reproduce chapter` -->"
HEADING = "## How true is it?"
#: Tables of the chapter: experiment and key. The index page has all of them.
SHOWN = (
    ("paper", "claims"), ("paper", "tracks"), ("paper", "map"), ("tank1", "sizes"), ("tank1", "map"),
    ("tank2", "closure"), ("tank2", "sizes"), ("tank2", "map"), ("budget", "budget"),
)  # fmt: skip


def chapter(exhibits: Sequence[Exhibit], quick: bool) -> str:
    shown = [(e, t) for name, key in SHOWN for e in exhibits if e.name == name for t in e.tables if t.key == key]
    plans = " (quick plans: `--quick`)" if quick else ""
    lines = [
        BEGIN, HEADING, "",
        f"The experiments of Negahdaripour & Madjidi (2003), flown in the simulated world{plans}. `twin reproduce all` "
        "writes these tables and all others, with the figures, to one page.",
    ]  # fmt: skip
    described = set[str]()
    for exhibit, table in shown:
        lines += [""] if exhibit.name in described else ["", f"**{exhibit.title}.** {exhibit.text}", ""]
        described.add(exhibit.name)
        lines += [f"*{table.title}*", "", *_markdown(table)]
    return "\n".join([*lines, END])


def _markdown(table: Table) -> list[str]:
    header, *rows = [[cell.replace("|", "\\|") for cell in row] for row in table.rows]
    return [_line(header), _line(["---"] * len(header)), *map(_line, rows)]


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |".replace("|  |", "| |")


def with_chapter(page: str, text: str, name: str = "page") -> str:
    """Returns a page whose marked part is the chapter; raises TwinError unless each marker is there once, in order."""
    first, last = page.find(BEGIN), page.find(END)
    if min(first, last) < 0 or last < first or page.count(BEGIN) != 1 or page.count(END) != 1:
        raise TwinError(name, "does not have the markers of the chapter once", f"the lines {BEGIN} and {END}")
    return page[:first] + text + page[last + len(END) :]


def update(page: Path, exhibits: Sequence[Exhibit], quick: bool) -> None:
    """Replaces the chapter in a Markdown file; raises TwinError if it cannot be read or lacks the markers."""
    text = read_text(page, "", "a Markdown file")
    page.write_text(with_chapter(text, chapter(exhibits, quick), str(page)), encoding="utf-8")
