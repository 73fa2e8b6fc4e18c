"""Lawnmower survey: L tracks of two legs, joined by short segments (Negahdaripour & Madjidi 2003, section III-A).

By default every second leg is flown backwards, so the images of all legs have the same orientation. With `turns` =
"bow_first" the vehicle turns by 180 degrees at the end of each leg except the last, alternately counter-clockwise and
clockwise so that a tether is not twisted. Consecutive keyframes are displaced along the image height, neighbouring
swaths along the image width. With "arcs", it flies all legs bow first at constant speed, and turns beyond their ends.
Cross lines, which check the legs, are a last track: the vehicle flies them sideways.
"""

import math
from collections.abc import Sequence
from itertools import accumulate, pairwise
from typing import NamedTuple

import numpy as np
from scipy.integrate import cumulative_trapezoid

from twin.controllers.curves import PathSegment, end_of, steady_line, u_turn
from twin.controllers.segments import Point, Segment, SpeedProfile, Turn, line
from twin.controllers.survey_area import SurveyArea
from twin.controllers.survey_plan import (
    TURN_ACCELERATION,
    TURN_RATE,
    SurveyPlan,
    SurveyRequest,
    check_request,
    frames_per_keyframe,
    n_tracks_to_fly,
)
from twin.core.geometry import Array

_SPACING_SAMPLES = 2001  # of an uneven spacing, across an area
_COINCIDE_M = 1e-9  # distance below which two corners of a path are the same
_RUN_S = 2.0  # time of straight flight before a leg and after it, in which the vehicle settles


class _Strip(NamedTuple):
    """Part of the area between two values of v, with a leg along its centre line."""

    low_m: float
    high_m: float
    leg_m: float  # v of the leg
    spacing_m: float  # distance to the leg of the next strip of the band


class _Leg(NamedTuple):
    start_m: float  # least and greatest u
    end_m: float
    v_m: float
    to_next_m: float  # distance to the next leg


def plan(request: SurveyRequest) -> SurveyPlan:
    """Plans a lawnmower survey of an area; raises TwinError if a requirement is invalid or cannot be met.

    The legs run along the heading of the area. Their distance is at most (1 - overlap_across) ImgSize Altitude /
    FocalLength (ImgSize is the image width), times `across_scale` and, where they are unevenly spaced, the value of
    `leg_spacing` there. Each band of the area (`SurveyArea.bands`) is divided into an even number of strips, of equal
    width unless they are unevenly spaced, with a leg along the centre line of each, spanning the extent of the area
    within its strip; the first leg is the rightmost as seen along the heading. Where two legs are joined, the one that
    ends first is extended.
    """
    check_request(request)
    area = request.area or SurveyArea("rectangle", request.area_m)
    max_spacing_m = (1 - request.overlap_across) * request.footprint_m[0] * request.across_scale
    bands = area.bands()
    # Tolerance: a strip that exceeds the limit only by rounding must not add a track.
    counts = [math.ceil(_in_spacings(*band, request) / max_spacing_m / 2 - 1e-9) for band in bands]
    n_tracks = n_tracks_to_fly(request, sum(counts))
    strips = [strip for band, n in zip(bands, counts, strict=True) for strip in _strips(*band, 2 * n, request)]
    legs = [
        _Leg(*area.extent_between(strip.low_m, strip.high_m), strip.leg_m, _to_next(strip, following))
        for strip, following in zip(strips, [*strips[1:], None], strict=True)
    ]
    corners = [_corners(legs, 2 * k, last=k == n_tracks - 1) for k in range(n_tracks)]
    if request.turns == "arcs":
        paths = _tracks_of_arcs(request, area, corners)
    else:
        paths = [_track(request, area, track) for track in corners]
    if request.cross_lines:
        paths.append(_cross_track(request, area, legs[: 2 * n_tracks], corners[-1][-1], paths[-1][-1].yaw))
    return SurveyPlan(
        request, paths=tuple(paths), area=area, speed_mps=request.speed_mps,
        n_frames_per_keyframe=frames_per_keyframe(request, request.speed_mps),
        swath_length_m=float(np.mean([leg.end_m - leg.start_m for leg in legs])),
        swath_spacing_m=max(s.spacing_m for s in strips), n_tracks_to_fill=sum(counts),
        side_along_m=request.footprint_m[1], side_across_m=request.footprint_m[0],
        least_spacing_m=min(s.spacing_m for s in strips), legs_after_gaps=tuple(2 * n for n in accumulate(counts[:-1])),
        covered_to_m=math.inf if n_tracks == sum(counts) else strips[2 * n_tracks - 1].high_m,
    )  # fmt: skip


def _in_spacings(low_m: float, high_m: float, request: SurveyRequest) -> float:
    """Returns the width of a band divided by `leg_spacing`: the integral of its inverse over v."""
    return float(_density(low_m, high_m, request)[1][-1]) if request.leg_spacing else high_m - low_m


def _density(low_m: float, high_m: float, request: SurveyRequest) -> tuple[Array, Array]:
    """Returns values of v (n,) in a band, and the integral (n,) of 1 / `leg_spacing` from its lower edge to them."""
    v = np.linspace(low_m, high_m, _SPACING_SAMPLES)
    return v, cumulative_trapezoid(1 / np.interp(v, *np.array(request.leg_spacing).T), v, initial=0)


def _strips(low_m: float, high_m: float, n: int, request: SurveyRequest) -> list[_Strip]:
    """Returns n strips of a band: of equal width or, with `leg_spacing`, of widths proportional to it."""
    if not request.leg_spacing:
        width_m = (high_m - low_m) / n
        edge = [k * width_m + low_m for k in range(n + 1)]
        return [_Strip(edge[k], edge[k + 1], (k + 0.5) * width_m + low_m, width_m) for k in range(n)]
    v, integral = _density(low_m, high_m, request)
    edges = np.interp(np.linspace(0, integral[-1], n + 1), integral, v).tolist()
    legs = [(low + high) / 2 for low, high in pairwise(edges)]
    spacings = [*(b - a for a, b in pairwise(legs)), edges[-1] - edges[-2]]
    return [_Strip(*strip) for strip in zip(edges[:-1], edges[1:], legs, spacings, strict=True)]


def _to_next(strip: _Strip, following: _Strip | None) -> float:
    if following is None or following.low_m == strip.high_m:
        return strip.spacing_m
    return following.leg_m - strip.leg_m  # the next band


def _corners(legs: Sequence[_Leg], first: int, last: bool) -> list[tuple[float, float]]:
    """Returns the corners (u, v) [m] of a track: the ends of its two legs and, unless `last`, the start of the next."""
    south, to_second, to_third = legs[first].v_m, legs[first].to_next_m, legs[first + 1].to_next_m
    start = min(leg.start_m for leg in legs[max(first - 1, 0) : first + 1])
    turn = max(leg.end_m for leg in legs[first : first + 2])
    end = legs[first + 1].start_m if last else min(leg.start_m for leg in legs[first + 1 : first + 3])
    out, back = [(start, south), (turn, south)], [(turn, south + to_second), (end, south + to_second)]
    return [*out, *back, *([] if last else [(end, south + (to_second + to_third))])]


def _track(request: SurveyRequest, area: SurveyArea, corners: list[tuple[float, float]]) -> tuple[Segment, ...]:
    """Returns the segments of a track between its corners (u, v) [m], with its turns on the spot."""
    points = _points(request, area, corners)
    turning = request.turns == "bow_first"
    segments: list[Segment] = []
    for k, (a, b) in enumerate(pairwise(points)):
        reversed_bow = turning and k in (1, 2)
        yaw = area.heading + (math.pi if reversed_bow else 0.0)
        segments.append(_line(request, a, b, yaw, is_leg=k in (0, 2)))
        if turning and (k == 0 or (k == 2 and len(points) > 4)):  # at the end of a leg, except the last one
            profile = SpeedProfile(math.pi, TURN_RATE, TURN_ACCELERATION)
            segments.append(Turn(b, yaw, -1.0 if reversed_bow else 1.0, profile))
    return tuple(segments)


def _tracks_of_arcs(
    request: SurveyRequest, area: SurveyArea, corners: Sequence[list[tuple[float, float]]]
) -> list[tuple[PathSegment, ...]]:
    """Returns the segments of tracks between their corners (u, v) [m], flown at constant speed."""
    # Straight lines before and after a leg let the vehicle settle; a track begins where the last ends, after whole
    # frames.
    speed, radius_m, run_m = request.speed_mps, request.turn_radius_m, _RUN_S * request.speed_mps
    ahead, astern, done_m, paths = area.heading, area.heading + math.pi, 0.0, list[tuple[PathSegment, ...]]()
    for (start, south), (turn, _), (_, north), (end, _), *following in corners:
        (first,) = _points(request, area, [(start - run_m + done_m, south)])
        path: list[PathSegment] = [steady_line(first, ahead, turn - start + 2 * run_m - done_m, speed)]
        path.append(u_turn(end_of(path), ahead, north - south, radius_m, speed))
        path.append(steady_line(end_of(path), astern, turn - end + 2 * run_m, speed))
        path += [u_turn(end_of(path), astern, north - v, radius_m, speed) for _, v in following]
        n_frames = sum(segment.profile.duration_s for segment in path) * request.frame_rate_hz
        done_m = (math.floor(n_frames) + 1 - n_frames) * speed / request.frame_rate_hz
        path.append(steady_line(end_of(path), ahead if following else astern, done_m, speed))
        paths.append(tuple(path))
    return paths


def _points(request: SurveyRequest, area: SurveyArea, corners: Sequence[tuple[float, float]]) -> list[Point]:
    scene = [area.to_scene(u, v) for u, v in corners]
    return [(float(x), float(y), request.altitude_m) for x, y in scene]


def _line(request: SurveyRequest, start: Point, end: Point, yaw: float, is_leg: bool) -> Segment:
    """Returns a line at the cruise speed or, across the legs on a surface that is steep there, more slowly."""
    pace = 1.0 if is_leg or request.surface is None else request.surface.pace(start, end)
    return line(start, end, pace * request.speed_mps, pace * request.acceleration_mps2, yaw)


def _cross_track(
    request: SurveyRequest, area: SurveyArea, legs: Sequence[_Leg], start: tuple[float, float], yaw: float
) -> tuple[Segment, ...]:
    """Returns the segments of cross lines over the legs, from a start (u, v) [m], at one heading and their height."""
    # Where two are joined, the one that ends first is extended.
    corners = [start]
    for k, u in enumerate(_cross_positions(legs, request.cross_lines)):
        crossed = [leg.v_m for leg in legs if leg.start_m <= u <= leg.end_m]
        first, end = (min, max) if k % 2 else (max, min)
        joint = first(corners[-1][1], first(crossed))
        corners[-1] = corners[-1][0], joint
        corners += [(u, joint), (u, end(crossed))]
    points = _points(request, area, corners)
    raised = [(x, y, z + request.cross_rise_m) for x, y, z in points]
    pairs = [(a, b) for a, b in pairwise([points[0], *raised]) if math.dist(a, b) > _COINCIDE_M]
    return tuple(_line(request, a, b, yaw, is_leg=False) for a, b in pairs)


def _cross_positions(legs: Sequence[_Leg], n: int) -> list[float]:
    """Returns u of n lines across legs, at equal distances in the parts of u that legs span."""
    edges = np.unique([(leg.start_m, leg.end_m) for leg in legs])
    spanned = [any(leg.start_m <= low and high <= leg.end_m for leg in legs) for low, high in pairwise(edges)]
    length = np.concatenate([[0.0], np.cumsum(np.diff(edges) * spanned)])
    return np.interp((np.arange(n) + 0.5) / n * length[-1], length, edges).tolist()
