"""Top of a report: badge with the verdict, sentences on the limitations, headline and key figures."""

from collections.abc import Mapping
from typing import Any, Literal, NamedTuple

from twin.judge.map_error import INFINITE_WITH_HOLES
from twin.judge.verdict import more_is_better, nees_bounds
from twin.report.html import render_text
from twin.report.number_formats import DASH, length, percent, with_unit
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
    """Returns sentences on the limitations: reason of the status, missed requirements, warnings, idealisations."""
    warnings = metrics.get("warnings") or list(filter(None, [metrics.get("warning")]))
    return [*_status(metrics), *_missed(metrics), *warnings, *metrics.get("idealisations", ())]


def _status(metrics: Mapping[str, Any]) -> list[str]:
    status, reason = metrics["status"], metrics["reason"]
    if status == "complete":
        return [f"{reason[:1].upper()}{reason[1:]}."] if reason else []
    return [f"{_STATUSES.get(status, f'The survey is {status}')}: {reason or 'no reason is known'}."]


def _missed(metrics: Mapping[str, Any]) -> list[str]:
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


def conditions(scenario: Mapping[str, Any], visibility_m: float | None = None) -> str:
    """Returns the conditions of a survey as text: altitude, rig, water type with source of its table, clarity."""
    water, plan = scenario.get("water", {}), scenario.get("plan", {})
    jerlov, turbidity = water.get("jerlov", "clear"), water.get("turbidity", 1.0)
    custom = water.get("absorption_per_m") or water.get("spectrum_file")
    source = f" ({WATER_SOURCES[water['source']].citation})" if "source" in water else ""
    kind = "water with custom optical properties" if custom else f"water of Jerlov type {jerlov}{source}"
    if jerlov == "clear" and not custom:
        kind, turbidity = "clear water", 1.0
    scattering = f" with {turbidity:g} times its scattering" if turbidity != 1 else ""
    seen = f", visibility {visibility_m:.2g} m" if visibility_m else ""
    rig = scenario.get("rig", {}).get("title")
    cameras = f' with the rig "{rig}"' if rig else ""
    below = "smoothed floor" if plan.get("height") == "floor" else "reference plane"
    return f"{plan.get('altitude_m', 0):g} m above the {below}{cameras} in {kind}{scattering}{seen}"


def closed_form_comparison(links: Mapping[str, Any]) -> str:
    """Returns sentences that compare the translation errors of the links with those of the closed form, eq. (2)."""
    changes = []
    for direction in ("along", "across"):
        error = links[direction]["translation_rmse_m"]
        closed_form_error = links[direction]["closed_form_translation_rmse_m"]
        if error and closed_form_error is not None:
            changes.append(f"from {length(closed_form_error)} to {length(error)} {direction}")
    if not any(links[direction]["count"] for direction in ("along", "across")):
        return "No motion between keyframes was measured."
    if not changes:
        return "The motions between keyframes were not computed by eq. (2)."
    return (
        "Eq. (2) treats the depth of one stereo pair as exact. Two-view structure and motion weights both stereo pairs "
        f"by their noise, which changes the RMS translation error of the links {' and '.join(changes)}."
    )
