"""First lines of a report: a badge with the verdict on the survey, and sentences on the limitations of its results."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, NamedTuple

from twin.judge.map_error import INFINITE_WITH_HOLES
from twin.judge.require import more_is_better
from twin.report.wording import percent, with_unit

#: Level of a badge: green, amber or red. The name is also the badge's CSS class in page.css.
Level = Literal["good", "warn", "bad"]
_STATUSES = {"aborted": "The survey was aborted", "degraded": "The survey is degraded"}


class Badge(NamedTuple):
    """Verdict on a survey in a few words, with its severity level."""

    text: str
    level: Level


def badge(metrics: Mapping[str, Any] | None) -> Badge:
    """Returns the verdict on a survey.

    The badge is red if the survey is unfinished, is not complete or missed a requirement; otherwise it is amber if the
    survey has warnings, and green if it has none.

    Args:
        metrics: contents of metrics.json; None for an unfinished survey.
    """
    if not metrics:
        return Badge("unfinished", "bad")
    missed = ["requirement missed"] if _missed(metrics) else []
    warned = ["with warnings"] if metrics.get("warnings") or metrics.get("warning") else []
    level: Level = "bad" if metrics["status"] != "complete" or missed else "warn" if warned else "good"
    return Badge(", ".join([metrics["status"], *(missed or warned)]), level)


def first_lines(metrics: Mapping[str, Any]) -> list[str]:
    """Returns the sentences at the top of a report, the most serious first.

    They state the reason why a survey is not complete, each requirement missed, each warning, and each idealisation of
    the scenario.
    """
    warnings = metrics.get("warnings") or list(filter(None, [metrics.get("warning")]))
    return [*_status(metrics), *_missed(metrics), *warnings, *metrics.get("idealisations", ())]


def _status(metrics: Mapping[str, Any]) -> list[str]:
    """Returns a list with one sentence on the status of the survey and its reason; [] if complete without a reason."""
    status, reason = metrics["status"], metrics["reason"]
    if status == "complete":
        return [f"{reason[:1].upper()}{reason[1:]}."] if reason else []
    return [f"{_STATUSES.get(status, f'The survey is {status}')}: {reason or 'no reason is known'}."]


def _missed(metrics: Mapping[str, Any]) -> list[str]:
    """Returns a sentence for each requirement that was missed."""
    return [
        f"Requirement missed: {name} is {_value(name, row['value'], metrics)}, "
        f"{'at least' if more_is_better(name) else 'at most'} {with_unit(name, row['limit'])} is required."
        for name, row in (metrics.get("require") or {}).items()
        if not row["passed"]
    ]


def _value(name: str, value: float | None, metrics: Mapping[str, Any]) -> str:
    """Returns the value of a metric as text: "unknown" if it has none, "infinite" if holes make it infinite."""
    if value is not None:
        return with_unit(name, value)
    known = metrics["map"].get("completeness_area")
    if name in INFINITE_WITH_HOLES and known is not None:
        return f"infinite (only {percent(known)} of the asked area has a height)"
    return "unknown"
