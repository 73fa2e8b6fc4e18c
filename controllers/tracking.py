"""Trajectory following and station keeping: from where the vehicle believes it is to the commands of its thrusters."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from controllers.allocation import Allocation, share_out
from controllers.segments import Reference

Array = NDArray[np.float64]

ATTITUDE_BANDWIDTH = 2.0  # of attitude over position: the inner loop must be the faster one
INTEGRAL_BANDWIDTH = np.array([0.3] * 3 + [1.5] * 3)  # of the integral's pole over the natural frequency
INTEGRAL_LIMIT = np.array([2.0, 2.0, 2.0, 1.5, 1.5, 1.5])  # [rad/s2, m/s2]: more than any current worth flying in asks


class HullModel(NamedTuple):
    """What the controller believes about the hull; each (6,), about and along the body's x, y, z axes.

    Args:
        inertia: moments of inertia [kg m2] and masses [kg], with added mass.
        added_mass: (3,) the added masses alone [kg].
        linear_drag: [N m s/rad], [N s/m], positive.
        quadratic_drag: [N m s2/rad2], [N s2/m2], positive.
    """

    inertia: Array
    added_mass: Array
    linear_drag: Array
    quadratic_drag: Array


@njit(cache=True, nogil=True)
def cruise_wrench(hull: HullModel, velocity: Array) -> Array:
    """The wrench (6,) that keeps up a velocity (3,) in still water: drag, and v x M_A v against the Munk moment.

    The Munk moment turns a hull broadside. At survey speed it outweighs this vehicle's righting moment in pitch.
    """
    u, v, w = velocity
    x, y, z = hull.added_mass
    drag = (hull.linear_drag[3:] + hull.quadratic_drag[3:] * np.abs(velocity)) * velocity
    return np.array([(z - y) * v * w, (x - z) * w * u, (y - x) * u * v, drag[0], drag[1], drag[2]])


class Gains(NamedTuple):
    """Gains of error, its rate and its integral, each (6,) [1/s2, 1/s, 1/s3]."""

    error: Array
    rate: Array
    integral: Array


def critical_gains(natural_frequency_radps: float) -> Gains:
    """Gains that give a free mass the poles (s + w)^2 (s + a), a = INTEGRAL_BANDWIDTH w, on each axis."""
    w = natural_frequency_radps * np.array([ATTITUDE_BANDWIDTH] * 3 + [1.0] * 3)
    a = INTEGRAL_BANDWIDTH * w
    return Gains(error=w**2 + 2 * w * a, rate=2 * w + a, integral=a * w**2)


def body_reference(camera: Reference, lever_arm_m: Array) -> Reference:
    """Where a level body shall be so that a point of it (3,) [m, in the body] follows its own reference."""
    return camera._replace(position=camera.position - level_arm(float(camera.yaw), lever_arm_m))


@njit(cache=True, nogil=True)
def level_arm(yaw: float, lever_arm_m: Array) -> Array:
    """From a level body to a point of it (3,) [m, in the body], in the world."""
    c, s = np.cos(yaw), np.sin(yaw)
    forward, left, up = lever_arm_m
    return np.array([c * forward - s * left, s * forward + c * left, up])


def commanded_velocity(position: Array, reference: Reference, natural_frequency_radps: float) -> Array:
    """Velocity (3,) [m/s] that takes a point to its reference: along with it, and back to it in a time 1 / w."""
    return reference.velocity + natural_frequency_radps * (reference.position - position)


class Steering(NamedTuple):
    """What a pilot goes by.

    Args:
        hull: the believed hull.
        allocation: of the thrusters.
        gains: of its errors.
        period_s: time between commands.
        integral: (6,) of its errors [rad/s2 in the body, m/s2 in the world: currents and buoyancy do not turn with
            us], changed in place.
    """

    hull: HullModel
    allocation: Allocation
    gains: Gains
    period_s: float
    integral: Array


class Pilot:
    """Follows a reference of the body with level attitude: feed-forward of drag and acceleration, PD and integral.

    Args:
        hull: the believed hull.
        allocation: of the thrusters.
        natural_frequency_radps: closed-loop bandwidth of position.
        period_s: time between commands.
    """

    def __init__(self, hull: HullModel, allocation: Allocation, natural_frequency_radps: float, period_s: float):
        self.steering = Steering(hull, allocation, critical_gains(natural_frequency_radps), period_s, np.zeros(6))

    def command(self, world_from_body: Array, twist_body: Array, reference: Reference) -> Array:
        """Thruster commands in [-1, 1] (n,) for one period.

        Args:
            world_from_body: (4, 4) estimated pose.
            twist_body: (6,) estimated [angular, linear] velocity in the body [rad/s, m/s].
            reference: of the body, in the world.
        """
        return commanded(
            self.steering, world_from_body, twist_body, reference.position, reference.velocity,
            reference.acceleration, float(reference.yaw),
        )  # fmt: skip


@njit(cache=True, nogil=True)
def commanded(steering, pose, twist, position, velocity, acceleration, yaw):
    """As `Pilot.command`."""
    wrench, error = _wrench(
        pose, twist, position, velocity, acceleration, yaw, steering.hull, steering.gains, steering.integral
    )
    commands, share = share_out(steering.allocation, wrench)
    _integrate(steering.integral, steering.gains.integral * steering.period_s, error, share < 1)
    return commands


@njit(cache=True, nogil=True)
def _wrench(pose, twist, position, velocity, acceleration, yaw, hull, gains, integral):
    """Wrench [moment, force] in the body (6,), and the error behind it, [rotation in the body, way in the world]."""
    error = _pose_error(pose, position, yaw)
    ahead = _into_body(pose, velocity)
    push = _into_body(pose, integral[3:] + acceleration)
    wanted = gains.error * error - gains.rate * twist
    for k in range(3):
        wanted[k] += integral[k]
        wanted[3 + k] += gains.rate[3 + k] * ahead[k] + push[k]
    wrench = hull.inertia * wanted + cruise_wrench(hull, ahead)
    in_world = error.copy()
    for i in range(3):
        in_world[3 + i] = position[i] - pose[i, 3]
    return wrench, in_world


@njit(cache=True, nogil=True)
def _integrate(integral, gain, error, saturated):
    """Lets the integral grow within its limits; while the thrusters saturate it may only shrink (anti-windup)."""
    for k in range(6):
        grown = min(max(integral[k] + gain[k] * error[k], -INTEGRAL_LIMIT[k]), INTEGRAL_LIMIT[k])
        if not (saturated and abs(grown) > abs(integral[k])):
            integral[k] = grown


@njit(cache=True, nogil=True)
def _into_body(pose, vector):
    """A vector (3,) of the world in the axes of a body."""
    result = np.zeros(3)
    for i in range(3):
        for k in range(3):
            result[i] += pose[k, i] * vector[k]
    return result


@njit(cache=True, nogil=True)
def _pose_error(pose, position, yaw):
    """What is missing from the pose to a level reference, [rotation, translation] in the body [rad, m]. -> (6,)."""
    c, s = np.cos(yaw), np.sin(yaw)
    # of body_from_wanted, column by column: the body's axes seen from the level reference
    x, y = _into_body(pose, np.array([c, s, 0.0])), _into_body(pose, np.array([-s, c, 0.0]))
    z = _into_body(pose, np.array([0.0, 0.0, 1.0]))
    way = _into_body(pose, position - pose[:3, 3])
    # half the antisymmetric part: the rotation vector for small angles, bounded for large ones
    return np.array([0.5 * (y[2] - z[1]), 0.5 * (z[0] - x[2]), 0.5 * (x[1] - y[0]), way[0], way[1], way[2]])
