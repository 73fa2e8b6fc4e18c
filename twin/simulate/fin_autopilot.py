"""Autopilot of a vehicle that is steered by fins: it keeps the vehicle on its level path at the planned speed.

Feed-forward of the trim on a circle of the curvature of the path, and linear state feedback u = u_trim - K (x - x_trim)
with integral action; K is that of the linear-quadratic regulator about the trim. The bow points along the planned
velocity through the estimated current.
"""

import numpy as np
from scipy.linalg import solve_continuous_are

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
_MOST_INTEGRAL_M_S = 20.0  # limit of the integrals of the position error
_MOST_ERROR_M = np.array([1.5, 1.0, 0.5])  # position error along and across the path, and upwards, that is corrected
_CURRENT_S = 6.0  # time constant of the estimate of the current; at first, that since the start


class FinAutopilot:
    """Autopilot with its state: integrals of the position error, and the estimate of the current across the bow.

    The trims (k, 9 + n) are those at the cruise speed on circles of the curvatures (k,), increasing, positive to the
    left [1/m]: roll, pitch, yaw minus course [rad], [angular, linear] velocity in body axes, inputs. The gains K (n,
    15) are of the errors of position along the course, to its left and up, of roll, pitch, yaw, twist, and of the
    integrals of the position errors. `most` (n,) are the greatest thrusts [N] and then angles of fins [rad].
    """

    def __init__(self, curvatures: Array, trims: Array, gains: Array, most: Array, speed_mps: float, period_s: float):
        self._curvatures, self._trims, self._gains, self.most = curvatures, trims, gains, most
        self._speed_mps, self._period_s = speed_mps, period_s
        self._integral, self._current, self._since_start_s = np.zeros(3), np.zeros(2), 0.0

    def inputs(
        self, pose: Array, twist: Array, position: Array, velocity: Array, acceleration: Array, is_measured: bool
    ) -> Array:
        """Returns the inputs (n,) for one period; updates the state, integrals and current only if measured."""
        through, course = velocity[:2] - self._current, np.arctan2(velocity[1], velocity[0])
        speed = float(np.hypot(*through))
        curvature = float(through[0] * acceleration[1] - through[1] * acceleration[0]) / speed**3
        trim = np.array([np.interp(curvature, self._curvatures, column) for column in self._trims.T])
        attitude = trim[:3] + [0.0, 0.0, np.arctan2(through[1], through[0])]
        turned = (np.array(geometry.rpy_from_rotation(pose[:3, :3])) - attitude + np.pi) % (2 * np.pi) - np.pi
        offset = geometry.rotation_from_rpy(0.0, 0.0, course).T @ (pose[:3, 3] - position)
        offset = np.clip(offset, -_MOST_ERROR_M, _MOST_ERROR_M)
        moving = twist - speed / self._speed_mps * trim[3:9]
        moving[3:] -= pose[:2, :3].T @ self._current
        inputs = trim[9:] - self._gains @ np.concatenate([offset, turned, moving, self._integral])
        limited = np.clip(inputs, -self.most, self.most)
        if is_measured:
            self._learn_current(moving[4] * pose[:2, 1])
            if (inputs == limited).all():
                self._integral += self._period_s * offset
                self._integral = np.clip(self._integral, -_MOST_INTEGRAL_M_S, _MOST_INTEGRAL_M_S)
        return limited

    def _learn_current(self, drift: Array) -> None:
        """Updates the current by a velocity (2,) across the bow in the world that the trim does not explain."""
        self._since_start_s += self._period_s
        lag_s = min(max(self._since_start_s, 5 * self._period_s), _CURRENT_S)
        self._current = self._current + self._period_s / lag_s * drift


def fin_autopilot(vehicle: VehicleConfig, speed_mps: float, frame_rate_hz: float) -> FinAutopilot:
    """Returns the autopilot for a cruise speed, designed without the factors on drag and added mass."""
    nominal = vehicle.model_copy(update={"drag_factor": 1.0, "added_mass_factor": 1.0})
    hull, fins, n = trimmed_hull(nominal), fins_of(nominal, 1.0), len(vehicle.thrusters)
    configuration, movable = angular_first(parameters_of(nominal).thrust_configuration), fins.max_rad > 0

    def row(found: Trim) -> Array:
        course = geometry.rotation_from_rpy(found.roll, found.pitch, 0.0) @ found.twist[3:]
        attitude = [found.roll, found.pitch, -np.arctan2(course[1], course[0])]  # the yaw against the course
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
