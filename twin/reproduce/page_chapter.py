"""The chapter "How true is it?" of docs/paper.md, generated from the results of `twin reproduce all`."""

from collections.abc import Sequence
from pathlib import Path

from twin.core.templates import filled
from twin.core.user_files import read_text
from twin.errors import TwinError
from twin.reproduce.exhibit import Exhibit

BEGIN = "<!-- begin: written by `twin reproduce chapter`, do not edit -->"
END = "<!-- end: written by `twin reproduce chapter` -->"
HEADING = "## How true is it?"
#: Tables of the chapter: experiment and key. The index page has all of them.
SHOWN = (
    ("paper", "claims"), ("paper", "tracks"), ("paper", "map"), ("tank1", "sizes"), ("tank1", "map"),
    ("tank2", "closure"), ("tank2", "sizes"), ("tank2", "map"), ("budget", "budget"),
)  # fmt: skip


def chapter(exhibits: Sequence[Exhibit], quick: bool) -> str:
    """Returns the chapter between its markers; a text stands above the first table of each experiment."""
    shown = [(e, t) for name, key in SHOWN for e in exhibits if e.name == name for t in e.tables if t.key == key]
    context = {"shown": shown, "quick": quick, "begin": BEGIN, "end": END, "heading": HEADING}
    return filled("twin.reproduce", "chapter.md.j2", context)


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
