"""Steady flight of a vehicle that is steered by fins: its trim on a level circle, minimum speed and turning radius."""

from itertools import takewhile
from typing import NamedTuple

import numpy as np
from scipy.optimize import root

from twin.core import geometry
from twin.core.geometry import Array
from twin.errors import TwinError
from twin.scenario.model import VehicleConfig
from twin.simulate.fins import Fins, add_fins, fins_of
from twin.simulate.hull import trimmed_hull
from twin.simulate.hydrodynamics import Hull, acceleration, angular_first
from twin.simulate.parameters import parameters_of

_TRIM_SHARE = 0.4  # share of their greatest angle that fins use in steady flight; the rest is left for control
_MOST_PITCH = np.radians(8.0)  # in steady flight, so that hull and fins are far from stall
_RESERVE_N = 1.0  # by which the net buoyancy may change, upwards or downwards, at the minimum speed
_SPEEDS_MPS = np.arange(3.0, 0.25, -0.05)
_TOLERANCE = 1e-7  # of the accelerations of a trim [rad/s2, m/s2]
_CURVATURES_PER_M = np.arange(0.01, 2.0, 0.01)


class Trim(NamedTuple):
    """Steady motion at constant height on a circle, or straight ahead, in still water."""

    roll: float  #: [rad]
    pitch: float  #: [rad], positive with the bow down
    twist: Array  #: (6,) [angular, linear] velocity in body axes [rad/s, m/s]
    thrust_n: float  #: of each thruster
    angles_rad: Array  #: (n,) of the fins


def accelerated(hull: Hull, fins: Fins, rotation: Array, twist: Array, thrust: Array, angles_rad: Array) -> Array:
    """Returns the `acceleration` (6,) in still water under a wrench of the thrusters (6,) and angles of the fins."""
    wrench = thrust.copy()
    add_fins(wrench, fins._replace(angle_rad=angles_rad), twist)
    return acceleration(hull, rotation, twist, np.zeros((5, 3)), wrench)


def trim(vehicle: VehicleConfig, speed_mps: float, curvature_per_m: float = 0.0) -> Trim | None:
    """Returns the trim at a speed through the water on a circle of this curvature, positive to the left.

    It solves acceleration (6,) = 0 and vertical velocity = 0 for roll, pitch, the two angles of the flow, the thrust,
    and the angles of rudders and elevators: the angle of a fin is that of the rudders times the left part of its normal
    plus that of the elevators times the upper part. None if there is no such motion, or none was found.
    """
    hull, fins = trimmed_hull(vehicle), fins_of(vehicle, 1.0)
    per_newton = angular_first(parameters_of(vehicle).thrust_configuration).sum(axis=1)
    drag_n = hull.quadratic_drag[3, 3] * speed_mps**2

    def motion(unknown: Array) -> Trim:
        roll, pitch, sideslip, attack, load, rudder, elevator = unknown
        rates = geometry.rotation_from_rpy(roll, pitch, 0.0).T @ [0.0, 0.0, curvature_per_m * speed_mps]
        ahead = np.cos(sideslip) * np.array([np.cos(attack), 0.0, np.sin(attack)])
        twist = np.concatenate([rates, speed_mps * (ahead + [0.0, np.sin(sideslip), 0.0])])
        return Trim(roll, pitch, twist, load * drag_n, (fins.max_rad > 0) * (fins.normal @ [rudder, elevator]))

    def residual(unknown: Array) -> Array:
        roll, pitch, twist, thrust_n, angles_rad = motion(unknown)
        rotation = geometry.rotation_from_rpy(roll, pitch, 0.0)
        rate = accelerated(hull, fins, rotation, twist, thrust_n * per_newton, angles_rad)
        return np.append(rate, rotation[2] @ twist[3:])

    # least squares: without rudders or elevators, the Jacobian is singular
    solved = root(residual, np.array([0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0]), method="lm", tol=1e-12)
    return motion(solved.x) if np.abs(solved.fun).max() < _TOLERANCE else None


def minimum_speed_mps(vehicle: VehicleConfig) -> float:
    """Returns the least speed, from 0.3 m/s in steps of 0.05 m/s, at which the fins keep the height with a reserve.

    Raises TwinError if the fins cannot keep the height at any speed up to 3 m/s.
    """
    buoyancies_n = np.clip([vehicle.buoyancy_n - _RESERVE_N, vehicle.buoyancy_n + _RESERVE_N], -20, 20).tolist()
    loaded = [vehicle.model_copy(update={"buoyancy_n": buoyancy_n}) for buoyancy_n in buoyancies_n]
    speeds = list(takewhile(lambda speed: all(_is_easy(one, trim(one, speed)) for one in loaded), _SPEEDS_MPS))
    if not speeds:
        problem = f"cannot keep the height against a net buoyancy of {vehicle.buoyancy_n:g} N"
        raise TwinError("vehicle.fins", problem, "larger fins, or a vehicle.buoyancy_n nearer to 0")
    return round(float(speeds[-1]), 2)


def turning_radius_m(vehicle: VehicleConfig, speed_mps: float, share: float = _TRIM_SHARE) -> float:
    """Returns the least radius of a level turn in which the fins use this share of their greatest angles [m].

    Raises TwinError if they cannot turn the vehicle.
    """
    turns = list(takewhile(lambda k: _is_easy(vehicle, trim(vehicle, speed_mps, k), share), _CURVATURES_PER_M))
    if not turns:
        problem = f"cannot turn the vehicle at {speed_mps:g} m/s within {1 / _CURVATURES_PER_M[0]:g} m"
        raise TwinError("vehicle.fins", problem, "larger fins, or another plan.speed_mps")
    return float(1 / turns[-1])


def _is_easy(vehicle: VehicleConfig, found: Trim | None, share: float = _TRIM_SHARE) -> bool:
    most_rad = np.radians([fin.max_deg for fin in vehicle.fins])
    if found is None or abs(found.pitch) > _MOST_PITCH:
        return False
    return bool((np.abs(found.angles_rad) <= share * most_rad + 1e-12).all())
