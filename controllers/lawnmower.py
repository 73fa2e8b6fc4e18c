"""The lawnmower survey: L tracks of two legs and two short segments (Negahdaripour & Madjidi 2003, section III-A).

The vehicle keeps its bow to the east and flies every second leg backwards, so the top of the image always points east:
keyframes follow each other along the image height, swaths lie side by side along the image width.
"""

from __future__ import annotations

import math
from itertools import pairwise

from controllers.segments import Point, Segment, line
from controllers.survey_plan import SurveyPlan, SurveyRequest, frames_per_keyframe, refuse_impossible, tracks_to_fly


def plan(request: SurveyRequest) -> SurveyPlan:
    """The survey that keeps the overlaps over an area (Negahdaripour & Madjidi 2003, section III-A).

    Legs run along x, at most (1 - overlap_across) ImgSize Altitude / FocalLength apart (ImgSize is the image width),
    and split the area into equal strips, an even number of them; the first is in the south.

    Raises:
        PlanFault: the key at fault, what is wrong, what is allowed.
    """
    refuse_impossible(request)
    length_m, width_m = request.area_m
    widest_m = (1 - request.overlap_across) * request.footprint_m[0]
    # A strip that exceeds the limit by rounding alone must not cost a track.
    filling = math.ceil(width_m / widest_m / 2 - 1e-9)
    n_tracks = tracks_to_fly(request, filling)
    spacing_m = width_m / (2 * filling)
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
    """A track (from 1): leg out, over, leg back, on to the next but from the last."""
    half_x, half_y = request.area_m[0] / 2, request.area_m[1] / 2
    south = (2 * track - 1.5) * spacing_m - half_y
    out = [(-half_x, south), (half_x, south)]
    back = [(half_x, south + spacing_m), (-half_x, south + spacing_m)]
    onward = [] if last else [(-half_x, south + 2 * spacing_m)]
    corners: list[Point] = [(x, y, request.altitude_m) for x, y in out + back + onward]
    return tuple(line(a, b, request.speed_mps, request.acceleration_mps2) for a, b in pairwise(corners))
