"""Summary of a plan as tables and JSON: image properties over the floor, expected errors, warnings, computing cost."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from twin.controllers.forecast import Forecast, forecast
from twin.core.geometry import Array
from twin.core.quality import Energy
from twin.imaging.light.spectra import provenance_of
from twin.judge.summary_statistics import finite_tree
from twin.judge.verdict import judge_requirements
from twin.planning.cost import ComputingCost, computing_cost
from twin.planning.expected_error import ExpectedError, expected_error
from twin.planning.vehicle_limits import largest_latency_s
from twin.report.html import render_rows
from twin.report.number_formats import duration, length, percent, with_unit
from twin.world.computer import frames_of_latency
from twin.world.energy import planned_energy
from twin.world.floor_forecast import FloorForecast, Spread, forecast_over_floor, spread
from twin.world.mission import Mission
from twin.world.path_checks import unknown_share
from twin.world.planning import SHORT_PERCENT, UNKNOWN_SLOPE, planned_keyframes

#: Standard deviation of the disparity on good texture [px]; the depth error on the reference plane is proportional to
#: it.
DISPARITY_SIGMA_PX = 0.1
#: An overlap is insufficient if it is lower than required by more than this. Rounding N, the number of frames per
#: keyframe, to an integer can lower the overlap slightly.
OVERLAP_TOLERANCE = 0.01
#: For each survey pattern: the name of a swath, and the swaths of one track.
_SWATHS = {"lawnmower": ("leg", "two legs"), "loops": ("loop", "a loop")}
#: For each property of the images over the floor: its label, and the functions that format and return its values.
_PROPERTIES: dict[str, tuple[str, Callable[[float | None], str], Callable[[PlanSummary], Array]]] = {
    "altitude_m": ("altitude above the floor", length, lambda s: s.floor.altitude_m),
    "clearance_m": ("clearance", length, lambda s: s.floor.clearance_m),
    "footprint_across_m": ("footprint across", length, lambda s: s.floor.footprint_m[:, 0]),
    "footprint_along_m": ("footprint along", length, lambda s: s.floor.footprint_m[:, 1]),
    "gsd_m": ("ground sample distance", length, lambda s: s.floor.gsd_m),
    "overlap_along": ("overlap along", percent, lambda s: s.floor.overlap_along),
    "overlap_across": ("overlap across (sidelap)", percent, lambda s: s.floor.overlap_across),
    "stereo_share": ("floor seen by both cameras", percent, lambda s: s.floor.stereo_share),
    "height_sigma_m": ("expected sigma of height", length, lambda s: s.error.sigma_m),
}
#: The error model counts as extrapolated beyond this multiple of the largest Cramér-Rao bound to which it was fitted.
_EXTRAPOLATED = 1.5


class Latency(NamedTuple):
    """Latency of the computer, in whole frames."""

    latency_s: float
    stable_s: float  #: largest one with which leg and station keeping are stable (`largest_latency_s`)

    @property
    def unstable(self) -> bool:
        return self.latency_s > self.stable_s

    @property
    def text(self) -> str:
        return f"{self.latency_s:.2f} s from image to command; stable up to {self.stable_s:.2f} s"


@dataclass(frozen=True)
class PlanSummary:
    """Properties of a mission predicted by `twin plan`."""

    mission: Mission
    plane: Forecast  #: footprint, overlaps, disparity and depth error refer to the reference plane
    floor: FloorForecast  #: properties of the planned images over the floor with its objects
    error: ExpectedError
    cost: ComputingCost
    require: dict[str, dict[str, Any]]  #: value, limit and verdict of each required metric that can be predicted
    latency: Latency | None  #: None without a latency
    #: sentences on requirements expected to be missed, on insufficient overlap, and on limits of validity
    warnings: tuple[str, ...]

    @property
    def meets_requirements(self) -> bool:
        return all(r["passed"] for r in self.require.values())

    @property
    def hold_s(self) -> float:
        holds = not self.mission.plan.flies_arcs
        return holds * self.mission.scenario.control.hold_s * len(self.mission.tracks)


def summarise(mission: Mission) -> PlanSummary:
    plane = forecast(mission.plan, mission.rig.baseline_m, DISPARITY_SIGMA_PX)
    floor = forecast_over_floor(mission)
    error = expected_error(mission, floor)
    predicted = _predicted_metrics(floor, error)
    known = {f"{section}.{key}" for section, metrics in predicted.items() for key in metrics}
    require = judge_requirements({n: v for n, v in mission.scenario.require.items() if n in known}, predicted)
    holes = (note.removesuffix(".") for note in mission.hole_notes)
    scenario, latency = mission.scenario, None
    built_in = scenario.vehicle.dynamics == "rigid" and not scenario.control.plugin
    if built_in and (n_late := frames_of_latency(scenario)):
        latency = Latency(n_late / mission.rig.frame_rate_hz, largest_latency_s(mission))
    late = [f"the latency is too long for a stable flight: {latency.text}"] if latency and latency.unstable else []
    warnings = (*holes, *_missed(require), *_short_overlap(mission, floor), *_limits_of_validity(mission, error), *late)
    cost = computing_cost(mission, plane.n_keyframes)
    return PlanSummary(mission, plane, floor, error, cost, require, latency, warnings)


def run_time_s(mission: Mission) -> float:
    """Returns the expected processor time of a survey [s]."""
    plane = forecast(mission.plan, mission.rig.baseline_m, DISPARITY_SIGMA_PX)
    return computing_cost(mission, plane.n_keyframes).wall_s


def _predicted_metrics(floor: FloorForecast, error: ExpectedError) -> dict[str, dict[str, float | None]]:
    """Returns the metrics that can be predicted before the survey, by section and key of metrics.json."""
    covered = floor.coverage * error.completeness
    along, across = spread(floor.overlap_along), spread(floor.overlap_across)
    return {
        "map": {
            "completeness": error.completeness,
            "completeness_area": covered,
            "rmse_m": error.rmse_m,
            "p85_m": error.percentile_m(85),
            "le90_m": error.percentile_m(90),
            "le95_m": error.percentile_m(95),
            "le90_area_m": error.percentile_m(90, 1 - covered),
        },
        "overlap": {
            "along_median": along.median,
            "along_p05": along.p05,
            "across_median": across.median,
            "across_p05": across.p05,
        },
    }


def _missed(require: dict[str, dict[str, Any]]) -> Iterator[str]:
    for name, r in require.items():
        if not r["passed"]:
            expected, limit = with_unit(name, r["value"]), with_unit(name, r["limit"])
            yield f"{name} is expected to miss its limit: {expected} expected, limit {limit}"


def required_overlaps(mission: Mission) -> tuple[float, float]:
    """Returns the required overlaps as fractions of the image sides along and across (`frames_per_keyframe`)."""
    plan, required = mission.plan, mission.scenario.plan
    along = 1 - (1 - required.overlap_along) * plan.request.footprint_m[0] / plan.side_along_m
    return max(0.0, along), required.overlap_across


def _short_overlap(mission: Mission, floor: FloorForecast) -> Iterator[str]:
    """Yields a sentence for each direction in which the 5th percentile of the overlap is insufficient."""
    found = (("along the swaths", floor.overlap_along), ("between swaths", floor.overlap_across))
    for (where, overlap), limit in zip(found, required_overlaps(mission), strict=True):
        p05 = spread(overlap).p05
        if p05 is not None and p05 < limit - OVERLAP_TOLERANCE:
            yield (
                f"{SHORT_PERCENT:g} % of the keyframes have an overlap {where} below {percent(p05)} over the floor; "
                f"{percent(limit)} is required"
            )


def _limits_of_validity(mission: Mission, error: ExpectedError) -> Iterator[str]:
    """Yields a sentence for each limit of validity of the plan that applies to a mission."""
    scenario = mission.scenario
    if error.bound_px > _EXTRAPOLATED * error.fitted_bound_px:
        yield (
            f"the expected error is extrapolated: matching precision {error.bound_px:.3g} px, error model fitted up to "
            f"{error.fitted_bound_px:.3g} px"
        )
    sections = ["[port]"] if scenario.port.kind != "none" else []
    if scenario.calibration_error != type(scenario.calibration_error)():
        sections.append("[calibration_error]")
    if sections:
        yield f"the expected error does not include the effects of {', '.join(sections)}"
    window, n_tracks = scenario.estimator_settings().window_tracks, mission.plan.n_leg_tracks
    if mission.plan.cross_track and window < n_tracks:
        yield (f"the cross lines are linked with the last {window} of {n_tracks} tracks only (estimate.window_tracks)")
    if scenario.terrain.prior == "none":
        steepest = math.degrees(math.atan(UNKNOWN_SLOPE))
        yield f"the floor is not known: the survey is spaced for slopes up to {steepest:.0f} deg"
    if mission.objects and scenario.imaging.fidelity != "rendered":
        yield "the surrogate surveys the bare sea floor, and so does this plan: both leave out [[objects]]"


def rows(summary: PlanSummary) -> list[tuple[str, str]]:
    """Returns the properties of the plan as text: pairs (name, value with unit)."""
    mission = summary.mission
    swath, of_track = _SWATHS[mission.scenario.plan.pattern]
    energy = planned_energy(mission) if mission.scenario.vehicle.dynamics == "rigid" else None
    known = {
        "summary": summary,
        "mission": mission,
        "swath": swath,
        "of_track": of_track,
        "tasks": {task.name: task for task in mission.scenario.tasks},
        "energy": energy,
        "dives": energy and _dives(energy),
        "swath_spacing": _swath_spacing(mission),
        "heading_deg": math.degrees(mission.plan.area.heading),
        "water": provenance_of(mission.scenario.water),
        "duration": duration,
    }
    return render_rows("plan_rows.txt.j2", known, "twin.planning")


def instructions(mission: Mission) -> str:
    """Returns what to fly, e.g. "Fly 2.1 m above the floor at 0.35 m/s, legs 0.9 m apart (41 min, one dive)"."""
    plan, scenario = mission.plan, mission.scenario
    height = "floor"
    if not plan.follows_floor:
        x, y, z = planned_keyframes(plan, scenario.plan.pattern).position_m.T
        low_m, high_m = np.nanquantile(z - mission.chart.height_at(x, y), [0.05, 0.95])
        height = f"reference plane z = 0 ({length(low_m)} to {length(high_m)} above the floor)"
    legs = f", {_SWATHS[scenario.plan.pattern][0]}s {_swath_spacing(mission)} apart" if plan.swath_spacing_m else ""
    time = duration(mission.n_frames / mission.rig.frame_rate_hz)
    dives = f", {_dives(planned_energy(mission))}" if scenario.vehicle.dynamics == "rigid" else ""
    return (
        f"Fly {length(scenario.plan.altitude_m)} above the {height} at {plan.speed_mps:.2g} m/s{legs} ({time}{dives})"
    )


def _dives(energy: Energy) -> str:
    return "one dive" if energy.dives == 1 else f"{energy.dives} dives"


def _swath_spacing(mission: Mission) -> str:
    """Returns the distance between swaths as text, or the least and the greatest if legs are unevenly spaced."""
    plan = mission.plan
    if not plan.request.leg_spacing:
        return length(plan.swath_spacing_m)
    return f"{length(plan.least_spacing_m)} to {length(plan.swath_spacing_m)}"


def floor_rows(summary: PlanSummary) -> list[tuple[str, ...]]:
    """Returns the image properties over the floor as table rows, the header first."""
    table: list[tuple[str, ...]] = [("", "minimum", "5 %", "median", "maximum")]
    for key, values in floor_spreads(summary).items():
        label, write, _ = _PROPERTIES[key]
        table.append((label, *(write(v) for v in values)))
    return table


def floor_spreads(summary: PlanSummary) -> dict[str, Spread]:
    """Returns the spread of each image property over the floor, by its JSON key."""
    return {key: spread(values_of(summary)) for key, (_, _, values_of) in _PROPERTIES.items()}


def as_json(summary: PlanSummary, picture: str) -> dict[str, Any]:
    """Returns the summary as a JSON object, with the path of the drawing of the plan."""
    mission, plane, t = summary.mission, summary.plane._asdict(), summary.mission.terrain
    filled = t.n_filled / t.height_m.size - t.unknown_share  # share of the nodes in small holes
    holes = {"floor": t.unknown_share, "asked_area": unknown_share(mission.plan, t), "filled": filled}
    return finite_tree(
        {
            "schema": "twin.plan/1",
            "name": mission.scenario.name,
            "objects": len(mission.objects),
            "water": provenance_of(mission.scenario.water),
            "clarity": mission.clarity._asdict(),
            "plan": plane | {"duration_s": plane["duration_s"] + summary.hold_s, "n_frames": mission.n_frames},
            "floor": {key: values._asdict() for key, values in floor_spreads(summary).items()},
            "coverage": summary.floor.coverage,
            "holes": holes,
            "input": mission.stated_input,
            "expected": _predicted_metrics(summary.floor, summary.error),
            "require": summary.require,
            "latency": summary.latency and summary.latency._asdict(),
            "energy": planned_energy(mission)._asdict(),
            "cost": summary.cost._asdict(),
            "warnings": list(summary.warnings),
            "picture": picture,
        }
    )
