"""Fins: force of thin foils in the local flow, with stall, and the lag of their angles.

A fin of the planform area S and the lift slope a has, at the angle of attack alpha of the water to its chord, a force
across the chord of rho/2 S V^2 a min(|alpha|, alpha_stall), with V the part of the velocity in the plane of chord and
normal. Its lift is thus that of thin-foil theory at small angles, and falls with the cosine of alpha beyond stall, as
that of a flat plate; its drag is lift times tan alpha, that of a foil without suction at its leading edge (Hoerner &
Borst 1985, ch. 17: a fin of small aspect ratio), an upper limit. The drag at zero lift is part of that of the hull.
"""

import math
from typing import NamedTuple

import numpy as np

from twin.core.geometry import Array
from twin.kernels import kernel
from twin.scenario.model import VehicleConfig
from twin.simulate.hydrodynamics import twist_from_free_joint

WATER_KG_M3 = 1025.0


class Fins(NamedTuple):
    """State and parameters of n fins, for a fixed timestep."""

    position_m: Array  #: (n, 3) centre of pressure from the centre of gravity, in the body
    normal: Array  #: (n, 2) parts to the left and up of the unit vector of the lift at a positive angle
    coefficient: Array  #: (n,) rho/2 S a [N s2/m2 per rad]
    stall_rad: Array  #: (n,)
    max_rad: Array  #: (n,) angle at a command of 1; 0 of a fixed fin
    keep: Array  #: (n,) share of the distance from the commanded angle that is left after a timestep
    commanded_rad: Array  #: (n,) modified in place
    angle_rad: Array  #: (n,) modified in place


def fins_of(vehicle: VehicleConfig, timestep_s: float) -> Fins:
    """Returns the fins of a vehicle at an angle of 0, exact for commands that are constant over a timestep."""
    fins, n = vehicle.fins, len(vehicle.fins)
    direction = np.radians([fin.lift_direction_deg for fin in fins])
    return Fins(
        position_m=np.array([fin.position_m for fin in fins], float).reshape(n, 3),
        normal=np.column_stack([np.cos(direction), np.sin(direction)]),
        coefficient=np.array([WATER_KG_M3 / 2 * fin.area_m2 * fin.lift_slope_per_rad for fin in fins]),
        stall_rad=np.radians([fin.stall_deg for fin in fins]), max_rad=np.radians([fin.max_deg for fin in fins]),
        keep=np.array([math.exp(-timestep_s / fin.lag_s) for fin in fins]), commanded_rad=np.zeros(n),
        angle_rad=np.zeros(n),
    )  # fmt: skip


@kernel
def command_fins(fins, command):
    """Sets the commands (m,) of the m movable fins, clipped to [-1, 1], for the following steps."""
    k = 0
    for n in range(len(fins.max_rad)):
        if fins.max_rad[n] > 0.0:
            fins.commanded_rad[n] = min(max(command[k], -1.0), 1.0) * fins.max_rad[n]
            k += 1


@kernel
def step_fins(fins):
    for n in range(len(fins.angle_rad)):
        away = fins.angle_rad[n] - fins.commanded_rad[n]
        fins.angle_rad[n] = fins.commanded_rad[n] + fins.keep[n] * away


@kernel
def velocity_through_water(world_from_body, velocity, flow):
    """Returns the [angular, linear] velocity (6,) through the water in body axes, from that of a free joint."""
    moving = velocity.copy()
    moving[:3] -= flow[0]
    return twist_from_free_joint(world_from_body, moving)


@kernel
def add_fins(wrench, fins, relative):
    """Adds the forces of the fins to a wrench (6,) [N m, N] at a `relative` velocity (6,) [rad/s, m/s] in the body."""
    for n in range(len(fins.angle_rad)):
        x, y, z = fins.position_m[n]
        left, up = fins.normal[n]
        p, q, r, u, v, w = relative
        ahead = u + q * z - r * y
        across = left * (v + r * x - p * z) + up * (w + p * y - q * x)
        c, s = math.cos(fins.angle_rad[n]), math.sin(fins.angle_rad[n])
        along_chord, across_chord = c * ahead + s * across, c * across - s * ahead
        attack = -math.atan2(across_chord, abs(along_chord))
        attack = min(max(attack, -fins.stall_rad[n]), fins.stall_rad[n])
        force = fins.coefficient[n] * (along_chord**2 + across_chord**2) * attack
        fx, fy, fz = -s * force, c * left * force, c * up * force
        wrench[0] += y * fz - z * fy
        wrench[1] += z * fx - x * fz
        wrench[2] += x * fy - y * fx
        wrench[3] += fx
        wrench[4] += fy
        wrench[5] += fz
