"""Paths from user input or files, which may be invalid: null byte, too long, loop of symbolic links."""

from __future__ import annotations

from pathlib import Path


def is_file(path: Path) -> bool:
    """Returns whether a path is a regular file; False for an invalid path (null byte, too long)."""
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


def resolved(path: Path) -> Path:
    """Returns the absolute path without symbolic links; a path that cannot be resolved is only made absolute.

    Opening such a path later raises an error that states the reason.
    """
    try:
        return path.resolve()
    except (OSError, ValueError, RuntimeError):  # too long; null byte; loop of links
        return path.absolute()


def path_problem(path: Path) -> str | None:
    """Returns why the file system rejects a path, or None; the path need not exist.

    The reasons are a null byte, bytes that are not UTF-8, excessive length, a loop of links, a link to a missing file,
    or a missing permission in the folders above.
    """
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
