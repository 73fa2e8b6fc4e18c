"""Mission: the scenario of a survey with its floor, plan and map grid, checked before the flight."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from twin import terrains
from twin.controllers import segments
from twin.controllers.survey_plan import SurveyPlan
from twin.controllers.tracking import rotate_lever_arm
from twin.core import geometry
from twin.core.geometry import Array
from twin.core.records import MapGrid, StereoRig
from twin.errors import ScenarioError, TwinError
from twin.imaging.camera.lens_psf import NEAREST_FOCUS_M
from twin.imaging.camera.true_cameras import TrueCameras, make_true_cameras
from twin.imaging.light.illumination import Illumination, illumination_of
from twin.imaging.light.lamps import light_sources_in_camera
from twin.imaging.scene.object_view import Objects
from twin.judge.metrics import check_require
from twin.plugin.guard import check_loadable, terrain_heights
from twin.plugin.loading import CONTROLLERS, ESTIMATORS
from twin.scenario.model import (
    BeaconConfig,
    CurrentConfig,
    LensConfig,
    NavigationConfig,
    PlanConfig,
    Scenario,
    SensorConfig,
    SnowConfig,
    Source,
    TerrainConfig,
    VehicleConfig,
)
from twin.simulate.autopilot import top_speed_mps
from twin.simulate.hull import physics_timestep_s
from twin.simulate.inertial_sensor import imu_rate_hz
from twin.terrains.ground_cover import DEFAULT_COVERS
from twin.terrains.objects.model import PlacedObject
from twin.world.clearance import path_points, planned_clearance
from twin.world.mesh_floor import MeshFloor, load_mesh_floor
from twin.world.objects import check_path, load_objects
from twin.world.pace import SAME_TIME_S, Pace
from twin.world.planning import check_map_size, plan_survey
from twin.world.thrust_authority import check_thrust

#: Distance between the points of the path at which the height of a lamp above the floor is checked, and the largest
#: number of these points; on longer paths they are farther apart.
LAMP_STEP_M, LAMP_POINTS = 0.02, 1_000_000


class Step(NamedTuple):
    """One planned frame.

    Args:
        reference: planned position, velocity, yaw and acceleration of the left camera.
        keyframe: whether the frame is a keyframe.
        holding: whether the vehicle keeps station.
    """

    reference: segments.Reference
    keyframe: bool
    holding: bool


@dataclass(frozen=True)
class FrameSequence:
    """Sequence of n consecutive planned frames; item k is the `Step` of frame k.

    Args:
        reference: planned position, velocity, yaw and acceleration of the left camera at each frame.
        keyframe: (n,) bool, whether each frame is a keyframe.
        holding: whether the vehicle keeps station.
        path_times_s: (n,) time of each frame on the planned path, since the start of the track [s].
        rate: derivative of the path time with respect to time; below 1 if the vehicle is slowed.
    """

    reference: segments.Reference
    keyframe: NDArray[np.bool_]
    holding: bool
    path_times_s: Array
    rate: float = 1.0

    def __len__(self) -> int:
        return len(self.keyframe)

    def first(self, n: int) -> FrameSequence:
        """Returns the first n frames."""
        reference = segments.Reference(*(np.asarray(part)[:n] for part in self.reference))
        return replace(self, reference=reference, keyframe=self.keyframe[:n], path_times_s=self.path_times_s[:n])

    def __getitem__(self, k: int) -> Step:
        return Step(self.reference.row(k), bool(self.keyframe[k]), self.holding)


@dataclass(frozen=True)
class Mission:
    """A survey that has been checked and is ready to be flown.

    Args:
        scenario: description of the survey.
        terrain: sea floor as a height grid; of a mesh floor, that of its highest surface.
        plan: planned path.
        rig: calibration that the estimators use.
        grid: cells of the map.
        true_cameras: true parameters of the cameras.
        illumination: optical properties of the water, and daylight.
        objects: objects on the sea floor.
        mesh_floor: the sea floor if it is a mesh, else None.
    """

    scenario: Scenario
    terrain: terrains.Terrain
    plan: SurveyPlan
    rig: StereoRig
    grid: MapGrid
    true_cameras: TrueCameras
    illumination: Illumination
    objects: tuple[PlacedObject, ...] = ()
    mesh_floor: MeshFloor | None = None

    @property
    def rendered_terrain(self) -> terrains.Terrain:
        """Returns the height grid that is rendered: the sea floor, or the height grid below a mesh floor."""
        return self.terrain if self.mesh_floor is None else self.mesh_floor.under

    def rendered_objects(self) -> Objects | None:
        """Returns the objects and the tiles of a mesh floor that are rendered; None if there are none."""
        if not self.objects and self.mesh_floor is None:
            return None
        tiles = None if self.mesh_floor is None else self.mesh_floor.tiles
        return Objects(self.objects, np.array(self.scenario.current.velocity_mps), tiles)

    @property
    def start(self) -> Array:
        """Returns world_from_camera (4, 4) at the start of the survey: vehicle level, bow along the first leg."""
        start = self.plan.reference(1, 0.0)
        return geometry.pose(geometry.rotations_of_down_camera(np.asarray(start.yaw)), start.position)

    @property
    def start_of_body(self) -> Array:
        """Returns world_from_body (4, 4) at the start of the survey."""
        return self.start @ geometry.inverse(self.rig.body_from_camera)

    def asked(self, x_m: Array, y_m: Array) -> NDArray[np.bool_]:
        """Returns whether each point (x, y) [m] lies in the asked area, over floor with a height."""
        return self.plan.inside_area(x_m, y_m) & ~self.terrain.in_hole(x_m, y_m)

    def planned_frames(self, track: int) -> FrameSequence:
        """Returns the planned frames of a track (numbered from 1), without the station keeping after it."""
        times_s, keyframes = self.plan.frames_of_track(track)
        return FrameSequence(self.plan.references(track, times_s), keyframes, holding=False, path_times_s=times_s)

    def station_keeping_frames(self, track: int) -> FrameSequence:
        """Returns the planned frames of one half of the station keeping after a track (numbered from 1).

        Both halves have the same frames; the global alignment runs between them.
        """
        n = self._n_holding
        times_s = np.full(n, self.plan.track_duration_s(track))
        return FrameSequence(
            self.plan.references(track, times_s), np.zeros(n, np.bool_), holding=True, path_times_s=times_s
        )

    def next_frames(self, track: int, path_time_s: float, pace: Pace) -> FrameSequence:
        """Returns the next frames of a track at a pace: one frame, or all that remain at full pace.

        Every planned keyframe is flown, at the first frame at or after its path time.

        Args:
            track: number of the track, from 1.
            path_time_s: path time of the last frame flown [s].
            pace: pace of the vehicle along the path.

        Returns:
            The frames; none if the last frame of the track has been flown.
        """
        planned_s, planned_keyframes = self.plan.frames_of_track(track)
        times_s = pace.path_times(path_time_s, float(planned_s[-1]), 1 / self.plan.frame_rate_hz)
        reference = pace.scaled(self.plan.references(track, times_s))
        passed = np.searchsorted(planned_s[planned_keyframes], np.append(path_time_s, times_s) + SAME_TIME_S, "right")
        return FrameSequence(reference, (np.diff(passed) > 0) | pace.keyframe, False, times_s, pace.rate)

    @property
    def _n_holding(self) -> int:
        """Returns the number of frames of half the station keeping after a track."""
        return max(1, round(self.scenario.control.hold_s / 2 * self.plan.frame_rate_hz))

    @property
    def n_frames(self) -> int:
        """Returns the number of frames of the whole survey at the planned speed, including station keeping."""
        return sum(len(self.plan.frames_of_track(t)[0]) + 2 * self._n_holding for t in self.tracks)

    @property
    def tracks(self) -> range:
        """Returns the numbers of the tracks, from 1."""
        return range(1, self.plan.n_tracks + 1)


def prepare(scenario: Scenario) -> Mission:
    """Returns the mission of a scenario: loads its floor and objects, plans the survey, and checks all of them.

    Raises:
        ScenarioError: the survey cannot be flown; the error lists every reason with file and line, or with the `--set`
            that caused it.
    """
    errors: list[str] = []
    source = scenario.source
    mesh_floor = None
    if scenario.terrain.kind == "mesh":
        _attempt(lambda: _check_texture_keys(scenario.terrain), source, errors)
        mesh_floor = _attempt(lambda: load_mesh_floor(scenario), source, errors)
        terrain = mesh_floor and mesh_floor.terrain
    else:
        terrain = _attempt(lambda: load_terrain(scenario), source, errors)
    plan = _attempt(lambda: plan_survey(scenario, terrain), source, errors)
    _attempt(lambda: _check_plugins(scenario), source, errors)
    _attempt(lambda: _check_speed(scenario.vehicle, scenario.plan, plan), source, errors)
    _attempt(lambda: _check_current(scenario.vehicle, scenario.current), source, errors)
    if (sensor := scenario.sensor) is not None:
        _attempt(lambda: _check_exposure(sensor), source, errors)
        for key, time_ms in (("exposure_max_ms", sensor.exposure_max_ms), ("readout_ms", sensor.readout_ms)):
            _attempt(lambda k=key, t=time_ms: _check_in_frame(k, t, scenario.rig.frame_rate_hz), source, errors)
        _attempt(lambda: _check_white_balance(sensor), source, errors)
    _attempt(lambda: _check_lens_blur(scenario.lens, scenario.sensor), source, errors)
    _attempt(lambda: _check_snow(scenario.snow), source, errors)
    if (imu := scenario.imu) is not None:
        _attempt(lambda: imu_rate_hz(imu, motion_rate_hz(scenario)), source, errors)
    true_cameras = _attempt(lambda: make_true_cameras(scenario), source, errors)
    illumination = _attempt(lambda: _illumination(scenario), source, errors)
    _attempt(lambda: check_require(scenario.require), source, errors)
    _attempt(lambda: _check_beacons_listed(scenario.navigation, scenario.beacons), source, errors)
    objects: tuple[PlacedObject, ...] = ()
    if terrain is not None:
        objects = load_objects(scenario, terrain, lambda build: _attempt(build, source, errors))
        for k, beacon in enumerate(scenario.beacons):
            _attempt(lambda k=k, beacon=beacon: _check_beacon(k, beacon, terrain), source, errors)
    if terrain is not None and plan is not None:
        _attempt(lambda: _check_clearance(scenario.plan, terrain, plan), source, errors)
        _attempt(lambda: check_path(objects, plan, scenario.plan.clearance_m), source, errors)
        _attempt(lambda: check_thrust(scenario.vehicle, scenario.current.velocity_mps, plan), source, errors)
        for k in range(len(scenario.lamps)):
            _attempt(lambda k=k: _check_lamp(k, scenario, terrain, plan), source, errors)
    grid = None
    if terrain is not None and plan is not None:
        grid = _attempt(lambda: _grid(scenario.map.cell_m, plan, terrain), source, errors)
    if errors or terrain is None or plan is None or grid is None or true_cameras is None or illumination is None:
        raise ScenarioError(errors)
    return Mission(
        scenario, terrain, plan, scenario.believed_rig(), grid, true_cameras, illumination, objects, mesh_floor
    )


def _attempt(build, source: Source, errors: list[str]):
    """Returns the result of `build`; if it raises TwinError, appends its description to `errors` and returns None."""
    try:
        return build()
    except TwinError as error:
        errors.append(source.describe(error))
    return None


def motion_rate_hz(scenario: Scenario) -> float:
    """Returns the number of simulated steps of the vehicle per second.

    These are the timesteps of the physics or, for a kinematic vehicle, the frames.
    """
    frame_rate_hz = scenario.rig.frame_rate_hz
    rigid = scenario.vehicle.dynamics == "rigid"
    return round(1 / (frame_rate_hz * physics_timestep_s(frame_rate_hz))) * frame_rate_hz if rigid else frame_rate_hz


def load_terrain(scenario: Scenario) -> terrains.Terrain:
    """Returns the floor of a scenario, generated or read from its files.

    Raises:
        TwinError: the floor cannot be generated or read, or a key of the section `terrain` has no effect on it.
    """
    t = scenario.terrain
    _check_texture_keys(t)
    if t.kind == "mesh":
        return load_mesh_floor(scenario).terrain
    _check_mesh_keys(t)
    if t.kind != "file":
        given = [key for key in ("height_file", "texture_file", "orthophoto_file", "z") if getattr(t, key)]
        if given:
            key = given[0]
            raise TwinError(
                f"terrain.{key}",
                f"has no effect on a generated floor (terrain.kind = {t.kind!r})",
                'terrain.kind = "file"',
            )
        texel_m = scenario.texel_m if scenario.imaging.fidelity == "rendered" else t.grid_m  # unused without images
        texture = terrains.TextureSource(
            texel_m, cover=t.cover, coarsen=t.texture_px_m is None, walls=scenario.has_walls
        )
        if (plugin := t.plugin) is not None:
            return terrains.generate_from(
                lambda x_m, y_m, _: terrain_heights(plugin, x_m, y_m, scenario.seed),
                t.size_m, t.grid_m, texture, t.cover or DEFAULT_COVERS[t.kind], scenario.seed,
            )  # fmt: skip
        return terrains.generate(t.kind, t.size_m, t.relief_m, t.base_m, t.grid_m, texture, scenario.seed)
    if t.plugin is not None:
        raise TwinError("terrain.plugin", 'has no effect on a measured DEM (terrain.kind = "file")', "another kind")
    if t.height_file is None:
        raise TwinError("terrain.height_file", "missing", 'a DEM, as terrain.kind is "file"')
    tiling = t.texture_tiling if scenario.imaging.fidelity == "rendered" else "repeat"  # unused without images
    photographed = t.texture_file is not None or t.orthophoto_file is not None
    texture = terrains.TextureSource(
        scenario.texel_m, t.texture_file, tiling, t.orthophoto_file, t.cover, coarsen=t.texture_px_m is None,
        in_images=photographed or scenario.imaging.fidelity == "rendered", walls=scenario.has_walls,
    )  # fmt: skip
    return terrains.load(t.height_file, texture, t.height_spacing_m, t.height_range_m, scenario.seed, t.z)


def _check_texture_keys(t: TerrainConfig) -> None:
    """Raises TwinError if `cover` is set with `texture_file`, or `texture_tiling` is changed without `texture_file`."""
    if t.texture_file is not None and t.cover is not None:
        raise TwinError("terrain.cover", "has no effect on a floor with terrain.texture_file", "one of the two")
    if t.texture_file is None and t.texture_tiling != TerrainConfig.model_fields["texture_tiling"].default:
        raise TwinError("terrain.texture_tiling", "has no effect without a photo", "with terrain.texture_file")


def _check_mesh_keys(t: TerrainConfig) -> None:
    """Raises TwinError if keys of a mesh are set for a floor that is not a mesh."""
    for key in ("mesh_file", "mesh_up", "mesh_scale"):
        if getattr(t, key) != TerrainConfig.model_fields[key].default:
            raise TwinError(f"terrain.{key}", f"has no effect on terrain.kind = {t.kind!r}", 'terrain.kind = "mesh"')


def _check_plugins(scenario: Scenario) -> None:
    """Raises TwinError if a plug-in (controller or estimator) cannot be loaded, or an estimator would get no images."""
    check_loadable("control.plugin", CONTROLLERS, scenario.control.plugin)
    check_loadable("estimate.plugin", ESTIMATORS, scenario.estimate.plugin)
    if scenario.estimate.plugin is not None and scenario.imaging.fidelity != "rendered":
        raise TwinError("estimate.plugin", "needs images; the surrogate has none", 'imaging.fidelity = "rendered"')


def _check_speed(vehicle: VehicleConfig, asked: PlanConfig, plan: SurveyPlan | None) -> None:
    """Raises TwinError if the cruise speed exceeds the top speed: forwards or, for loops, in the slowest direction.

    A kinematic vehicle is not checked.
    """
    if vehicle.dynamics == "kinematic":
        return
    bearings = np.linspace(0, 2 * np.pi, 24, endpoint=False) if asked.pattern == "loops" else np.zeros(1)
    directions = np.stack([np.cos(bearings), np.sin(bearings), np.zeros_like(bearings)], axis=1)
    reach = min(top_speed_mps(vehicle, direction) for direction in directions)
    if (asked.speed_mps if plan is None else plan.speed_mps) > reach:
        raise TwinError("plan.speed_mps", f"{asked.speed_mps:g}: too fast for the thrusters", f"up to {reach:.2f}")


def _check_beacons_listed(navigation: NavigationConfig, beacons: Sequence[BeaconConfig]) -> None:
    """Raises TwinError if beacons are used for aiding and the scenario defines none."""
    if "beacons" in navigation.aiding and not beacons:
        raise TwinError("navigation.aiding", "'beacons': the scenario defines no beacon", "with a [[beacons]] section")


def _check_beacon(number: int, beacon: BeaconConfig, terrain: terrains.Terrain) -> None:
    """Raises TwinError if a beacon lies outside the terrain or below the floor."""
    x, y, z = beacon.position_m
    floor_m = float(terrain.height_at(x, y))
    if np.isnan(floor_m):
        east, north = terrain.east_m, terrain.north_m
        raise TwinError(
            f"beacons.{number}.position_m", f"({x:g}, {y:g}) lies outside the terrain",
            f"x {terrain.west_m:.2f} to {east:.2f}, y {terrain.south_m:.2f} to {north:.2f} m",
        )  # fmt: skip
    if z < floor_m:
        raise TwinError(f"beacons.{number}.position_m", f"z {z:g} is below the floor", f"above {floor_m:.3f} m")


def _check_current(vehicle: VehicleConfig, current: CurrentConfig) -> None:
    """Raises TwinError if the scenario combines a current with a kinematic vehicle, on which it has no effect."""
    if vehicle.dynamics == "kinematic" and any(current.velocity_mps):
        raise TwinError(
            "current.velocity_mps", "has no effect on a kinematic vehicle", 'zero, or vehicle.dynamics = "rigid"'
        )


def _illumination(scenario: Scenario) -> Illumination:
    """Returns the optical properties of the water and the daylight."""
    illumination = illumination_of(scenario)
    light_sources_in_camera(scenario.believed_rig(), scenario.lamps, illumination.daylight, 0)
    return illumination


def _check_lamp(number: int, scenario: Scenario, terrain: terrains.Terrain, plan: SurveyPlan) -> None:
    """Raises TwinError if a lamp is below the floor at a point of the path, with any heading of the bow on the legs."""
    corners, offset = plan.outline(), np.array(scenario.lamps[number].position_m)
    offset = offset - scenario.believed_rig().body_from_camera[:3, 3]
    lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    along = np.append(np.arange(0.0, lengths[-1], max(LAMP_STEP_M, lengths[-1] / LAMP_POINTS)), lengths[-1])
    x, y = (np.interp(along, lengths, corners[:, k]) for k in range(2))
    camera = np.column_stack([x, y, plan.camera_height_at(x, y)])
    headings = [plan.area.heading, plan.area.heading + np.pi][: 1 + plan.turns_on_the_spot]
    x, y, z = np.concatenate([camera + rotate_lever_arm(heading, offset) for heading in headings]).T
    above = np.nan_to_num(z - terrain.height_at(x, y), nan=np.inf)
    if (least := above.min()) < 0:
        raise TwinError(
            f"lamps.{number}.position_m", f"is {-least:.2f} m below the floor at x {x[above.argmin()]:.1f},"
            f" y {y[above.argmin()]:.1f}", f"{scenario.lamps[number].position_m[2] - least:.2f} or more for z (up)",
        )  # fmt: skip


def _check_exposure(sensor: SensorConfig) -> None:
    """Raises TwinError if the shortest exposure is longer than the longest."""
    if sensor.exposure_min_ms > sensor.exposure_max_ms:
        raise TwinError(
            "sensor.exposure_min_ms", f"{sensor.exposure_min_ms:g}: longer than the longest exposure",
            f"up to sensor.exposure_max_ms = {sensor.exposure_max_ms:g}",
        )  # fmt: skip


def _check_white_balance(sensor: SensorConfig) -> None:
    """Raises TwinError if gains or a colour temperature are set that the mode of the white balance does not use."""
    unused = {"white_gains": "gains", "white_temperature_k": "temperature"}
    for key, mode in unused.items():
        if getattr(sensor, key) != SensorConfig.model_fields[key].default and sensor.white_balance != mode:
            raise TwinError(
                f"sensor.{key}", f'is unused: sensor.white_balance is "{sensor.white_balance}"',
                f'with sensor.white_balance = "{mode}"',
            )  # fmt: skip


def _check_lens_blur(lens: LensConfig, sensor: SensorConfig | None) -> None:
    """Raises TwinError if [sensor] is missing although the blur of the lens needs it, or if the focus is too near."""
    for key, used in (("diffraction", lens.diffraction), ("focus_m", lens.focus_m > 0)):
        if used and sensor is None:
            raise TwinError(f"lens.{key}", "needs the f-number and the pixel size of the sensor", "with [sensor]")
    if 0 < lens.focus_m < NEAREST_FOCUS_M:
        raise TwinError("lens.focus_m", f"{lens.focus_m:g}: too near", f"0, or {NEAREST_FOCUS_M:g} or more")


def _check_snow(snow: SnowConfig) -> None:
    """Raises TwinError if the limits of the size distribution are reversed, or set without a distribution."""
    if snow.junge_exponent is None:
        for key in ("diameter_min_m", "diameter_max_m"):
            if getattr(snow, key) != SnowConfig.model_fields[key].default:
                raise TwinError(f"snow.{key}", "is unused: all particles have diameter_m", "with snow.junge_exponent")
    elif snow.diameter_min_m >= snow.diameter_max_m:
        raise TwinError(
            "snow.diameter_min_m", f"{snow.diameter_min_m:g}: not smaller than the largest diameter",
            f"below snow.diameter_max_m = {snow.diameter_max_m:g}",
        )  # fmt: skip


def _check_in_frame(key: str, time_ms: float, frame_rate_hz: float) -> None:
    """Raises TwinError if the time `sensor.<key>` is longer than the interval between frames."""
    if time_ms > 1000 / frame_rate_hz:
        raise TwinError(
            f"sensor.{key}", f"{time_ms:g}: longer than a frame",
            f"up to {np.floor(1e5 / frame_rate_hz) / 100:g} at rig.frame_rate_hz = {frame_rate_hz:g}",
        )  # fmt: skip


def _check_clearance(asked: PlanConfig, terrain: terrains.Terrain, plan: SurveyPlan) -> None:
    """Raises TwinError if the area exceeds the terrain, or the path leaves the terrain or is too near the floor."""
    size, outline = terrain.size_m, plan.area.outline()
    extent = f"{size[0]:.2f} x {size[1]:.2f} m"
    # a tolerance: rotation rounds the corners of an area as large as the terrain
    if (np.ptp(outline, axis=0) > np.array(size) + 1e-9).any():
        shown = " x ".join(f"{a:g}" for a in asked.area_m)
        turned = f" at a heading of {asked.heading_deg:g} deg" if asked.heading_deg else ""
        raise TwinError("plan.area_m", f"{shown} m{turned} is larger than the terrain", f"up to {extent}")
    clearance = planned_clearance(plan, terrain)
    field = "plan.area_m" if asked.polygon is None else "plan.polygon"
    if not clearance.inside:
        raise TwinError(field, "the path leaves the terrain", f"a path inside {extent}")
    _check_over_heights(field, terrain, plan)
    if clearance.least_m < asked.clearance_m:
        needed = asked.altitude_m - clearance.least_m + asked.clearance_m
        raise TwinError(
            "plan.altitude_m",
            f"{asked.altitude_m:g}: the cameras come within {clearance.least_m:.2f} m of the floor"
            f" at x {clearance.x_m:.1f}, y {clearance.y_m:.1f}",
            f"at least {needed:.2f} for {asked.clearance_m:g} m of clearance",
        )


def _check_over_heights(field: str, terrain: terrains.Terrain, plan: SurveyPlan) -> None:
    """Raises TwinError if the path leads over floor without a height, farther from the next height than an image shows.

    There is nothing to plan a height or a clearance from. Smaller holes are flown over, but not judged.
    """
    if terrain.known is None:
        return
    x, y, _ = path_points(plan).T
    cols, rows = (x - terrain.west_m) / terrain.spacing_m, (y - terrain.south_m) / terrain.spacing_m
    away_m = np.asarray(distance_transform_edt(~terrain.known)) * terrain.spacing_m
    away_m = away_m[np.rint(rows).astype(int), np.rint(cols).astype(int)]
    k, limit_m = int(away_m.argmax()), min(plan.footprint_m) / 2
    if away_m[k] > limit_m:
        raise TwinError(
            field, f"the path leads over floor without a height, up to {away_m[k]:.2f} m from the next height"
            f" (at x {x[k]:.1f}, y {y[k]:.1f})",
            f"a path within {limit_m:.2f} m of heights: another plan.centre_m, plan.area_m or plan.polygon",
        )  # fmt: skip


def _grid(cell_m: float, plan: SurveyPlan, terrain: terrains.Terrain) -> MapGrid:
    """Returns the grid of the map: a rectangle that contains the footprints along the path and a margin of 0.5 m."""
    corners = plan.outline()[:, :2]
    margin = np.array(_half_extent_m(plan)) * _widest(plan, terrain) + 0.5
    west, south = np.floor((corners.min(axis=0) - margin) / cell_m) * cell_m
    east, north = np.ceil((corners.max(axis=0) + margin) / cell_m) * cell_m
    grid = MapGrid(float(west), float(north), cell_m, round((north - south) / cell_m), round((east - west) / cell_m))
    check_map_size(grid)
    return grid


def _half_extent_m(plan: SurveyPlan) -> tuple[float, float]:
    """Returns half the extent of a footprint on the reference plane along x and y [m].

    It is the maximum over the headings on the path; with turns on the spot, half the diagonal of the footprint.
    """
    across_m, along_m = plan.footprint_m
    if plan.turns_on_the_spot:
        diagonal_m = float(np.hypot(along_m, across_m))
        return diagonal_m / 2, diagonal_m / 2
    c, s = abs(np.cos(plan.area.heading)), abs(np.sin(plan.area.heading))
    return float(c * along_m + s * across_m) / 2, float(s * along_m + c * across_m) / 2


def _widest(plan: SurveyPlan, terrain: terrains.Terrain) -> float:
    """Returns an upper bound of the size of the footprints, as a multiple of the footprint at `plan.altitude_m`."""
    highest_m = plan.altitude_m if plan.surface is None else path_points(plan)[:, 2].max()
    return max(1.0, float(highest_m - terrain.lowest_m) / plan.altitude_m)
