"""Survey planning over a floor: spacing that keeps the required overlap there, and a path that follows the floor."""

import math

import numpy as np
from scipy.ndimage import uniform_filter1d

from twin.controllers import lawnmower, loops
from twin.controllers.camera_surface import CameraSurface, surface_above_floor
from twin.controllers.detours import Task, with_tasks
from twin.controllers.survey_area import SurveyArea
from twin.controllers.survey_plan import SurveyPlan, SurveyRequest
from twin.core import geometry
from twin.core.geometry import Array
from twin.core.height_field import HeightField, height_field, image_overlap
from twin.core.records import MapGrid, StereoRig
from twin.errors import TwinError
from twin.judge.swaths import KeyframePoses, image_pairs, swath_numbers, thinned, travel_direction
from twin.scenario.model import PlanConfig, Scenario, VehicleConfig
from twin.simulate.steady_flight import minimum_speed_mps, turning_radius_m
from twin.terrains import Terrain
from twin.world.asked_area import survey_area
from twin.world.path_checks import climb_slope, hole_part

#: Percentage of pairs with less overlap than required; with 0, a single step or boulder would set the spacing.
SHORT_PERCENT = 5.0
#: Largest number of pairs of keyframes, along and across each, whose overlap is computed to choose the spacing.
_PAIRS = 250
_ITERATIONS = 25
_TOLERANCE = 0.005  # of 1 - overlap, relative
_LEAST_SCALE = 0.05  # of the spacing relative to that over the reference plane
_ACROSS_SLOPE = 2.0  # greatest slope of a path that follows the floor across the legs, where it is flown more slowly
UNKNOWN_SLOPE = 0.3  #: slope (rise over run) for which a survey over an unknown floor is spaced
_MEAN_SAMPLES = 20  # of the height along each side of a rectangle
_SPACING_POINTS = 200  #: largest number of points of `_leg_spacing` along the legs, and across them
#: The spacing is chosen from all tracks that fill the area or, if they are more than this, from the tracks to fly.
_MOST_TRACKS = 1000

#: Largest number of frames (18 hours at 30 Hz; about 1 kB of memory each), of keyframes, and of cells of the map
#: (about 100 bytes of memory each).
MAX_FRAMES, MAX_KEYFRAMES, MAX_MAP_CELLS = 2_000_000, 200_000, 25_000_000

_EQUAL: tuple[tuple[float, float], ...] = ()  #: `SurveyRequest.leg_spacing` of equally spaced legs

_PATTERNS = {"lawnmower": lawnmower.plan, "loops": loops.plan}


def plan_survey(scenario: Scenario, terrain: Terrain | None) -> SurveyPlan:
    """Returns the plan of a survey, with height and spacing adapted to the floor if the scenario requests it.

    They are not adapted without a terrain or if the path leaves it or leads over its holes, nor the spacing if the path
    meets the floor. Raises TwinError if no plan satisfies the scenario, or it exceeds the limits of `check_plan_size`.
    """
    plan, pattern = level_plan(scenario, terrain), scenario.plan.pattern
    if scenario.terrain.prior == "none":
        plan = _PATTERNS[pattern](for_slopes(plan.request))
    request = plan.request
    check_plan_size(plan, scenario.control.hold_s)
    if terrain is None or not _lies_over(plan, terrain):
        return plan
    if scenario.plan.height == "floor" or scenario.control.height != "planned":
        request = request._replace(surface=_surface(scenario, request, plan.area, terrain))
        plan = _PATTERNS[pattern](request)
    x, y, z = plan.all_references().position.T
    if scenario.plan.overlap_reference == "floor" and not (terrain.height_at(x, y) >= z).any():
        plan = _over_floor(plan, pattern, terrain, scenario.believed_rig())
    plan = _with_tasks(scenario, plan, terrain)
    check_plan_size(plan, scenario.control.hold_s)
    return plan


def _with_tasks(scenario: Scenario, plan: SurveyPlan, terrain: Terrain) -> SurveyPlan:
    """Returns the plan with its tasks; raises TwinError, which names the task, if one cannot be planned."""
    hold_s, n_tracks = scenario.control.hold_s, plan.n_tracks
    for k, task in enumerate(scenario.tasks):
        if task.after_track is not None and task.after_track > n_tracks:
            raise TwinError(f"tasks.{k}.after_track", f"{task.after_track}: no such track", f"1 to {n_tracks}")
        if not plan.inside_area(*task.position_m):
            position = "({:g}, {:g})".format(*task.position_m)
            raise TwinError(f"tasks.{k}.position_m", f"{position} lies outside the area", "a point in the asked area")
    sides = [max(task.size_m) for task in scenario.tasks]
    tasks = [
        Task(
            task.name, task.position_m, task.size_m, task.altitude_m,
            0.0 if plan.follows_floor else mean_height_m(terrain, task.position_m, (side, side)),
            task.speed_mps, task.overlap_along, task.overlap_across, task.after_track, task.start_s,
            task.within_leg,
        )
        for task, side in zip(scenario.tasks, sides, strict=True)
    ]  # fmt: skip
    for k, task in enumerate(tasks):
        try:
            with_tasks(plan, [task], hold_s)
        except TwinError as error:
            raise TwinError(error.field.replace("plan.", f"tasks.{k}."), error.problem, error.allowed) from None
    return with_tasks(plan, tasks, hold_s)


def mean_height_m(terrain: Terrain, centre_m: tuple[float, float], size_m: tuple[float, float]) -> float:
    """Returns the mean height of a floor over a rectangle along x and y [m]."""
    east, north = np.meshgrid(*(np.linspace(-0.5, 0.5, _MEAN_SAMPLES) * side for side in size_m))
    return float(terrain.height_near(centre_m[0] + east, centre_m[1] + north).mean())


def level_plan(scenario: Scenario, terrain: Terrain | None) -> SurveyPlan:
    """Returns the plan of a survey over the reference plane; raises TwinError like `plan_survey`."""
    return _PATTERNS[scenario.plan.pattern](survey_request(scenario, terrain))


def for_slopes(request: SurveyRequest) -> SurveyRequest:
    """Returns the request with the spacing that keeps the overlaps over slopes of `UNKNOWN_SLOPE`."""
    # At the slope g, the floor that rises reaches 1 / (1 + g t) as far into an image as level floor (`_leg_spacing`).
    across, along = (1 / (1 + UNKNOWN_SLOPE * side / 2 / request.altitude_m) for side in request.footprint_m)
    return request._replace(across_scale=across, along_scale=along)


def check_plan_size(plan: SurveyPlan, hold_s: float) -> None:
    """Raises TwinError if a plan has more than `MAX_FRAMES` frames or `MAX_KEYFRAMES` keyframes."""
    duration_s = sum(plan.track_duration_s(track) for track in range(1, plan.n_tracks + 1))
    n_frames = (duration_s + hold_s * plan.n_tracks) * plan.request.frame_rate_hz
    remedy = "fewer plan.tracks, a smaller area, less overlap, more speed"
    _check_number("plan.area_m", n_frames, MAX_FRAMES, "frames", remedy)
    n_keyframes = duration_s * plan.request.frame_rate_hz / plan.n_frames_per_keyframe
    _check_number("plan.overlap_along", n_keyframes, MAX_KEYFRAMES, "keyframes", "less overlap, or fewer plan.tracks")


def check_map_size(grid: MapGrid) -> None:
    """Raises TwinError if a map has more than `MAX_MAP_CELLS` cells."""
    n_cells = grid.rows * grid.cols
    needed_m = grid.cell_m * math.sqrt(n_cells / MAX_MAP_CELLS)
    _check_number("map.cell_m", n_cells, MAX_MAP_CELLS, "cells of the map", f"a cell of {needed_m:.2g} m")


def _check_number(field: str, number: float, limit: int, items: str, remedy: str) -> None:
    if number > limit:
        raise TwinError(field, f"{number:.4g} {items} are too many", f"up to {limit}: {remedy}")


def survey_request(scenario: Scenario, terrain: Terrain | None) -> SurveyRequest:
    """Returns the requirements of a survey; without a terrain, its area lies at the origin.

    Raises TwinError if the area cannot be placed, or the vehicle cannot turn as planned.
    """
    p, rig = scenario.plan, scenario.believed_rig()
    if p.turns != "reverse" and scenario.vehicle.dynamics == "kinematic":
        raise TwinError("plan.turns", f"{p.turns!r}: a kinematic vehicle does not rotate", '"reverse"')
    area = None if terrain is None else survey_area(p, terrain)
    return SurveyRequest(
        p.area_m if area is None else area.size_m, p.altitude_m, p.speed_mps, p.overlap_along, p.overlap_across,
        p.tracks, rig.width_px, rig.height_px, rig.focal_px, rig.frame_rate_hz, area=area, turns=p.turns,
        turn_radius_m=_turn_radius_m(p, scenario.vehicle),
        cross_lines=p.cross_lines, cross_rise_m=p.cross_rise_m,
    )  # fmt: skip


def _turn_radius_m(asked: PlanConfig, vehicle: VehicleConfig) -> float:
    """Returns the radius of turns of a vehicle that is steered by fins, else 0; raises TwinError if it cannot fly."""
    if not vehicle.is_steered_by_fins:
        if asked.turns == "arcs":
            raise TwinError("plan.turns", "'arcs': the vehicle is not steered by fins", '"reverse" or "bow_first"')
        return 0.0
    if asked.turns != "arcs":
        problem = f"{asked.turns!r}: a vehicle that is steered by fins can neither reverse nor turn on the spot"
        raise TwinError("plan.turns", problem, '"arcs"')
    if asked.speed_mps < (least := minimum_speed_mps(vehicle)):
        problem = f"{asked.speed_mps:g}: too slow for the fins to keep the height"
        raise TwinError("plan.speed_mps", problem, f"at least {least:.2f}")
    return turning_radius_m(vehicle, asked.speed_mps)


def _lies_over(plan: SurveyPlan, terrain: Terrain) -> bool:
    inside = bool(np.isfinite(terrain.height_at(*plan.outline()[:, :2].T)).all())
    return inside and (terrain.known is None or not hole_part(plan, terrain).too_far)


def _surface(scenario: Scenario, request: SurveyRequest, area: SurveyArea, terrain: Terrain) -> CameraSurface:
    if scenario.vehicle.dynamics == "kinematic":
        planned = scenario.plan.height == "floor"
        key, allowed = ("plan.height", '"plane"') if planned else ("control.height", '"planned"')
        value = "floor" if planned else scenario.control.height
        raise TwinError(key, f"{value!r}: a kinematic vehicle moves in a horizontal plane", allowed)
    sides, slopes = smoothed_over(scenario, request), climb_slopes(scenario)
    return surface_above_floor(terrain.height_near, area, terrain.spacing_m, request.altitude_m, sides, slopes)


def smoothed_over(scenario: Scenario, request: SurveyRequest) -> tuple[float, float]:
    """Returns the lengths along and across the legs over which a path that follows the floor averages it [m]."""
    across_m, along_m = request.footprint_m
    return (along_m if scenario.plan.pattern == "lawnmower" else across_m), across_m


def climb_slopes(scenario: Scenario) -> tuple[float, float]:
    """Returns the greatest slopes of a path that follows the floor, along and across the legs."""
    slope = climb_slope(scenario.vehicle, scenario.plan.speed_mps)
    return slope, _ACROSS_SLOPE if scenario.plan.pattern == "lawnmower" else slope


def _over_floor(plan: SurveyPlan, pattern: str, terrain: Terrain, rig: StereoRig) -> SurveyPlan:
    """Returns the plan with the spacing that keeps the overlap over the floor; TwinError if none does."""
    # Legs are equally spaced unless fewer tracks fill the area if they are nearer to each other over high floor.
    make, field, spacings = _PATTERNS[pattern], floor_of(terrain), [_EQUAL]
    if pattern == "lawnmower":
        spacings.append(_leg_spacing(plan, terrain))
    found, errors = list[SurveyPlan](), list[TwinError]()
    for spacing in spacings:
        request = plan.request._replace(leg_spacing=spacing)
        try:  # the overlap over the floor can only add tracks
            if not found or make(request._replace(tracks=0)).n_tracks_to_fill < found[0].n_tracks_to_fill:
                found.append(make(_keep_overlap(request, pattern, field, rig)))
        except TwinError as error:
            errors.append(error)
    if not found:
        raise errors[0]
    return min(found, key=lambda kept: kept.n_tracks_to_fill)


def _leg_spacing(plan: SurveyPlan, terrain: Terrain) -> tuple[tuple[float, float], ...]:
    """Returns pairs of v [m] and the extent across the legs of images there, relative to that over the plane."""
    # At a height h above a floor with the slope g across the legs, the floor that rises reaches h t / (1 + g t) into an
    # image, with t the tangent of half the angle of view. Floor averaged over half an image, SHORT_PERCENT percentile.
    request, area = plan.request, plan.area
    half_m = request.footprint_m[0] / 2
    reach_m = [side / 2 + half_m for side in area.size_m]
    u, v = (np.linspace(-r, r, min(_SPACING_POINTS, round(8 * r / half_m))) for r in reach_m)
    x, y = area.to_scene(u[:, None], v)
    floor_m = terrain.height_near(x, y)
    for axis, along in enumerate((u, v)):
        size = 2 * round(half_m / (along[1] - along[0]) / 2) + 1
        floor_m = np.asarray(uniform_filter1d(floor_m, size, axis, mode="nearest"))
    height_m = plan.camera_height_at(x.ravel(), y.ravel()).reshape(x.shape) - floor_m
    slope = np.abs(np.gradient(floor_m, v, axis=1))
    extent = height_m / request.altitude_m / (1 + slope * half_m / request.altitude_m)
    extent = np.where(area.contains(x, y), np.maximum(extent, _LEAST_SCALE), np.nan)
    known = np.isfinite(extent).any(axis=0)
    if not known.any():
        return _EQUAL  # the area is smaller than the distance between the points
    least = np.interp(v, v[known], np.nanpercentile(extent[:, known], SHORT_PERCENT, axis=0))
    return tuple(zip(v.tolist(), least.tolist(), strict=True))


def _keep_overlap(request: SurveyRequest, pattern: str, field: HeightField, rig: StereoRig) -> SurveyRequest:
    """Returns the request with `along_scale` and `across_scale` reduced until the overlap over the floor suffices.

    It suffices if all but SHORT_PERCENT of the pairs of keyframes, along and across the swaths, have the required
    overlap or that which all but SHORT_PERCENT have over the reference plane with scales of 1. Scales are multiplied by
    allowed / found of 1 - overlap (0.3 to 0.99); the least step of 1 % is doubled after each without effect (integers).
    """
    make = _PATTERNS[pattern]
    rough_tracks = max(request.area_m) / make(request._replace(tracks=1)).swath_spacing_m
    whole = request._replace(tracks=0, cross_lines=0) if rough_tracks <= _MOST_TRACKS else request
    level = _non_overlap(make(whole._replace(surface=None, leg_spacing=_EQUAL)), pattern, _level_floor(request), rig)
    allowed = np.maximum(level, [1 - request.overlap_along, 1 - request.overlap_across])
    plan, scale, unchanged = make(whole), np.ones(2), np.zeros(2)
    found = _non_overlap(plan, pattern, field, rig)
    for _ in range(_ITERATIONS):
        short = found > allowed * (1 + _TOLERANCE)
        if not short.any():
            return whole._replace(tracks=request.tracks, cross_lines=request.cross_lines)
        step = np.maximum(np.minimum(allowed / np.where(short, found, 1), 1 - 0.01 * 2**unchanged), 0.3)
        scale = np.where(short, scale * step, scale)
        whole = whole._replace(along_scale=float(scale[0]), across_scale=float(scale[1]))
        if scale.min() < _LEAST_SCALE:
            break
        previous, plan = plan, make(whole)
        same = np.equal(*((p.n_frames_per_keyframe, p.swath_spacing_m) for p in (previous, plan)))
        unchanged = np.where(same, unchanged + 1, 0)
        found = found if same.all() else _non_overlap(plan, pattern, field, rig)
    raise TwinError(
        "plan.altitude_m",
        f"{request.altitude_m:g}: no spacing keeps the required overlap over the floor, which comes too near",
        'a greater altitude, less overlap, plan.height = "floor", or plan.overlap_reference = "plane"',
    )


def _level_floor(request: SurveyRequest) -> HeightField:
    """Returns a level square floor on the reference plane, far larger than the area."""
    centre_m = request.area.centre_m if request.area else (0.0, 0.0)
    reach_m = 10 * (max(request.area_m) + max(request.footprint_m)) + 2 * float(np.hypot(*centre_m))
    return height_field(np.zeros((2, 2)), 2 * reach_m, -reach_m, -reach_m)


def _non_overlap(plan: SurveyPlan, pattern: str, field: HeightField, rig: StereoRig) -> Array:
    """Returns the percentiles (2,), along and across, of 1 - overlap of a plan over a floor; 0 without pairs."""
    pairs = image_pairs(planned_keyframes(plan, pattern), plan.follows_floor)
    missed = [1 - image_overlap(field, *thinned(p, _PAIRS), rig) for p in pairs]
    known = [m[np.isfinite(m)] for m in missed]
    return np.array([np.percentile(m, 100 - SHORT_PERCENT) if len(m) else 0.0 for m in known])


def planned_keyframes(plan: SurveyPlan, pattern: str) -> KeyframePoses:
    """Returns the planned keyframes of all tracks, with the camera looking straight down."""
    are_keyframes = [plan.frames_of_track(track)[1] for track in range(1, plan.n_tracks + 1)]
    position, _, yaw, _ = plan.all_references()
    keyframe, yaw = np.concatenate(are_keyframes), np.asarray(yaw)
    track = np.repeat(np.arange(1, plan.n_tracks + 1), [len(part) for part in are_keyframes])
    swath = swath_numbers(position, yaw, track, {"pattern": pattern} | plan.swath_notes)
    poses = np.tile(np.eye(4), (int(keyframe.sum()), 1, 1))
    poses[:, :3, :3] = geometry.rotations_of_down_camera(yaw[keyframe])
    poses[:, :3, 3] = position[keyframe]
    return KeyframePoses(poses, travel_direction(position)[keyframe], swath[keyframe])


def floor_of(terrain: Terrain) -> HeightField:
    """Returns the height field of a terrain, for ray casting; there is no floor at its unknown nodes."""
    height = terrain.height_m if terrain.known is None else np.where(terrain.known, terrain.height_m, np.nan)
    return height_field(height, terrain.spacing_m, terrain.west_m, terrain.south_m)
