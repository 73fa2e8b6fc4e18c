"""Lawnmower survey: L tracks of two legs and two short segments (Negahdaripour & Madjidi 2003, section III-A).

The bow always points east, and every second leg is flown backwards. The top of the image therefore always points east:
consecutive keyframes are displaced along the image height, neighbouring swaths along the image width.
"""

from __future__ import annotations

import math
from itertools import pairwise

from controllers.segments import Point, Segment, line
from controllers.survey_plan import SurveyPlan, SurveyRequest, check_request, frames_per_keyframe, n_tracks_to_fly


def plan(request: SurveyRequest) -> SurveyPlan:
    """Plans a lawnmower survey of an area (Negahdaripour & Madjidi 2003, section III-A).

    The legs run along x, at most (1 - overlap_across) ImgSize Altitude / FocalLength apart (ImgSize is the image
    width). They are the centre lines of an even number of equal strips of the area; the first leg is the southernmost.

    Args:
        request: requirements of the survey.
    Raises:
        TwinError: a requirement is invalid or cannot be met.
    """
    check_request(request)
    length_m, width_m = request.area_m
    max_spacing_m = (1 - request.overlap_across) * request.footprint_m[0]
    # Tolerance: a strip that exceeds the limit only by rounding must not add a track.
    n_filling = math.ceil(width_m / max_spacing_m / 2 - 1e-9)
    n_tracks = n_tracks_to_fly(request, n_filling)
    spacing_m = width_m / (2 * n_filling)
    return SurveyPlan(
        paths=tuple(_track(request, spacing_m, track, last=track == n_tracks) for track in range(1, n_tracks + 1)),
        area_m=request.area_m,
        altitude_m=request.altitude_m,
        speed_mps=request.speed_mps,
        frame_rate_hz=request.frame_rate_hz,
        n_frames_per_keyframe=frames_per_keyframe(request, request.speed_mps),
        swath_length_m=length_m,
        swath_spacing_m=spacing_m,
        footprint_m=request.footprint_m,
        side_along_m=request.footprint_m[1],
        side_across_m=request.footprint_m[0],
        focal_px=float(request.focal_px),
        acceleration_mps2=request.acceleration_mps2,
    )


def _track(request: SurveyRequest, spacing_m: float, track: int, last: bool) -> tuple[Segment, ...]:
    """Returns the segments of a track (from 1): leg, cross segment, return leg, segment to the next track if any."""
    half_x, half_y = request.area_m[0] / 2, request.area_m[1] / 2
    south = (2 * track - 1.5) * spacing_m - half_y
    out = [(-half_x, south), (half_x, south)]
    back = [(half_x, south + spacing_m), (-half_x, south + spacing_m)]
    onward = [] if last else [(-half_x, south + 2 * spacing_m)]
    corners: list[Point] = [(x, y, request.altitude_m) for x, y in out + back + onward]
    return tuple(line(a, b, request.speed_mps, request.acceleration_mps2) for a, b in pairwise(corners))
