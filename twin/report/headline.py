"""Headline and key figures of a survey or replay: texts with the values of metrics.json."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from twin.judge.warnings import nees_bounds
from twin.report.html import render_text
from twin.report.wording import DASH, REPLAY_ALIGNMENTS, length
from twin.scenario.water_sources import WATER_SOURCES


class KeyFigure(NamedTuple):
    """One of the key figures at the top of a report: the value has its unit, the meaning is a short note on it."""

    label: str
    value: str
    meaning: str


def headline(metrics: Mapping[str, Any] | None, scenario: Mapping[str, Any]) -> str:
    """Returns the summary of a survey or replay: status, conditions, final position error and map quality.

    The limitations of these results are not included; `verdict.first_lines` returns them.

    Args:
        metrics: contents of metrics.json; None for an unfinished survey.
        scenario: contents of the scenario file.
    """
    if metrics is None and "replay" in scenario:
        return "This replay is unfinished: it has no metrics.json."
    if metrics is None:
        return f"This survey is unfinished: it has no metrics.json. The survey is planned {conditions(scenario)}."
    verb = "was" if metrics["status"] == "aborted" else "is"
    if metrics.get("replay"):
        return f"The replay {verb} {metrics['status']}. {results(metrics)}"
    return f"The survey {verb} {metrics['status']}. It was flown {conditions(scenario)}. {results(metrics)}"


def results(metrics: Mapping[str, Any]) -> str:
    """Returns position error and map quality as text; of a replay also the frames, the closed loops and lost inputs."""
    alignment = REPLAY_ALIGNMENTS.get(str((metrics.get("replay") or {}).get("alignment")), "")
    return " ".join(render_text("headline.txt.j2", {**metrics, "alignment": alignment}).split())


def key_figures(metrics: Mapping[str, Any]) -> list[KeyFigure]:
    """Returns the key figures of a survey; an empty list if `metrics` is empty.

    A replay has only the figures that have a value: recorded images have no plan, and often no truth.
    """
    if not metrics:
        return []
    text = render_text("key_figures.txt.j2", {**metrics, "nees_bounds": nees_bounds(metrics["consistency"])})
    figures = [KeyFigure(*line.split(" | ")) for line in text.splitlines() if line]
    return [figure for figure in figures if figure.value != DASH] if metrics.get("replay") else figures


def conditions(scenario: Mapping[str, Any]) -> str:
    """Returns the conditions of a survey as text: altitude, water type with the source of its table, and turbidity."""
    water, plan = scenario.get("water", {}), scenario.get("plan", {})
    jerlov, turbidity = water.get("jerlov", "clear"), water.get("turbidity", 1.0)
    custom = water.get("absorption_per_m") or water.get("spectrum_file")
    source = f" ({WATER_SOURCES[water['source']].citation})" if "source" in water else ""
    kind = "water with custom optical properties" if custom else f"water of Jerlov type {jerlov}{source}"
    if jerlov == "clear" and not custom:
        kind, turbidity = "clear water", 1.0
    scattering = f" with {turbidity:g} times its scattering" if turbidity != 1 else ""
    below = "smoothed floor" if plan.get("height") == "floor" else "reference plane"
    return f"{plan.get('altitude_m', 0):g} m above the {below} in {kind}{scattering}"


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
