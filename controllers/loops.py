"""Loop survey: circles that all pass through the start point (Negahdaripour & Madjidi 2003, section III, Fig. 1).

The start is the centre of a disc of diameter D. Every loop is a circle of diameter D / 2 from the start to the rim and
back; consecutive loops are rotated about the start by a constant angle. Every loop closes at the start, whose position
is known, so drift does not accumulate from loop to loop. The bow always points from the start towards the centre of the
first loop (east if the heading is 0).
"""

from __future__ import annotations

import math

from twin.controllers.segments import Circle, circle, max_circle_speed_mps
from twin.controllers.survey_area import SurveyArea
from twin.controllers.survey_plan import SurveyPlan, SurveyRequest, check_request, n_tracks_to_fly, survey_plan
from twin.errors import TwinError


def plan(request: SurveyRequest) -> SurveyPlan:
    """Plans a loop survey of the disc inscribed in the area; each loop is a track.

    The distance between neighbouring loops is at most (1 - overlap_across) times the shorter side of the footprint,
    times `across_scale`, because loops run in every direction. On small loops, acceleration limits the speed.

    Raises:
        TwinError: a requirement is invalid or cannot be met.
    """
    check_request(request)
    area = request.area or SurveyArea("disc", request.area_m)
    if request.turns != "reverse":
        raise TwinError("plan.turns", f"{request.turns!r} has no effect on loops", '"reverse"')
    loop_diameter_m = _disc_diameter_m(request.area_m) / 2
    shorter_m = min(request.footprint_m)
    n_filling = n_loops_to_fill(loop_diameter_m, (1 - request.overlap_across) * shorter_m * request.across_scale)
    n_tracks = n_tracks_to_fly(request, n_filling)
    speed_mps = min(request.speed_mps, max_circle_speed_mps(loop_diameter_m / 2, request.acceleration_mps2))
    return survey_plan(
        request,
        paths=tuple((_loop(request, area, loop_diameter_m, 2 * math.pi * k / n_filling),) for k in range(n_tracks)),
        area=area,
        speed_mps=speed_mps,
        swath_length_m=math.pi * loop_diameter_m,
        swath_spacing_m=loop_spacing_m(loop_diameter_m, n_filling),
        n_tracks_to_fill=n_filling,
        side_along_m=shorter_m,
        side_across_m=shorter_m,
    )


def loop_spacing_m(loop_diameter_m: float, n_loops: int) -> float:
    """Returns the greatest distance between neighbouring loops [m]: a sin(pi / n) for n loops of diameter a.

    This is the distance between their centres, at a / 2 from the start in directions that differ by 2 pi / n.
    """
    return loop_diameter_m * math.sin(math.pi / n_loops)


def n_loops_to_fill(loop_diameter_m: float, max_spacing_m: float) -> int:
    """Returns the least number of loops, at least two, whose spacing is at most `max_spacing_m`."""
    # Tolerance: a spacing that exceeds the limit only by rounding must not add a loop.
    return math.ceil(math.pi / math.asin(min(1.0, max_spacing_m / loop_diameter_m)) - 1e-9)


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
    """Returns the diameter D of the disc inscribed in the area [m]. Raises TwinError if the area is not a square."""
    length_m, width_m = area_m
    if not math.isclose(length_m, width_m):
        least = min(area_m)
        problem = f"{length_m:g} x {width_m:g} m: loops need a square area"
        raise TwinError("plan.area_m", problem, f"the disc's diameter for both, as in [{least:g}, {least:g}]")
    return length_m
