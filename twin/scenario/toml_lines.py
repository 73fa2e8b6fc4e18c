"""Line numbers of the keys in a TOML text."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import tomlkit
from tomlkit.exceptions import TOMLKitError
from tomlkit.items import AbstractTable, AoT, Array, Item, Key, Table

#: Commas, whitespace and comments between the items of an array.
_SEPARATOR = re.compile(r"(?:[\s,]|#[^\n]*)*")

#: Longest text that is parsed for line numbers; tomlkit takes up to 0.1 ms per character.
_MAX_PARSED = 50_000
#: A row with a table header, and the beginning of a row with a key; quotes in a key are part of the match.
_HEADER = re.compile(r"\s*\[(\[?)([^\[\]=#]{1,400})\]\]?\s*(?:#.*)?$")
_KEY = re.compile(r"\s*([\w\"'.\- \t]{1,400}?)\s*=")

_Body = Sequence[tuple[Key | None, Item]]


class _Block(NamedTuple):
    """A table header and the lines below it, up to the next header.

    Args:
        header: the header without whitespace, `[plan]` or `[[lamps]]`; empty for the lines before the first header.
        keys: dotted keys, each with its line in the block, counted from 0.
        n_lines: number of lines.
    """

    header: str
    keys: list[tuple[str, int]]
    n_lines: int


def key_lines(text: str) -> dict[str, int]:
    """Returns the line number, counted from 1, of every key and table of a TOML text.

    Keys are dotted and without quotes; items of arrays are counted from 0 (`lamps.0.position_m`). In a text of more
    than 50,000 characters, and in a valid text that tomlkit rejects, only table headers and keys that begin a row are
    found.
    """
    if len(text) > _MAX_PARSED:
        return _keys_of_rows(text)
    try:
        return _parsed_key_lines(text)
    except TOMLKitError:
        return _keys_of_rows(text)


def _keys_of_rows(text: str) -> dict[str, int]:
    """Returns the line number of every table header, and of every key that begins a row."""
    lines: dict[str, int] = {}
    n_items: dict[str, int] = {}
    table = ""
    for number, row in enumerate(text.split("\n"), start=1):
        if header := _HEADER.match(row):
            name = table = _unquoted(header[2])
            if header[1]:  # an item of an array of tables
                table = f"{name}.{n_items.setdefault(name, 0)}"
                n_items[name] += 1
            lines.setdefault(name, number)
            lines.setdefault(table, number)
        elif key := _KEY.match(row):
            lines.setdefault(f"{table}.{_unquoted(key[1])}".removeprefix("."), number)
    return lines


def _unquoted(key: str) -> str:
    """Returns a dotted key without quotes and spaces."""
    return re.sub(r"[\s\"']", "", key)


def _parsed_key_lines(text: str) -> dict[str, int]:
    """Returns the line number of every key and table of a TOML text. Raises TOMLKitError if tomlkit rejects it."""
    rows = ["".join(row.split()) for row in text.split("\n")]
    blocks = list(_blocks("", "", tomlkit.parse(text).body, 0))
    lines: dict[str, int] = {}
    first_row = 0
    while blocks:
        # tomlkit keeps the tables of one array together, even if the file has other tables between them
        row = rows[min(first_row, len(rows) - 1)]
        block = next((block for block in blocks if row.startswith(block.header)), blocks[0])
        blocks.remove(block)
        for key, row_in_block in block.keys:
            lines.setdefault(key, first_row + row_in_block + 1)
        first_row += block.n_lines
    return lines


def _blocks(header: str, path: str, body: _Body, n_header_lines: int) -> Iterator[_Block]:
    """Yields the block of the top level or of a table, if it has a header of its own, then those of the tables in it.

    Args:
        header: header of the table; empty for the top level and for a table without a header of its own.
        path: dotted key of the table; empty for the top level.
        body: keys and items of the table.
        n_header_lines: number of lines that the header occupies, 0 or 1.
    """
    keys = [(path, 0)] if path else []
    row, tables = n_header_lines, []
    for key, item in body:
        if key is not None and isinstance(item, AoT | Table) and not key.is_dotted():
            tables.append((_join(path, key), item))
        else:
            row = _locate(keys, path, key, item, row)
    if header or not path:
        yield _Block(header, keys, row)
    for name, item in tables:
        if isinstance(item, AoT):
            for index, table in enumerate(item.body):
                header = _squeezed(f"[[{table.display_name}]]")
                yield from _with_parent(name, _blocks(header, f"{name}.{index}", table.value.body, 1))
        elif item.is_super_table():
            yield from _with_parent(name, _blocks("", name, item.value.body, 0))
        else:
            yield from _blocks(_squeezed(f"[{item.display_name}]"), name, item.value.body, 1)


def _with_parent(name: str, blocks: Iterator[_Block]) -> Iterator[_Block]:
    """Yields the blocks and adds the key `name` of their parent, which has no header of its own, to the first block."""
    for position, block in enumerate(blocks):
        if position == 0:
            block.keys.insert(0, (name, 0))
        yield block


def _locate(keys: list[tuple[str, int]], path: str, key: Key | None, item: Item, row: int) -> int:
    """Adds a key and the keys in its value, with their rows, to `keys`; returns the row where the next item begins."""
    if key is None:  # whitespace or a comment
        return row + item.as_string().count("\n")
    name = _join(path, key)
    row += item.trivia.indent.count("\n")
    keys.append((name, row))
    row = _locate_value(keys, name, item, row)
    return row + (0 if isinstance(item, AbstractTable) and key.is_dotted() else item.trivia.trail.count("\n"))


def _locate_value(keys: list[tuple[str, int]], name: str, item: Item, row: int) -> int:
    """Adds the keys in a value, with their rows, to `keys`; returns the row in which the value ends."""
    if isinstance(item, AbstractTable):
        for key, value in item.value.body:
            row = _locate(keys, name, key, value, row)
        return row
    if isinstance(item, Array):
        return _locate_items(keys, name, item, row)
    return row + item.as_string().count("\n")


def _locate_items(keys: list[tuple[str, int]], name: str, array: Array, row: int) -> int:
    """Adds the items of an array and the keys in them, with their rows, to `keys`; returns the row of the last "]"."""
    text = array.as_string()
    position = 1
    for index in range(len(array)):
        gap = _SEPARATOR.match(text, position)
        assert gap is not None
        first_row = row + text.count("\n", 0, gap.end())
        item = array.item(index)
        keys.append((f"{name}.{index}", first_row))
        _locate_value(keys, f"{name}.{index}", item, first_row)
        position = gap.end() + len(item.as_string())
    return row + text.count("\n")


def _join(path: str, key: Key) -> str:
    return f"{path}.{key.key}" if path else key.key


def _squeezed(header: str) -> str:
    return "".join(header.split())
