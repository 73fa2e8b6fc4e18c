"""Survey planning over a floor: spacing that keeps the required overlap there, and a path that follows the floor."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from twin.controllers import lawnmower, loops
from twin.controllers.camera_surface import CameraSurface, surface_above_floor
from twin.controllers.survey_plan import SurveyPlan, SurveyRequest
from twin.core.height_field import HeightField
from twin.core.records import MapGrid, StereoRig
from twin.errors import TwinError
from twin.scenario.model import Scenario
from twin.terrains import Terrain
from twin.world.placement import survey_area
from twin.world.planned_images import floor_of, level_floor, overlaps, planned_keyframes, planned_pairs, thinned
from twin.world.thrust_authority import climb_slope

#: Percentage of the pairs of keyframes that may have less overlap over the floor than required. If it were 0, a
#: single step or boulder would determine the spacing of the whole survey.
SHORT_PERCENT = 5.0
#: Largest number of pairs of keyframes, along and across each, whose overlap is computed to choose the spacing.
_PAIRS = 250
_ITERATIONS = 25
#: Relative tolerance of 1 - overlap.
_TOLERANCE = 0.005
#: Least `along_scale` and `across_scale` of a request: spacing relative to that over the reference plane.
_LEAST_SCALE = 0.05
#: The spacing is chosen from all tracks that fill the area or, if they are more than this, from the tracks to fly.
_MOST_TRACKS = 1000

#: Largest number of frames (18 hours at 30 Hz; about 1 kB of memory each), of keyframes, and of cells of the map
#: (about 100 bytes of memory each).
MAX_FRAMES, MAX_KEYFRAMES, MAX_MAP_CELLS = 2_000_000, 200_000, 25_000_000

_PATTERNS = {"lawnmower": lawnmower.plan, "loops": loops.plan}


class NonOverlap(NamedTuple):
    """Percentile (100 - SHORT_PERCENT) of 1 - overlap over the pairs of keyframes, along and across the swaths."""

    along: float
    across: float


def plan_survey(scenario: Scenario, terrain: Terrain | None) -> SurveyPlan:
    """Returns the plan of a survey, with height and spacing adapted to the floor if the scenario requests it.

    They are not adapted if the path leaves the terrain, nor the spacing if it meets the floor, which `prepare` reports.

    Args:
        terrain: the floor; None: the survey is planned over the reference plane.

    Raises:
        TwinError: no plan satisfies the scenario, or the plan exceeds the limits of `check_plan_size`.
    """
    request, pattern = survey_request(scenario, terrain), scenario.plan.pattern
    plan = _PATTERNS[pattern](request)
    check_plan_size(plan, scenario.control.hold_s)
    if terrain is None or not _lies_over(plan, terrain):
        return plan
    if scenario.plan.height == "floor":
        request = request._replace(surface=_surface(scenario, request, terrain))
        plan = _PATTERNS[pattern](request)
    if scenario.plan.overlap_reference == "floor" and _lies_above(plan, terrain):
        request = _keep_overlap(request, pattern, floor_of(terrain), scenario.believed_rig())
        plan = _PATTERNS[pattern](request)
        check_plan_size(plan, scenario.control.hold_s)
    return plan


def check_plan_size(plan: SurveyPlan, hold_s: float) -> None:
    """Raises TwinError if a plan has more than `MAX_FRAMES` frames or `MAX_KEYFRAMES` keyframes."""
    duration_s = sum(plan.track_duration_s(track) for track in range(1, plan.n_tracks + 1))
    n_frames = (duration_s + hold_s * plan.n_tracks) * plan.frame_rate_hz
    _check_number(
        "plan.area_m", n_frames, MAX_FRAMES, "frames", "fewer plan.tracks, a smaller area, less overlap, more speed"
    )
    n_keyframes = duration_s * plan.frame_rate_hz / plan.n_frames_per_keyframe
    _check_number("plan.overlap_along", n_keyframes, MAX_KEYFRAMES, "keyframes", "less overlap, or fewer plan.tracks")


def check_map_size(grid: MapGrid) -> None:
    """Raises TwinError if a map has more than `MAX_MAP_CELLS` cells."""
    n_cells = grid.rows * grid.cols
    needed_m = grid.cell_m * math.sqrt(n_cells / MAX_MAP_CELLS)
    _check_number("map.cell_m", n_cells, MAX_MAP_CELLS, "cells of the map", f"a cell of {needed_m:.2g} m")


def _check_number(field: str, number: float, limit: int, items: str, remedy: str) -> None:
    """Raises TwinError if a number of items exceeds its limit."""
    if number > limit:
        raise TwinError(field, f"{number:.4g} {items} are too many", f"up to {limit}: {remedy}")


def survey_request(scenario: Scenario, terrain: Terrain | None) -> SurveyRequest:
    """Returns the requirements of the survey of a scenario.

    Args:
        terrain: the floor, in which the area is placed; None: the area lies at the origin.

    Raises:
        TwinError: the area cannot be placed, or the vehicle cannot turn on the spot.
    """
    p, rig = scenario.plan, scenario.believed_rig()
    if p.turns != "reverse" and scenario.vehicle.dynamics == "kinematic":
        raise TwinError("plan.turns", f"{p.turns!r}: a kinematic vehicle does not rotate", '"reverse"')
    area = None if terrain is None else survey_area(p, terrain)
    return SurveyRequest(
        p.area_m if area is None else area.size_m, p.altitude_m, p.speed_mps, p.overlap_along, p.overlap_across,
        p.tracks, rig.width_px, rig.height_px, rig.focal_px, rig.frame_rate_hz, area=area, turns=p.turns,
    )  # fmt: skip


def _lies_over(plan: SurveyPlan, terrain: Terrain) -> bool:
    """Returns whether all waypoints of the path lie over the terrain, at any height."""
    return bool(np.isfinite(terrain.height_at(*plan.outline()[:, :2].T)).all())


def _lies_above(plan: SurveyPlan, terrain: Terrain) -> bool:
    """Returns whether all waypoints of the path lie above the floor."""
    x, y, z = plan.outline().T
    return bool((terrain.height_at(x, y) < z).all())


def _surface(scenario: Scenario, request: SurveyRequest, terrain: Terrain) -> CameraSurface:
    """Returns the surface that the camera follows, at `plan.altitude_m` above the smoothed floor."""
    if scenario.vehicle.dynamics == "kinematic":
        raise TwinError("plan.height", "'floor': a kinematic vehicle moves in a horizontal plane", '"plane"')
    if min(terrain.height_m.shape) < 4:
        shape = " x ".join(map(str, terrain.height_m.shape))
        raise TwinError("plan.height", f"'floor': the terrain has {shape} nodes", "at least 4 x 4 nodes")
    across_m, along_m = request.footprint_m
    along_x = scenario.plan.pattern == "lawnmower" and not scenario.plan.heading_deg
    footprint_m = (along_m, across_m) if along_x else (across_m, across_m)
    slope = climb_slope(scenario.vehicle, scenario.plan.speed_mps)
    corner_m = (terrain.west_m, terrain.south_m)
    return surface_above_floor(terrain.height_m, terrain.spacing_m, corner_m, request.altitude_m, footprint_m, slope)


def _keep_overlap(request: SurveyRequest, pattern: str, field: HeightField, rig: StereoRig) -> SurveyRequest:
    """Returns the request with `along_scale` and `across_scale` reduced until the overlap over the floor suffices.

    The overlap suffices if all but SHORT_PERCENT of the pairs of keyframes, both along and across the swaths, have at
    least the smaller of two overlaps: the required one, and the one that all but SHORT_PERCENT of the pairs have over
    the reference plane in the plan with scales of 1 at constant height. The scales start at 1 and are repeatedly
    multiplied by the factors of `_reduction`. On a floor at the reference plane they stay 1.
    """
    make = _PATTERNS[pattern]
    whole = request._replace(tracks=0) if _n_whole(request, pattern) <= _MOST_TRACKS else request
    plane = make(whole._replace(surface=None))
    centre_m = request.area.centre_m if request.area else (0.0, 0.0)
    reach_m = 10 * (max(request.area_m) + max(request.footprint_m)) + 2 * float(np.hypot(*centre_m))
    allowed = _non_overlap(plane, pattern, level_floor(0.0, reach_m), rig)
    allowed = NonOverlap(max(allowed.along, 1 - request.overlap_along), max(allowed.across, 1 - request.overlap_across))
    plan, unchanged = make(whole), [0, 0]
    for _ in range(_ITERATIONS):
        found = _non_overlap(plan, pattern, field, rig)
        if all(f <= a * (1 + _TOLERANCE) for f, a in zip(found, allowed, strict=True)):
            return whole._replace(tracks=request.tracks)
        reduced = [_reduction(f, a, n) for f, a, n in zip(found, allowed, unchanged, strict=True)]
        whole = whole._replace(along_scale=whole.along_scale * reduced[0], across_scale=whole.across_scale * reduced[1])
        if min(whole.along_scale, whole.across_scale) < _LEAST_SCALE:
            break
        previous, plan = plan, make(whole)
        same = (
            plan.n_frames_per_keyframe == previous.n_frames_per_keyframe,
            plan.swath_spacing_m == previous.swath_spacing_m,
        )
        unchanged = [n + 1 if kept else 0 for n, kept in zip(unchanged, same, strict=True)]
    raise TwinError(
        "plan.altitude_m",
        f"{request.altitude_m:g}: no spacing keeps the required overlap over the floor, which comes too near",
        'a greater altitude, less overlap, plan.height = "floor", or plan.overlap_reference = "plane"',
    )


def _n_whole(request: SurveyRequest, pattern: str) -> float:
    """Returns the longer side of the area divided by the swath spacing: a rough number of the tracks that fill it."""
    swath_m = _PATTERNS[pattern](request._replace(tracks=1)).swath_spacing_m
    return max(request.area_m) / swath_m


def _reduction(found: float, allowed: float, unchanged: int) -> float:
    """Returns the factor by which a scale is multiplied: 1 if the overlap suffices, otherwise 0.3 to 0.99.

    The numbers of frames per keyframe and of tracks are integers, so a small step may leave them unchanged. The least
    step of 1 % is therefore doubled after each of the last `unchanged` steps without effect.
    """
    if found <= allowed * (1 + _TOLERANCE):
        return 1.0
    return max(min(allowed / found, 1 - 0.01 * 2**unchanged), 0.3)


def _non_overlap(plan: SurveyPlan, pattern: str, field: HeightField, rig: StereoRig) -> NonOverlap:
    """Returns the `NonOverlap` of a plan over a floor, from at most _PAIRS pairs along and _PAIRS across the swaths.

    A value is 0 without pairs whose first image shows floor.
    """
    pairs = planned_pairs(planned_keyframes(plan, pattern))
    missed = [1 - overlaps(field, thinned(p, _PAIRS), rig) for p in pairs]
    known = [m[np.isfinite(m)] for m in missed]
    return NonOverlap(*(float(np.percentile(m, 100 - SHORT_PERCENT)) if len(m) else 0.0 for m in known))
