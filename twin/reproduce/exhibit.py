"""Results of one experiment as tables and figures, and the files that show them: JSON, index page, docs/paper.md."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from twin.core.templates import filled
from twin.core.user_files import read_json, read_text
from twin.errors import TwinError
from twin.report.html import render_page

SCHEMA = "twin.exhibit/1"
RESULTS_FILE, PAGE_FILE = "results.json", "index.html"
DASH = "-"
#: Markers of the chapter "How true is it?" of docs/paper.md, and its heading.
BEGIN = "<!-- begin: written by `twin reproduce chapter`, do not edit -->"
END = "<!-- end: written by `twin reproduce chapter` -->"
HEADING = "## How true is it?"
#: Tables of the chapter: experiment and key. The index page has all of them.
SHOWN = (
    ("paper", "claims"), ("paper", "tracks"), ("paper", "map"), ("tank1", "sizes"), ("tank1", "map"),
    ("tank2", "closure"), ("tank2", "sizes"), ("tank2", "map"), ("budget", "budget"),
)  # fmt: skip

Row = tuple[str, ...]


class Table(NamedTuple):
    key: str  #: name of the table within its experiment
    title: str
    rows: tuple[Row, ...]  #: rows of text, the header first


class Figure(NamedTuple):
    """A PNG file in the folder of the experiment, and its caption."""

    file: str
    caption: str


class Exhibit(NamedTuple):
    name: str  #: as in `twin reproduce NAME`
    title: str
    text: str  #: description of the experiment, in a few sentences
    tables: tuple[Table, ...]
    figures: tuple[Figure, ...] = ()

    def table(self, key: str) -> Table:
        return next(table for table in self.tables if table.key == key)

    def as_dict(self) -> dict[str, Any]:
        tables, figures = ([item._asdict() for item in items] for items in (self.tables, self.figures))
        return self._asdict() | {"tables": tables, "figures": figures}


def make_table(key: str, title: str, rows: Sequence[Sequence[str]]) -> Table:
    return Table(key, title, tuple(tuple(row) for row in rows))


def write_json(file: Path, contents: Any) -> None:
    """Writes a JSON file, in a folder that is created if missing."""
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps(contents, indent=1) + "\n", encoding="utf-8")


def write_exhibit(exhibit: Exhibit, folder: Path) -> Exhibit:
    """Writes NAME.json to a folder, which is created if missing; returns the exhibit."""
    write_json(folder / f"{exhibit.name}.json", {"schema": SCHEMA} | exhibit.as_dict())
    return exhibit


def write_all(exhibits: Sequence[Exhibit], folder: Path, quick: bool) -> None:
    """Writes results.json and index.html, which shows the figures in the subfolders of the experiments, to a folder."""
    contents = {"schema": f"{SCHEMA}s", "quick": quick, "exhibits": [exhibit.as_dict() for exhibit in exhibits]}
    write_json(folder / RESULTS_FILE, contents)
    page = render_page("twin.reproduce", "index_page.html.j2", {"exhibits": exhibits, "quick": quick})
    (folder / PAGE_FILE).write_text(page, encoding="utf-8")


def read_all(file: Path) -> tuple[list[Exhibit], bool]:
    """Returns the exhibits in a results.json, and whether of quick versions; raises TwinError if it is not readable."""
    contents = read_json(file, "", "results.json of `twin reproduce all`")
    if not isinstance(contents, dict) or not isinstance(contents.get("exhibits"), list):
        raise TwinError(str(file), "has no list of exhibits", "results.json of `twin reproduce all`")
    return [_exhibit_of(entry, file) for entry in contents["exhibits"]], bool(contents.get("quick"))


def _exhibit_of(contents: Any, file: Path) -> Exhibit:
    try:
        tables = tuple(make_table(t["key"], t["title"], t["rows"]) for t in contents["tables"])
        figures = tuple(Figure(f["file"], f["caption"]) for f in contents["figures"])
        return Exhibit(contents["name"], contents["title"], contents["text"], tables, figures)
    except (KeyError, TypeError, AttributeError) as error:
        raise TwinError(str(file), f"is not a result of `twin reproduce`: {error!r}", "results.json") from None


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


def update_chapter(page: Path, exhibits: Sequence[Exhibit], quick: bool) -> None:
    """Replaces the chapter in a Markdown file; raises TwinError if it cannot be read or lacks the markers."""
    text = read_text(page, "", "a Markdown file")
    page.write_text(with_chapter(text, chapter(exhibits, quick), str(page)), encoding="utf-8")


def millimetres(value_m: float | None) -> str:
    """Returns a length as text in millimetres, with 2 decimals below 10 mm, 1 below 100 mm, else 0; "-" if unknown."""
    if value_m is None or value_m != value_m:
        return DASH
    value = 1e3 * value_m
    return f"{value:.2f} mm" if abs(value) < 10 else f"{value:.1f} mm" if abs(value) < 100 else f"{value:.0f} mm"


def percent(share: float | None, digits: int = 0) -> str:
    """Returns a share (0 to 1) as text in percent, with `digits` decimals; "-" if it is unknown."""
    return DASH if share is None or share != share else f"{100 * share:.{digits}f} %"
