"""Figures in words: lengths a reader can picture, and the survey in one sentence."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

DASH = "–"  # noqa: RUF001


class KeyFigure(NamedTuple):
    """One figure of the overview: what it is, its value in words, what that means."""

    what: str
    value: str
    meaning: str


def length(value_m: float | None) -> str:
    """A length in the unit that suits it."""
    if value_m is None:
        return DASH
    size = abs(value_m)
    if size < 0.01:
        return f"{1e3 * value_m:.2g} mm" if size < 1e-3 else f"{1e3 * value_m:.1f} mm"
    return f"{100 * value_m:.1f} cm" if size < 1 else f"{value_m:.2f} m"


def percent(share: float | None) -> str:
    return DASH if share is None else f"{100 * share:.1f} %"


def angle(value_deg: float | None) -> str:
    return DASH if value_deg is None else f"{value_deg:.2f}°"


def small_angle(value_deg: float | None) -> str:
    """An angle of motions: 1 mrad is 1 mm at 1 m."""
    return DASH if value_deg is None else f"{1e3 * math.radians(value_deg):.2g} mrad"


def factor(value: float | None) -> str:
    """By what an error fell: two digits below ten, whole above."""
    return DASH if value is None else f"{value:.1f} ×" if value < 9.95 else f"{value:.0f} ×"  # noqa: RUF001


def better(gain: float | None) -> str:
    """What a stage bought, in words; nothing where that is within a twentieth."""
    if gain is None or 0.95 <= gain <= 1.05:
        return ""
    return f"{factor(gain)} better" if gain > 1 else f"{factor(1 / gain)} worse"


def milliseconds(value_ms: float | None) -> str:
    return DASH if value_ms is None else f"{value_ms:.3g} ms" if value_ms < 1e3 else f"{value_ms / 1e3:.2f} s"


def plain(value: Any) -> str:
    """A number without needless digits; a dash for none."""
    return DASH if value is None else f"{value:.4g}" if isinstance(value, float) else str(value)


def headline(metrics: Mapping[str, Any] | None, scenario: Mapping[str, Any]) -> str:
    """The survey in one or two plain sentences: complete or not, how far off, in which water."""
    if metrics is None:
        return f"This survey is unfinished: it has no metrics.json. It was to be flown {conditions(scenario)}."
    beware = f" Beware: {metrics['warning']}." if metrics.get("warning") else ""
    if metrics["status"] != "complete":
        flown = f"The survey broke off ({metrics['reason']}). It was flown {conditions(scenario)}."
    else:
        flown = f"The survey is complete, flown {conditions(scenario)}."
    return f"{flown} {_result(metrics)}{beware}"


def conditions(scenario: Mapping[str, Any]) -> str:
    """Height and water of the survey."""
    water, plan = scenario.get("water", {}), scenario.get("plan", {})
    jerlov, turbidity = water.get("jerlov", "clear"), water.get("turbidity", 1.0)
    own = water.get("absorption_per_m") or water.get("spectrum_file")
    kind = "water of its own spectrum" if own else f"water of Jerlov type {jerlov}"
    if jerlov == "clear" and not own:
        kind, turbidity = "clear water", 1.0
    thick = f" with {turbidity:g} times its scattering" if turbidity != 1 else ""
    return f"{plan.get('altitude_m', 0):g} m above the reference plane in {kind}{thick}"


def _result(metrics: Mapping[str, Any]) -> str:
    final, floor = metrics["trajectory"]["final"], metrics["map"]
    said = []
    if final["ate_rmse_m"] is not None:
        said.append(f"Its final path is {length(final['ate_rmse_m'])} off (RMS) over {length(final['path_m'])}.")
    if floor["le90_m"] is not None:
        share, error = percent(floor["completeness"]), length(floor["le90_m"])
        said.append(f"The map holds {share} of the floor that was seen, nine tenths of it right within {error}.")
    return " ".join(said) or "There is no map and no path to judge."


def closed_form_verdict(links: Mapping[str, Any]) -> str:
    """What taking the depth as exact costs the motions between keyframes, in a sentence."""
    said = []
    for where in ("along", "across"):
        joint, exact = links[where]["translation_rmse_m"], links[where]["closed_form_translation_rmse_m"]
        if joint and exact is not None:
            said.append(f"{length(exact)} to {length(joint)} {where}")
    if not said:
        return "No motion between keyframes was measured."
    return (
        "Eq. (2) takes the depth of one stereo pair as exact; structure and motion together weigh both pairs by their "
        f"noise, which takes the error of translation from {' and from '.join(said)}."
    )


def key_figures(metrics: Mapping[str, Any]) -> list[KeyFigure]:
    """The overview of a survey's quality."""
    return [*_path_figures(metrics), *_map_figures(metrics), *_survey_figures(metrics)] if metrics else []


def _path_figures(metrics: Mapping[str, Any]) -> list[KeyFigure]:
    f2f, online, final = (metrics["trajectory"][key] for key in ("f2f", "online", "final"))
    return [
        KeyFigure("Path, final", length(final["ate_rmse_m"]), f"RMS; {length(final['ate_max_m'])} at most"),
        KeyFigure("Path, online", length(online["ate_rmse_m"]), "RMS of what the vehicle flew on"),
        KeyFigure("Path, frame to frame", length(f2f["ate_rmse_m"]), f"RMS; drift {_drift(f2f)}"),
        KeyFigure(
            "NEES of positions", plain(metrics["consistency"]["nees_position_mean"]), "3 is right; more: over-sure"
        ),
    ]


def _map_figures(metrics: Mapping[str, Any]) -> list[KeyFigure]:
    floor = metrics["map"]
    return [
        KeyFigure("Map, LE90", length(floor["le90_m"]), f"90 % of heights are better; NMAD {length(floor['nmad_m'])}"),
        KeyFigure("Map, bias", length(floor["bias_m"]), f"mean of map minus truth; RMSE {length(floor['rmse_m'])}"),
        KeyFigure(
            "Completeness", percent(floor["completeness"]), f"of the floor seen; {length(floor['cell_m'])} cells"
        ),
        KeyFigure("Honesty of sigma", plain(floor["sigma_ratio"]), "RMS of map error over its sigma; 1 is right"),
    ]


def _survey_figures(metrics: Mapping[str, Any]) -> list[KeyFigure]:
    shared, control, timing = metrics["overlap"], metrics["control"], metrics["timing"]
    counts = f"{timing['frames']} frames, {timing['keyframes']} keyframes"
    return [
        KeyFigure(
            "Overlap along", percent(shared["along_median"]), f"median; {percent(shared['along_planned'])} planned"
        ),
        KeyFigure("Overlap across", percent(shared["across_median"]), f"{percent(shared['across_planned'])} planned"),
        KeyFigure("Cross-track", length(control["cross_track_rmse_m"]), "RMS distance from the planned path"),
        KeyFigure("Real-time factor", plain(timing["real_time_factor"]), counts),
    ]


def _drift(path: Mapping[str, Any]) -> str:
    return DASH if path["drift_percent"] is None else f"{path['drift_percent']:.2f} % of the path"
