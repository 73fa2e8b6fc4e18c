"""Design of the autopilot of a vehicle that is steered by fins: linear-quadratic regulator about its trim."""

from __future__ import annotations

import numpy as np
from scipy.linalg import solve_continuous_are
from scipy.optimize import approx_fprime

from twin.controllers.fin_autopilot import FinAutopilot
from twin.core import geometry
from twin.core.geometry import Array
from twin.scenario.model import VehicleConfig
from twin.simulate.autopilot import full_force_n
from twin.simulate.fins import fins_of
from twin.simulate.hull import trimmed_hull
from twin.simulate.hydrodynamics import angular_first
from twin.simulate.parameters import parameters_of
from twin.simulate.steady_flight import Trim, accelerated, trim, turning_radius_m

#: Deviations that cost the same (Bryson's rule): position along, across, up [m], roll, pitch, yaw [rad], twist (of
#: which only the yaw rate costs [rad/s]), integrals of the position [m s]; inputs as shares of their greatest values.
_DEVIATIONS = np.array([1.0, 0.2, 0.2, np.inf, 0.3, 0.15, *[np.inf] * 2, 0.3, *[np.inf] * 3, 5.0, 2.0, 1.5])
_INPUT_SHARE = 0.5
_CURVATURES = np.linspace(-1.5, 1.5, 9)  # of the trims, in curvatures of the planned turns


def fin_autopilot(vehicle: VehicleConfig, speed_mps: float, frame_rate_hz: float) -> FinAutopilot:
    """Returns the autopilot for a cruise speed, designed without the factors on drag and added mass."""
    nominal = vehicle.model_copy(update={"drag_factor": 1.0, "added_mass_factor": 1.0})
    hull, fins, n = trimmed_hull(nominal), fins_of(nominal, 1.0), len(vehicle.thrusters)
    configuration, movable = angular_first(parameters_of(nominal).thrust_configuration), fins.max_rad > 0

    def row(found: Trim) -> Array:
        attitude = [found.roll, found.pitch, found.yaw_from_course]
        return np.concatenate([attitude, found.twist, [found.thrust_n] * n, found.angles_rad[movable]])

    def rates(values: Array) -> Array:
        """Returns the rates of position in course axes, attitude and twist, from these (12,) and inputs (n,)."""
        (roll, pitch, yaw), twist, inputs = values[3:6], values[6:12], values[12:]
        rotation, angles = geometry.rotation_from_rpy(roll, pitch, yaw), np.zeros(len(movable))
        angles[movable] = inputs[n:]
        s, c, t = np.sin(roll), np.cos(roll), np.tan(pitch)
        turning = [[1, s * t, c * t], [0, c, -s], [0, s / np.cos(pitch), c / np.cos(pitch)]] @ twist[:3]
        return np.concatenate(
            [
                rotation @ twist[3:],
                turning,
                accelerated(hull, fins, rotation, twist, configuration @ inputs[:n], angles),
            ]
        )

    most = np.concatenate([[full_force_n(nominal, np.array([1.0, 0, 0]))] * n, fins.max_rad[movable]])
    planned = 1 / turning_radius_m(nominal, speed_mps)
    trims = {k: found for k in planned * _CURVATURES if (found := trim(nominal, speed_mps, k)) is not None}
    slopes = np.zeros((15, 15 + len(most)))
    slopes[:12, [*range(12), *range(15, 15 + len(most))]] = approx_fprime(
        np.concatenate([np.zeros(3), row(trims[0.0])]), rates
    )  # fmt: skip
    slopes[12:, :3] = np.eye(3)
    a, b, effort = slopes[:, :15], slopes[:, 15:], np.diag(1 / (_INPUT_SHARE * most) ** 2)
    gains = np.linalg.solve(effort, b.T @ solve_continuous_are(a, b, np.diag(1 / _DEVIATIONS**2), effort))
    table = np.array([row(found) for found in trims.values()])
    return FinAutopilot(np.array(list(trims)), table, gains, most, speed_mps, 1 / frame_rate_hz)
