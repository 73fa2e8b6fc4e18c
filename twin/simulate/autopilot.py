"""The pilot of our vehicle: what its maker's data sheet says, never the factors by which a scenario departs from it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from controllers.allocation import allocation
from controllers.tracking import HullModel, Pilot
from scenes.bluerov2 import BLUEROV2_HEAVY
from twin.scenario.model import VehicleConfig
from twin.simulate.hull import hull_of
from twin.simulate.hydrodynamics import angular_first
from twin.simulate.thrusters import steady_thrust_n

Array = NDArray[np.float64]


def nominal_pilot(natural_frequency_radps: float, frame_rate_hz: float) -> Pilot:
    """A pilot that believes the published hull and thrusters, and commands once a frame."""
    hull = hull_of(VehicleConfig.model_validate({}))
    believed = HullModel(hull.inertia + hull.added, hull.added[3:], hull.linear_drag, hull.quadratic_drag)
    effects = angular_first(BLUEROV2_HEAVY.allocation)
    shares = allocation(effects, _thrust_n)
    return Pilot(believed, shares, natural_frequency_radps, 1 / frame_rate_hz)


def top_speed_mps(vehicle: VehicleConfig, direction: Array) -> float:
    """Steady speed along a unit direction (3,) of the body in still water at which a thruster gives its all [m/s].

    Drag takes linear v + quadratic v |v| along each axis, so the thrust of each thruster is p v + q v^2.
    """
    hull = hull_of(vehicle)
    shares = allocation(angular_first(BLUEROV2_HEAVY.allocation), _thrust_n).thrusts_from_wrench[:, 3:]
    linear, quadratic = hull.linear_drag[3:] * direction, hull.quadratic_drag[3:] * np.abs(direction) * direction
    full_n = float(_thrust_n(np.ones(1))[0])
    coefficients = zip(shares @ quadratic, shares @ linear, strict=True)
    roots = np.concatenate([np.roots([q, p, sign * full_n]) for q, p in coefficients for sign in (-1, 1)])
    real = roots[np.isreal(roots)].real
    return float(real[real > 0].min())


def _thrust_n(command: Array) -> Array:
    """Steady thrust of commands in [-1, 1] [N]."""
    return steady_thrust_n(command, BLUEROV2_HEAVY.thrust_coefficients)
