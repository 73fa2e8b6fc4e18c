"""Top of a report: badge with the verdict, sentences on the limitations, headline and key figures."""

from collections.abc import Mapping
from typing import Any, Literal, NamedTuple

from twin.judge.map_error import INFINITE_WITH_HOLES
from twin.judge.verdict import more_is_better, nees_bounds
from twin.report.html import render_rows, render_text
from twin.report.number_formats import DASH, percent, with_unit
from twin.report.words import words
from twin.scenario.water_sources import WATER_SOURCES

#: Level of a badge: green, amber or red. The name is also the badge's CSS class in page.css.
Level = Literal["good", "warn", "bad"]
#: How the estimates of a replay were moved to the recorded truth, by the name of the alignment.
REPLAY_ALIGNMENTS = {
    "se3": "aligned with the truth by the best rigid motion (SE(3))",
    "first": "anchored at the first true pose",
    "none": "without alignment",
}
_STATUSES = {"aborted": "The survey was aborted", "degraded": "The survey is degraded"}


class Badge(NamedTuple):
    """Verdict on a survey in a few words, with its severity level."""

    text: str
    level: Level


def badge(metrics: Mapping[str, Any] | None) -> Badge:
    """Returns red if unfinished (None), incomplete or missing a requirement, amber with warnings, otherwise green."""
    if not metrics:
        return Badge("unfinished", "bad")
    missed = ["requirement missed"] if _missed(metrics) else []
    warned = ["with warnings"] if metrics.get("warnings") or metrics.get("warning") else []
    level: Level = "bad" if metrics["status"] != "complete" or missed else "warn" if warned else "good"
    return Badge(", ".join([metrics["status"], *(missed or warned)]), level)


def first_lines(metrics: Mapping[str, Any]) -> list[str]:
    """Returns sentences on the limitations: problems, then idealisations."""
    return [*problems(metrics), *metrics.get("idealisations", ())]


def problems(metrics: Mapping[str, Any]) -> list[str]:
    """Returns sentences on the reason of the status, missed requirements and warnings."""
    warnings = metrics.get("warnings") or list(filter(None, [metrics.get("warning")]))
    return [*_status(metrics), *_missed(metrics), *warnings]


def _status(metrics: Mapping[str, Any]) -> list[str]:
    status, reason = metrics["status"], metrics["reason"]
    if status == "complete":
        return [f"{reason[:1].upper()}{reason[1:]}."] if reason else []
    return [f"{_STATUSES.get(status, f'The survey is {status}')}: {reason or 'no reason is known'}."]


def _missed(metrics: Mapping[str, Any]) -> list[str]:
    return [
        f"Requirement missed: {words(name)} is {_value(name, row['value'], metrics)}, "
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


class KeyFigure(NamedTuple):
    """One of the key figures at the top of a report: the value has its unit, the meaning is a short note on it."""

    label: str
    value: str
    meaning: str


def headline(metrics: Mapping[str, Any] | None, scenario: Mapping[str, Any]) -> str:
    """Returns the summary from metrics.json (None: unfinished) and scenario: status, conditions, final errors."""
    if metrics is None and "replay" in scenario:
        return "This replay is unfinished: it has no metrics.json."
    if metrics is None:
        return f"This survey is unfinished: it has no metrics.json. The survey is planned {conditions(scenario)}."
    verb = "was" if metrics["status"] == "aborted" else "is"
    if metrics.get("replay"):
        return f"The replay {verb} {metrics['status']}. {results(metrics)}"
    flown = conditions(scenario, metrics.get("water", {}).get("visibility_m"))
    return f"The survey {verb} {metrics['status']}. It was flown {flown}. {results(metrics)}"


def results(metrics: Mapping[str, Any]) -> str:
    """Returns position error and map quality as text; of a replay also the frames, the closed loops and lost inputs."""
    alignment = REPLAY_ALIGNMENTS.get(str((metrics.get("replay") or {}).get("alignment")), "")
    return " ".join(render_text("headline.txt.j2", {**metrics, "alignment": alignment}).split())


def key_figures(metrics: Mapping[str, Any]) -> list[KeyFigure]:
    """Returns the key figures of a survey; of a replay only those that have a value."""
    if not metrics:
        return []
    text = render_text("key_figures.txt.j2", {**metrics, "nees_bounds": nees_bounds(metrics["consistency"])})
    figures = [KeyFigure(*line.split(" | ")) for line in text.splitlines() if line]
    return [figure for figure in figures if figure.value != DASH] if metrics.get("replay") else figures


def input_rows(stated: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Returns what is stated of a floor as text: pairs (name, value with evidence); [] for a generated floor."""
    return render_rows("input.txt.j2", {"stated": stated}) if stated else []


def conditions(scenario: Mapping[str, Any], visibility_m: float | None = None) -> str:
    """Returns the conditions of a survey as text: altitude, rig, water type with source of its table, clarity."""
    source = scenario.get("water", {}).get("source")
    known = {"scenario": scenario, "visibility_m": visibility_m, "source": WATER_SOURCES.get(source)}
    return " ".join(render_text("conditions.txt.j2", known).split())
