"""Texts of the reports: numbers with units, summary and key figures of a survey, and definitions of terms."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

from twin.judge.warnings import nees_bounds
from twin.scenario.water_sources import WATER_SOURCES

DASH = "–"  # noqa: RUF001
#: Units by the suffix of a metric's name.
_UNITS = {
    "_m": " m", "_s": " s", "_ms": " ms", "_deg": " deg", "_px": " px", "_percent": " %", "_mb": " MiB",
}  # fmt: skip

#: Display names of the processing stages in metrics.json (`timing.stages`) and of the sum of all keyframe stages.
PROCESSING_STAGES = {
    "physics": "simulator: physics",
    "render": "simulator: rendering",
    "optics": "simulator: water and sensor",
    "f2f": "frame-to-frame motion (F2F)",
    "f2m": "registration with the mosaic (F2M)",
    "stereo": "stereo matching",
    "flow": "optical flow between keyframes",
    "network": "keyframe network",
    "ga": "global alignment (GA)",
    "map": "elevation map",
    "orthomosaic": "orthomosaic",
    "keyframe": "all keyframe processing",
}

#: Terms and their definitions, listed at the end of every report. The full list is docs/glossary.md.
TERMS = {
    "RMSE": "Root mean square error.",
    "LE90": "90th percentile of the absolute height error (linear error at 90 %).",
    "NMAD": "Normalised median absolute deviation, 1.4826 median |e - median e|: a standard deviation that is robust "
    "against outliers.",
    "Sigma calibration": "RMS of error / sigma, where sigma is the estimated standard deviation. 1 is right; larger "
    "values mean that the estimate is overconfident.",
    "NEES": "Normalised estimation error squared, e' C^-1 e, of an error e with the estimated covariance C. Its mean "
    "is 3 for consistent positions and 6 for consistent motions; larger values mean overconfident covariances.",
    "CE90": "90th percentile of the horizontal error (circular error at 90 %), for the orthomosaic that of "
    "patches against the true albedo.",
    "CIEDE2000": "Colour difference of CIE 142-2001. About 1 is barely visible.",
    "Edge width": "Distance over which the image of a sharp edge rises from 10 % to 90 %.",
    "Completeness": "Fraction of the map cells with an estimated height, of the asked area or of the observed floor. A "
    "cell is observed if both images of at least one keyframe show it.",
    "Asked area": "Area that the planned tracks are to cover. LE90 over this area counts a cell without a height as an "
    "infinite error, so it is infinite if more than 10 % of the area has no height.",
    "Keyframe": "Frame with a stereo pair whose pose the network estimates and that contributes to the map.",
    "Link": "Measured motion between two keyframes.",
    "F2F": "Frame-to-frame motion: camera motion between consecutive frames, from optical flow.",
    "F2M": "Registration of a keyframe with the mosaic of earlier keyframes.",
    "GA": "Global alignment: least-squares adjustment of the keyframe poses to the links and all other measurements.",
    "Eq. (2)": "Closed-form motion between two keyframes (Negahdaripour & Madjidi 2003), which treats depth as exact.",
}


#: How the estimates of a replay were moved to the recorded truth, by the name of the alignment.
REPLAY_ALIGNMENTS = {
    "se3": "aligned with the truth by the best rigid motion (SE(3))",
    "first": "anchored at the first true pose",
    "none": "without alignment",
}


class KeyFigure(NamedTuple):
    """One of the key figures at the top of a report.

    Args:
        label: name of the quantity.
        value: its value with unit.
        meaning: a short note: definition of the quantity, a reference value or a related value.
    """

    label: str
    value: str
    meaning: str


def length(value_m: float | None) -> str:
    """Returns a length as text in mm, cm or m; a dash for None."""
    if value_m is None:
        return DASH
    size = abs(value_m)
    if size < 0.01:
        return f"{1e3 * value_m:.2g} mm" if size < 1e-3 else f"{1e3 * value_m:.1f} mm"
    return f"{100 * value_m:.1f} cm" if size < 1 else f"{value_m:.2f} m"


def percent(fraction: float | None) -> str:
    """Returns a fraction as text in percent with at most one decimal; a dash for None, NaN and infinity.

    Fractions that are not 0 or 1 but would be rounded to 0 % or 100 % are given as "< 0.1 %" or "> 99.9 %".
    """
    if fraction is None or not math.isfinite(fraction):
        return DASH
    value = 100 * fraction
    if 1e-9 < value < 0.05:
        return "< 0.1 %"
    if 1e-9 < 100 - value < 0.05:
        return "> 99.9 %"
    return f"{value:.1f}".removesuffix(".0") + " %"


def angle(value_deg: float | None) -> str:
    """Returns an angle as text in degrees; a dash for None."""
    return DASH if value_deg is None else f"{value_deg:.2f}°"


def milliradians(value_deg: float | None) -> str:
    """Returns an angle [deg] as text in milliradians; a dash for None. 1 mm at a distance of 1 m subtends 1 mrad."""
    return DASH if value_deg is None else f"{1e3 * math.radians(value_deg):.2g} mrad"


def ratio(value: float | None) -> str:
    """Returns a ratio as text, with one decimal below ten and as an integer from ten; a dash for None."""
    return DASH if value is None else f"{value:.1f} ×" if value < 9.95 else f"{value:.0f} ×"  # noqa: RUF001


def improvement(gain: float | None) -> str:
    """Returns the change of an error as text, e.g. "2.0 × smaller"; "" for gains of 0.95 to 1.05 and for None.

    Args:
        gain: error before divided by error after; None if unknown.
    """
    if gain is None or 0.95 <= gain <= 1.05:
        return ""
    return f"{ratio(gain)} smaller" if gain > 1 else f"{ratio(1 / gain)} larger"


def milliseconds(value_ms: float | None) -> str:
    """Returns a duration as text, in ms if shorter than one second, otherwise in s; a dash for None."""
    return DASH if value_ms is None else f"{value_ms:.3g} ms" if value_ms < 1e3 else f"{value_ms / 1e3:.2f} s"


def plain(value: Any) -> str:
    """Returns a value as text, a float with at most four significant digits; a dash for None."""
    return DASH if value is None else f"{value:.4g}" if isinstance(value, float) else str(value)


def with_unit(name: str, value: float | None) -> str:
    """Returns a number as `plain` with the unit that its dotted name ends with, e.g. "0.02 m"; a dash for None."""
    unit = next((unit for suffix, unit in _UNITS.items() if name.endswith(suffix)), "")
    return plain(value) + (unit if value is not None else "")


def headline(metrics: Mapping[str, Any] | None, scenario: Mapping[str, Any]) -> str:
    """Returns the summary of a survey as text: status, conditions, final position error and map quality.

    The summary of a replay is that of `replay_summary`, with the status. The limitations of these results are not
    included; `verdict.first_lines` returns them.

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
        return f"The replay {verb} {metrics['status']}. {replay_summary(metrics)}"
    return f"The survey {verb} {metrics['status']}. It was flown {conditions(scenario)}. {_results(metrics)}"


def replay_summary(metrics: Mapping[str, Any]) -> str:
    """Returns a summary of a replay as text: frames, position error, consistency of the network, skipped inputs."""
    replay, timing = metrics["replay"], metrics["timing"]
    network, final = replay.get("network") or {}, metrics["trajectory"]["final"]
    sentences = [
        f"{timing['frames']} frames of recorded stereo data ({replay.get('reader')}) gave {timing['keyframes']} "
        "keyframes."
    ]
    if final["ate_rmse_m"] is None:
        sentences.append("There is no truth to compare with; the numbers show consistency only.")
    else:
        path = f"{length(final['ate_rmse_m'])} (RMSE) over a path of {length(final['path_m'])}"
        aligned = REPLAY_ALIGNMENTS.get(str(replay.get("alignment")), "")
        sentences.append(f"The position error of the final trajectory is {path}, {aligned}.")
    if metrics["map"]["le90_m"] is not None:
        error = length(metrics["map"]["le90_m"])
        sentences.append(f"The LE90 of the heights is {error}, with the same alignment.")
    if network.get("loops"):
        residual, chi2 = length(network["loop_translation_m"]), plain(network["loop_chi2"])
        sentences.append(
            f"{network['loops']} links close loops; their median residual is {residual}, chi-square {chi2}."
        )
    skipped = [f"{reason}: {count}" for reason, count in (replay.get("skipped") or {}).items()]
    return " ".join([*sentences, *([f"Skipped: {'; '.join(skipped)}."] if skipped else [])])


def conditions(scenario: Mapping[str, Any]) -> str:
    """Returns the conditions of a survey as text: altitude, Jerlov type with the source of its table, and turbidity.

    If the scenario defines the optical properties itself, the text states this instead of a Jerlov type.
    """
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


def _results(metrics: Mapping[str, Any]) -> str:
    """Returns the position error and the map quality as text, one sentence for each available result."""
    final, elevation = metrics["trajectory"]["final"], metrics["map"]
    sentences = []
    if final["ate_rmse_m"] is not None:
        error, path = length(final["ate_rmse_m"]), length(final["path_m"])
        sentences.append(f"The position error of the final trajectory is {error} (RMSE) over a path of {path}.")
    if elevation.get("completeness_area") is not None:
        share, error = percent(elevation["completeness_area"]), area_le90(elevation)
        sentences.append(f"The map covers {share} of the asked area; LE90 of its heights over this area is {error}.")
    if elevation["le90_m"] is not None:
        share, error = percent(elevation["completeness"]), length(elevation["le90_m"])
        subject = "It" if elevation.get("completeness_area") is not None else "The map"
        sentences.append(f"{subject} covers {share} of the observed floor, with an LE90 of {error} over these cells.")
    return " ".join(sentences) or "There is no trajectory and no map to evaluate."


def area_le90(elevation: Mapping[str, Any]) -> str:
    """Returns LE90 over the asked area as text: "infinite (holes)" if holes make it infinite, a dash without a map.

    Args:
        elevation: section `map` of the metrics.
    """
    value, known = elevation.get("le90_area_m"), elevation.get("completeness_area")
    return length(value) if value is not None or known is None else "infinite (holes)"


def closed_form_comparison(links: Mapping[str, Any]) -> str:
    """Returns sentences that compare the translation errors of the links with those of the closed form, eq. (2).

    If there are no such errors, it returns a sentence that states the reason.
    """
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


def key_figures(metrics: Mapping[str, Any]) -> list[KeyFigure]:
    """Returns the key figures of a survey; an empty list if `metrics` is empty.

    A replay has only the figures that have a value: recorded images have no plan, and often no truth.
    """
    if not metrics:
        return []
    mosaic = metrics.get("orthomosaic") or {}
    figures = [
        *_position_figures(metrics),
        *_map_figures(metrics),
        *(_orthomosaic_figures(mosaic) if mosaic.get("pixel_m") else []),
        *_survey_figures(metrics),
    ]
    return [figure for figure in figures if figure.value != DASH] if metrics.get("replay") else figures


def _position_figures(metrics: Mapping[str, Any]) -> list[KeyFigure]:
    """Returns the key figures of the trajectories."""
    f2f, online, final = (metrics["trajectory"][key] for key in ("f2f", "online", "final"))
    nees, (low, high) = plain(metrics["consistency"]["nees_position_mean"]), nees_bounds(metrics["consistency"])
    return [
        KeyFigure("Position error, final", length(final["ate_rmse_m"]), f"RMSE; maximum {length(final['ate_max_m'])}"),
        KeyFigure("Position error, online", length(online["ate_rmse_m"]), "RMSE of the estimate used for control"),
        KeyFigure("Position error, F2F", length(f2f["ate_rmse_m"]), f"RMSE; drift {_drift(f2f)}"),
        KeyFigure("NEES of positions", nees, f"mean; 3 is expected, {low:.2g} to {high:.2g} accepted"),
    ]


def _map_figures(metrics: Mapping[str, Any]) -> list[KeyFigure]:
    """Returns the key figures of the elevation map."""
    elevation = metrics["map"]
    le90, bias = length(elevation["le90_m"]), length(elevation["bias_m"])
    rmse, nmad = length(elevation["rmse_m"]), length(elevation["nmad_m"])
    completeness, cell = percent(elevation["completeness"]), length(elevation["cell_m"])
    area = percent(elevation.get("completeness_area"))
    mapped = f"over the mapped {completeness} of the observed floor"
    if elevation["completeness"] is None and elevation["le90_m"] is not None:  # a replay with true heights
        mapped = "over all cells with an estimated and a true height, moved by the alignment of the path"
    figures = [
        KeyFigure("Completeness", area, f"of the asked area; {completeness} of the observed floor; cell size {cell}"),
        KeyFigure("Map LE90, asked area", area_le90(elevation), _holes(elevation)),
        KeyFigure("Map LE90, mapped floor", le90, f"{mapped}; NMAD {nmad}"),
        KeyFigure("Map bias", bias, f"{mapped}; RMSE {rmse}"),
        KeyFigure("Sigma calibration", plain(elevation["sigma_ratio"]), f"RMS of error / sigma, 1 is right; {mapped}"),
    ]
    if elevation.get("objects_le90_m") is not None:
        figures += [_surface_figure(elevation, "floor", "bare floor"), _surface_figure(elevation, "objects", "objects")]
    return figures


def _holes(elevation: Mapping[str, Any]) -> str:
    """Returns a phrase on the holes of the map in the asked area."""
    if elevation.get("completeness_area") is not None:
        return f"a hole counts as infinite; {percent(elevation['completeness_area'])} has a height"
    evaluated = "completeness_area" in elevation and elevation["completeness"] is not None
    return "the asked area contains no cell centre" if evaluated else "a hole counts as infinite"


def _surface_figure(elevation: Mapping[str, Any], key: str, name: str) -> KeyFigure:
    """Returns the key figure of the height errors over the floor or the objects; `key` is the prefix of its metrics."""
    median, gross = length(elevation[f"{key}_median_m"]), percent(elevation[f"{key}_gross_share"])
    text = f"median of the absolute errors {median}; more than 10 cm in {gross} of the cells"
    return KeyFigure(f"Map LE90, {name}", length(elevation[f"{key}_le90_m"]), text)


def _orthomosaic_figures(mosaic: Mapping[str, Any]) -> list[KeyFigure]:
    """Returns the key figures of the orthomosaic, from `orthomosaic` of metrics.json."""
    pixel, matched = length(mosaic["pixel_m"]), percent(mosaic["matched"])
    figures = [
        KeyFigure(
            "Orthomosaic CE90",
            length(mosaic["ce90_m"]),
            f"horizontal error of the {matched} of patches found in the true albedo; pixel size {pixel}",
        ),
        KeyFigure("Orthomosaic edge width", length(mosaic["edge_width_m"]), f"10 % to 90 %; pixel size {pixel}"),
    ]
    if mosaic["colour_difference_median"] is not None:
        p90 = plain(mosaic["colour_difference_p90"])
        text = f"CIEDE2000 against the true albedo, median; 90th percentile {p90}"
        figures.append(KeyFigure("Orthomosaic colour error", plain(mosaic["colour_difference_median"]), text))
    return figures


def _survey_figures(metrics: Mapping[str, Any]) -> list[KeyFigure]:
    """Returns the key figures of overlap, control and computing time."""
    overlap, control, timing = metrics["overlap"], metrics["control"], metrics["timing"]
    along, sidelap = percent(overlap["along_median"]), percent(overlap["across_median"])
    along_planned, sidelap_planned = percent(overlap["along_planned"]), percent(overlap["across_planned"])
    counts = f"{timing['frames']} frames, {timing['keyframes']} keyframes"
    return [
        KeyFigure("Overlap along the swath", along, f"median over the floor; {along_planned} planned"),
        KeyFigure("Sidelap", sidelap, f"median over the floor; {sidelap_planned} planned"),
        KeyFigure("Cross-track error", length(control["cross_track_rmse_m"]), "RMS distance from the planned path"),
        KeyFigure("Real-time factor", plain(timing["real_time_factor"]), counts),
    ]


def _drift(path: Mapping[str, Any]) -> str:
    """Returns the end error of a trajectory in percent of the path length as text; a dash if it is unknown."""
    return DASH if path["drift_percent"] is None else f"{path['drift_percent']:.2f} % of the path length"
