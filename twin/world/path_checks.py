"""Checks of the planned path: over the floor, clear of floor and objects, within the thrust of the vehicle."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, maximum_filter
from scipy.optimize import root_scalar

from twin.controllers.forecast import Clearance, least_clearance
from twin.controllers.segments import Reference
from twin.controllers.survey_plan import SurveyPlan
from twin.core.geometry import Array
from twin.errors import TwinError
from twin.scenario.model import FaultConfig, PlanConfig, Scenario, VehicleConfig
from twin.simulate.autopilot import thrust_loads, top_speed_mps
from twin.simulate.sea import Sea, strongest_currents_mps
from twin.simulate.steady_flight import minimum_speed_mps
from twin.simulate.tether import NO_TETHER, Tether, steady_pulls
from twin.terrains import Terrain
from twin.terrains.objects.placed_object import PlacedObject
from twin.terrains.objects.scattering import disc_of

VEHICLE_REACH_M = 0.4  #: horizontal distance from the cameras to the farthest point of the vehicle, rounded up
_AREA_SAMPLES = 500  # along each side of an area
#: Share of the greatest vertical speed at which a path over the floor may climb; the rest is for the controller.
_CLIMB_SHARE = 0.5
#: Greatest slope (rise over run) of a path over the floor, even if the thrusters can fly a steeper one.
_MAX_SLOPE = 0.6


def check_floor_below(asked: PlanConfig, terrain: Terrain, plan: SurveyPlan) -> None:
    """Raises TwinError if the area exceeds the terrain, or the path leaves the terrain or is too near the floor."""
    size, outline = terrain.size_m, plan.area.outline()
    extent = f"{size[0]:.2f} x {size[1]:.2f} m"
    heading_deg = round(float(np.degrees(plan.area.heading)), 2)
    # a tolerance: rotation rounds the corners of an area as large as the terrain
    if (np.ptp(outline, axis=0) > np.array(size) + 1e-9).any():
        shown = " x ".join(f"{a:g}" for a in asked.area_m)
        turned = f" at a heading of {heading_deg:g} deg" if heading_deg else ""
        raise TwinError("plan.area_m", f"{shown} m{turned} is larger than the terrain", f"up to {extent}")
    clearance = _clearance(plan, asked, terrain)
    field = "plan.area_m" if asked.polygon is None else "plan.polygon"
    if not clearance.inside:
        raise TwinError(field, "the path leaves the terrain", f"a path inside {extent}")
    _check_over_heights(field, terrain, plan)
    if clearance.least_m < asked.clearance_m:
        needed = asked.altitude_m - clearance.least_m + asked.clearance_m
        near = f"come within {clearance.least_m:.2f} m of" if clearance.least_m >= 0 else "lie below"
        remedy = ', or plan.height = "floor"' if not plan.follows_floor else ""
        raise TwinError(
            "plan.altitude_m",
            f"{asked.altitude_m:g}: the cameras {near} the floor at x {clearance.x_m:.1f}, y {clearance.y_m:.1f}",
            f"at least {needed:.2f} for {asked.clearance_m:g} m of clearance{remedy}",
        )


def check_tasks(scenario: Scenario, plan: SurveyPlan, terrain: Terrain) -> None:
    """Raises TwinError if the path of a task leaves the terrain or is too near the floor, or its speed is too high."""
    tracks = {detour.name: detour.track for detour in plan.detours}
    for k, task in enumerate(scenario.tasks):
        reach = np.inf
        if scenario.vehicle.dynamics == "rigid":
            reach = top_speed_mps(scenario.vehicle, np.array([1.0, 0.0, 0.0]))
        if task.speed_mps > reach:
            raise TwinError(
                f"tasks.{k}.speed_mps", f"{task.speed_mps:g}: too fast for the thrusters", f"up to {reach:.2f}"
            )
        times_s, _ = plan.frames_of_track(tracks[task.name])
        x, y, z = plan.references(tracks[task.name], times_s).position.T
        if not np.isfinite(terrain.height_at(x, y)).all():
            raise TwinError(f"tasks.{k}.position_m", "the path leaves the terrain", f"inside {terrain.extent}")
        least_m = float((z - highest_near(terrain, x, y, VEHICLE_REACH_M)).min())
        if (short_m := scenario.plan.clearance_m - least_m) > 0:
            problem = f"{task.altitude_m:g}: the cameras come within {least_m:.2f} m of the floor"
            raise TwinError(f"tasks.{k}.altitude_m", problem, f"at least {task.altitude_m + short_m:.2f}")


def check_places_of_faults(faults: Sequence[FaultConfig], plan: SurveyPlan) -> None:
    """Raises TwinError if the left camera does not come to the place of a fault on its planned path."""
    for k, fault in enumerate(faults):
        if fault.at_m is not None:
            least_m = float(np.linalg.norm(plan.all_references().position[:, :2] - fault.at_m, axis=1).min())
            if least_m > fault.radius_m:
                problem = f"{fault.at_m}: the left camera comes no nearer than {least_m:.2f} m"
                raise TwinError(f"faults.{k}.at_m", problem, f"within radius_m = {fault.radius_m:g} m of the path")


def _clearance(plan: SurveyPlan, asked: PlanConfig, terrain: Terrain) -> Clearance:
    """Returns the least clearance of the planned path, and the position of the camera there."""
    # A level path must be clear of the floor in its images and between its swaths; one that follows the floor, of that
    # within VEHICLE_REACH_M and `plan.clearance_m`: beside a wall, images may show higher floor than the cameras.
    if not plan.follows_floor:
        return least_clearance(plan, terrain.height_at)
    x, y, z = plan.all_references().position.T
    inside = bool(np.isfinite(terrain.height_at(x, y)).all())
    gap = z - highest_near(terrain, x, y, VEHICLE_REACH_M + asked.clearance_m)
    k = int(gap.argmin())
    return Clearance(float(gap[k]), float(x[k]), float(y[k]), inside)


def room_below_m(plan: SurveyPlan, asked: PlanConfig, chart: Terrain, top: Terrain, beside_m: float) -> float:
    """Returns by how much a path that is shifted by up to `beside_m` may be lowered, for `plan.clearance_m` [m].

    `chart` is the known floor, `top` this floor with its objects.
    """
    x, y, z = plan.all_references().position.T
    reach_m = VEHICLE_REACH_M + beside_m + (asked.clearance_m if plan.follows_floor else 0.0)
    least_m = min(_clearance(plan, asked, chart).least_m, (z - highest_near(top, x, y, reach_m)).min())
    return float(least_m) - asked.clearance_m


def highest_near(terrain: Terrain, x_m: Array, y_m: Array, reach_m: float) -> Array:
    """Returns the height (n,) of the highest floor within a horizontal distance of each of n points."""
    # by the nodes in three rectangles that together nearly fill the circle, and points on it
    rows, cols = _nodes(terrain, x_m, y_m)
    rows, cols = (np.clip(k, 0, n - 1) for k, n in zip((rows, cols), terrain.height_m.shape, strict=True))
    highest = terrain.height_near(x_m, y_m)
    for angle in np.pi / 8 * np.arange(1, 4):
        sides = [2 * int(reach_m * side / terrain.spacing_m) + 1 for side in (np.sin(angle), np.cos(angle))]
        highest = np.maximum(highest, maximum_filter(terrain.height_m, sides, mode="nearest")[rows, cols])
    for angle in np.pi / 4 * np.arange(8):
        east_m, north_m = reach_m * np.cos(angle), reach_m * np.sin(angle)
        highest = np.maximum(highest, terrain.height_near(x_m + east_m, y_m + north_m))
    return highest


def _nodes(terrain: Terrain, x: Array, y: Array) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Returns row and column, each (n,), of the nodes of a terrain that are nearest to points."""
    cols, rows = (x - terrain.west_m) / terrain.spacing_m, (y - terrain.south_m) / terrain.spacing_m
    return np.rint(rows).astype(np.intp), np.rint(cols).astype(np.intp)


def unknown_share(plan: SurveyPlan, terrain: Terrain) -> float:
    """Returns the share of the asked area that lies over floor without a height, from samples of it."""
    if terrain.known is None:
        return 0.0
    steps = (np.arange(_AREA_SAMPLES) + 0.5) / _AREA_SAMPLES - 0.5
    x, y = np.moveaxis(plan.area.at_fractions(np.stack(np.meshgrid(steps, steps), axis=-1)), -1, 0)
    asked = plan.inside_area(x, y)
    return float(terrain.in_hole(x, y)[asked].mean()) if asked.any() else 0.0


class HolePart(NamedTuple):
    """Part of a path over a hole of the floor that is farthest from a height."""

    away_m: float
    x_m: float
    y_m: float
    limit_m: float  # greatest distance at which an image still shows floor with heights

    @property
    def too_far(self) -> bool:
        return self.away_m > self.limit_m


def hole_part(plan: SurveyPlan, terrain: Terrain) -> HolePart:
    """Returns the part of a path, inside the extent of the terrain, that is farthest from floor with a height."""
    x, y, _ = plan.all_references().position.T
    known = np.ones_like(terrain.height_m, np.bool_) if terrain.known is None else terrain.known
    away_m = np.asarray(distance_transform_edt(~known))[_nodes(terrain, x, y)] * terrain.spacing_m
    k = int(away_m.argmax())
    return HolePart(float(away_m[k]), float(x[k]), float(y[k]), min(plan.request.footprint_m) / 2)


def _check_over_heights(field: str, terrain: Terrain, plan: SurveyPlan) -> None:
    """Raises TwinError if the path is farther from the next height than an image shows, or the area has no floor."""
    if terrain.known is None:
        return
    allowed = "another plan.centre_m, plan.area_m or plan.polygon"
    if (part := hole_part(plan, terrain)).too_far:
        raise TwinError(
            field, f"the path leads over floor without a height, up to {part.away_m:.2f} m from the next height"
            f" (at x {part.x_m:.1f}, y {part.y_m:.1f})",
            f"a path within {part.limit_m:.2f} m of heights: {allowed}",
        )  # fmt: skip
    if unknown_share(plan, terrain) == 1:
        share = f"{100 * terrain.unknown_share:.3g} % of the floor has none"
        raise TwinError(field, f"no cell of the floor in the area has a height ({share})", allowed)


def check_objects(objects: Sequence[PlacedObject], plan: SurveyPlan, clearance_m: float) -> None:
    """Raises TwinError if the vehicle comes too close to an object on its planned path."""
    # the highest corner of its bounding box, less than `clearance_m` below the cameras within VEHICLE_REACH_M of its
    # circle
    path = plan.all_references().position if objects else np.empty((0, 3))
    for item in objects:
        disc, top_m = disc_of(item), item.corners_m()[:, 2].max()
        away = np.hypot(path[:, 0] - disc.x_m, path[:, 1] - disc.y_m) - disc.radius_m - VEHICLE_REACH_M
        gap = np.where(away < 0, path[:, 2] - top_m, np.inf)
        k = int(gap.argmin())
        if gap[k] < clearance_m:
            raise TwinError(
                f"objects.{item.group}",
                f"the object at x {disc.x_m:.2f}, y {disc.y_m:.2f} is in the path of the vehicle: its top is at"
                f" z {top_m:.2f} m, the cameras are at {path[k, 2]:.2f} m",
                f"objects at least {clearance_m:g} m below the cameras (plan.clearance_m)",
            )


def check_below_surface(scenario: Scenario, plan: SurveyPlan) -> None:
    """Raises TwinError if the cameras reach the surface of a sea with daylight from above it or with waves."""
    highest_m, sun, waves = float(plan.all_references().position[:, 2].max()), scenario.sun, scenario.waves
    lit_m = sun.depth_m * (scenario.plan.altitude_m < sun.depth_m)  # otherwise the light is refused
    depths = {"sun.depth_m": lit_m, "waves.depth_m": 0.0 if waves.is_calm else waves.depth_m}
    for key, depth_m in depths.items():
        if depth_m and highest_m >= depth_m:
            raise TwinError(key, f"{depth_m:g}: the cameras are above the surface", f"more than {highest_m:.2f}")


def check_lamp(number: int, position_m: Array, camera_m: Array, terrain: Terrain, planned: Reference) -> None:
    """Raises TwinError if a lamp, at a position (3,) in the body, is below the floor at a planned frame."""
    forward, left, up = position_m - camera_m
    c, s = np.cos(planned.yaw), np.sin(planned.yaw)
    x, y, z = planned.position.T + np.array([c * forward - s * left, s * forward + c * left, np.full(len(c), up)])
    above = np.nan_to_num(z - terrain.height_at(x, y), nan=np.inf)
    if (least := above.min()) < 0:
        raise TwinError(
            f"lamps.{number}.position_m", f"is {-least:.2f} m below the floor at x {x[above.argmin()]:.1f},"
            f" y {y[above.argmin()]:.1f}", f"{position_m[2] - least:.2f} or more for z (up)",
        )  # fmt: skip


def check_speed(vehicle: VehicleConfig, asked: PlanConfig, speed_mps: float) -> None:
    """Raises TwinError if a cruise speed exceeds the top speed, for loops and cross lines in the slowest direction."""
    if vehicle.dynamics == "kinematic":
        return
    around = asked.pattern == "loops" or asked.cross_lines > 0
    bearings = np.linspace(0, 2 * np.pi, 24, endpoint=False) if around else np.zeros(1)
    directions = np.stack([np.cos(bearings), np.sin(bearings), np.zeros_like(bearings)], axis=1)
    reach = min(top_speed_mps(vehicle, direction) for direction in directions)
    if speed_mps > reach:
        raise TwinError("plan.speed_mps", f"{asked.speed_mps:g}: too fast for the thrusters", f"up to {reach:.2f}")


def check_thrust(vehicle: VehicleConfig, sea: Sea, plan: SurveyPlan, tether: Tether = NO_TETHER) -> None:
    """Raises TwinError if a thruster saturates: to hold station in the current, or at the planned velocities in it.

    The current is its mean with the strongest tide, at the heights of the path; gusts and waves are shorter. Also
    raises TwinError if a file of the current does not cover times and heights of the path. A kinematic vehicle is not
    checked; of a vehicle with fins, only the speed is.
    """
    if vehicle.dynamics == "kinematic":
        return
    planned = plan.all_references()
    lowest_m, highest_m = float(planned.position[:, 2].min()), float(planned.position[:, 2].max())
    _check_coverage(sea, lowest_m, highest_m, len(planned.position) / plan.request.frame_rate_hz)
    position = np.round(planned.position) if tether.length_m else np.zeros((len(planned.position), 3))
    rounded = np.round(np.column_stack([np.asarray(planned.yaw), planned.velocity, position]), 3)
    distinct = np.unique(rounded, axis=0)
    yaw, velocity, position = distinct[:, 0], distinct[:, 1:4], distinct[:, 4:]
    for current in strongest_currents_mps(sea, lowest_m, highest_m):
        if vehicle.is_steered_by_fins:
            if current.any():
                _check_speed_through(vehicle, current, velocity)
        else:

            def load(current: Array, velocity: Array) -> float:
                pulls = steady_pulls(tether, current, position, yaw, velocity)
                return float(thrust_loads(vehicle, body_velocities(yaw, velocity - current), pulls).max())

            _check_thrust_in(load, current, plan.speed_mps, velocity, " with its tether" if tether.length_m else "")


def _check_speed_through(vehicle: VehicleConfig, current: Array, velocity: Array) -> None:
    """Raises TwinError if the planned velocities (n, 3) need a speed through the water that fins cannot use."""
    through = np.linalg.norm(velocity - current, axis=1)
    least, most = minimum_speed_mps(vehicle), top_speed_mps(vehicle, np.array([1.0, 0.0, 0.0]))
    if through.min() < least or through.max() > most:
        raise TwinError(
            "current.velocity_mps", f"{np.linalg.norm(current):.2f} m/s: at the planned speed over the ground, the"
            f" speed through the water is {through.min():.2f} to {through.max():.2f} m/s", f"{least:.2f} to {most:.2f}",
        )  # fmt: skip


def _check_coverage(sea: Sea, lowest_m: float, highest_m: float, duration_s: float) -> None:
    for what, table, low, high, unit in (
        ("the path", sea.heights_m, lowest_m, highest_m, "m above z = 0"),
        ("the survey", sea.times_s, 0.0, duration_s, "s"),
    ):
        if len(table) > 1 and not (table[0] <= low and high <= table[-1]):
            problem = f"covers {table[0]:g} to {table[-1]:g} {unit}; {what} extends from {low:.1f} to {high:.1f}"
            raise TwinError("current.file", problem, "a file that covers it")


def _check_thrust_in(
    load: Callable[[Array, Array], float], current: Array, cruise_mps: float, velocity: Array, tether: str
) -> None:
    """Raises TwinError if the thrust load(current, velocities) is above 1 to hold station or at velocities (n, 3)."""
    speed_mps = float(np.linalg.norm(current))
    if load(0 * current, 0 * velocity) >= 1:
        raise TwinError("vehicle.buoyancy_n", f"the thrusters cannot hold the depth{tether}", "less, or more thrust")
    if (factor := _saturating_factor(lambda k: load(k * current, 0 * velocity))) is not None:
        raise TwinError(
            "current.velocity_mps", f"{speed_mps:.2f} m/s: the thrusters cannot hold station against it{tether}",
            f"up to {np.floor(100 * factor * speed_mps) / 100:.2f} m/s in this direction",
        )  # fmt: skip
    if (factor := _saturating_factor(lambda k: load(current, k * velocity))) is not None:
        against = f" in a current of {speed_mps:.2f} m/s{tether}" if current.any() else tether or " where it rises"
        raise TwinError(
            "plan.speed_mps", f"{cruise_mps:g}: too fast for the thrusters{against}",
            f"up to {np.floor(1000 * factor * cruise_mps) / 1000:.3f}",
        )  # fmt: skip


def climb_slope(vehicle: VehicleConfig, speed_mps: float) -> float:
    """Returns the greatest slope of a path: a share of that which saturates a thruster, at most _MAX_SLOPE."""
    ahead = np.array([speed_mps, 0.0, 0.0])

    def excess(climb: float) -> float:
        velocities = np.array([ahead, ahead]) + [[0, 0, climb], [0, 0, -climb]]
        return float(thrust_loads(vehicle, velocities).max()) - 1

    if excess(0.0) >= 0:
        return _MAX_SLOPE  # `prepare` reports that the speed is too high
    high = _MAX_SLOPE / _CLIMB_SHARE * speed_mps
    climb = high if excess(high) <= 0 else _root(excess, high)
    return _CLIMB_SHARE * climb / speed_mps


def _saturating_factor(load: Callable[[float], float]) -> float | None:
    """Returns the factor below 1 at which load(factor) is 1, a thruster saturates; None if there is none."""
    return None if load(1.0) <= 1 else _root(lambda factor: load(factor) - 1, 1.0)


def _root(function: Callable[[float], float], high: float) -> float:
    return float(root_scalar(function, bracket=(0.0, high), method="brentq", xtol=1e-4).root)


def body_velocities(yaw: Array, velocity: Array) -> Array:
    """Returns velocities (n, 3) converted from world axes to the body axes of a level vehicle at yaws (n,) [rad]."""
    c, s = np.cos(yaw), np.sin(yaw)
    x, y, z = velocity.T
    return np.column_stack([c * x + s * y, c * y - s * x, z])
