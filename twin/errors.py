"""What the user did wrong, said so that the user can mend it."""

from __future__ import annotations


class TwinError(Exception):
    """A fault at a boundary: the field, the value that came, what is allowed there.

    Args:
        field: dotted scenario key (``plan.altitude_m``) or the name of the file or argument at fault.
        problem: what is wrong, in a few words.
        allowed: what would be right.
    """

    def __init__(self, field: str, problem: str, allowed: str = ""):
        self.field, self.problem, self.allowed = field, problem, allowed
        super().__init__(f"{field}: {problem}" + (f" (allowed: {allowed})" if allowed else ""))


class ScenarioError(TwinError):
    """All faults of one scenario at once, each with its file and line."""

    def __init__(self, lines: list[str]):
        self.lines = lines
        Exception.__init__(self, "\n".join(lines))


class SurveyAborted(Exception):  # noqa: N818 (an outcome, not a mistake)
    """The survey cannot go on (physics diverged, disk full, vision lost); partial results are kept."""
