"""Electrical energy of a survey, and the number of dives that it takes."""

import math

import numpy as np

from twin.core.geometry import Array
from twin.core.quality import Energy
from twin.scenario.model import VehicleConfig
from twin.simulate.autopilot import steady_thrusts_n
from twin.simulate.parameters import thrust_and_power

RESERVE = 0.2  #: share of the battery that stays unused


def electrical_power_w(vehicle: VehicleConfig, velocities: Array, pulls: Array | float = 0.0) -> Array:
    """Returns the power (n,) at steady velocities (n, 3) through the water, in the body: hotel load and thrusters.

    The power of a propeller at rest grows with its thrust to the power 1.5 (momentum theory); the tables of the T200
    from 10 to 20 V have exponents of 1.4 to 1.7. At a stated supply voltage, it is that of the tables.
    """
    thrusts = steady_thrusts_n(vehicle, velocities, pulls)
    if vehicle.voltage_v is not None:
        power_w = np.interp(thrusts, *thrust_and_power(vehicle, vehicle.voltage_v)[1:]).sum(axis=1)
    else:
        power_w = vehicle.power_coefficient * (np.abs(thrusts) ** 1.5).sum(axis=1)
    return np.asarray(vehicle.hotel_w + power_w, np.float64)


def energy_of(vehicle: VehicleConfig, velocities: Array, interval_s: float, pulls: Array | float = 0.0) -> Energy:
    """Returns the energy at steady velocities (n, 3) through the water, in the body, each held for an interval."""
    if vehicle.dynamics == "kinematic":
        return Energy()
    survey_wh = float(electrical_power_w(vehicle, velocities, pulls).sum()) * interval_s / 3600
    return Energy(survey_wh, max(1, math.ceil(survey_wh / usable_wh(vehicle))))


def usable_wh(vehicle: VehicleConfig) -> float:
    return (1 - RESERVE) * vehicle.battery_wh
