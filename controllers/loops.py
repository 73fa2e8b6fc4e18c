"""The looping survey: circles that cross at the start point (Negahdaripour & Madjidi 2003, section III, Fig. 1).

The start is the middle of a disc of diameter D. Every loop is a circle of diameter D / 2 through the start, out to the
rim and back, each turned against the one before by the same angle. So every loop closes where the position is known:
its drift is its own. The bow stays to the east.
"""

from __future__ import annotations

import math

from controllers.segments import Circle, circle, circling_mps
from controllers.survey_plan import (
    PlanFault,
    SurveyPlan,
    SurveyRequest,
    frames_per_keyframe,
    refuse_impossible,
    tracks_to_fly,
)


def plan(request: SurveyRequest) -> SurveyPlan:
    """The survey that keeps the overlaps over the disc in the area; each loop is a track.

    Neighbouring loops are nowhere farther apart than (1 - overlap_across) of the image's shorter side on the reference
    plane: loops run and part in every direction, also along the bow. Tight loops are flown below the cruise speed.

    Raises:
        PlanFault: the key at fault, what is wrong, what is allowed.
    """
    refuse_impossible(request)
    reach_m = _disc_diameter_m(request.area_m) / 2
    shorter_m = min(request.footprint_m)
    filling = loops_to_fill(reach_m, (1 - request.overlap_across) * shorter_m)
    n_tracks = tracks_to_fly(request, filling)
    speed_mps = min(request.speed_mps, circling_mps(reach_m / 2, request.acceleration_mps2))
    return SurveyPlan(
        paths=tuple((_loop(request, reach_m, 2 * math.pi * k / filling),) for k in range(n_tracks)),
        area_m=request.area_m,
        altitude_m=request.altitude_m,
        speed_mps=speed_mps,
        frame_rate_hz=request.frame_rate_hz,
        n_frames_per_keyframe=frames_per_keyframe(request, speed_mps),
        swath_length_m=math.pi * reach_m,
        swath_spacing_m=loop_spacing_m(reach_m, filling),
        footprint_m=request.footprint_m,
        side_along_m=shorter_m,
        side_across_m=shorter_m,
        focal_px=float(request.focal_px),
        acceleration_mps2=request.acceleration_mps2,
    )


def loop_spacing_m(reach_m: float, n_loops: int) -> float:
    """Greatest distance from a point of a loop to its neighbour: a sin(pi / n), a = diameter of the loops.

    It is the distance of the neighbours' centres, a/2 from the start and 2 pi / n apart: equal circles are farthest
    apart along the line through their centres.
    """
    return reach_m * math.sin(math.pi / n_loops)


def loops_to_fill(reach_m: float, widest_m: float) -> int:
    """Fewest evenly turned loops, at least two, whose spacing is at most `widest_m`."""
    # A spacing that exceeds the limit by rounding alone must not cost a loop.
    return math.ceil(math.pi / math.asin(min(1.0, widest_m / reach_m)) - 1e-9)


def _loop(request: SurveyRequest, reach_m: float, bearing: float) -> Circle:
    """The loop whose farthest point lies at an angle [rad] from the east."""
    x, y, z = reach_m / 2 * math.cos(bearing), reach_m / 2 * math.sin(bearing), request.altitude_m
    return circle((0.0, 0.0, z), (x, y, z), request.speed_mps, request.acceleration_mps2)


def _disc_diameter_m(area_m: tuple[float, float]) -> float:
    """D, where the area is the square around a disc."""
    length_m, width_m = area_m
    if not math.isclose(length_m, width_m):
        least = min(area_m)
        problem = f"{length_m:g} x {width_m:g} m: loops cover a disc"
        raise PlanFault("plan.area_m", problem, f"the disc's diameter for both, as in [{least:g}, {least:g}]")
    return length_m
