"""Trajectory tracking and station keeping: computes thruster commands from the estimated pose and velocity."""

from typing import NamedTuple

import numpy as np

from twin.controllers.allocation import ThrustAllocation, allocate_wrench
from twin.controllers.current_estimate import CurrentEstimate, rotate_to_body, update_current
from twin.controllers.segments import Reference
from twin.core.geometry import Array
from twin.kernels import kernel

ATTITUDE_BANDWIDTH = 2.0  # ratio of attitude to position bandwidth: attitude, the inner loop, must be faster
INTEGRAL_BANDWIDTH = np.array([0.3] * 3 + [1.5] * 3)  # pole of the integral action divided by the natural frequency
INTEGRAL_LIMIT = np.array([2.0, 2.0, 2.0, 1.5, 1.5, 1.5])  # [rad/s2, m/s2]: more than any survey current requires


class HullModel(NamedTuple):
    """Hull model of the controller; (6,) arrays are [rotation about, translation along] the axes of the body."""

    inertia: Array  # (6,) moments of inertia [kg m2] and masses [kg], including added mass
    added_mass: Array  # (3,) added masses along the axes [kg]
    linear_drag: Array  # (6,) coefficients of linear drag [N m s/rad, then N s/m], positive
    quadratic_drag: Array  # (6,) coefficients of quadratic drag [N m s2/rad2, then N s2/m2], positive
    drag_centre_m: Array  # (3,) point at which the drag acts


@kernel
def feedforward_wrench(hull: HullModel, velocity: Array) -> Array:
    """Returns the wrench (6,) that sustains a body velocity (3,) in still water against drag and the Munk moment.

    The Munk moment -v x M_A v (M_A added mass) exceeds the BlueROV2's righting moment in pitch above 0.33 m/s.
    """
    u, v, w = velocity
    x, y, z = hull.added_mass
    drag = (hull.linear_drag[3:] + hull.quadratic_drag[3:] * np.abs(velocity)) * velocity
    a, b, c = hull.drag_centre_m
    moment = b * drag[2] - c * drag[1], c * drag[0] - a * drag[2], a * drag[1] - b * drag[0]
    munk = (z - y) * v * w, (x - z) * w * u, (y - x) * u * v
    return np.array([moment[0] + munk[0], moment[1] + munk[1], moment[2] + munk[2], drag[0], drag[1], drag[2]])


class Gains(NamedTuple):
    """Gains of the pose controller, each (6,) [1/s2, 1/s, 1/s3]."""

    proportional: Array
    derivative: Array
    integral: Array


def pole_placement_gains(natural_frequency_radps: float) -> Gains:
    """Returns the gains that give a free mass on each axis the characteristic polynomial (s + w)^2 (s + a).

    w is the natural frequency for translation and ATTITUDE_BANDWIDTH times that for rotation; a = INTEGRAL_BANDWIDTH w.
    """
    w = natural_frequency_radps * np.array([ATTITUDE_BANDWIDTH] * 3 + [1.0] * 3)
    a = INTEGRAL_BANDWIDTH * w
    return Gains(proportional=w**2 + 2 * w * a, derivative=2 * w + a, integral=a * w**2)


@kernel
def rotate_lever_arm(yaw: float, lever_arm_m: Array) -> Array:
    c, s = np.cos(yaw), np.sin(yaw)
    forward, left, up = lever_arm_m
    return np.array([c * forward - s * left, s * forward + c * left, up])


def commanded_velocity(position: Array, reference: Reference, natural_frequency_radps: float) -> Array:
    return reference.velocity + natural_frequency_radps * (reference.position - position)


class ControllerState(NamedTuple):
    """Parameters and state of the pose controller; `integral` and `flow` are modified in place."""

    hull: HullModel  # hull model
    allocation: ThrustAllocation  # thrust allocation
    gains: Gains  # PID gains
    period_s: float  # time between commands
    lag_s: float  # time by which the measured velocity lags behind the commanded thrust
    #: (6,) integral action [rad/s2 in the body, m/s2 in the world]. The linear part is in the world because current and
    #: buoyancy do not rotate with the vehicle.
    integral: Array
    flow: CurrentEstimate


@kernel
def control_thrusters(controller, pose, twist, position, velocity, acceleration, yaw, is_measured=True):
    """Returns the thruster commands (n,) in [-1, 1] for one period, and updates the integral action in place.

    PID control of position and level attitude, with feed-forward of acceleration and of the drag in the estimated
    current, which is kept unless the motion was measured. From the estimated pose world_from_body (4, 4) and [angular,
    linear] velocity (6,) in the body to the `Reference` of the body in the world.
    """
    if is_measured:
        update_current(controller.flow, controller.hull, pose, twist, controller.period_s)
    else:
        controller.flow.velocity[:] = twist[3:]
    wrench, error = _wrench(
        pose, twist, position, velocity, acceleration, yaw, controller.hull, controller.gains, controller.integral,
        controller.flow.current,
    )  # fmt: skip
    commands, scale = allocate_wrench(controller.allocation, wrench)
    share = controller.period_s / (controller.period_s + controller.lag_s)
    for k in range(3):
        controller.flow.force[k] += share * (scale * wrench[3 + k] - controller.flow.force[k])
    _integrate(controller.integral, controller.gains.integral * controller.period_s, error, scale < 1)
    return commands


@kernel
def _wrench(pose, twist, position, velocity, acceleration, yaw, hull, gains, integral, current):
    """Returns the wrench (6,) [moment, force] in the body, and the integrated error (6,) [body rad, world m]."""
    error = _pose_error(pose, position, yaw)
    velocity_body = rotate_to_body(pose, velocity)
    feedforward = rotate_to_body(pose, integral[3:] + acceleration)
    target = gains.proportional * error - gains.derivative * twist
    for k in range(3):
        target[k] += integral[k]
        target[3 + k] += gains.derivative[3 + k] * velocity_body[k] + feedforward[k]
    wrench = hull.inertia * target + feedforward_wrench(hull, velocity_body - rotate_to_body(pose, current))
    integrated_error = error.copy()
    for i in range(3):
        integrated_error[3 + i] = position[i] - pose[i, 3]
    return wrench, integrated_error


@kernel
def _integrate(integral, gain, error, saturated):
    """Updates the integral in place within INTEGRAL_LIMIT; stops its growth while a thruster saturates: anti-windup."""
    for k in range(6):
        updated = min(max(integral[k] + gain[k] * error[k], -INTEGRAL_LIMIT[k]), INTEGRAL_LIMIT[k])
        if not (saturated and abs(updated) > abs(integral[k])):
            integral[k] = updated


@kernel
def _pose_error(pose, position, yaw):
    """Returns the motion (6,) from the pose to a level reference, [rotation, translation] in the body [rad, m]."""
    c, s = np.cos(yaw), np.sin(yaw)
    # columns of body_from_reference
    x, y = rotate_to_body(pose, np.array([c, s, 0.0])), rotate_to_body(pose, np.array([-s, c, 0.0]))
    z = rotate_to_body(pose, np.array([0.0, 0.0, 1.0]))
    t = rotate_to_body(pose, position - pose[:3, 3])
    # half the antisymmetric part: the rotation vector for small angles, bounded for large ones
    return np.array([0.5 * (y[2] - z[1]), 0.5 * (z[0] - x[2]), 0.5 * (x[1] - y[0]), t[0], t[1], t[2]])
