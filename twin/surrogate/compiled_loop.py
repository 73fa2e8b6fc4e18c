"""The closed loop between two keyframes, compiled: frames of which only motion and readings are told."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numba import njit

from twin.core import geometry
from twin.estimate.navigation.dead_reckoning import reckon
from twin.estimate.pipeline import Navigator
from twin.simulate.free_body import FreeBody, advance, is_lost, twist_of
from twin.simulate.sensors import read_gauges
from twin.surrogate.sampling import moved
from twin.surrogate.vision import SurrogateVision
from twin.world.mission import Course
from twin.world.pilot import RovPilot, steer

if TYPE_CHECKING:
    from twin.surrogate.surrogate_world import SurrogateWorld
    from twin.world.world import Glide


def compiled(
    world: SurrogateWorld, vehicle: FreeBody, vision: SurrogateVision, navigator: Navigator, pilot: RovPilot
) -> Glide:
    """What `survey.fly` does with each frame, for all frames up to the next keyframe, where F2F can follow them.

    Every step is the one that a single frame takes, and so are the numbers drawn for it.
    """
    rate_hz = world.mission.rig.frame_rate_hz
    gauges, n_steps = world.sensors.gauges(), round(1 / rate_hz / vehicle.body.timestep_s)

    def glide(course: Course, first: int) -> int:
        errors, ahead = vision.following, course.keyframe[first:]
        end = first + (int(np.argmax(ahead)) if ahead.any() else len(ahead))
        if errors is None or end == first:
            return first
        n, reference = end - first, tuple(np.asarray(part)[first:end] for part in course.reference)
        numbers = vision.draw(n), *world.sensors.noise(n)
        with world.watch("physics"):
            n, reckoned, true, f2f, online = _fly(
                vision.last_pose, vision.last_numbers, vehicle.body, gauges, errors,
                navigator.reckoning, navigator.instruments, pilot.helm, reference, numbers, n_steps, rate_hz,
            )  # fmt: skip
        times_s = np.arange(len(world), len(world) + n) / rate_hz
        world.record(true[:n])
        vision.last_pose, vision.last_numbers = true[n - 1], numbers[0][n - 1]
        navigator.go_on(reckoned)
        navigator.record(times_s, f2f[:n], online[:n])
        vehicle.passed(n / rate_hz)
        return end

    return glide


@njit(cache=True, nogil=True)
def _fly(last, last_numbers, body, gauges, errors, reckoned, instruments, helm, reference, numbers, n_steps, rate_hz):
    """Frames flown (fewer where the physics diverged), reckoning after them, poses (n, 4, 4): true, f2f, online."""
    positions, velocities, yaws, accelerations = reference
    of_vision, of_gauges, of_log = numbers
    n = len(positions)
    true, f2f, online = np.empty((n, 4, 4)), np.empty((n, 4, 4)), np.empty((n, 4, 4))
    for k in range(n):
        geometry.put(true[k], geometry.compose(body.pose, gauges.body_from_camera))
        height, angles, velocity = read_gauges(gauges, body.pose, twist_of(body), of_gauges[k], of_log[k])
        a_from_b = moved(errors, last, true[k], of_vision[k], last_numbers if k == 0 else of_vision[k - 1])
        reckoned, aided = reckon(reckoned, instruments, a_from_b, errors.cov, height, angles, velocity)
        geometry.put(f2f[k], reckoned.f2f)
        geometry.put(online[k], reckoned.online)
        last = true[k]
        twist = geometry.log(aided) * rate_hz
        command = steer(helm, reckoned.online, twist, positions[k], velocities[k], accelerations[k], yaws[k])
        advance(body, command, n_steps)
        if is_lost(body):
            return k + 1, reckoned, true, f2f, online
    return n, reckoned, true, f2f, online
