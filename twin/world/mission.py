"""Missions: scenario, floor, plan and map grid of a survey, checked before the flight."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

import terrains
from controllers import lawnmower, loops, segments
from controllers.forecast import least_clearance
from controllers.survey_plan import SurveyPlan, SurveyRequest
from twin.core import geometry
from twin.core.geometry import Array
from twin.core.records import MapGrid, StereoRig
from twin.errors import ScenarioError, TwinError
from twin.imaging.illumination import Illumination, illumination_of
from twin.imaging.lamps import light_sources_in_camera
from twin.imaging.true_cameras import TrueCameras, make_true_cameras
from twin.judge.metrics import check_require
from twin.scenario.model import BeaconConfig, CalibrationErrorConfig, Scenario, SensorConfig, Source
from twin.simulate.autopilot import top_speed_mps

#: Distance between the points of the path at which the height of a lamp above the floor is checked.
LAMP_STEP_M = 0.02


class Step(NamedTuple):
    """One planned frame.

    Args:
        reference: planned pose and velocity of the left camera.
        keyframe: whether the frame is a keyframe.
        holding: whether the vehicle keeps station.
    """

    reference: segments.Reference
    keyframe: bool
    holding: bool


@dataclass(frozen=True)
class Course:
    """Sequence of n consecutive planned frames; item k is the `Step` of frame k.

    Args:
        reference: planned pose and velocity of the left camera at each frame.
        keyframe: (n,) bool, whether each frame is a keyframe.
        holding: whether the vehicle keeps station.
    """

    reference: segments.Reference
    keyframe: NDArray[np.bool_]
    holding: bool

    def __len__(self) -> int:
        return len(self.keyframe)

    def __getitem__(self, k: int) -> Step:
        return Step(self.reference.row(k), bool(self.keyframe[k]), self.holding)


@dataclass(frozen=True)
class Mission:
    """A survey that has been checked and is ready to be flown.

    Args:
        scenario: description of the survey.
        terrain: sea floor.
        plan: planned path.
        rig: calibration that the estimators use.
        grid: cells of the map.
        true_cameras: true parameters of the cameras.
        illumination: optical properties of the water, and daylight.
    """

    scenario: Scenario
    terrain: terrains.Terrain
    plan: SurveyPlan
    rig: StereoRig
    grid: MapGrid
    true_cameras: TrueCameras
    illumination: Illumination

    @property
    def start(self) -> Array:
        """Returns world_from_camera (4, 4) at the start of the survey: vehicle level, bow to the east."""
        return geometry.pose(geometry.BODY_FROM_DOWN_CAMERA, self.plan.reference(1, 0.0).position)

    @property
    def start_of_body(self) -> Array:
        """Returns world_from_body (4, 4) at the start of the survey."""
        return self.start @ geometry.inverse(self.rig.body_from_camera)

    def fly(self, track: int) -> Course:
        """Returns the course along a track (numbered from 1); every N-th frame and the last one are keyframes."""
        times_s, keyframes = self.plan.frames_of_track(track)
        return Course(self.plan.references(track, times_s), keyframes, holding=False)

    def hold(self, track: int) -> Course:
        """Returns the course of half the station keeping after a track (numbered from 1).

        It is flown twice, before and after the global alignment.
        """
        n = self._n_holding
        end = self.plan.references(track, np.full(n, self.plan.track_duration_s(track)))
        return Course(end, np.zeros(n, np.bool_), holding=True)

    @property
    def _n_holding(self) -> int:
        return max(1, round(self.scenario.control.hold_s / 2 * self.plan.frame_rate_hz))

    @property
    def n_frames(self) -> int:
        """Returns the number of frames of the whole survey, with station keeping."""
        return sum(len(self.plan.frames_of_track(t)[0]) + 2 * self._n_holding for t in self.tracks)

    @property
    def tracks(self) -> range:
        """Returns the numbers of the tracks, from 1."""
        return range(1, self.plan.n_tracks + 1)


def prepare(scenario: Scenario) -> Mission:
    """Loads the floor, plans the survey and checks both.

    Raises:
        ScenarioError: the survey cannot be flown; the error lists every reason with file and line.
    """
    errors: list[str] = []
    source = scenario.source
    terrain = _attempt(lambda: load_terrain(scenario), source, errors)
    plan = _attempt(lambda: make_plan(scenario), source, errors)
    _attempt(lambda: _check_speed(scenario), source, errors)
    _attempt(lambda: _check_current(scenario), source, errors)
    if (sensor := scenario.sensor) is not None:
        _attempt(lambda: _check_exposure(sensor), source, errors)
        for key, time_ms in (("exposure_max_ms", sensor.exposure_max_ms), ("readout_ms", sensor.readout_ms)):
            _attempt(lambda k=key, t=time_ms: _check_in_frame(k, t, scenario.rig.frame_rate_hz), source, errors)
    true_cameras = _attempt(lambda: make_true_cameras(scenario), source, errors)
    illumination = _attempt(lambda: _illumination(scenario), source, errors)
    _attempt(lambda: _check_surrogate(scenario), source, errors)
    _attempt(lambda: check_require(scenario.require), source, errors)
    _attempt(lambda: _check_beacons_listed(scenario), source, errors)
    if terrain is not None:
        for k, beacon in enumerate(scenario.beacons):
            _attempt(lambda k=k, beacon=beacon: _check_beacon(k, beacon, terrain), source, errors)
    if terrain is not None and plan is not None:
        _attempt(lambda: _check_clearance(scenario, terrain, plan), source, errors)
        for k in range(len(scenario.lamps)):
            _attempt(lambda k=k: _check_lamp(k, scenario, terrain, plan), source, errors)
    if errors or terrain is None or plan is None or true_cameras is None or illumination is None:
        raise ScenarioError(errors)
    grid = _grid(scenario, plan)
    return Mission(scenario, terrain, plan, scenario.believed_rig(), grid, true_cameras, illumination)


def _attempt(build, source: Source, errors: list[str]):
    """Returns the result of `build`; if it raises TwinError, appends the description to `errors` and returns None."""
    try:
        return build()
    except TwinError as error:
        errors.append(source.describe(error))
    return None


def load_terrain(scenario: Scenario) -> terrains.Terrain:
    """Generates or reads the floor of a scenario.

    Raises:
        TwinError: the floor cannot be generated or read.
    """
    t = scenario.terrain
    if t.kind != "file":
        if t.height_file or t.texture_file:
            key = "height_file" if t.height_file else "texture_file"
            raise TwinError(
                f"terrain.{key}",
                f"has no effect on a generated floor (terrain.kind = {t.kind!r})",
                'terrain.kind = "file"',
            )
        texel_m = t.texture_px_m if scenario.imaging.fidelity == "rendered" else t.grid_m  # unused without images
        return terrains.generate(t.kind, t.size_m, t.relief_m, t.base_m, t.grid_m, texel_m, scenario.seed)
    if t.height_file is None:
        raise TwinError("terrain.height_file", "missing", 'a DEM, as terrain.kind is "file"')
    return terrains.load(
        t.height_file, t.texture_file, t.texture_px_m, t.height_spacing_m, t.height_range_m, scenario.seed
    )


_PATTERNS = {"lawnmower": lawnmower.plan, "loops": loops.plan}


def make_plan(scenario: Scenario) -> SurveyPlan:
    """Plans the survey of a scenario.

    Raises:
        TwinError: no plan satisfies the scenario.
    """
    p, rig = scenario.plan, scenario.believed_rig()
    request = SurveyRequest(
        p.area_m, p.altitude_m, p.speed_mps, p.overlap_along, p.overlap_across, p.tracks,
        rig.width_px, rig.height_px, rig.focal_px, rig.frame_rate_hz,
    )  # fmt: skip
    return _PATTERNS[p.pattern](request)


def _check_speed(scenario: Scenario) -> None:
    """Checks that the thrusters reach the planned speed: ahead, and for loops in every horizontal direction."""
    if scenario.vehicle.dynamics == "kinematic":
        return
    bearings = np.linspace(0, 2 * np.pi, 24, endpoint=False) if scenario.plan.pattern == "loops" else np.zeros(1)
    directions = np.stack([np.cos(bearings), np.sin(bearings), np.zeros_like(bearings)], axis=1)
    reach = min(top_speed_mps(scenario.vehicle, direction) for direction in directions)
    if scenario.plan.speed_mps > reach:
        raise TwinError(
            "plan.speed_mps", f"{scenario.plan.speed_mps:g}: too fast for the thrusters", f"up to {reach:.2f}"
        )


def _check_surrogate(scenario: Scenario) -> None:
    """Rejects effects that the surrogate does not model."""
    if scenario.imaging.fidelity == "rendered":
        return
    plain = scenario.port.kind == "none" and scenario.calibration_error == CalibrationErrorConfig()
    absent = {"port, calibration_error": not plain, "snow": scenario.snow.density_per_m3 > 0}
    for section, given in absent.items():
        if given:
            raise TwinError("imaging.fidelity", f"'surrogate' does not model [{section}]", '"rendered"')


def _check_beacons_listed(scenario: Scenario) -> None:
    """Checks that the scenario defines beacons if they are used for aiding."""
    if "beacons" in scenario.navigation.aiding and not scenario.beacons:
        raise TwinError("navigation.aiding", "'beacons': the scenario defines no beacon", "with a [[beacons]] section")


def _check_beacon(number: int, beacon: BeaconConfig, terrain: terrains.Terrain) -> None:
    """Checks that a beacon lies within the terrain, on or above the floor."""
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


def _check_current(scenario: Scenario) -> None:
    """Raises TwinError if a kinematic vehicle has a current: a current has no effect on kinematic motion."""
    if scenario.vehicle.dynamics == "kinematic" and any(scenario.current.velocity_mps):
        raise TwinError(
            "current.velocity_mps", "has no effect on a kinematic vehicle", 'zero, or vehicle.dynamics = "rigid"'
        )


def _illumination(scenario: Scenario) -> Illumination:
    """Returns the optical properties of the water and the daylight.

    Raises:
        TwinError: water, daylight or the beam of a lamp is invalid.
    """
    illumination = illumination_of(scenario)
    light_sources_in_camera(scenario.believed_rig(), scenario.lamps, illumination.daylight, 0)
    return illumination


def _check_lamp(number: int, scenario: Scenario, terrain: terrains.Terrain, plan: SurveyPlan) -> None:
    """Checks that a lamp stays above the floor along the whole path, with the bow to the east."""
    corners, offset = plan.outline(), np.array(scenario.lamps[number].position_m)
    offset = offset - scenario.believed_rig().body_from_camera[:3, 3]
    lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    along = np.append(np.arange(0.0, lengths[-1], LAMP_STEP_M), lengths[-1])
    x, y, z = (np.interp(along, lengths, corners[:, k]) + offset[k] for k in range(3))
    above = np.nan_to_num(z - terrain.height_at(x, y), nan=np.inf)
    if (least := above.min()) < 0:
        raise TwinError(
            f"lamps.{number}.position_m", f"is {-least:.2f} m below the floor at x {x[above.argmin()]:.1f},"
            f" y {y[above.argmin()]:.1f}", f"{scenario.lamps[number].position_m[2] - least:.2f} or more for z (up)",
        )  # fmt: skip


def _check_exposure(sensor: SensorConfig) -> None:
    """Checks that the shortest exposure is not longer than the longest."""
    if sensor.exposure_min_ms > sensor.exposure_max_ms:
        raise TwinError(
            "sensor.exposure_min_ms", f"{sensor.exposure_min_ms:g}: longer than the longest exposure",
            f"up to sensor.exposure_max_ms = {sensor.exposure_max_ms:g}",
        )  # fmt: skip


def _check_in_frame(key: str, time_ms: float, frame_rate_hz: float) -> None:
    """Checks that the sensor time `sensor.<key>` is at most one frame interval."""
    if time_ms > 1000 / frame_rate_hz:
        raise TwinError(
            f"sensor.{key}", f"{time_ms:g}: longer than a frame",
            f"up to {np.floor(1e5 / frame_rate_hz) / 100:g} at rig.frame_rate_hz = {frame_rate_hz:g}",
        )  # fmt: skip


def _check_clearance(scenario: Scenario, terrain: terrains.Terrain, plan: SurveyPlan) -> None:
    """Checks that the path stays over the terrain, with at least the required clearance."""
    size = terrain.size_m
    if any(a > s for a, s in zip(scenario.plan.area_m, size, strict=True)):
        shown = " x ".join(f"{a:g}" for a in scenario.plan.area_m)
        raise TwinError(
            "plan.area_m", f"{shown} m is larger than the terrain", f"up to {size[0]:.2f} x {size[1]:.2f} m"
        )
    clearance = least_clearance(plan, terrain.height_at)
    if not clearance.inside:
        raise TwinError("plan.area_m", "the path leaves the terrain", f"a path inside {size[0]:.2f} x {size[1]:.2f} m")
    if clearance.least_m < scenario.plan.clearance_m:
        needed = scenario.plan.altitude_m - clearance.least_m + scenario.plan.clearance_m
        raise TwinError(
            "plan.altitude_m",
            f"{scenario.plan.altitude_m:g}: the cameras come within {clearance.least_m:.2f} m of the floor"
            f" at x {clearance.x_m:.1f}, y {clearance.y_m:.1f}",
            f"at least {needed:.2f} for {scenario.plan.clearance_m:g} m of clearance",
        )


def _grid(scenario: Scenario, plan: SurveyPlan) -> MapGrid:
    """Returns the grid of the map: a rectangle that contains the footprints along the path and a margin of 0.5 m."""
    corners = plan.outline()[:, :2]
    across_m, along_m = plan.footprint_m
    margin = np.array([along_m, across_m]) / 2 + 0.5
    cell = scenario.map.cell_m
    west, south = np.floor((corners.min(axis=0) - margin) / cell) * cell
    east, north = np.ceil((corners.max(axis=0) + margin) / cell) * cell
    return MapGrid(float(west), float(north), cell, round((north - south) / cell), round((east - west) / cell))
