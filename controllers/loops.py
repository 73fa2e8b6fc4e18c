"""Loop survey: circles that all pass through the start point (Negahdaripour & Madjidi 2003, section III, Fig. 1).

The start is the centre of a disc of diameter D. Every loop is a circle of diameter D / 2 from the start to the rim and
back; consecutive loops are rotated about the start by a constant angle. Every loop closes at the start, whose position
is known, so drift does not accumulate from loop to loop. The bow always points from the start towards the centre of the
first loop (east if the heading is 0).
"""

import math

from twin.controllers.segments import Circle, circle, max_circle_speed_mps
from twin.controllers.survey_area import SurveyArea
from twin.controllers.survey_plan import SurveyPlan, SurveyRequest, check_request, frames_per_keyframe, n_tracks_to_fly
from twin.errors import TwinError


def plan(request: SurveyRequest) -> SurveyPlan:
    """Plans a loop survey of the disc inscribed in the area; raises TwinError if a requirement cannot be met.

    Each loop is a track. Neighbouring loops are at most (1 - overlap_across) times the shorter side of the footprint,
    times `across_scale`, apart. On small loops, acceleration limits the speed.
    """
    check_request(request)
    area = request.area or SurveyArea("disc", request.area_m)
    if request.turns != "reverse":
        raise TwinError("plan.turns", f"{request.turns!r} has no effect on loops", '"reverse"')
    if request.cross_lines:
        raise TwinError("plan.cross_lines", f"{request.cross_lines}: has no effect on loops", "0")
    loop_diameter_m = _disc_diameter_m(request.area_m) / 2
    shorter_m = min(request.footprint_m)
    max_spacing_m = (1 - request.overlap_across) * shorter_m * request.across_scale
    # The centres of n loops lie at a / 2 from the start: neighbours are a sin(pi / n) apart.
    # Tolerance: a spacing that exceeds the limit only by rounding must not add a loop.
    n_filling = math.ceil(math.pi / math.asin(min(1.0, max_spacing_m / loop_diameter_m)) - 1e-9)
    n_tracks = n_tracks_to_fly(request, n_filling)
    speed_mps = min(request.speed_mps, max_circle_speed_mps(loop_diameter_m / 2, request.acceleration_mps2))
    spacing_m = loop_diameter_m * math.sin(math.pi / n_filling)
    return SurveyPlan(
        request,
        paths=tuple((_loop(request, area, loop_diameter_m, 2 * math.pi * k / n_filling),) for k in range(n_tracks)),
        area=area, speed_mps=speed_mps, n_frames_per_keyframe=frames_per_keyframe(request, speed_mps),
        swath_length_m=math.pi * loop_diameter_m, swath_spacing_m=spacing_m, n_tracks_to_fill=n_filling,
        side_along_m=shorter_m, side_across_m=shorter_m, least_spacing_m=spacing_m,
    )  # fmt: skip


def _loop(request: SurveyRequest, area: SurveyArea, diameter_m: float, angle: float) -> Circle:
    """Returns the loop whose centre lies in the direction `angle` [rad, counter-clockwise from the area's heading]."""
    z = request.altitude_m
    start = area.to_scene(0.0, 0.0)
    centre = area.to_scene(diameter_m / 2 * math.cos(angle), diameter_m / 2 * math.sin(angle))
    return circle(
        (float(start[0]), float(start[1]), z), (float(centre[0]), float(centre[1]), z),
        request.speed_mps, request.acceleration_mps2, area.heading,
    )  # fmt: skip


def _disc_diameter_m(area_m: tuple[float, float]) -> float:
    length_m, width_m = area_m
    if not math.isclose(length_m, width_m):
        least = min(area_m)
        problem = f"{length_m:g} x {width_m:g} m: loops need a square area"
        raise TwinError("plan.area_m", problem, f"the disc's diameter for both, as in [{least:g}, {least:g}]")
    return length_m
