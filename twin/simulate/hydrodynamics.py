"""Rigid-body and added-mass dynamics of a submerged hull (Fossen 2011, Marine Craft Hydrodynamics, ch. 6 to 8).

    (M_RB + M_A) nu' + C_RB(nu) nu + C_A(nu_r) nu_r + M_A (w x R'v_c - R'a_v) + D(nu_r) nu_r + g(R) = tau + m_w R'a_w,
    nu_r = nu - R'v_c

M_RB is the inertia of the rigid body, M_A that of the added mass; C_RB and C_A are the Coriolis and centripetal
matrices of the two, D is the drag matrix, and -g is the wrench of weight and buoyancy. The twist nu is the [angular,
linear] velocity of the centre of gravity in body axes, w its angular part, and nu' its rate of change; tau is the
thruster wrench [moment, force]. R is the rotation world_from_body, R' its transpose, and v_c the velocity of the water
at the centre of gravity, in the world. The fourth term is the rate of change of R'v_c: by rotation of the body (without
it, the dynamics would not be Galilean invariant), and by the change a_v of v_c along the path of the body. The last one
is the force on the displaced water of mass m_w, which has the acceleration a_w (Froude-Krylov); it acts at the centre
of buoyancy. The velocity of the water varies little over the hull. The equation is solved for nu' with the total
inertia: added-mass forces from the acceleration of the previous step would be unstable where added mass exceeds mass.
"""

from typing import NamedTuple

import numpy as np

from twin.core.geometry import Array
from twin.kernels import kernel

GRAVITY_MPS2 = 9.81


class Hull(NamedTuple):
    """Parameters of a hull about its centre of gravity, in its principal axes; arrays have angular parts first."""

    inertia: Array  #: (6,) moments of inertia [kg m2], then the mass three times [kg]
    added_inertia: Array  #: (6, 6) added mass matrix [kg m2, kg m, kg]
    #: (6, 6) matrices of linear and quadratic drag, positive on their diagonals; column j of the latter is multiplied
    #: by the square of component j of the velocity, with its sign.
    linear_drag: Array
    quadratic_drag: Array
    drag_centre_m: Array  #: (3,) point whose velocity through the water determines the drag, and at which it acts
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
def acceleration(hull: Hull, world_from_body: Array, twist: Array, flow: Array, wrench: Array) -> Array:
    """Returns nu' (6,) in body axes, which solves the equation of motion [rad/s2, m/s2]."""
    # at a rotation (3, 3), twist (6,) in the body, flow (5, 3) of `sea.flow_at`, wrench (6,) of thrusters [N m, N]
    current = np.zeros(6)  # R'v_c
    up = np.zeros(3)
    for k in range(3):
        up[k] = world_from_body[2, k]
        for i in range(3):
            current[3 + k] += world_from_body[i, k] * flow[0, i]
    relative = twist - current
    momentum, added_momentum = hull.inertia * twist, np.zeros(6)
    added_flow, rate = np.zeros(6), np.zeros(6)  # rate: - w x R'v_c
    _add_cross(rate, 3, -1.0, twist, 0, current, 3)
    for i in range(6):
        for k in range(6):
            added_momentum[i] += hull.added_inertia[i, k] * relative[k]
            added_flow[i] += hull.added_inertia[i, k] * rate[k]
    force = wrench.copy()
    _add_drag(force, hull, relative)
    force += added_flow
    _add_accelerating_flow(force, hull, world_from_body, twist, flow)
    for p in (momentum, added_momentum):
        _add_cross(force, 0, -1.0, twist, 0, p, 0)
        _add_cross(force, 3, -1.0, twist, 0, p, 3)
    _add_cross(force, 0, -1.0, relative, 3, added_momentum, 3)  # Munk moment; zero for the rigid body
    _add_cross(force, 0, hull.buoyancy_n, hull.centre_of_buoyancy_m, 0, up, 0)
    for k in range(3):
        force[3 + k] += (hull.buoyancy_n - hull.weight_n) * up[k]
    total = hull.added_inertia.copy()
    for k in range(6):
        total[k, k] += hull.inertia[k]
    _solve_in_place(total, force)
    return force


@kernel
def _add_drag(force: Array, hull: Hull, relative: Array) -> None:
    at_centre, drag = relative.copy(), np.zeros(6)
    _add_cross(at_centre, 3, 1.0, relative, 0, hull.drag_centre_m, 0)
    for i in range(6):
        for k in range(6):
            drag[i] -= (hull.linear_drag[i, k] + hull.quadratic_drag[i, k] * abs(at_centre[k])) * at_centre[k]
        force[i] += drag[i]
    _add_cross(force, 0, 1.0, hull.drag_centre_m, 0, drag, 3)


@kernel
def _solve_in_place(a: Array, b: Array) -> None:
    """Solves a x = b for a symmetric positive definite matrix (n, n) by elimination; b becomes x, a is overwritten."""
    n = len(b)
    for j in range(n):
        for i in range(j + 1, n):
            factor = a[i, j] / a[j, j]
            b[i] -= factor * b[j]
            for k in range(j + 1, n):
                a[i, k] -= factor * a[j, k]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            b[i] -= a[i, k] * b[k]
        b[i] /= a[i, i]


@kernel
def _add_accelerating_flow(force: Array, hull: Hull, world_from_body: Array, twist: Array, flow: Array) -> None:
    """Adds M_A R'a_v + m_w R'a_w, with its moment; a = dv_c/dt + (v . grad) v_c, v that of body or water."""
    along, water = np.zeros(3), np.zeros(3)
    for i in range(3):
        along[i], water[i] = flow[1, i], flow[1, i]
        for j in range(3):
            velocity = 0.0
            for k in range(3):
                velocity += world_from_body[j, k] * twist[3 + k]
            along[i] += flow[2 + i, j] * velocity
            water[i] += flow[2 + i, j] * flow[0, j]
    displaced = np.zeros(3)
    for k in range(3):
        for i in range(3):
            in_body = world_from_body[i, k] * along[i]
            for row in range(6):
                force[row] += hull.added_inertia[row, 3 + k] * in_body
            displaced[k] += hull.buoyancy_n / GRAVITY_MPS2 * world_from_body[i, k] * water[i]
    for k in range(3):
        force[3 + k] += displaced[k]
    _add_cross(force, 0, 1.0, hull.centre_of_buoyancy_m, 0, displaced, 0)


@kernel
def free_joint_acceleration(hull: Hull, world_from_body: Array, velocity: Array, flow: Array, wrench: Array) -> Array:
    """Returns the `acceleration` (6,) in the velocity coordinates of MuJoCo's free joint [m/s2, rad/s2].

    These are [linear in world axes, angular in body axes], as those of `velocity`. The linear part is R (v' + w x v),
    with R = `world_from_body`, v the linear and w the angular velocity in body axes, and v' the rate of change of v.
    """
    twist = twist_from_free_joint(world_from_body, velocity)
    body_acceleration = acceleration(hull, world_from_body, twist, flow, wrench)
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
