"""Results of a study on disk: one JSON line per survey while it runs, and one Parquet table at the end."""

import errno
import json
import os
from collections.abc import Container, Iterator
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from twin.studies.flight import Row

JOURNAL_FILE = "optuna.journal"  #: in the folder of a search, beside the log: its candidates
_IDENTITY = ("sample", "seed", "status", "reason", "unmodelled", "warning", "fidelity", "scenario_hash")
_KEYS = {"sample": int, "seed": int, "scenario_hash": str, "status": str, "reason": str}  # without them: a damaged row
_CHUNK = 1000  # rows converted to columns at a time: 100,000 rows as dictionaries would take gigabytes


class ResultsLog:
    """Log in rows.jsonl, one row per line, the last of a survey counts; unwritten rows (full disk) follow later."""

    def __init__(self, folder: Path):
        self.file = folder / "rows.jsonl"
        self._unwritten: list[str] = []

    def add(self, row: Row) -> None:
        """Writes a row and earlier ones that could not be written; ignores a failure of the write."""
        self._unwritten.append(json.dumps(row) + "\n")
        with suppress(OSError):
            self.flush()

    def flush(self) -> None:
        """Writes the rows that are still in memory; raises OSError if the file cannot be written."""
        if not self._unwritten:
            return
        with self.file.open("a+b", buffering=0) as file:
            begin = file.seek(0, 2)
            file.seek(max(begin - 1, 0))
            is_cut = file.read(1) not in (b"", b"\n")  # the last line, e.g. by a power failure
            lines = b"\n" * is_cut + "".join(self._unwritten).encode()
            if (file.write(lines) or 0) < len(lines):
                file.truncate(begin)  # remove the partly written row
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self.file))
        self._unwritten.clear()

    def rows(self) -> Iterator[Row]:
        """Yields all rows of the file in the order in which they were written; skips damaged rows."""
        if not self.file.exists():
            return
        with self.file.open("rb") as file:
            for line in file:
                try:
                    row = json.loads(line)
                except ValueError:
                    continue
                if isinstance(row, dict) and all(isinstance(row.get(key), kind) for key, kind in _KEYS.items()):
                    if not any(isinstance(value, str) for key, value in row.items() if key.startswith("require.")):
                        yield row

    def done(self) -> set[tuple[int, int]]:
        """Returns (sample, seed) of every survey whose last row does not have the status "failed"."""
        last = {key_of(row): row["status"] for row in self.rows()}
        return {key for key, status in last.items() if status != "failed"}

    def table(self, wanted: Container[tuple[int, int]] | None = None) -> pa.Table:
        """Returns the last row of each of the `wanted` surveys (None: of all) as a table, sorted by sample and seed."""
        last = {key_of(row): number for number, row in enumerate(self.rows())}
        included = {number for key, number in last.items() if wanted is None or key in wanted}

        def included_rows() -> Iterator[Row]:
            return (row for number, row in enumerate(self.rows()) if number in included)

        kinds: dict[str, set[type]] = {}
        for row in included_rows():
            for name, value in row.items():
                kinds.setdefault(name, set()).add(type(value))
        types = {name: _column_type(found - {type(None)}) for name, found in kinds.items()}
        rows, chunks = included_rows(), []
        while chunk := list(islice(rows, _CHUNK)):
            chunks.append(pa.table({name: _column([row.get(name) for row in chunk], types[name]) for name in types}))
        if not chunks:
            return pa.table({})
        whole = pa.concat_tables(chunks).sort_by([("sample", "ascending"), ("seed", "ascending")])
        return whole.select(sorted(whole.column_names, key=_column_order)).combine_chunks()


def cut_torn_line(file: Path) -> None:
    """Removes an unfinished last line, e.g. of a power failure, from a file, which may be missing."""
    if file.exists():
        data = file.read_bytes()
        os.truncate(file, data.rfind(b"\n") + 1)


def key_of(row: Row) -> tuple[int, int]:
    return row["sample"], row["seed"]


def write_parquet(rows: pa.Table, file: Path) -> None:
    """Writes a table to a Parquet file atomically."""
    part = file.with_name(f".{file.name}.part")
    pq.write_table(rows, part)
    part.replace(file)


def _column_order(name: str) -> tuple[int, int, str]:
    if name in _IDENTITY:
        return 0, _IDENTITY.index(name), name
    return {"vary": 1, "timing": 3}.get(name.partition(".")[0], 2), 0, name


def _column_type(kinds: set[type]) -> pa.DataType:
    """Returns the type of a column; lists, dictionaries and mixtures of these kinds are stored as text."""
    if not kinds:
        return pa.null()
    columns = (({bool}, pa.bool_()), ({int}, pa.int64()), ({int, float}, pa.float64()))
    return next((column for numbers, column in columns if kinds <= numbers), pa.string())


def _column(values: list[Any], kind: pa.DataType) -> pa.Array:
    if kind == pa.string():
        values = [value if value is None or isinstance(value, str) else _text(value) for value in values]
    return pa.array(values, kind)


def _text(value: Any) -> str:
    """Returns JSON or, for tables such as `[[faults]]`, their values as words, which tell them apart."""
    if isinstance(value, list) and value and all(isinstance(one, dict) for one in value):
        return "; ".join(" ".join(_word(key, item) for key, item in one.items()) for one in value)
    return json.dumps(value)


def _word(key: str, value: Any) -> str:
    if isinstance(value, str):
        return value
    name, _, unit = key.rpartition("_")
    number = f"{value:g}" if isinstance(value, int | float) else json.dumps(value)
    return f"{name} {number} {unit}" if name else f"{key} {number}"
