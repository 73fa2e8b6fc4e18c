"""Thrust authority: whether the thrusters reach the planned speed, and hold station and fly against the current."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.optimize import root_scalar

from twin.controllers.survey_plan import SurveyPlan
from twin.core.geometry import Array
from twin.errors import TwinError
from twin.scenario.model import PlanConfig, VehicleConfig
from twin.simulate.autopilot import thrust_loads, top_speed_mps
from twin.world.planned_images import planned_references

#: A path over the floor may climb and descend at this share of the greatest vertical speed at cruise speed; the rest is
#: reserved for the controller.
_CLIMB_SHARE = 0.5
#: Greatest slope (rise over run) of a path over the floor, even if the thrusters can fly a steeper one.
_MAX_SLOPE = 0.6


def check_speed(vehicle: VehicleConfig, asked: PlanConfig, speed_mps: float) -> None:
    """Raises TwinError if a cruise speed exceeds the top speed: forwards or, for loops, in the slowest direction.

    A kinematic vehicle is not checked.
    """
    if vehicle.dynamics == "kinematic":
        return
    bearings = np.linspace(0, 2 * np.pi, 24, endpoint=False) if asked.pattern == "loops" else np.zeros(1)
    directions = np.stack([np.cos(bearings), np.sin(bearings), np.zeros_like(bearings)], axis=1)
    reach = min(top_speed_mps(vehicle, direction) for direction in directions)
    if speed_mps > reach:
        raise TwinError("plan.speed_mps", f"{asked.speed_mps:g}: too fast for the thrusters", f"up to {reach:.2f}")


def check_thrust(vehicle: VehicleConfig, current_mps: tuple[float, float, float], plan: SurveyPlan) -> None:
    """Raises TwinError if a thruster saturates: to hold station in the current, or at the planned velocities in it.

    A kinematic vehicle, and a path at constant height without current, are not checked.
    """
    current = np.array(current_mps)
    if vehicle.dynamics == "kinematic" or not (current.any() or plan.surface is not None):
        return
    planned = planned_references(plan)
    rounded = np.round(np.column_stack([np.asarray(planned.yaw), planned.velocity]), 3)
    distinct = np.unique(rounded, axis=0)
    yaw, velocity = distinct[:, 0], distinct[:, 1:]
    hold, speed_mps = _body_velocities(yaw, -np.tile(current, (len(yaw), 1))), float(np.linalg.norm(current))
    if (factor := _saturating_factor(vehicle, lambda k: k * hold)) is not None:
        raise TwinError(
            "current.velocity_mps", f"{speed_mps:.2f} m/s: the thrusters cannot hold station against it",
            f"up to {np.floor(100 * factor * speed_mps) / 100:.2f} m/s in this direction",
        )  # fmt: skip
    factor = _saturating_factor(vehicle, lambda k: _body_velocities(yaw, k * velocity - current))
    if factor is not None:
        against = f" in a current of {speed_mps:.2f} m/s" if current.any() else " up the slopes"
        raise TwinError(
            "plan.speed_mps", f"{plan.speed_mps:g}: too fast for the thrusters{against}",
            f"up to {np.floor(1000 * factor * plan.speed_mps) / 1000:.3f}",
        )  # fmt: skip


def climb_slope(vehicle: VehicleConfig, speed_mps: float) -> float:
    """Returns the greatest slope of a path: half the slope that saturates a thruster at cruise speed, at most 0.6.

    It is 0.6 if the cruise speed alone saturates a thruster.
    """
    ahead = np.array([speed_mps, 0.0, 0.0])
    excess = lambda climb: _load(vehicle, np.array([ahead, ahead]) + [[0, 0, climb], [0, 0, -climb]]) - 1  # noqa: E731
    if excess(0.0) >= 0:
        return _MAX_SLOPE  # `prepare` reports that the speed is too high
    high = _MAX_SLOPE / _CLIMB_SHARE * speed_mps
    climb = high if excess(high) <= 0 else _root(excess, high)
    return _CLIMB_SHARE * climb / speed_mps


def _saturating_factor(vehicle: VehicleConfig, velocities: Callable[[float], Array]) -> float | None:
    """Returns the factor below 1 at which velocities(factor) (n, 3) saturate a thruster; None if there is none."""
    if _load(vehicle, velocities(1.0)) <= 1:
        return None
    return _root(lambda factor: _load(vehicle, velocities(factor)) - 1, 1.0)


def _root(function: Callable[[float], float], high: float) -> float:
    """Returns a root between 0 and `high` of a function that has opposite signs at these two values."""
    return float(root_scalar(function, bracket=(0.0, high), method="brentq", xtol=1e-4).root)


def _load(vehicle: VehicleConfig, velocities: Array) -> float:
    """Returns the greatest thrust of any thruster at body velocities (n, 3) through the water; 1 is full thrust."""
    return float(thrust_loads(vehicle, velocities).max(initial=0.0))


def _body_velocities(yaw: Array, velocity: Array) -> Array:
    """Returns velocities (n, 3) converted from world axes to the body axes of a level vehicle at yaws (n,) [rad]."""
    c, s = np.cos(yaw), np.sin(yaw)
    x, y, z = velocity.T
    return np.column_stack([c * x + s * y, c * y - s * x, z])
