"""Surveys of the tank: the images that a rig on an overhead track takes, which is not straight, and the estimates."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from twin.controllers.segments import Reference
from twin.core import geometry
from twin.core.geometry import Array
from twin.core.interrupts import StageGuard
from twin.core.records import ElevationMap, MapGrid, SurveyResult, Truth
from twin.core.timing import Stopwatch
from twin.estimate.pipeline import Navigator
from twin.judge.trajectory_errors import anchor
from twin.reproduce.experiment_floors import tank_floor
from twin.reproduce.paper_flight import finished_map
from twin.scenario.file import load_scenario
from twin.session.assembly import image_vision
from twin.simulate.kinematic_vehicle import KinematicVehicle
from twin.world.mission import FrameSequence, Mission, Step, prepare
from twin.world.rendered_world import RenderedWorld

AREA_M = (2.0, 1.5)  # mapped area around the centre of the tank
QUICK = ("rig.image_width_px=320", "rig.image_height_px=240", "estimate.patch_px=15", "map.cell_m=0.003")
N_PAIRS = 130
SEED = 1
STEP_M, HEIGHT_M = 0.05, 1.524  # between frames; of the cameras above the floor (5 ft)
LEG_M, LEG_SPACING_M, N_LEGS = 0.97, 0.25, 5
N_LOOP = 30  # steps of one loop
#: Bend of the track: the rig is displaced by up to BEND_M across it, within about BEND_WIDTH_M of x = BEND_AT_M.
BEND_M, BEND_AT_M, BEND_WIDTH_M = 0.012, 0.2, 0.15
JITTER_M, JITTER_RAD = 0.001, float(np.deg2rad(0.1))  # standard deviation of each axis


class RigPath(NamedTuple):
    planned_m: Array  #: (n, 3) positions of the left camera as read on the track
    world_from_camera: Array  #: (n, 4, 4) true poses of the left camera
    repeats: tuple[int, ...] = ()  #: numbers (from 0) of the frames that repeat frame 0

    @property
    def start(self) -> Array:
        """Returns the planned pose (4, 4) of the left camera at the first frame: level, optical axis along -z."""
        return geometry.pose(geometry.rotations_of_down_camera(np.zeros(1))[0], self.planned_m[0])


@dataclass(frozen=True)
class TankSurvey:
    mission: Mission
    path: RigPath
    result: SurveyResult
    elevation: ElevationMap  #: map along the final trajectory
    truth: Truth
    ended: str = ""  #: why the final alignment is missing; "" if it was done


def lawnmower_path(n_pairs: int, seed: int) -> RigPath:
    """Returns the path of the first test: up to 137 stereo pairs on parallel legs along x joined by half circles."""
    turn_m = LEG_SPACING_M / 2
    angle = np.linspace(0, np.pi, 181)[:-1]
    turn = turn_m * np.column_stack([np.sin(angle), 1 - np.cos(angle)])
    sides = [-1 if k % 2 else 1 for k in range(N_LEGS)]
    south_m = -(N_LEGS - 1) / 2 * LEG_SPACING_M
    parts = [
        np.concatenate([[[-LEG_M / 2, 0.0]], turn + [LEG_M / 2, 0.0]]) * [side, 1] + [0.0, south_m + k * LEG_SPACING_M]
        for k, side in enumerate(sides)
    ]
    points = np.concatenate(parts)
    lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    along = STEP_M * np.arange(n_pairs)
    return _rig_path(np.column_stack([np.interp(along, lengths, points[:, axis]) for axis in range(2)]), seed)


def two_loops_path(seed: int) -> RigPath:
    """Returns the path of the second test: two circles that touch at the start; frames 30 and 60 repeat frame 0."""
    radius_m = N_LOOP * STEP_M / (2 * np.pi)
    angle = 2 * np.pi * np.arange(N_LOOP + 1) / N_LOOP
    loop = radius_m * np.column_stack([1 - np.cos(angle), np.sin(angle)])
    path = _rig_path(np.concatenate([loop, loop[1:] * [-1, 1]]), seed)
    poses = path.world_from_camera.copy()
    repeats = N_LOOP, 2 * N_LOOP
    poses[list(repeats)] = poses[0]
    return RigPath(path.planned_m, poses, repeats)


def _rig_path(xy: Array, seed: int) -> RigPath:
    """Returns the path for planned positions `xy` (n, 2) [m]; true poses include the bend of the track and jitter."""
    rng, n = np.random.default_rng(seed), len(xy)
    planned = np.column_stack([xy, np.full(n, HEIGHT_M)])
    bend = BEND_M * np.exp(-(((xy[:, 0] - BEND_AT_M) / BEND_WIDTH_M) ** 2))
    position = planned + np.column_stack([np.zeros(n), bend, np.zeros(n)]) + rng.normal(0, JITTER_M, (n, 3))
    level = geometry.rotations_of_down_camera(np.zeros(n))
    turned = np.array([geometry.so3_exp(w) for w in rng.normal(0, JITTER_RAD, (n, 3))])
    poses = np.tile(np.eye(4), (n, 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = level @ turned, position
    return RigPath(planned, poses)


def survey_tank(name: str, folder: Path, settings: Sequence[str] = ()) -> TankSurvey:
    """Returns the survey of a tank experiment: "tank1", parallel legs, or "tank2", two loops that touch at the start.

    The estimators start at the planned pose of the first frame; the true one has the bend and jitter of the track.
    Keyframe images go to `folder`; `settings` are overrides "key=value" of the scenario `tank`. Raises TwinError if a
    setting is invalid, or no stereo pair became a keyframe.
    """
    path = two_loops_path(SEED) if name == "tank2" else lawnmower_path(N_PAIRS, SEED)
    mission, stopwatch, guard = tank_mission(settings), Stopwatch(), StageGuard()
    rig, estimator, n = mission.rig, mission.scenario.estimator_settings(), len(path.planned_m)
    still = np.zeros_like(path.planned_m)
    reference = Reference(path.planned_m, still, np.zeros(n), still)
    with (
        image_vision(mission, folder, stopwatch) as vision,
        RenderedWorld(mission, stopwatch) as world,
        Navigator(rig, estimator, path.start, vision=vision, stopwatch=stopwatch) as navigator,
    ):
        vehicle, first = world.vehicle, None
        assert isinstance(vehicle, KinematicVehicle)
        for k, pose in enumerate(path.world_from_camera):
            vehicle.world_from_body = pose @ geometry.inverse(rig.body_from_camera)
            frame = world.observe(Step(reference.row(k), keyframe=True, holding=False))
            first = first or frame
            repeated = k in path.repeats
            navigator.update(replace(frame, left=first.left, right=first.right) if repeated else frame)
        times_s = np.arange(n) / rig.frame_rate_hz
        world.start_sequence(FrameSequence(reference, np.ones(n, np.bool_), False, times_s, 1))
        result, elevation = finished_map(navigator, mission.grid, guard)
        return TankSurvey(mission, path, result, elevation, world.truth(), guard.cause)


def height_errors(survey: TankSurvey) -> Array:
    """Returns estimated minus true height (rows, cols) [m]; NaN where a cell was not observed or estimated.

    The map is anchored at the first true pose, as the trajectories are: the estimators do not know the bend and jitter
    of the track at its start.
    """
    true_from_map = anchor(survey.result.final.world_from_camera[0], survey.truth.trajectory.world_from_camera[0])
    x, y = np.meshgrid(*survey.mission.grid.centres())
    points = np.stack([x, y, survey.elevation.height_m.astype(np.float64)], axis=-1)
    moved = geometry.transform(true_from_map, points.reshape(-1, 3)).reshape(points.shape)
    error_m = moved[..., 2] - survey.mission.terrain.height_at(moved[..., 0], moved[..., 1])
    return np.where(survey.truth.seen, error_m, np.nan)


def tank_mission(settings: Sequence[str]) -> Mission:
    """Returns the mission of the scenario `tank`, over the floor with objects, with the map grid of `AREA_M`."""
    mission = prepare(load_scenario("tank", settings))
    return replace(mission, terrain=tank_floor(SEED), grid=map_grid(mission.scenario.map.cell_m))


def map_grid(cell_m: float) -> MapGrid:
    """Returns the grid of the map: `AREA_M`, with the centre of a cell at the origin."""
    cols, rows = (round(side / 2 / cell_m) for side in AREA_M)
    return MapGrid(-(cols + 0.5) * cell_m, (rows + 0.5) * cell_m, cell_m, 2 * rows + 1, 2 * cols + 1)


def closures(result: SurveyResult, repeats: Sequence[int]) -> list[list[float]]:
    """Returns the closure errors [m] at the frames `repeats` that repeat frame 0: of F2F, online, after alignment."""
    paths = (result.f2f.positions, result.online.positions, result.final.positions)
    return [[float(np.linalg.norm(path[k] - path[0])) for path in paths] for k in repeats]
