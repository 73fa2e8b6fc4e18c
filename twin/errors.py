"""Exceptions of the project. The module imports no other one of the project, so that every package can use it."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class TwinError(Exception):
    """Invalid user input, an unwritable file or a missing system library, reported by the command line with status 2.

    Args:
        field: dotted scenario key (``plan.altitude_m``), or the name of the file, argument or command concerned.
        problem: the invalid value and why it is invalid, in a few words.
        allowed: the valid values, or the remedy.
    """

    def __init__(self, field: str, problem: str, allowed: str = ""):
        self.field, self.problem, self.allowed = field, problem, allowed
        super().__init__(f"{field}: {problem}" + (f" (allowed: {allowed})" if allowed else ""))

    def __reduce__(self) -> tuple[type[TwinError], tuple[object, ...]]:
        return type(self), (self.field, self.problem, self.allowed)


class ScenarioError(TwinError):
    """All errors of one scenario; the message has one line per error, with file and line number or with `--set`."""

    def __init__(self, lines: list[str]):
        self.lines = lines
        Exception.__init__(self, "\n".join(lines))

    def __reduce__(self) -> tuple[type[TwinError], tuple[object, ...]]:
        return type(self), (self.lines,)


class UnmodelledError(ScenarioError):
    """The surrogate cannot simulate a valid scenario; with rendered images it can be flown."""


class EngineLostError(TwinError):
    """A cluster cannot run further surveys; the results obtained until then are kept."""


class SurveyAborted(Exception):  # noqa: N818 (an outcome of a survey, not an input error)
    """The survey cannot continue (physics diverged, vision lost, alignment failed); partial results are kept."""


def described(error: BaseException) -> str:
    """Returns the class and the message of an exception in one line of at most 300 characters."""
    text = "".join(letter if letter.isprintable() else "?" for letter in " ".join(str(error).split()))
    return (f"{type(error).__name__}: {text}" if text else type(error).__name__)[:300]


def did_you_mean(word: str, names: Iterable[str]) -> str:
    """Returns ` (did you mean NAME?)` with the name most similar to the word, or "" if none is similar."""
    close = difflib.get_close_matches(word[:100], names, n=1)
    return f" (did you mean {close[0]}?)" if close else ""
