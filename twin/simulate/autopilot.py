"""The pilot of our vehicle: what its maker's data sheet says, never the factors by which a scenario departs from it."""

from __future__ import annotations

import math

import numpy as np

from controllers.allocation import allocation
from controllers.tracking import HullModel, Pilot
from scenes.bluerov2 import BLUEROV2_HEAVY
from twin import config
from twin.simulate.hydrodynamics import angular_first
from twin.simulate.thrusters import steady_thrust_n
from twin.simulate.vehicle import hull_of


def nominal_pilot(natural_frequency_radps: float, frame_rate_hz: float) -> Pilot:
    """A pilot that believes the published hull and thrusters, and commands once a frame."""
    hull = hull_of(config.Vehicle.model_validate({}))
    believed = HullModel(hull.inertia + hull.added, hull.added[3:], hull.linear_drag, hull.quadratic_drag)
    effects = angular_first(BLUEROV2_HEAVY.allocation)
    shares = allocation(effects, lambda u: steady_thrust_n(u, BLUEROV2_HEAVY.thrust_coefficients))
    return Pilot(believed, shares, natural_frequency_radps, 1 / frame_rate_hz)


def top_speed_mps(vehicle: config.Vehicle) -> float:
    """Speed along the bow at which drag takes all that the thrusters give, straight ahead in still water [m/s]."""
    hull, share = hull_of(vehicle), angular_first(BLUEROV2_HEAVY.allocation)[3]
    full_n = steady_thrust_n(np.ones(1), BLUEROV2_HEAVY.thrust_coefficients)[0]
    thrust_n = float(abs(share).sum() * full_n)
    linear, quadratic = float(hull.linear_drag[3]), float(hull.quadratic_drag[3])
    return (math.sqrt(linear**2 + 4 * quadratic * thrust_n) - linear) / (2 * quadratic)
