"""The rows of a study on disk: each is written down as it comes, and all of them become one Parquet table."""

from __future__ import annotations

import errno
import json
import os
from collections.abc import Container, Iterable, Iterator
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import IO, Any

import pyarrow as pa
import pyarrow.parquet as pq

from twin.study.flight import Row

_CHUNK = 1000  # rows turned into columns at a time: a hundred thousand as dictionaries would take gigabytes


class Ledger:
    """rows.jsonl: a row a line, the last of a survey counts. A full disk keeps rows waiting, and never ends a study."""

    def __init__(self, folder: Path):
        self.file = folder / "rows.jsonl"
        self._waiting: list[str] = []

    def add(self, row: Row) -> None:
        """Writes a row down, with those that could not be written before."""
        self._waiting.append(json.dumps(row) + "\n")
        with suppress(OSError):
            self.flush()

    def flush(self) -> None:
        """Writes down what waits. Raises OSError where it cannot."""
        if not self._waiting:
            return
        with self.file.open("a+b", buffering=0) as file:
            begin = file.seek(0, 2)
            lines = _lead(file, begin) + "".join(self._waiting).encode()
            if (file.write(lines) or 0) < len(lines):
                file.truncate(begin)  # of a row all or nothing
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self.file))
        self._waiting.clear()

    def rows(self) -> Iterator[Row]:
        """Every row that was written whole, in the order of writing."""
        if not self.file.exists():
            return
        with self.file.open("rb") as file:
            for line in file:
                try:
                    row = json.loads(line)
                except ValueError:
                    continue
                if isinstance(row, dict) and "sample" in row:
                    yield row

    def done(self) -> set[tuple[int, int]]:
        """Sample and seed of the surveys that need not be flown again."""
        status = {(row["sample"], row["seed"]): row["status"] for row in self.rows()}
        return {key for key, ended in status.items() if ended != "failed"}

    def table(self, wanted: Container[tuple[int, int]] | None = None) -> pa.Table:
        """The rows that count of the surveys wanted (None: all), by sample and seed, with the columns of all of them.

        The same rows in any order of writing give the same table.
        """
        latest = {(row["sample"], row["seed"]): number for number, row in enumerate(self.rows())}
        counts = {number for key, number in latest.items() if wanted is None or key in wanted}

        def counting() -> Iterator[Row]:
            return (row for number, row in enumerate(self.rows()) if number in counts)

        types: dict[str, pa.DataType] = {}
        for row in counting():
            for name, value in row.items():
                types[name] = _wider(types.get(name, pa.null()), _type(value))
        rows, chunks = counting(), []
        while chunk := list(islice(rows, _CHUNK)):
            chunks.append(pa.table({name: _column([row.get(name) for row in chunk], types[name]) for name in types}))
        if not chunks:
            return pa.table({})
        whole = pa.concat_tables(chunks).sort_by([("sample", "ascending"), ("seed", "ascending")])
        return whole.select(_ordered(whole.column_names)).combine_chunks()


def _lead(file: IO[bytes], end: int) -> bytes:
    """What to write first: a line that was cut off, as by a loss of power, is ended before the next."""
    if end == 0:
        return b""
    file.seek(end - 1)
    return b"" if file.read(1) == b"\n" else b"\n"


def write_parquet(rows: pa.Table, file: Path) -> None:
    """Writes the table, atomically."""
    part = file.with_name(f".{file.name}.part")
    pq.write_table(rows, part)
    part.replace(file)


def _ordered(names: Iterable[str]) -> list[str]:
    """Identity, what varies, figures, times: within each by name, as rows come in no order of their own."""
    identity = ("sample", "seed", "status", "reason", "warning", "scenario_hash")
    sections = {"vary": 1, "timing": 3}

    def place(name: str) -> tuple[int, int, str]:
        if name in identity:
            return 0, identity.index(name), name
        return sections.get(name.partition(".")[0], 2), 0, name

    return sorted(names, key=place)


def _type(value: Any) -> pa.DataType:
    """The column that holds a value; what is neither number nor text goes in as JSON."""
    if value is None:
        return pa.null()
    for kind, column in ((bool, pa.bool_()), (int, pa.int64()), (float, pa.float64())):
        if isinstance(value, kind):
            return column
    return pa.string()


def _wider(one: pa.DataType, other: pa.DataType) -> pa.DataType:
    """The column that holds both."""
    if one == other or pa.types.is_null(other):
        return one
    if pa.types.is_null(one):
        return other
    return pa.float64() if {one, other} == {pa.int64(), pa.float64()} else pa.string()


def _column(values: list[Any], kind: pa.DataType) -> pa.Array:
    if kind == pa.string():
        values = [value if value is None or isinstance(value, str) else json.dumps(value) for value in values]
    elif kind == pa.float64():
        values = [None if value is None else float(value) for value in values]
    return pa.array(values, kind)
