"""Tether of a vehicle: its drag in the current, and its pull where it is caught."""

from typing import NamedTuple

import numpy as np

from twin.core.geometry import Array
from twin.kernels import kernel
from twin.scenario.model import TetherConfig
from twin.simulate.sea import flow_at, steady_current

_WATER_KG_M3 = 1025.0
_SEGMENTS = 6  # of the line, each with the flow at its middle
_STIFFNESS_N_PER_M, _DAMPING_N_S_PER_M = 200.0, 60.0  # of a line that is caught and taut


class Tether(NamedTuple):
    """Neutrally buoyant line from the vehicle to a fixed point above the start, paid out as needed.

    It is straight, and turns freely at both ends: of the drag on a piece at the share s from the vehicle, the vehicle
    carries 1 - s (balance of moments about the upper end). The cross-flow principle holds: only the velocity across the
    line matters. A line that is caught holds the vehicle within its slack of the place.
    """

    length_m: float  #: 0: no tether
    drag: float  #: drag per length and squared velocity, rho Cn d / 2 [N s2/m3]
    top_m: Array  #: (3,) upper end in the world
    attachment_m: Array  #: (3,) lower end in the body
    #: (5,) whether it is caught (1 or 0), where (x, y, z) [m] and with how much slack [m]; modified in place
    snag: Array


def tether_of(tether: TetherConfig, start_m: Array) -> Tether:
    drag = _WATER_KG_M3 * tether.drag_coefficient * tether.diameter_m / 2
    top_m = start_m + np.array([0.0, 0.0, tether.length_m])
    return Tether(tether.length_m, drag, top_m, np.array(tether.attachment_m, float), np.zeros(5))


NO_TETHER = tether_of(TetherConfig(), np.zeros(3))


def steady_pulls(tether: Tether, current_mps: Array, position_m: Array, yaw: Array, velocity_mps: Array) -> Array:
    """Returns the wrenches (n, 6) [N m, N] of a tether on a level vehicle, in the body."""
    # in a current (3,) or (n, 3), at positions (n, 3), yaws (n,) [rad] and velocities (n, 3) in the world
    wrenches, currents, zero = np.zeros((len(yaw), 6)), np.broadcast_to(current_mps, (len(yaw), 3)), np.zeros(3)
    for k in range(len(yaw) if tether.length_m else 0):
        c, s, moving = np.cos(yaw[k]), np.sin(yaw[k]), np.concatenate([velocity_mps[k], zero])
        rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        add_tether(wrenches[k], tether, steady_current(currents[k]), 0.0, rotation, position_m[k], moving)
    return wrenches


@kernel
def add_tether(wrench, tether, sea, time_s, world_from_body, position, velocity):
    """Adds the pull of the tether to a wrench (6,) [moment, force] in body axes [N m, N]."""
    # at a rotation (3, 3) and position (3,) of the centre of gravity; velocity (6,): [linear in world, angular in body]
    if tether.length_m == 0.0 and tether.snag[0] == 0.0:
        return
    a, turning = tether.attachment_m, velocity[3:]
    arm_rate = np.array([
        turning[1] * a[2] - turning[2] * a[1], turning[2] * a[0] - turning[0] * a[2],
        turning[0] * a[1] - turning[1] * a[0],
    ])  # fmt: skip
    end, end_rate, pull = np.zeros(3), np.zeros(3), np.zeros(3)
    for i in range(3):
        end[i], end_rate[i] = position[i], velocity[i]
        for k in range(3):
            end[i] += world_from_body[i, k] * a[k]
            end_rate[i] += world_from_body[i, k] * arm_rate[k]
    if tether.length_m > 0.0:
        _add_line_drag(pull, tether, sea, time_s, end, end_rate)
    if tether.snag[0] > 0.0:
        _add_snag(pull, tether.snag, end, end_rate)
    force = np.zeros(3)
    for k in range(3):
        for i in range(3):
            force[k] += world_from_body[i, k] * pull[i]
        wrench[3 + k] += force[k]
    wrench[0] += a[1] * force[2] - a[2] * force[1]
    wrench[1] += a[2] * force[0] - a[0] * force[2]
    wrench[2] += a[0] * force[1] - a[1] * force[0]


@kernel
def _add_line_drag(pull, tether, sea, time_s, end, end_rate):
    line = tether.top_m - end
    length_m = np.sqrt(np.sum(line * line))
    for n in range(_SEGMENTS):
        share = (n + 0.5) / _SEGMENTS
        relative = flow_at(sea, time_s, end + share * line)[0] - (1 - share) * end_rate
        along = np.sum(relative * line) / length_m**2
        across = relative - along * line
        speed = np.sqrt(np.sum(across * across))
        pull += (1 - share) * tether.drag * speed * across * (length_m / _SEGMENTS)


@kernel
def _add_snag(pull, snag, end, end_rate):
    away = end - snag[1:4]
    distance_m = np.sqrt(np.sum(away * away))
    stretch_m = distance_m - snag[4]
    if stretch_m > 0.0:
        direction = away / distance_m
        tension = _STIFFNESS_N_PER_M * stretch_m + _DAMPING_N_S_PER_M * np.sum(end_rate * direction)
        pull -= max(tension, 0.0) * direction
