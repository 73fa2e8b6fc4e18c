"""Mission: the scenario of a survey with its floor, plan and map grid, checked before the flight."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, ParamSpec, TypeVar

import numpy as np
from numpy.typing import NDArray

from twin import terrains
from twin.controllers import segments
from twin.controllers.camera_surface import CameraSurface
from twin.controllers.survey_area import SurveyArea
from twin.controllers.survey_plan import FRAMES_BETWEEN_TRACKS, SurveyPlan
from twin.core import geometry
from twin.core.geometry import Array
from twin.core.records import MapGrid, StereoRig
from twin.errors import ScenarioError, TwinError
from twin.imaging.camera.true_cameras import TrueCameras, make_true_cameras
from twin.imaging.light.illumination import Illumination, illumination_of
from twin.imaging.light.lamps import light_sources_in_camera
from twin.imaging.light.water import Clarity, clarity
from twin.imaging.scene.object_view import Objects
from twin.judge.metrics import check_require
from twin.plugin.guard import check_loadable
from twin.plugin.loading import CONTROLLERS, ESTIMATORS
from twin.scenario.model import BeaconConfig, Scenario, Source, TaskConfig
from twin.simulate.hull import physics_timestep_s
from twin.simulate.sea import make_sea, mean_current_mps
from twin.simulate.sensors import imu_rate_hz
from twin.simulate.tether import tether_of
from twin.terrains.objects.placed_object import PlacedObject
from twin.world.computer import check_computer
from twin.world.height_floor import chart_of, load_terrain
from twin.world.mesh_floor import MeshFloor, load_mesh_floor
from twin.world.objects import load_objects
from twin.world.pace import SAME_TIME_S, Pace
from twin.world.path_checks import (
    check_below_surface,
    check_floor_below,
    check_lamp,
    check_objects,
    check_places_of_faults,
    check_speed,
    check_tasks,
    check_thrust,
    highest_near,
    unknown_share,
)
from twin.world.planning import check_map_size, plan_survey
from twin.world.scenario_checks import contradictions, floor_contradictions

P = ParamSpec("P")
T = TypeVar("T")


class Detail(NamedTuple):
    """Map of a task, apart from that of the area."""

    name: str
    track: int  #: number of the track from whose keyframes it is made, from 1
    grid: MapGrid
    area: SurveyArea  #: rectangle that the task asked for


class Step(NamedTuple):
    reference: segments.Reference  #: planned position, velocity, yaw and acceleration of the left camera
    keyframe: bool  #: whether the frame is a keyframe
    holding: bool  #: whether the vehicle keeps station


@dataclass(frozen=True)
class FrameSequence:
    """Sequence of n consecutive planned frames; item k is the `Step` of frame k."""

    reference: segments.Reference  #: planned position, velocity, yaw and acceleration of the left camera at each frame
    keyframe: NDArray[np.bool_]  #: (n,) whether each frame is a keyframe
    holding: bool  #: whether the vehicle keeps station
    path_times_s: Array  #: (n,) time of each frame on the planned path, since the start of the track
    track: int  #: number of the track, from 1
    rate: float = 1.0  #: derivative of the path time with respect to time; below 1 if the vehicle is slowed

    def __len__(self) -> int:
        return len(self.keyframe)

    def first(self, n: int) -> FrameSequence:
        # copies: views would keep all frames
        reference = segments.Reference(*(np.asarray(part)[:n].copy() for part in self.reference))
        keyframe, path_times_s = self.keyframe[:n].copy(), self.path_times_s[:n].copy()
        return replace(self, reference=reference, keyframe=keyframe, path_times_s=path_times_s)

    def __getitem__(self, k: int) -> Step:
        return Step(self.reference.row(k), bool(self.keyframe[k]), self.holding)


@dataclass(frozen=True)
class Mission:
    """A survey that has been checked and is ready to be flown."""

    scenario: Scenario
    terrain: terrains.Terrain  #: sea floor as a height grid; of a mesh floor, that of its highest surface
    chart: terrains.Terrain  #: sea floor as it is known before the survey, over which it is planned
    plan: SurveyPlan
    rig: StereoRig  #: calibration that the estimators use
    grid: MapGrid  #: cells of the map
    true_cameras: TrueCameras
    illumination: Illumination
    objects: tuple[PlacedObject, ...] = ()
    mesh_floor: MeshFloor | None = None  #: the sea floor if it is a mesh, else None

    @property
    def clarity(self) -> Clarity:
        return clarity(self.scenario.water)

    @property
    def rendered_terrain(self) -> terrains.Terrain:
        return self.terrain if self.mesh_floor is None else self.mesh_floor.under

    def rendered_objects(self) -> Objects | None:
        if not self.objects and self.mesh_floor is None:
            return None
        tiles = None if self.mesh_floor is None else self.mesh_floor.tiles
        return Objects(self.objects, np.array(self.scenario.current.velocity_mps), tiles)

    @property
    def start(self) -> Array:
        """Returns world_from_camera (4, 4) at the start of the survey: vehicle level, bow along the first leg.

        If it flies arcs, its bow points along its velocity through the mean current.
        """
        start = self.plan.reference(1, 0.0)
        yaw = np.asarray(start.yaw)
        if self.plan.flies_arcs:
            x, y, _ = start.velocity - mean_current_mps(make_sea(self.scenario), float(start.position[2]))
            yaw = np.arctan2(y, x)
        return geometry.pose(geometry.rotations_of_down_camera(yaw), start.position)

    @property
    def start_velocity_mps(self) -> Array:
        """Returns the velocity (3,) at the start of the survey: at rest, or at the planned speed if it flies arcs."""
        return self.plan.reference(1, 0.0).velocity + 0.0  # no negative zero

    @property
    def start_of_body(self) -> Array:
        return self.start @ geometry.inverse(self.rig.body_from_camera)

    def asked(self, x_m: Array, y_m: Array) -> NDArray[np.bool_]:
        """Returns whether each point (x, y) [m] lies in the asked area, over floor with a height."""
        return self.plan.inside_area(x_m, y_m) & ~self.terrain.in_hole(x_m, y_m)

    @property
    def details(self) -> tuple[Detail, ...]:
        """Returns the maps of the tasks, in the order in which they are flown."""
        tasks = {task.name: task for task in self.scenario.tasks}
        flown = sorted(self.plan.detours, key=lambda detour: detour.track)
        return tuple(self._detail(tasks[detour.name], detour.track) for detour in flown)

    def _detail(self, task: TaskConfig, track: int) -> Detail:
        area = SurveyArea("rectangle", task.size_m, task.position_m, self.plan.area.heading)
        ratio = min(1.0, task.altitude_m / self.plan.request.altitude_m)
        cell_m = max(round(self.scenario.map.cell_m * ratio, 4), 1e-4) if task.cell_m is None else task.cell_m
        (west, south), (east, north) = (f(area.outline(), axis=0) for f in (np.min, np.max))
        n = np.ceil(np.array([north - south, east - west]) / cell_m - 1e-9).astype(int).tolist()
        return Detail(task.name, track, MapGrid(float(west), float(north), cell_m, *n), area)

    @property
    def hole_notes(self) -> list[str]:
        """Returns sentences on floor without a height: how much of the floor, and of the asked area."""
        share = unknown_share(self.plan, self.terrain)
        area = [f"{100 * share:.3g} % of the asked area has no height and is not part of it."] if share > 0 else []
        return self.terrain.hole_notes + area

    @property
    def stated_input(self) -> dict[str, Any]:
        """Returns the input statement of the floor as JSON; {} for a generated floor."""
        return self.terrain.stated._asdict() if self.terrain.stated else {}

    @property
    def tracks(self) -> range:
        return range(1, self.plan.n_tracks + 1)

    def above(self, surface: CameraSurface | None) -> Mission:
        """Returns the mission with a path that follows another surface; None: the planned one."""
        if surface is None:
            return self
        return replace(self, plan=replace(self.plan, request=self.plan.request._replace(surface=surface)))

    def planned_frames(self, track: int) -> FrameSequence:
        times_s, keyframes = self.plan.frames_of_track(track)
        return FrameSequence(self.plan.references(track, times_s), keyframes, False, times_s, track)

    def station_keeping_frames(self, track: int, half: int = 0) -> FrameSequence:
        """Returns the frames of a half (0, 1) of the station keeping; a vehicle that flies arcs goes straight on."""
        n, times_s = self._n_holding, np.full(self._n_holding, self.plan.track_duration_s(track))
        if self.plan.flies_arcs:
            times_s -= (FRAMES_BETWEEN_TRACKS - half * n - np.arange(n)) / self.plan.request.frame_rate_hz
        holding = not self.plan.flies_arcs
        return FrameSequence(self.plan.references(track, times_s), np.zeros(n, np.bool_), holding, times_s, track)

    def next_frames(self, track: int, path_time_s: float, pace: Pace) -> FrameSequence:
        """Returns the frames of a track after a path time: the next one, or at full pace all that remain."""
        # every planned keyframe is flown, at the first frame at or after its path time
        planned_s, planned_keyframes = self.plan.frames_of_track(track)
        times_s = pace.path_times(path_time_s, float(planned_s[-1]), 1 / self.plan.request.frame_rate_hz)
        reference = pace.scaled(self.plan.references(track, times_s))
        passed = np.searchsorted(planned_s[planned_keyframes], np.append(path_time_s, times_s) + SAME_TIME_S, "right")
        keyframes = np.diff(passed) > 0
        keyframes[:1] |= pace.keyframe
        return FrameSequence(reference, keyframes, False, times_s, track, pace.rate)

    @property
    def _n_holding(self) -> int:
        if self.plan.flies_arcs:
            return FRAMES_BETWEEN_TRACKS // 2
        return max(1, round(self.scenario.control.hold_s / 2 * self.plan.request.frame_rate_hz))

    @property
    def n_frames(self) -> int:
        """Returns the number of frames at the planned speed, including station keeping."""
        return sum(len(self.plan.frames_of_track(t)[0]) + 2 * self._n_holding for t in self.tracks)


class _Errors:
    def __init__(self, source: Source):
        self.source, self.lines = source, list[str]()

    def attempt(self, build: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T | None:
        try:
            return build(*args, **kwargs)
        except TwinError as error:
            self.lines.append(self.source.describe(error))
        return None


def prepare(scenario: Scenario) -> Mission:
    """Returns the mission of a scenario, planned and checked; raises ScenarioError, with every reason, if invalid."""
    errors = _Errors(scenario.source)
    faults = list(floor_contradictions(scenario.terrain))
    terrain, mesh_floor = (None if faults else errors.attempt(_load_floor, scenario)) or (None, None)
    chart = None if terrain is None else errors.attempt(chart_of, scenario, terrain)
    plan = None if terrain is not None and chart is None else errors.attempt(plan_survey, scenario, chart)
    errors.lines += [scenario.source.describe(fault) for fault in (*faults, *contradictions(scenario))]
    true_cameras, illumination = _check_equipment(scenario, errors)
    objects, grid = (), None
    if terrain is not None:
        objects = load_objects(scenario, terrain, errors.attempt)
        for k, beacon in enumerate(scenario.beacons):
            errors.attempt(_check_beacon, k, beacon, terrain)
    errors.attempt(check_speed, scenario.vehicle, scenario.plan, (plan or scenario.plan).speed_mps)
    if terrain is not None and chart is not None and plan is not None:
        _check_path(scenario, chart, plan, objects if chart is terrain else (), errors)
        grid = errors.attempt(
            _grid, scenario.map.cell_m, plan, {id(floor): floor for floor in (chart, terrain)}.values()
        )
    if errors.lines:
        raise ScenarioError(errors.lines)
    assert terrain is not None and chart is not None and plan is not None and grid is not None
    assert true_cameras is not None and illumination is not None
    rig = scenario.believed_rig()
    mission = Mission(scenario, terrain, chart, plan, rig, grid, true_cameras, illumination, objects, mesh_floor)
    for detail in mission.details:
        errors.attempt(check_map_size, detail.grid)
    if errors.lines:
        raise ScenarioError(errors.lines)
    return mission


def _load_floor(scenario: Scenario) -> tuple[terrains.Terrain, MeshFloor | None]:
    if scenario.terrain.kind != "mesh":
        return load_terrain(scenario), None
    mesh_floor = load_mesh_floor(scenario)
    return mesh_floor.terrain, mesh_floor


def _check_equipment(scenario: Scenario, errors: _Errors) -> tuple[TrueCameras | None, Illumination | None]:
    """Returns the cameras and the light of a scenario, and adds their errors and those of plug-ins and limits."""
    errors.attempt(check_loadable, "control.plugin", CONTROLLERS, scenario.control.plugin)
    errors.attempt(check_loadable, "estimate.plugin", ESTIMATORS, scenario.estimate.plugin)
    if scenario.imu is not None:
        errors.attempt(imu_rate_hz, scenario.imu, motion_rate_hz(scenario))
    errors.attempt(check_require, scenario.require)
    cameras = errors.attempt(make_true_cameras, scenario)
    if (light := errors.attempt(illumination_of, scenario)) is not None:
        errors.attempt(light_sources_in_camera, scenario.believed_rig(), scenario.lamps, light.daylight, 0)
    return cameras, light


def motion_rate_hz(scenario: Scenario) -> float:
    """Returns the rate of the simulated steps of the vehicle: timesteps or, for a kinematic vehicle, frames."""
    frame_rate_hz, vehicle = scenario.rig.frame_rate_hz, scenario.vehicle
    if vehicle.dynamics != "rigid":
        return frame_rate_hz
    return round(1 / (frame_rate_hz * physics_timestep_s(frame_rate_hz, vehicle))) * frame_rate_hz


def _check_beacon(number: int, beacon: BeaconConfig, terrain: terrains.Terrain) -> None:
    x, y, z = beacon.position_m
    field, floor_m = f"beacons.{number}.position_m", float(terrain.height_at(x, y))
    if np.isnan(floor_m):
        raise TwinError(field, f"({x:g}, {y:g}) lies outside the terrain", terrain.extent)
    if z < floor_m:
        raise TwinError(field, f"z {z:g} is below the floor", f"above {floor_m:.3f} m")


def _check_path(
    scenario: Scenario, terrain: terrains.Terrain, plan: SurveyPlan, objects: tuple[PlacedObject, ...], errors: _Errors
) -> None:
    errors.attempt(check_floor_below, scenario.plan, terrain, plan)
    errors.attempt(check_below_surface, scenario, plan)
    errors.attempt(check_objects, objects, plan, scenario.plan.clearance_m)
    errors.attempt(check_tasks, scenario, plan, terrain)
    errors.attempt(check_computer, scenario, plan)
    errors.attempt(check_places_of_faults, scenario.faults, plan)
    if (sea := errors.attempt(make_sea, scenario)) is not None:
        start_m = plan.reference(1, 0.0).position
        errors.attempt(check_thrust, scenario.vehicle, sea, plan, tether_of(scenario.tether, start_m))
    camera_m, planned = scenario.believed_rig().body_from_camera[:3, 3], plan.all_references()
    for k, lamp in enumerate(scenario.lamps):
        errors.attempt(check_lamp, k, np.array(lamp.position_m), camera_m, terrain, planned)


def _grid(cell_m: float, plan: SurveyPlan, floors: Iterable[terrains.Terrain]) -> MapGrid:
    """Returns the grid of the map: a rectangle that contains the footprints along the path and a margin of 0.5 m."""
    widest = max(1.0, *(_greatest_altitude_m(plan, floor) / plan.request.altitude_m for floor in floors))
    corners, margin = plan.outline()[:, :2], np.array(_half_extent_m(plan)) * widest + 0.5
    west, south = np.floor((corners.min(axis=0) - margin) / cell_m) * cell_m
    east, north = np.ceil((corners.max(axis=0) + margin) / cell_m) * cell_m
    grid = MapGrid(float(west), float(north), cell_m, round((north - south) / cell_m), round((east - west) / cell_m))
    check_map_size(grid)
    return grid


def _greatest_altitude_m(plan: SurveyPlan, terrain: terrains.Terrain) -> float:
    """Returns the greatest height of the camera above the lowest floor or, on a surface, above that in its image."""
    if not plan.follows_floor:
        return plan.request.altitude_m - terrain.lowest_m
    x, y, z = plan.all_references().position.T
    reach_m = max(plan.request.footprint_m)
    lowest_m = -highest_near(replace(terrain, height_m=-terrain.height_m), x, y, reach_m)
    return float((z - lowest_m).max())


def _half_extent_m(plan: SurveyPlan) -> tuple[float, float]:
    """Returns half the greatest extent of a footprint on the reference plane along x and y [m]."""
    across_m, along_m = plan.request.footprint_m
    if plan.turns_on_the_spot or plan.flies_arcs:
        diagonal_m = float(np.hypot(along_m, across_m))
        return diagonal_m / 2, diagonal_m / 2
    c, s = abs(np.cos(plan.area.heading)), abs(np.sin(plan.area.heading))
    return float(c * along_m + s * across_m) / 2, float(s * along_m + c * across_m) / 2
