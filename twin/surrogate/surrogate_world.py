"""Simulated world without images, objects and overhangs; vehicle and sensors are modelled as in `RenderedWorld`.

The closed loop of vehicle, sensors, navigator and pilot over the frames between two keyframes is compiled.
"""

from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.height_field import HeightField, cast_pixels
from twin.core.records import StereoRig
from twin.core.timing import StageTimer
from twin.estimate.navigation.pose_filter import dead_reckon
from twin.estimate.pipeline import Navigator
from twin.kernels import kernel
from twin.simulate.compiled_vehicle import CompiledVehicle, advance, body_twist, has_ended
from twin.simulate.hull import physics_timestep_s, whole_timesteps
from twin.simulate.kinematic_vehicle import KinematicVehicle
from twin.simulate.sea import make_sea
from twin.simulate.sensors import NavigationSensors, read_per_frame_sensors
from twin.simulate.tether import tether_of
from twin.surrogate.coverage import RENDERED, survey_conditions, unmodelled
from twin.surrogate.error_model_file import FittedErrorModel
from twin.surrogate.matchability import Matchability
from twin.surrogate.sampling import sample_f2f_motion
from twin.surrogate.vision import SurrogateVision
from twin.world.mission import FrameSequence, Mission, Step
from twin.world.obstacles import Obstacles, floor_of
from twin.world.pilot import PilotOfEstimates, RovPilot, steer
from twin.world.world import CameraImages, FastForward, World, left_camera, streams

_BLANK: NDArray[np.uint8] = np.zeros((0, 0, 3), np.uint8)  # placeholder: an image without pixels


class SurrogateWorld(World):
    """World whose visual measurements are sampled from an error model.

    Raises UnmodelledError outside the range of the fit without `imaging.extrapolate`, or if marine snow prevents all
    matches.
    """

    def __init__(self, mission: Mission, stopwatch: StageTimer, fitted: FittedErrorModel):
        scenario, rig, rng = mission.scenario, mission.rig, streams(mission.scenario.seed)
        if scenario.vehicle.dynamics == "rigid":
            vehicle = CompiledVehicle(
                scenario.vehicle, make_sea(scenario, rng["sea"]), mission.start_of_body,
                physics_timestep_s(rig.frame_rate_hz, scenario.vehicle), floor_of(mission),
                tether_of(scenario.tether, mission.start_of_body[:3, 3]), mission.start_velocity_mps,
            )  # fmt: skip
        else:
            vehicle = KinematicVehicle(mission.start_of_body)
            self._obstacles = Obstacles(replace(mission, objects=()))
            vehicle.touched = self._obstacles.touched
        noise, project = scenario.believed_noise(), mission.true_cameras.project
        sensors = NavigationSensors(scenario.navigation, noise, rig, rng, project)
        super().__init__(mission, stopwatch, vehicle, sensors)
        # `vision` must not hold a reference to `self`: the reference cycle would keep the survey in memory
        true_pose = partial(left_camera, vehicle, rig)
        self.vision = SurrogateVision(mission, fitted.model, true_pose, stopwatch)
        self.warnings = _extrapolations(mission, fitted, self.vision.matchability)
        if mission.objects:
            self.warnings += ("The surrogate surveys the bare sea floor: it does not simulate [[objects]].",)
        if mission.mesh_floor is not None:
            self.warnings += ("The surrogate surveys the highest surface of the mesh: it simulates no overhangs.",)

    @property
    def made_anew(self) -> tuple[object, ...]:
        floor = self.vehicle.state.floor if isinstance(self.vehicle, CompiledVehicle) else self._obstacles
        return (*super().made_anew, floor, self.vision.floor, self.vision.matchability)

    def capture(self, step: Step) -> CameraImages:
        pose, rig = self.world_from_camera, self.mission.rig
        return CameraImages(
            _BLANK, _BLANK if step.keyframe else None, lambda: _depth_image(self.vision.floor, pose, rig)
        )

    def fast_forward(self, navigator: Navigator, pilot: PilotOfEstimates) -> FastForward:
        own = navigator.vision is self.vision
        if own and not self.faults.exist and isinstance(self.vehicle, CompiledVehicle) and isinstance(pilot, RovPilot):
            return _compiled_loop(self, self.vehicle, self.vision, navigator, pilot)
        return super().fast_forward(navigator, pilot)

    def seen(self) -> NDArray[np.bool_]:
        return self.vision.map_model.seen


def _depth_image(floor: HeightField, world_from_camera: Array, rig: StereoRig) -> NDArray[np.float32]:
    """Returns the depth image (height_px, width_px) along the optical axis [m]; inf where rays miss the floor."""
    rows, cols = np.indices((rig.height_px, rig.width_px), dtype=np.float64)
    depth = cast_pixels(floor, world_from_camera[None], rig, np.column_stack([cols.ravel(), rows.ravel()]))
    return depth.reshape(rows.shape).astype(np.float32)


def _extrapolations(mission: Mission, fitted: FittedErrorModel, matchability: Matchability) -> tuple[str, ...]:
    """Returns a warning if the survey lies outside the range of the fit; see `SurrogateWorld`."""
    found = fitted.quantities_outside_fit(survey_conditions(mission, matchability))
    if found and not mission.scenario.imaging.extrapolate:
        problem = "the error model of the surrogate does not hold for this survey"
        texts = ((f"{problem}: {values}", f"{allowed}, or {RENDERED}, or --extrapolate") for values, allowed in found)
        raise unmodelled(mission, texts)
    texts = "; ".join(f"{values} ({allowed})" for values, allowed in found)
    return (f"The surrogate extrapolates outside the range of its error model: {texts}.",) if found else ()


def _compiled_loop(
    world: World, vehicle: CompiledVehicle, vision: SurrogateVision, navigator: Navigator, pilot: RovPilot
) -> FastForward:
    """Returns a function that runs the compiled closed loop from a given frame up to the next keyframe."""
    # same operations and random numbers as `survey.fly`; it returns the next frame to simulate (a keyframe, the number
    # of frames, or the given one if F2F has no points to track). If the physics diverges or the hull touches the floor,
    # the frames up to the one after which this was detected are recorded, and SurveyAborted is raised.
    rate_hz = world.mission.rig.frame_rate_hz
    interval_s = 1 / rate_hz
    sensors, n_steps = world.sensors.per_frame, whole_timesteps(interval_s, vehicle.state.timestep_s)

    def fast_forward(sequence: FrameSequence, first: int) -> int:
        errors, ahead = vision.frame_errors, sequence.keyframe[first:]
        end = first + (int(np.argmax(ahead)) if ahead.any() else len(ahead))
        if errors is None or end == first:
            return first
        n, reference = end - first, tuple(np.asarray(part)[first:end] for part in sequence.reference)
        numbers = vision.draw_normals(n), *world.sensors.draw_noise(n)
        with world.stopwatch("physics"):
            n, state, true, f2f, online, steps, variances = _fly(
                vision.last_pose, vision.last_normals, vehicle.state, sensors, errors,
                navigator.filter.state, navigator.filter.aiding(interval_s), pilot.state, reference, numbers, n_steps,
                interval_s,
            )  # fmt: skip
        times_s = np.arange(len(world), len(world) + n) / rate_hz
        world.record(true[:n])
        vision.last_pose, vision.last_normals = true[n - 1], numbers[0][n - 1]
        navigator.filter.state = state
        navigator.log.append(times_s, f2f[:n], online[:n], steps[:n], variances[:n])
        vehicle.advance_clock(n / rate_hz)
        return first + n

    return fast_forward


@kernel
def _fly(last, last_normals, body, sensors, errors, state, aiding, pilot, reference, normals, n_steps, interval_s):
    """Runs the closed loop over at most n frames, until `has_ended`."""
    # returns the number of simulated frames, the dead-reckoning state after the last one, the poses (n, 4, 4), true, by
    # F2F alone and online, and `PoseLog.steps` with variances (n, 6); only simulated frames are set
    positions, velocities, yaws, accelerations = reference
    vision_normals, sensor_normals, dvl_normals = normals
    n = len(positions)
    true, f2f, online = np.empty((n, 4, 4)), np.empty((n, 4, 4)), np.empty((n, 4, 4))
    steps, variances = np.empty((n, 6)), np.empty((n, 6))
    for k in range(n):
        geometry.copy_into(true[k], geometry.compose(body.pose, sensors.body_from_camera))
        twist = body_twist(body.pose, body.velocity, body.acceleration, body.timestep_s)
        height, angles, velocity = read_per_frame_sensors(sensors, body.pose, twist, sensor_normals[k], dvl_normals[k])
        a_from_b = sample_f2f_motion(
            errors, last, true[k], vision_normals[k], last_normals if k == 0 else vision_normals[k - 1]
        )
        state, motion = dead_reckon(state, aiding, a_from_b, errors.cov, height, angles, velocity)
        geometry.copy_into(steps[k], geometry.log(a_from_b))
        geometry.copy_into(variances[k], np.diag(errors.cov))
        geometry.copy_into(f2f[k], state.f2f)
        geometry.copy_into(online[k], state.online)
        last = true[k]
        twist = geometry.log(motion) * (1 / interval_s)  # bit-identical to `Navigator.update`
        command = steer(pilot, state.online, twist, positions[k], velocities[k], accelerations[k], yaws[k])
        advance(body, command, n_steps)
        if has_ended(body.velocity, body.left):
            return k + 1, state, true, f2f, online, steps, variances
    return n, state, true, f2f, online, steps, variances
