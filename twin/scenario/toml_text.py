"""Parsing of TOML text within limits of size, nesting and numbers, so that no file exhausts memory, stack or time."""

import re
import tomllib
from collections.abc import Iterator
from typing import Any

from twin.errors import TwinError

#: Limits of a TOML text: characters, levels of tables and arrays, and characters of a key.
MAX_CHARACTERS, MAX_LEVELS, MAX_KEY_CHARACTERS = 1_000_000, 32, 200
#: Smallest and largest integer (TOML 1.0: 64 bits, signed).
MIN_INTEGER, MAX_INTEGER = -(2**63), 2**63 - 1

#: A dotted key with more than 100 parts; the time that `tomllib` takes grows with the square of their number.
_LONG_KEY = re.compile(r"""(?<![\w"'.-])(?:["'\w-]+[ \t]*\.[ \t]*){100}""")


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
