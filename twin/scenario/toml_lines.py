"""Line numbers of the keys in a TOML text."""

import re
import tomllib
from collections import Counter

#: Strings, comments, line ends, punctuation, and other text up to the next of these; white space is left out.
_TOKEN = re.compile(
    r'"""(?:\\.|[^\\])*?"{3,5}'
    r"|'''.*?'{3,5}"
    r'|"(?:\\.|[^"\\])*"'
    r"|'[^']*'|#[^\n]*|\n|[\[\]{},=.]"
    r"|[^\s\[\]{},=.#\"']+",
    re.DOTALL,
)


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
