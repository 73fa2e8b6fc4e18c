"""Lawnmower survey: L tracks of two legs, joined by short segments (Negahdaripour & Madjidi 2003, section III-A).

By default every second leg is flown backwards, so the images of all legs have the same orientation. With `turns` =
"bow_first" the vehicle turns by 180 degrees at the end of each leg except the last, alternately counter-clockwise and
clockwise so that a tether is not twisted. Consecutive keyframes are displaced along the image height, neighbouring
swaths along the image width.
"""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np

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


def plan(request: SurveyRequest) -> SurveyPlan:
    """Plans a lawnmower survey of an area; raises TwinError if a requirement is invalid or cannot be met.

    The legs run along the heading of the area. Their distance is at most (1 - overlap_across) ImgSize Altitude /
    FocalLength (ImgSize is the image width), times `across_scale`. The area is divided into an even number of strips of
    equal width, with a leg along the centre line of each, spanning the extent of the area within its strip; the first
    leg is the rightmost as seen along the heading. Where two legs are joined, the one that ends first is extended.
    """
    check_request(request)
    area = request.area or SurveyArea("rectangle", request.area_m)
    width_m = area.size_m[1]
    max_spacing_m = (1 - request.overlap_across) * request.footprint_m[0] * request.across_scale
    # Tolerance: a strip that exceeds the limit only by rounding must not add a track.
    n_filling = math.ceil(width_m / max_spacing_m / 2 - 1e-9)
    n_tracks = n_tracks_to_fly(request, n_filling)
    spacing_m = width_m / (2 * n_filling)
    edges = [k * spacing_m - width_m / 2 for k in range(2 * n_filling + 1)]
    legs = [area.extent_between(south_m, north_m) for south_m, north_m in pairwise(edges)]
    corners = [_corners(area, legs, spacing_m, track, last=track == n_tracks) for track in range(1, n_tracks + 1)]
    return SurveyPlan(
        request,
        paths=tuple(_track(request, area, track) for track in corners),
        area=area,
        speed_mps=request.speed_mps,
        n_frames_per_keyframe=frames_per_keyframe(request, request.speed_mps),
        swath_length_m=float(np.mean([end - start for start, end in legs])),
        swath_spacing_m=spacing_m,
        n_tracks_to_fill=n_filling,
        side_along_m=request.footprint_m[1],
        side_across_m=request.footprint_m[0],
    )


def _corners(
    area: SurveyArea, legs: list[tuple[float, float]], spacing_m: float, track: int, last: bool
) -> list[tuple[float, float]]:
    """Returns the corners (u, v) [m] of a track: the ends of its two legs and, unless `last`, the start of the next."""
    first = 2 * (track - 1)  # index of the track's first leg
    south = (2 * track - 1.5) * spacing_m - area.size_m[1] / 2
    start = min(u for u, _ in legs[max(first - 1, 0) : first + 1])
    turn = max(u for _, u in legs[first : first + 2])
    end = legs[first + 1][0] if last else min(u for u, _ in legs[first + 1 : first + 3])
    out, back = [(start, south), (turn, south)], [(turn, south + spacing_m), (end, south + spacing_m)]
    return [*out, *back, *([] if last else [(end, south + 2 * spacing_m)])]


def _track(request: SurveyRequest, area: SurveyArea, corners: list[tuple[float, float]]) -> tuple[Segment, ...]:
    """Returns the segments of a track between its corners (u, v) [m], with its turns on the spot."""
    scene = [area.to_scene(u, v) for u, v in corners]
    points: list[Point] = [(float(x), float(y), request.altitude_m) for x, y in scene]
    turning = request.turns == "bow_first"
    segments: list[Segment] = []
    for k, (a, b) in enumerate(pairwise(points)):
        reversed_bow = turning and k in (1, 2)
        yaw = area.heading + (math.pi if reversed_bow else 0.0)
        segments.append(line(a, b, request.speed_mps, request.acceleration_mps2, yaw))
        if turning and (k == 0 or (k == 2 and len(points) > 4)):  # at the end of a leg, except the last one
            profile = SpeedProfile(math.pi, TURN_RATE, TURN_ACCELERATION)
            segments.append(Turn(b, yaw, -1.0 if reversed_bow else 1.0, profile))
    return tuple(segments)
