"""Gate for files that a user names: bounded regular files; whatever a reader raises becomes a TwinError of one line."""

from __future__ import annotations

import io
import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from twin.errors import TwinError, described

MOST_TEXT_BYTES = 64 * 2**20  #: largest text file, unless its reader sets another limit
IMAGE_FORMATS = ("PNG", "JPEG", "TIFF", "BMP", "WEBP")  #: formats of images by their names in Pillow
MOST_IMAGE_BYTES = 512 * 2**20  #: largest encoded image
_MOST_BYTES = 16 * 2**30  # largest file that is not read as a whole


@contextmanager
def reading(file: Path, key: str = "", allowed: str = "", most_bytes: int = _MOST_BYTES) -> Iterator[None]:
    """Checks a file; within the context, any exception of its reader becomes a TwinError.

    Args:
        key: key of the scenario that names the file; "": the error names the file itself.
        allowed: the files that are allowed, for the error.

    Raises:
        TwinError: the file is missing, not a regular file or too large, or its reader raised an exception.
    """
    _check(file, key, allowed, most_bytes)
    try:
        yield
    except TwinError:
        raise
    except Exception as error:  # readers raise any of many types for a damaged file
        reason = described(error).removeprefix("ValueError: ")
        raise _error(file, key, f"cannot be read: {reason}", allowed) from error


def read_bytes(file: Path, key: str = "", allowed: str = "", most_bytes: int = MOST_TEXT_BYTES) -> bytes:
    """Returns the contents of a file; raises TwinError as `reading` does."""
    with reading(file, key, allowed, most_bytes), file.open("rb") as stream:
        data = stream.read(most_bytes + 1)  # a file of /proc has more bytes than its size states
    if len(data) > most_bytes:
        raise _error(file, key, "is too large", _limit(most_bytes, allowed))
    return data


def read_text(
    file: Path, key: str = "", allowed: str = "", most_bytes: int = MOST_TEXT_BYTES, encoding: str = "utf-8-sig"
) -> str:
    """Returns the contents of a text file, lines ending in a line feed; raises TwinError as `reading` does."""
    data = read_bytes(file, key, allowed, most_bytes)
    with reading(file, key, allowed):
        return io.TextIOWrapper(io.BytesIO(data), encoding).read()


def read_json(file: Path, key: str = "", allowed: str = "", most_bytes: int = MOST_TEXT_BYTES) -> Any:
    """Returns the contents of a JSON file; raises TwinError as `reading` does."""
    text = read_text(file, key, allowed, most_bytes)
    with reading(file, key, allowed):
        try:
            return json.loads(text)
        except json.JSONDecodeError as error:
            raise _error(file, key, f"is not JSON: {error}", allowed) from None


def _check(file: Path, key: str, allowed: str, most_bytes: int) -> None:
    """Raises TwinError unless a path is a regular file of at most `most_bytes` bytes."""
    if not is_file(file):
        if problem := path_problem(file):
            raise _error(file, key, f"cannot be read: {problem}", allowed)
        if file.exists():
            raise _error(file, key, "is not a regular file", allowed)
        raise TwinError(key, f"no such file {str(file)!r}", allowed) if key else _error(file, key, "does not exist")
    n_bytes = file.stat().st_size
    if n_bytes > most_bytes:
        raise _error(file, key, f"is too large: {n_bytes} bytes", _limit(most_bytes, allowed))


def _limit(most_bytes: int, allowed: str) -> str:
    return f"at most {most_bytes} bytes" + (f", {allowed}" if allowed else "")


def _error(file: Path, key: str, problem: str, allowed: str = "") -> TwinError:
    if key:
        return TwinError(key, f"{file.name!r} {problem}", allowed)
    return TwinError(ascii(str(file))[1:-1] if not str(file).isprintable() else str(file), problem, allowed)


def is_file(path: Path) -> bool:
    """Returns whether a path is a regular file; False for an invalid path (null byte, too long)."""
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


def resolved(path: Path) -> Path:
    """Returns the absolute path without symbolic links; a path that cannot be resolved is only made absolute."""
    try:
        return path.resolve()
    except (OSError, ValueError, RuntimeError):  # too long; null byte; loop of links
        return path.absolute()


def path_problem(path: Path) -> str | None:
    """Returns why the file system rejects a path, or None; the path need not exist."""
    text = str(path)
    if "\0" in text:
        return "contains a null byte"
    if not text.isprintable() and any("\ud800" <= character <= "\udfff" for character in text):
        return "is not text in UTF-8"  # OpenCV crashes on such a path
    try:
        path.stat()
    except (FileNotFoundError, NotADirectoryError):
        return "is a link to a missing file" if path.is_symlink() else None
    except (OSError, ValueError) as error:
        return getattr(error, "strerror", None) or str(error)
    return None
