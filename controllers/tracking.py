"""Trajectory following and station keeping: from where the vehicle believes it is to the commands of its thrusters."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from controllers.allocation import Allocation
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

    def cruise_wrench(self, velocity: Array) -> Array:
        """The wrench that keeps up a velocity (3,) in still water: drag, and v x M_A v against the Munk moment.

        The Munk moment turns a hull broadside. At survey speed it outweighs this vehicle's righting moment in pitch.
        """
        drag = (self.linear_drag[3:] + self.quadratic_drag[3:] * np.abs(velocity)) * velocity
        (u, v, w), (m_x, m_y, m_z) = velocity, self.added_mass
        return np.array([(m_z - m_y) * v * w, (m_x - m_z) * w * u, (m_y - m_x) * u * v, *drag])


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
    c, s = np.cos(camera.yaw), np.sin(camera.yaw)
    forward, left, up = lever_arm_m
    offset = np.array([c * forward - s * left, s * forward + c * left, up])
    return camera._replace(position=camera.position - offset)


def commanded_velocity(position: Array, reference: Reference, natural_frequency_radps: float) -> Array:
    """Velocity (3,) [m/s] that takes a point to its reference: along with it, and back to it in a time 1 / w."""
    return reference.velocity + natural_frequency_radps * (reference.position - position)


class Pilot:
    """Follows a reference of the body with level attitude: feed-forward of drag and acceleration, PD and integral.

    Args:
        hull: the believed hull.
        allocation: of the thrusters.
        natural_frequency_radps: closed-loop bandwidth of position.
        period_s: time between commands.
    """

    def __init__(self, hull: HullModel, allocation: Allocation, natural_frequency_radps: float, period_s: float):
        self._hull, self._allocation, self._period_s = hull, allocation, period_s
        self._gains = critical_gains(natural_frequency_radps)
        self._integral = np.zeros(
            6
        )  # [rad/s2 in the body, m/s2 in the world]: currents and buoyancy do not turn with us

    def command(self, world_from_body: Array, twist_body: Array, reference: Reference) -> Array:
        """Thruster commands in [-1, 1] (n,) for one period.

        Args:
            world_from_body: (4, 4) estimated pose.
            twist_body: (6,) estimated [angular, linear] velocity in the body [rad/s, m/s].
            reference: of the body, in the world.
        """
        rotation = world_from_body[:3, :3]
        error = _pose_error(world_from_body, reference)
        velocity = reference.velocity @ rotation
        rate_error = np.concatenate([np.zeros(3), velocity]) - twist_body
        acceleration = self._gains.error * error + self._gains.rate * rate_error
        acceleration += np.concatenate([self._integral[:3], (self._integral[3:] + reference.acceleration) @ rotation])
        wrench = self._hull.inertia * acceleration + self._hull.cruise_wrench(velocity)
        commands, share = self._allocation.commands(wrench)
        self._integrate(np.concatenate([error[:3], rotation @ error[3:]]), saturated=share < 1)
        return commands

    def _integrate(self, error: Array, saturated: bool) -> None:
        """Grows the integral within its limits; while the thrusters saturate it may only shrink (anti-windup)."""
        grown = self._integral + self._gains.integral * error * self._period_s
        grown = np.clip(grown, -INTEGRAL_LIMIT, INTEGRAL_LIMIT)
        held = saturated & (np.abs(grown) > np.abs(self._integral))
        self._integral = np.where(held, self._integral, grown)


def _pose_error(world_from_body: Array, reference: Reference) -> Array:
    """What is missing from the pose to a level reference, [rotation, translation] in the body [rad, m]. -> (6,)."""
    c, s = np.cos(reference.yaw), np.sin(reference.yaw)
    wanted = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    rotation = world_from_body[:3, :3]
    turn = rotation.T @ wanted
    # half the antisymmetric part: the rotation vector for small angles, bounded for large ones
    angles = 0.5 * np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    return np.concatenate([angles, (reference.position - world_from_body[:3, 3]) @ rotation])
