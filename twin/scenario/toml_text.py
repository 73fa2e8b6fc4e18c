"""TOML text: keys and values, within limits so that no file exhausts memory, stack or time, and lines of the keys."""

import re
import tomllib
from collections import Counter
from collections.abc import Iterator
from typing import Any

from twin.errors import TwinError

#: Limits of a TOML text: characters, levels of tables and arrays, and characters of a key.
MAX_CHARACTERS, MAX_LEVELS, MAX_KEY_CHARACTERS = 1_000_000, 32, 200
#: Smallest and largest integer (TOML 1.0: 64 bits, signed).
MIN_INTEGER, MAX_INTEGER = -(2**63), 2**63 - 1

#: A dotted key with more than 100 parts; the time that `tomllib` takes grows with the square of their number.
_LONG_KEY = re.compile(r"""(?<![\w"'.-])(?:["'\w-]+[ \t]*\.[ \t]*){100}""")
#: Strings, comments, line ends, punctuation, and other text up to the next of these; white space is left out.
_TOKEN = re.compile(
    r'"""(?:\\.|[^\\])*?"{3,5}'
    r"|'''.*?'{3,5}"
    r'|"(?:\\.|[^"\\])*"'
    r"|'[^']*'|#[^\n]*|\n|[\[\]{},=.]"
    r"|[^\s\[\]{},=.#\"']+",
    re.DOTALL,
)


def parse_toml(text: str) -> dict[str, Any]:
    """Returns the keys and values of a TOML text; `value_errors` checks the values.

    Raises ValueError, with the line number if it is known, if the text is not TOML, has more than `MAX_CHARACTERS`
    characters, is nested too deeply to be parsed, or has a key of more than 100 parts or an integer of more than 4300
    digits.
    """
    if len(text) > MAX_CHARACTERS:
        raise ValueError(f"{len(text)} characters (allowed: up to {MAX_CHARACTERS})")
    if long_key := _LONG_KEY.search(text):
        line = text.count("\n", 0, long_key.start()) + 1
        raise ValueError(f"a key has more than 100 parts (allowed: up to {MAX_LEVELS} levels) (at line {line})")
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise ValueError(f"too many levels of tables or arrays (allowed: up to {MAX_LEVELS})") from None
    except tomllib.TOMLDecodeError:
        raise
    except ValueError as error:  # an integer of more than 4300 digits
        if number := re.search(r"\d{4300}", text.replace("_", "")):
            line = text.replace("_", "").count("\n", 0, number.start()) + 1
            raise ValueError(f"an integer has thousands of digits (allowed: 64 bits) (at line {line})") from None
        raise ValueError(str(error)) from None


def value_errors(tree: dict[str, Any]) -> Iterator[TwinError]:
    """Yields an error for each value that is nested too deeply, each integer beyond 64 bits and each overlong key."""
    pending: list[tuple[str, int, Any]] = [("", 0, tree)]
    while pending:
        key, level, value = pending.pop()
        if level > MAX_LEVELS:
            yield TwinError(key, f"nested more than {MAX_LEVELS} levels deep", f"up to {MAX_LEVELS} levels")
        elif isinstance(value, dict):
            for name, item in value.items():
                if len(name) > MAX_KEY_CHARACTERS:
                    allowed = f"up to {MAX_KEY_CHARACTERS}"
                    yield TwinError(key or name[:20], f"a key has {len(name)} characters: {name[:20]!r}...", allowed)
                else:
                    pending.append((f"{key}.{name}" if key else name, level + 1, item))
        elif isinstance(value, list):
            pending += [(f"{key}.{k}", level + 1, item) for k, item in enumerate(value)]
        elif isinstance(value, int) and not MIN_INTEGER <= value <= MAX_INTEGER:
            yield TwinError(key, "an integer with too many digits", f"{MIN_INTEGER} to {MAX_INTEGER}")


def key_lines(text: str) -> dict[str, int]:
    """Returns the line number, counted from 1, of every key and table of a valid TOML text.

    Keys are dotted and without quotes; items of arrays are counted from 0 (`lamps.0.position_m`).
    """
    tokens, line = [], 1
    for token in _TOKEN.findall(text):
        if token[0] != "#":
            tokens.append((token, line))
            line += token.count("\n")
    return _Reader(tokens).read()


class _Reader:
    """Reads tokens with their lines by recursive descent."""

    def __init__(self, tokens: list[tuple[str, int]]) -> None:
        self.tokens = tokens[::-1]
        self.lines: dict[str, int] = {}
        self.n_items: Counter[str] = Counter()  # of each array of tables so far

    def read(self) -> dict[str, int]:
        table = ""
        while self._skip("\n"):
            if self.tokens[-1][0] == "[":
                table = self._header()
            else:
                self._pair(table)
        return self.lines

    def _header(self) -> str:
        path, is_item = "", self.tokens[-2][0] == "["
        del self.tokens[-1 - is_item :]
        while (token := self.tokens.pop())[0] != "]":
            if token[0] != ".":
                path = self._located(path, *token)
                self.n_items[path] += is_item and self.tokens[-1][0] == "]"
                if self.n_items[path]:
                    path = self._located(path, str(self.n_items[path] - 1), token[1])
        if is_item:
            self.tokens.pop()
        return path

    def _pair(self, path: str) -> None:
        while (token := self.tokens.pop())[0] != "=":
            if token[0] != ".":
                path = self._located(path, *token)
        self._value(path)

    def _value(self, path: str) -> None:
        opening, _ = self.tokens.pop()
        count = 0
        while opening in "[{" and self._skip("\n,") not in "]}":
            if opening == "{":
                self._pair(path)
            else:
                self._value(self._located(path, str(count), self.tokens[-1][1]))
                count += 1
        if opening in "[{":
            self.tokens.pop()
        while self.tokens and self.tokens[-1][0] not in "\n,]}":  # a value such as 1.5 has several tokens
            self.tokens.pop()

    def _skip(self, skipped: str) -> str:
        while self.tokens and self.tokens[-1][0] in skipped:
            self.tokens.pop()
        return self.tokens[-1][0] if self.tokens else ""

    def _located(self, path: str, part: str, line: int) -> str:
        name = tomllib.loads(f"key = {part}")["key"] if part[0] in "\"'" else part
        path = f"{path}.{name}" if path else name
        self.lines.setdefault(path, line)
        return path
