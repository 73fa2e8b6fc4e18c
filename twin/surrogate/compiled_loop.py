"""Compiled closed loop of vehicle, sensors, navigator and pilot over the frames between two keyframes."""

import numpy as np

from twin.core import geometry
from twin.estimate.navigation.pose_filter import dead_reckon
from twin.estimate.pipeline import Navigator
from twin.kernels import kernel
from twin.simulate.compiled_vehicle import CompiledVehicle, advance, body_twist, has_ended
from twin.simulate.hull import whole_timesteps
from twin.simulate.sensors import read_per_frame_sensors
from twin.surrogate.sampling import sample_f2f_motion
from twin.surrogate.vision import SurrogateVision
from twin.world.mission import FrameSequence
from twin.world.pilot import RovPilot, steer
from twin.world.world import FastForward, World


def compiled_loop(
    world: World, vehicle: CompiledVehicle, vision: SurrogateVision, navigator: Navigator, pilot: RovPilot
) -> FastForward:
    """Returns a function that runs the compiled closed loop from a given frame up to the next keyframe.

    It performs the same operations with the same random numbers as the loop in `survey.fly`, and returns the index of
    the next frame to simulate: that of the next keyframe or, without one, the number of frames; the given one if F2F
    has no points to track. If the physics diverges or the hull touches the floor, the frames up to the one after which
    this was detected are recorded, and SurveyAborted is raised.
    """
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
