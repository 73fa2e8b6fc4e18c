"""Rigid-body and added-mass dynamics of a submerged hull (Fossen 2011, Marine Craft Hydrodynamics, ch. 6 to 8).

    (M_RB + M_A) nu' + C_RB(nu) nu + C_A(nu_r) nu_r + M_A w x R'v_c + D(nu_r) nu_r + g(R) = tau,   nu_r = nu - R'v_c

Twists are [angular, linear] velocity of the centre of gravity in body axes, wrenches [moment, force]. The fifth term is
M_A times what the body's rotation does to a steady current seen in body axes: without it the same motion would feel
other forces in a moving body of water than in a still one. Added mass is solved for, never fed back from the last
step's acceleration, which is unstable once it exceeds the mass.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Hull(NamedTuple):
    """A hull whose axes are its principal axes, origin in the centre of gravity.

    Args:
        inertia: (6,) moments of inertia [kg m2], then the mass three times [kg].
        added: (6,) added moments of inertia [kg m2], then added masses [kg].
        linear_drag: (6,) [N m s/rad], [N s/m], positive.
        quadratic_drag: (6,) [N m s2/rad2], [N s2/m2], positive.
        centre_of_buoyancy_m: (3,) in the body.
        weight_n, buoyancy_n: whole weight and whole buoyancy.
    """

    inertia: Array
    added: Array
    linear_drag: Array
    quadratic_drag: Array
    centre_of_buoyancy_m: Array
    weight_n: float
    buoyancy_n: float


def angular_first(linear_first: Array) -> Array:
    """[roll, pitch, yaw, surge, sway, heave] of [surge, sway, heave, roll, pitch, yaw]: (6, ...) -> (6, ...)."""
    return np.roll(linear_first, 3, axis=0)


@njit(cache=True, nogil=True, inline="always")
def _add_cross(out: Array, at: int, sign: float, a: Array, i: int, b: Array, j: int) -> None:
    """out[at:at+3] += sign * a[i:i+3] x b[j:j+3]"""
    out[at] += sign * (a[i + 1] * b[j + 2] - a[i + 2] * b[j + 1])
    out[at + 1] += sign * (a[i + 2] * b[j] - a[i] * b[j + 2])
    out[at + 2] += sign * (a[i] * b[j + 1] - a[i + 1] * b[j])


@njit(cache=True, nogil=True)
def acceleration(hull: Hull, world_from_body: Array, twist: Array, current_mps: Array, wrench: Array) -> Array:
    """Solves the equation of motion for nu' in body axes [rad/s2, m/s2].

    Args:
        hull: the hull.
        world_from_body: (3, 3) rotation.
        twist: (6,) [angular, linear] velocity in the body [rad/s, m/s].
        current_mps: (3,) steady current in the world.
        wrench: (6,) of the thrusters in the body [N m, N].
    """
    flow = np.zeros(6)  # R'v_c
    up = np.zeros(3)
    for k in range(3):
        up[k] = world_from_body[2, k]
        for i in range(3):
            flow[3 + k] += world_from_body[i, k] * current_mps[i]
    relative = twist - flow
    momentum, added_momentum = hull.inertia * twist, hull.added * relative
    added_flow = np.zeros(6)
    _add_cross(added_flow, 3, 1.0, twist, 0, flow, 3)
    force = wrench - (hull.linear_drag + hull.quadratic_drag * np.abs(relative)) * relative - hull.added * added_flow
    for p in (momentum, added_momentum):
        _add_cross(force, 0, -1.0, twist, 0, p, 0)
        _add_cross(force, 3, -1.0, twist, 0, p, 3)
    _add_cross(force, 0, -1.0, relative, 3, added_momentum, 3)  # Munk moment; zero for the rigid body
    _add_cross(force, 0, hull.buoyancy_n, hull.centre_of_buoyancy_m, 0, up, 0)
    for k in range(3):
        force[3 + k] += (hull.buoyancy_n - hull.weight_n) * up[k]
    return force / (hull.inertia + hull.added)


@njit(cache=True, nogil=True)
def free_joint_acceleration(
    hull: Hull, world_from_body: Array, velocity: Array, current_mps: Array, wrench: Array
) -> Array:
    """The same acceleration in the velocity coordinates of MuJoCo's free joint [m/s2, rad/s2].

    Their order is [linear in the world, angular in the body], so the linear part is R (v' + w x v).

    Args:
        velocity: (6,) of the free joint [m/s, rad/s]; the others as in `acceleration`.
    """
    twist = twist_of_free_joint(world_from_body, velocity)
    rate = acceleration(hull, world_from_body, twist, current_mps, wrench)
    _add_cross(rate, 3, 1.0, twist, 0, twist, 3)
    result = np.zeros(6)
    for i in range(3):
        result[3 + i] = rate[i]
        for k in range(3):
            result[i] += world_from_body[i, k] * rate[3 + k]
    return result


@njit(cache=True, nogil=True)
def twist_of_free_joint(world_from_body: Array, velocity: Array) -> Array:
    """Twist [angular, linear] in the body (6,) of a free joint's velocity [linear in world, angular in body]."""
    twist = np.zeros(6)
    for k in range(3):
        twist[k] = velocity[3 + k]
        for i in range(3):
            twist[3 + k] += world_from_body[i, k] * velocity[i]
    return twist


def mechanical_energy(hull: Hull, world_from_body: Array, position_m: Array, twist: Array) -> float:
    """Kinetic energy of body and entrained still water plus potential of weight and buoyancy [J]; position (3,) [m]."""
    centre_z = position_m[2] + float(world_from_body[2] @ hull.centre_of_buoyancy_m)
    kinetic = 0.5 * float((hull.inertia + hull.added) @ twist**2)
    return kinetic + hull.weight_n * float(position_m[2]) - hull.buoyancy_n * centre_z
