"""Design of the autopilot of a vehicle that is steered by fins: linear-quadratic regulator about its trim."""

import numpy as np
from scipy.linalg import solve_continuous_are

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
_STEP = 1e-6  # of the numerical derivatives
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
        (roll, pitch, yaw), twist, inputs, angles = values[3:6], values[6:12], values[12:], np.zeros(len(movable))
        rotation, thrust = geometry.rotation_from_rpy(roll, pitch, yaw), configuration @ inputs[:n]
        angles[movable] = inputs[n:]
        s, c, t = np.sin(roll), np.cos(roll), np.tan(pitch)
        turning = [[1, s * t, c * t], [0, c, -s], [0, s / np.cos(pitch), c / np.cos(pitch)]] @ twist[:3]
        return np.concatenate([rotation @ twist[3:], turning, accelerated(hull, fins, rotation, twist, thrust, angles)])

    full_n = full_force_n(nominal, np.array([1.0, 0.0, 0.0]))
    most = np.concatenate([[full_n] * n, fins.max_rad[movable]])
    planned = 1 / turning_radius_m(nominal, speed_mps)
    trims = {k: found for k in planned * _CURVATURES if (found := trim(nominal, speed_mps, k)) is not None}
    straight = np.concatenate([np.zeros(3), row(trims[0.0])])
    steps = _STEP * np.eye(len(straight))
    slopes = np.stack([(rates(straight + step) - rates(straight - step)) / (2 * _STEP) for step in steps], axis=1)
    a, b, effort = np.zeros((15, 15)), np.zeros((15, len(most))), np.diag(1 / (_INPUT_SHARE * most) ** 2)
    a[:12, :12], b[:12], a[12:, :3] = slopes[:, :12], slopes[:, 12:], np.eye(3)
    gains = np.linalg.solve(effort, b.T @ solve_continuous_are(a, b, np.diag(1 / _DEVIATIONS**2), effort))
    table = np.array([row(found) for found in trims.values()])
    return FinAutopilot(np.array(list(trims)), table, gains, most, speed_mps, 1 / frame_rate_hz)
