"""The closed loop between two keyframes, compiled: frames of which only motion and readings are simulated."""

from __future__ import annotations

import numpy as np
from numba import njit

from twin.core import geometry
from twin.estimate.navigation.dead_reckoning import dead_reckon
from twin.estimate.pipeline import Navigator
from twin.simulate.compiled_vehicle import CompiledVehicle, advance, body_twist, has_diverged
from twin.simulate.sensors import read_per_frame_sensors
from twin.surrogate.sampling import sample_f2f_motion
from twin.surrogate.vision import SurrogateVision
from twin.world.mission import Course
from twin.world.pilot import RovPilot, steer
from twin.world.world import FastForward, World


def compiled_loop(
    world: World, vehicle: CompiledVehicle, vision: SurrogateVision, navigator: Navigator, pilot: RovPilot
) -> FastForward:
    """Returns the loop of `survey.fly` over all frames up to the next keyframe, as long as F2F can track them.

    Every frame passes the same steps with the same random numbers as in `survey.fly`.
    """
    rate_hz = world.mission.rig.frame_rate_hz
    gauges, n_steps = world.sensors.per_frame_sensors(), round(1 / rate_hz / vehicle.state.timestep_s)

    def fast_forward(course: Course, first: int) -> int:
        errors, ahead = vision.frame_errors, course.keyframe[first:]
        end = first + (int(np.argmax(ahead)) if ahead.any() else len(ahead))
        if errors is None or end == first:
            return first
        n, reference = end - first, tuple(np.asarray(part)[first:end] for part in course.reference)
        numbers = vision.draw_normals(n), *world.sensors.draw_noise(n)
        with world.stopwatch("physics"):
            n, reckoned, true, f2f, online = _fly(
                vision.last_pose, vision.last_normals, vehicle.state, gauges, errors,
                navigator.dead_reckoning, navigator.aiding(1 / rate_hz), pilot.state, reference, numbers, n_steps, rate_hz,
            )  # fmt: skip
        times_s = np.arange(len(world), len(world) + n) / rate_hz
        world.record(true[:n])
        vision.last_pose, vision.last_normals = true[n - 1], numbers[0][n - 1]
        navigator.adopt(reckoned)
        navigator.log.append(times_s, f2f[:n], online[:n])
        vehicle.advance_clock(n / rate_hz)
        return end

    return fast_forward


@njit(cache=True, nogil=True)
def _fly(last, last_numbers, body, gauges, errors, reckoned, instruments, helm, reference, numbers, n_steps, rate_hz):
    """Frames flown (fewer where the physics diverged), reckoning after them, poses (n, 4, 4): true, f2f, online."""
    positions, velocities, yaws, accelerations = reference
    of_vision, of_gauges, of_log = numbers
    n = len(positions)
    true, f2f, online = np.empty((n, 4, 4)), np.empty((n, 4, 4)), np.empty((n, 4, 4))
    for k in range(n):
        geometry.put(true[k], geometry.compose(body.pose, gauges.body_from_camera))
        height, angles, velocity = read_per_frame_sensors(gauges, body.pose, body_twist(body), of_gauges[k], of_log[k])
        a_from_b = sample_f2f_motion(errors, last, true[k], of_vision[k], last_numbers if k == 0 else of_vision[k - 1])
        reckoned, aided = dead_reckon(reckoned, instruments, a_from_b, errors.cov, height, angles, velocity)
        geometry.put(f2f[k], reckoned.f2f)
        geometry.put(online[k], reckoned.online)
        last = true[k]
        twist = geometry.log(aided) * rate_hz
        command = steer(helm, reckoned.online, twist, positions[k], velocities[k], accelerations[k], yaws[k])
        advance(body, command, n_steps)
        if has_diverged(body):
            return k + 1, reckoned, true, f2f, online
    return n, reckoned, true, f2f, online
