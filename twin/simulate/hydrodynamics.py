"""Rigid-body and added-mass dynamics of a submerged hull (Fossen 2011, Marine Craft Hydrodynamics, ch. 6 to 8).

    (M_RB + M_A) nu' + C_RB(nu) nu + C_A(nu_r) nu_r + M_A w x R'v_c + D(nu_r) nu_r + g(R) = tau,   nu_r = nu - R'v_c

M_RB is the inertia of the rigid body, M_A that of the added mass; C_RB and C_A are the Coriolis and centripetal
matrices of the two, D is the drag matrix, and -g is the wrench of weight and buoyancy. The twist nu is the [angular,
linear] velocity of the centre of gravity in body axes, w its angular part, and nu' its rate of change; tau is the
thruster wrench [moment, force]. R is the rotation world_from_body, R' its transpose, and v_c the velocity of a steady
current in the world. The fourth term is due to the rate of change of R'v_c when the body rotates; without it, the
dynamics would not be Galilean invariant. The equation is solved for nu' with the total inertia: added-mass forces from
the acceleration of the previous step would be unstable where added mass exceeds mass.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from twin.core.geometry import Array
from twin.kernels import kernel


class Hull(NamedTuple):
    """Parameters of a hull about its centre of gravity, in its principal axes; arrays (6,) have angular parts first."""

    inertia: Array  #: moments of inertia [kg m2], then the mass three times [kg]
    added_inertia: Array  #: added moments of inertia [kg m2], then added masses [kg]
    linear_drag: Array  #: coefficients of linear drag [N m s/rad, then N s/m], positive
    quadratic_drag: Array  #: coefficients of quadratic drag [N m s2/rad2, then N s2/m2], positive
    centre_of_buoyancy_m: Array  #: (3,)
    weight_n: float
    buoyancy_n: float


def angular_first(linear_first: Array) -> Array:
    return np.roll(linear_first, 3, axis=0)


@kernel(inline="always")
def _add_cross(out: Array, at: int, sign: float, a: Array, i: int, b: Array, j: int) -> None:
    """Adds a cross product in place: out[at:at+3] += sign * a[i:i+3] x b[j:j+3]."""
    out[at] += sign * (a[i + 1] * b[j + 2] - a[i + 2] * b[j + 1])
    out[at + 1] += sign * (a[i + 2] * b[j] - a[i] * b[j + 2])
    out[at + 2] += sign * (a[i] * b[j + 1] - a[i + 1] * b[j])


@kernel
def acceleration(hull: Hull, world_from_body: Array, twist: Array, current_mps: Array, wrench: Array) -> Array:
    """Returns the acceleration nu' (6,) in body axes, which solves the equation of motion [rad/s2, m/s2].

    Args:
        world_from_body: (3, 3) rotation.
        twist: (6,) [angular, linear] velocity in body axes [rad/s, m/s].
        current_mps: (3,) velocity of the steady current in the world.
        wrench: (6,) [moment, force] of the thrusters in body axes [N m, N].
    """
    flow = np.zeros(6)  # R'v_c
    up = np.zeros(3)
    for k in range(3):
        up[k] = world_from_body[2, k]
        for i in range(3):
            flow[3 + k] += world_from_body[i, k] * current_mps[i]
    relative = twist - flow
    momentum, added_momentum = hull.inertia * twist, hull.added_inertia * relative
    added_flow = np.zeros(6)
    _add_cross(added_flow, 3, 1.0, twist, 0, flow, 3)
    drag = (hull.linear_drag + hull.quadratic_drag * np.abs(relative)) * relative
    force = wrench - drag - hull.added_inertia * added_flow
    for p in (momentum, added_momentum):
        _add_cross(force, 0, -1.0, twist, 0, p, 0)
        _add_cross(force, 3, -1.0, twist, 0, p, 3)
    _add_cross(force, 0, -1.0, relative, 3, added_momentum, 3)  # Munk moment; zero for the rigid body
    _add_cross(force, 0, hull.buoyancy_n, hull.centre_of_buoyancy_m, 0, up, 0)
    for k in range(3):
        force[3 + k] += (hull.buoyancy_n - hull.weight_n) * up[k]
    return force / (hull.inertia + hull.added_inertia)


@kernel
def free_joint_acceleration(
    hull: Hull, world_from_body: Array, velocity: Array, current_mps: Array, wrench: Array
) -> Array:
    """Returns the `acceleration` (6,) in the velocity coordinates of MuJoCo's free joint [m/s2, rad/s2].

    These are [linear in world axes, angular in body axes], as those of `velocity`. The linear part is R (v' + w x v),
    with R = `world_from_body`, v the linear and w the angular velocity in body axes, and v' the rate of change of v.
    """
    twist = twist_from_free_joint(world_from_body, velocity)
    body_acceleration = acceleration(hull, world_from_body, twist, current_mps, wrench)
    _add_cross(body_acceleration, 3, 1.0, twist, 0, twist, 3)
    result = np.zeros(6)
    for i in range(3):
        result[3 + i] = body_acceleration[i]
        for k in range(3):
            result[i] += world_from_body[i, k] * body_acceleration[3 + k]
    return result


@kernel
def twist_from_free_joint(world_from_body: Array, velocity: Array) -> Array:
    """Returns the [angular, linear] velocity (6,) in body axes from the velocity (6,) of a free joint of MuJoCo."""
    twist = np.zeros(6)
    for k in range(3):
        twist[k] = velocity[3 + k]
        for i in range(3):
            twist[3 + k] += world_from_body[i, k] * velocity[i]
    return twist
