"""Results of one experiment as tables and figures, for the index page and the chapter of docs/paper.md."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from twin.errors import TwinError

SCHEMA = "twin.exhibit/1"
DASH = "-"

Row = tuple[str, ...]


class Table(NamedTuple):
    """A table of the results of an experiment.

    Args:
        key: name of the table within its experiment.
        title: heading.
        rows: rows of text, the header first.
    """

    key: str
    title: str
    rows: tuple[Row, ...]


class Figure(NamedTuple):
    """A PNG file in the folder of the experiment, and its caption."""

    file: str
    caption: str


class Exhibit(NamedTuple):
    """Results of one experiment.

    Args:
        name: name of the experiment, as in `twin reproduce NAME`.
        title: heading.
        text: description of the experiment, in a few sentences.
        tables, figures: the results.
    """

    name: str
    title: str
    text: str
    tables: tuple[Table, ...]
    figures: tuple[Figure, ...] = ()

    def table(self, key: str) -> Table:
        """Returns the table with a given key, which must exist."""
        return next(table for table in self.tables if table.key == key)

    def as_dict(self) -> dict[str, Any]:
        """Returns the results as the contents of a JSON file."""
        return {
            "name": self.name,
            "title": self.title,
            "text": self.text,
            "tables": [table._asdict() for table in self.tables],
            "figures": [figure._asdict() for figure in self.figures],
        }


def make_table(key: str, title: str, rows: Sequence[Sequence[str]]) -> Table:
    """Returns a table of rows of text, the header first."""
    return Table(key, title, tuple(tuple(row) for row in rows))


def write_exhibit(exhibit: Exhibit, folder: Path) -> None:
    """Writes NAME.json to the folder of the experiment's figures, which is created if missing."""
    folder.mkdir(parents=True, exist_ok=True)
    contents = {"schema": SCHEMA} | exhibit.as_dict()
    (folder / f"{exhibit.name}.json").write_text(json.dumps(contents, indent=1) + "\n", encoding="utf-8")


def exhibit_of(contents: Any, file: Path) -> Exhibit:
    """Returns the exhibit in the contents of a JSON file.

    Raises:
        TwinError: the contents are not those of an exhibit.
    """
    try:
        tables = tuple(make_table(t["key"], t["title"], t["rows"]) for t in contents["tables"])
        figures = tuple(Figure(f["file"], f["caption"]) for f in contents["figures"])
        return Exhibit(contents["name"], contents["title"], contents["text"], tables, figures)
    except (KeyError, TypeError, AttributeError) as error:
        raise TwinError(str(file), f"is not a result of `twin reproduce`: {error!r}", "results.json") from None


def millimetres(value_m: float | None) -> str:
    """Returns a length as text in millimetres, with 2 decimals below 10 mm, 1 below 100 mm, else 0; "-" if unknown."""
    if value_m is None or value_m != value_m:
        return DASH
    value = 1e3 * value_m
    return f"{value:.2f} mm" if abs(value) < 10 else f"{value:.1f} mm" if abs(value) < 100 else f"{value:.0f} mm"


def percent(share: float | None, digits: int = 0) -> str:
    """Returns a share (0 to 1) as text in percent, with `digits` decimals; "-" if it is unknown."""
    return DASH if share is None or share != share else f"{100 * share:.{digits}f} %"
