"""Detours of a survey: tracks away from its legs, after which the vehicle returns to where it left (P27)."""

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from twin.controllers import lawnmower
from twin.controllers.curves import end_of
from twin.controllers.segments import Line, Point, Segment, line
from twin.controllers.survey_area import SurveyArea
from twin.controllers.survey_plan import Detour, SurveyPlan, SurveyRequest

_LEAST_M = 0.1  # least distance of a break within a leg from the ends of the leg
_SAME_M = 1e-6  # distance below which two points of a path are the same


class Task(NamedTuple):
    """Close survey of a target by legs of its own; the survey is broken off for it at the end of a leg."""

    name: str
    centre_m: tuple[float, float]
    size_m: tuple[float, float]  # extent along and across the legs of the survey
    altitude_m: float  # above the floor
    floor_m: float  # height of the floor of a level survey; 0 if the path follows the floor
    speed_mps: float
    overlap_along: float
    overlap_across: float
    #: the survey is broken off after this track, else at the first end of a leg from this time on, else at the end of
    #: a leg that is nearest to the target
    after_track: int | None = None
    start_s: float | None = None
    within_leg: bool = False  # the survey is broken off within a leg: at `start_s`, else where it is nearest


class _Break(NamedTuple):
    track: int  # from 1
    n_segments: int  # of the track that are flown before
    along_m: float = math.inf  # length of the last of them that is flown before; inf: all of it


def with_tasks(plan: SurveyPlan, tasks: Sequence[Task], hold_s: float) -> SurveyPlan:
    """Returns the plan with a track for each task; a track that is broken off becomes two.

    The vehicle moves at the height of the survey to a point above the start of the task, descends, surveys the target,
    rises and returns. Raises TwinError if a task cannot be planned.
    """
    placed = sorted(((_break(plan, task, hold_s), task) for task in tasks), key=lambda item: item[0])
    for leave, task in reversed(placed):
        if math.isfinite(leave.along_m):
            plan = _split(plan, leave)
        path, n = _detour(plan, leave, task)
        plan = _inserted(plan, leave, path, n, task.name)
    return plan


def legs_at(plan: SurveyPlan, start: Point, yaw: float, legs: Sequence[tuple[Point, Point]]) -> tuple[Segment, ...]:
    """Returns a path along further legs, each the nearest one next, from a start [m] at a constant heading [rad]."""
    points, left = [start], list(legs)
    while left:
        near = [(math.dist(points[-1], leg[end]), k, end) for k, leg in enumerate(left) for end in range(2)]
        _, k, end = min(near)
        leg = left.pop(k)
        points += [leg[end], leg[1 - end]]
    return tuple(_joined(plan.request, points, plan.speed_mps, yaw))


def _break(plan: SurveyPlan, task: Task, hold_s: float) -> _Break:
    if task.after_track is not None:
        return _Break(task.after_track, len(plan.paths[task.after_track - 1]))
    ends, time_s = list[tuple[_Break, float, float]](), 0.0
    for number, path in enumerate(plan.paths, 1):
        for k, segment in enumerate(path, 1):
            is_leg = number != plan.cross_track  # cross lines are flown to their end
            if task.within_leg and is_leg and isinstance(segment, Line) and segment.profile.length_m > 2 * _LEAST_M:
                ends.append(_nearest_within(segment, _Break(number, k), time_s, task))
            time_s += segment.profile.duration_s
            away_m = math.dist(end_of([segment])[:2], task.centre_m)
            if is_leg or k == len(path):
                ends.append((_Break(number, k), time_s, away_m))
        time_s += hold_s
    if task.start_s is not None:
        return next((at for at, end_s, _ in ends if end_s >= task.start_s), ends[-1][0])
    return min(ends, key=lambda end: end[2])[0]


def _nearest_within(leg: Line, at: _Break, begins_s: float, task: Task) -> tuple[_Break, float, float]:
    """Returns the break within a leg that begins at a time [s], its time [s], and its distance from the target [m]."""
    if task.start_s is None:
        along_m = float(np.dot(np.subtract(task.centre_m, leg.start[:2]), leg.direction[:2]))
        time_s = begins_s
    else:
        time_s = min(max(task.start_s, begins_s), begins_s + leg.profile.duration_s)
        along_m = leg.profile.at(time_s - begins_s)[0]
    along_m = min(max(along_m, _LEAST_M), leg.profile.length_m - _LEAST_M)
    away_m = math.dist(np.array(leg.start[:2]) + along_m * np.array(leg.direction[:2]), task.centre_m)
    return at._replace(along_m=along_m), time_s, away_m


def _split(plan: SurveyPlan, at: _Break) -> SurveyPlan:
    """Returns the plan with the last leg before a break as two, each flown from rest to rest."""
    path = plan.paths[at.track - 1]
    leg = path[at.n_segments - 1]
    assert isinstance(leg, Line)
    if at.along_m > leg.profile.length_m - _LEAST_M / 2:  # the leg was split there
        return plan
    x, y, z = (np.array(leg.start) + at.along_m * np.array(leg.direction)).tolist()
    before = leg._replace(profile=replace(leg.profile, length_m=at.along_m))
    after = leg._replace(start=(x, y, z), profile=replace(leg.profile, length_m=leg.profile.length_m - at.along_m))
    split = (*path[: at.n_segments - 1], before, after, *path[at.n_segments :])
    return replace(plan, paths=(*plan.paths[: at.track - 1], split, *plan.paths[at.track :]))


def _detour(plan: SurveyPlan, leave: _Break, task: Task) -> tuple[tuple[Segment, ...], int]:
    """Returns the path of a task and its number of frames per keyframe."""
    last, request = plan.paths[leave.track - 1][leave.n_segments - 1], plan.request
    end = last.at(np.array([last.profile.duration_s])).row(0)
    x, y, z = end.position.tolist()
    yaw = float(end.yaw)
    close: SurveyRequest = request._replace(
        area=SurveyArea("rectangle", task.size_m, task.centre_m, yaw), area_m=task.size_m, altitude_m=task.altitude_m,
        speed_mps=task.speed_mps, overlap_along=task.overlap_along, overlap_across=task.overlap_across, tracks=0,
        cross_lines=0, turns="reverse", along_scale=1.0, across_scale=1.0, leg_spacing=(), surface=None,
    )  # fmt: skip
    planned = lawnmower.plan(close)
    legs = [_raised(segment, task.floor_m) for path in planned.paths for segment in path]
    (start_x, start_y, start_z), final = legs[0].points()[0].tolist(), end_of(legs)
    first = start_x, start_y, start_z
    above = [(point[0], point[1], z) for point in (first, final)]
    there = _joined(request, [(x, y, z), above[0]], plan.speed_mps, yaw)
    back = _joined(request, [above[1], (x, y, z)], plan.speed_mps, yaw)
    down, up = (_joined(close, pair, task.speed_mps, yaw) for pair in ([above[0], first], [final, above[1]]))
    return (*there, *down, *legs, *up, *back), planned.n_frames_per_keyframe


def _raised(segment: Segment, by_m: float) -> Segment:
    assert isinstance(segment, Line)  # a lawnmower that reverses
    x, y, z = segment.start
    return segment._replace(start=(x, y, z + by_m))


def _joined(request: SurveyRequest, points: Sequence[Point], speed_mps: float, yaw: float) -> list[Line]:
    pairs = [(a, b) for a, b in pairwise(points) if math.dist(a, b) > _SAME_M]
    return [line(a, b, speed_mps, request.acceleration_mps2, yaw) for a, b in pairs]


def _inserted(plan: SurveyPlan, leave: _Break, path: tuple[Segment, ...], n: int, name: str) -> SurveyPlan:
    """Returns the plan with a path as a track of its own after some segments of another track."""
    broken = plan.paths[leave.track - 1]
    rest = (broken[leave.n_segments :],) if leave.n_segments < len(broken) else ()
    later = 1 + len(rest)
    others = [d._replace(track=d.track + later * (d.track > leave.track)) for d in plan.detours]
    return replace(
        plan,
        paths=(*plan.paths[: leave.track - 1], broken[: leave.n_segments], path, *rest, *plan.paths[leave.track :]),
        detours=(*others, Detour(leave.track + 1, name, n)),
    )
