"""Lines of a pose graph file (g2o or TORO) as columns of numbers, with the line number of each row."""

from __future__ import annotations

import math
import re
import warnings
from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core.geometry import Array
from twin.core.user_files import read_bytes
from twin.errors import TwinError

#: Maximum size of a file [bytes].
MAX_BYTES = 500_000_000
#: Maximum number of splits of a line: into the tag, the next two words (of an edge: its nodes) and the rest.
_SPLITS = 3
#: A number as `numpy.fromstring` reads it.
_NUMBER = re.compile(r"[+-]?(?:(?:\d+\.?\d*|\.\d+)(?:e[+-]?\d+)?|inf|infinity|nan)", re.ASCII | re.IGNORECASE)


class Layout(NamedTuple):
    """Layout of the lines of one tag: how many node numbers, and then how many values, follow the tag."""

    n_nodes: int
    n_values: int


class Rows(NamedTuple):
    """All lines of one tag.

    Args:
        line: (n,) number of each line in the file, from 1.
        nodes: (n, k) node numbers.
        values: (n, m) values.
    """

    line: NDArray[np.int64]
    nodes: NDArray[np.int64]
    values: Array


class IgnoredLines(NamedTuple):
    """Lines with an unknown tag: the tag, the number of these lines, and the line number of the first one, from 1."""

    tag: str
    n_lines: int
    first_line: int


def read_rows(file: Path, layouts: Mapping[str, Layout]) -> tuple[dict[str, Rows], tuple[IgnoredLines, ...]]:
    """Returns the lines with a tag in `layouts` as numbers, and the counts of lines with other tags.

    Empty lines and comments (#) are skipped; a byte order mark at the start is accepted.

    Returns:
        The rows of each tag of `layouts`, and the lines with other tags.

    Raises:
        TwinError: the file cannot be read, or a line has the wrong number of values, a node number that is not an
            integer, or a value that is not a finite number.
    """
    by_tag: dict[str, tuple[list[int], list[list[str]]]] = defaultdict(lambda: ([], []))
    for count, text in enumerate(_text(file).splitlines(), start=1):
        words = text.split(None, _SPLITS)
        if words and words[0][0] != "#":
            lines, rows = by_tag[words[0]]
            lines.append(count)
            rows.append(words)
    known = {tag: _rows(file, tag, layout, *by_tag.pop(tag, ([], []))) for tag, layout in layouts.items()}
    return known, tuple(IgnoredLines(tag, len(lines), lines[0]) for tag, (lines, _) in by_tag.items())


def _text(file: Path) -> str:
    """Returns the text of a file. Raises TwinError if it is not a file of UTF-8 text of at most `MAX_BYTES` bytes."""
    allowed = f"a g2o or TORO file of up to {MAX_BYTES} bytes in UTF-8"
    try:
        return read_bytes(file, "", allowed, MAX_BYTES).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        kind = "is UTF-16" if error.object[:2] in (b"\xff\xfe", b"\xfe\xff") else f"is not UTF-8: {error.reason}"
        line = error.object.count(b"\n", 0, error.start) + 1
        raise TwinError(f"{file}:{line}", kind, allowed) from None


def _rows(file: Path, tag: str, layout: Layout, lines: list[int], rows: list[list[str]]) -> Rows:
    """Returns the node numbers and values of all lines with a tag; raises TwinError at the first malformed line.

    Args:
        file: the file, for messages.
        tag: the tag.
        layout: layout of its lines.
        lines: number of each line in the file, from 1.
        rows: words of each line, split at most `_SPLITS` times.
    """
    first = 1 + layout.n_nodes
    try:
        nodes = np.array([int(row[k]) for row in rows for k in range(1, first)], np.int64)
        # NaN, which is never a valid value, terminates each row, so a wrong number of values in any row is detected
        texts = [row[first] if first == _SPLITS else " ".join(row[first:]) for row in rows]
        text = " nan ".join([*texts, ""])
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # a word that is not a number
            values = np.fromstring(text, sep=" ").reshape(len(rows), layout.n_values + 1)
        if not (np.isfinite(values[:, :-1]).all() and np.isnan(values[:, -1]).all()):
            raise ValueError
    except (ValueError, IndexError, OverflowError):
        raise _line_error(file, tag, layout, lines, rows) from None
    return Rows(np.array(lines, np.int64), nodes.reshape(-1, layout.n_nodes), values[:, :-1])


def _line_error(file: Path, tag: str, layout: Layout, lines: list[int], rows: list[list[str]]) -> TwinError:
    """Returns the error of the first malformed line of a tag; raises AssertionError if no line is malformed.

    The arguments are those of `_rows`.
    """
    allowed = f"{tag} followed by {layout.n_nodes} node number(s) and {layout.n_values} finite numbers"
    for line, row in zip(lines, rows, strict=True):
        words = " ".join(row[1:]).split()
        nodes, values = words[: layout.n_nodes], words[layout.n_nodes :]
        if len(values) != layout.n_values:
            return TwinError(f"{file}:{line}", f"has {len(values)} values instead of {layout.n_values}", allowed)
        for word in nodes:
            if not re.fullmatch(r"[+-]?\d{1,19}", word, re.ASCII) or abs(int(word)) >= 2**63:
                return TwinError(f"{file}:{line}", f"{word[:40]!r} is not a node number", allowed)
        for k, word in enumerate(values, start=1):
            if not _NUMBER.fullmatch(word):
                return TwinError(f"{file}:{line}", f"{word[:40]!r} is not a number", allowed)
            if not math.isfinite(float(word)):
                return TwinError(f"{file}:{line}", f"value {k} is {float(word)}", allowed)
    raise AssertionError(f"{file}: no line with the tag {tag} is malformed")
