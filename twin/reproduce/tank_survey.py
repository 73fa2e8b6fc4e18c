"""Tank experiments: estimates from the images that a rig on an overhead track takes, compared with the truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.controllers.segments import Reference
from twin.core import geometry
from twin.core.interrupts import StageGuard
from twin.core.records import ElevationMap, MapGrid, SurveyResult, Trajectory, Truth
from twin.core.timing import Stopwatch
from twin.estimate.pipeline import Navigator
from twin.judge.trajectory_errors import anchor
from twin.reproduce.conclusion import finished, required_map
from twin.reproduce.tank_path import RigPath, lawnmower_path, two_loops_path
from twin.reproduce.tank_scene import tank_floor
from twin.scenario.file import load_scenario
from twin.session.assembly import image_vision
from twin.simulate.kinematic_vehicle import KinematicVehicle
from twin.world.mission import FrameSequence, Mission, Step, prepare
from twin.world.rendered_world import RenderedWorld

Array = NDArray[np.float64]

AREA_M = (2.0, 1.5)  # mapped area around the centre of the tank
QUICK = ("rig.image_width_px=320", "rig.image_height_px=240", "estimate.patch_px=15", "map.cell_m=0.003")
N_PAIRS = 130
SEED = 1


@dataclass(frozen=True)
class TankSurvey:
    """A tank experiment: estimates and truth.

    Args:
        mission: rig, floor and map grid.
        path: path of the rig.
        result: output of the estimators.
        elevation: map along the final trajectory.
        truth: true trajectory and floor.
        ended: why the final alignment is missing; "" if it was done.
    """

    mission: Mission
    path: RigPath
    result: SurveyResult
    elevation: ElevationMap
    truth: Truth
    ended: str = ""


class Closure(NamedTuple):
    """Closure errors: distances between the estimated positions of the first frame and of a frame that repeats it [m].

    Args:
        frame: number of the frame that repeats the first, from 1.
        before_m: closure error of the integrated frame-to-frame motion.
        online_m: closure error of the online estimate, which registration with the mosaic corrects.
        after_m: closure error after the global alignment.
    """

    frame: int
    before_m: float
    online_m: float
    after_m: float


def survey_tank(name: str, folder: Path, settings: Sequence[str] = (), n_pairs: int = N_PAIRS) -> TankSurvey:
    """Returns the survey of a tank experiment.

    The estimators start at the planned pose of the first frame; the true pose differs from it by the bend and the
    jitter of the track.

    Args:
        name: "tank1", parallel legs, or "tank2", two loops that touch at the start.
        folder: folder for the keyframe images.
        settings: overrides of the scenario `tank`, each "key=value".
        n_pairs: number of stereo pairs of tank1.

    Raises:
        TwinError: a setting is invalid, or no stereo pair became a keyframe, so that there is no map.
    """
    path = two_loops_path(SEED) if name == "tank2" else lawnmower_path(n_pairs, SEED)
    mission = tank_mission(settings)
    stopwatch, guard = Stopwatch(), StageGuard()
    rig, estimator = mission.rig, mission.scenario.estimator_settings()
    vision = image_vision(mission, folder, stopwatch)
    with (
        RenderedWorld(mission, stopwatch) as world,
        Navigator(rig, estimator, path.start, vision=vision, stopwatch=stopwatch) as navigator,
    ):
        vehicle, first = world.vehicle, None
        assert isinstance(vehicle, KinematicVehicle)
        for k, pose in enumerate(path.world_from_camera):
            vehicle.world_from_body = pose @ geometry.inverse(rig.body_from_camera)
            frame = world.observe(Step(_reference(path).row(k), keyframe=True, holding=False))
            first = first or frame
            repeated = k in path.repeats
            navigator.update(replace(frame, left=first.left, right=first.right) if repeated else frame)
        world.start_sequence(_sequence(path, rig.frame_rate_hz), 1)
        result, truth = finished(navigator, guard), world.truth()
        elevation = required_map(navigator, result, mission.grid, guard)
    return TankSurvey(mission, path, result, elevation, truth, guard.cause)


def height_errors(survey: TankSurvey) -> Array:
    """Returns estimated minus true height (rows, cols) [m], anchored at the first true pose as the trajectories are.

    The motion that maps the first estimated pose to the first true one is applied to the map before the comparison:
    the estimators do not know the bend and jitter of the track at its start. NaN where a cell was not observed or
    estimated.
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
    cell_m = mission.scenario.map.cell_m
    return replace(mission, terrain=tank_floor(SEED), grid=map_grid(cell_m))


def map_grid(cell_m: float) -> MapGrid:
    """Returns the grid of the map: `AREA_M`, with the centre of a cell at the origin."""
    cols, rows = (round(side / 2 / cell_m) for side in AREA_M)
    return MapGrid(-(cols + 0.5) * cell_m, (rows + 0.5) * cell_m, cell_m, 2 * rows + 1, 2 * cols + 1)


def _reference(path: RigPath) -> Reference:
    """Returns the planned positions as a reference path with velocity 0."""
    zeros = np.zeros_like(path.planned_m)
    return Reference(path.planned_m, zeros, np.zeros(len(zeros)), zeros)


def _sequence(path: RigPath, frame_rate_hz: float) -> FrameSequence:
    """Returns the planned frames of a path."""
    n = len(path.planned_m)
    return FrameSequence(_reference(path), np.ones(n, np.bool_), False, np.arange(n) / frame_rate_hz)


def closures(result: SurveyResult, repeats: Sequence[int]) -> list[Closure]:
    """Returns the closure errors of a survey at the frames (numbers from 0) that repeat frame 0."""
    return [Closure(k + 1, *(_gap_m(path, k) for path in (result.f2f, result.online, result.final))) for k in repeats]


def _gap_m(path: Trajectory, frame: int) -> float:
    """Returns the distance between the positions of a frame and of frame 0 [m]."""
    return float(np.linalg.norm(path.positions[frame] - path.positions[0]))
