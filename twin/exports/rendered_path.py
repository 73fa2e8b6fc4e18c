"""Images and truth along a given path of the left camera, without a vehicle, as the folder of a run."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.output_folder import sole_writer
from twin.core.records import Frame, Readings, Trajectory
from twin.core.timing import Stopwatch
from twin.datasets.tum import read_trajectory
from twin.errors import TwinError
from twin.report.frame_recorder import FrameRecorder
from twin.report.run_writer import RunFolder
from twin.scenario.model import Scenario
from twin.world.mission import Mission, prepare

_LEAST_CLEARANCE_M = 0.1  # between a camera and the floor: the near plane of the renderer
_OPTION = "--poses"


def render_path(scenario: Scenario, poses: Path, out: Path, progress: Callable[[float], None]) -> int:
    """Renders stereo pairs at the frame rate of the rig along a path, and returns their number.

    `poses` is a TUM file of poses world_from_camera of the left camera; between them, the motion is uniform. The folder
    has all frames without readings, and the true poses: `twin export` writes images and exact truth from it. Raises
    TwinError if the file is damaged, its times do not increase, or a pose is closer than 0.1 m to the floor.
    """
    from twin.world.rendered_world import RenderedWorld

    with sole_writer(out):
        mission = prepare(scenario)
        path = _at_frames(read_trajectory(poses), mission.rig.frame_rate_hz)
        _check_clearance(path, mission)
        twists = _twists(path.world_from_camera, mission.rig.body_from_camera, mission.rig.frame_rate_hz)
        numbers = list(range(len(path)))
        with RunFolder(out, scenario, ()) as folder, RenderedWorld(mission, Stopwatch()) as world:
            (folder.path / "keyframes").mkdir(exist_ok=True)
            index = {"frames": numbers, "tracks": [1] * len(numbers)}
            (folder.path / "keyframes" / "index.json").write_text(json.dumps(index), encoding="utf-8")
            path.save(folder.path / "trajectory_truth.tum")
            with FrameRecorder(out, "all") as recorder:
                for k, (time_s, pose) in enumerate(zip(path.times_s.tolist(), path.world_from_camera, strict=True)):
                    seen = world.camera.capture(pose, True, twists[k])
                    frame = Frame(k, time_s, seen.left, seen.right, Readings(), True, seen.exposure)
                    recorder.add(frame, pose, twists[k])
                    progress((k + 1) / len(path))
    return len(path)


def _at_frames(given: Trajectory, rate_hz: float) -> Trajectory:
    times_s = given.times_s - given.times_s[0]
    if len(times_s) < 2 or not (np.diff(times_s) > 0).all():
        raise TwinError(_OPTION, "the times of the poses do not increase", "at least two poses in the order of time")
    at_s = np.arange(int(np.floor(times_s[-1] * rate_hz + 1e-9)) + 1) / rate_hz
    before = np.clip(np.searchsorted(times_s, at_s, side="right") - 1, 0, len(times_s) - 2)
    share = (at_s - times_s[before]) / (times_s[before + 1] - times_s[before])
    poses = [
        a @ geometry.exp(part * geometry.log(geometry.inverse(a) @ b))
        for a, b, part in zip(given.world_from_camera[before], given.world_from_camera[before + 1], share, strict=True)
    ]
    return Trajectory(at_s, np.array(poses))


def _check_clearance(path: Trajectory, mission: Mission) -> None:
    x, y, z = path.positions.T
    above_m = z - mission.terrain.height_at(x, y)
    low = np.flatnonzero(~(above_m >= _LEAST_CLEARANCE_M))
    if len(low):
        k = int(low[0])
        place = "not over the terrain" if np.isnan(above_m[k]) else f"{above_m[k]:.2f} m above the floor"
        problem = f"the camera is {place} at {path.times_s[k]:.2f} s"
        raise TwinError(_OPTION, problem, f"at least {_LEAST_CLEARANCE_M:g} m")


def _twists(world_from_camera: Array, body_from_camera: Array, rate_hz: float) -> Array:
    """Returns the [angular, linear] velocity (n, 6) of the body in its axes, by central differences."""
    bodies, n = world_from_camera @ geometry.inverse(body_from_camera), len(world_from_camera)
    first, last = np.maximum(np.arange(n) - 1, 0), np.minimum(np.arange(n) + 1, n - 1)
    moved = [geometry.log(geometry.inverse(bodies[i]) @ bodies[j]) for i, j in zip(first, last, strict=True)]
    return np.array(moved) * (rate_hz / np.maximum(last - first, 1))[:, None]
