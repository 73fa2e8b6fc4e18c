"""Autopilot of a vehicle that is steered by fins: it keeps the vehicle on its level path at the planned speed.

Feed-forward of the trim on a circle of the curvature of the path, and linear state feedback u = u_trim - K (x - x_trim)
with integral action. The bow points along the planned velocity through the estimated current.
"""

import numpy as np

from twin.core import geometry
from twin.core.geometry import Array

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
        """Returns the inputs (n,) for one period, and updates the state, as `tracking.control_thrusters` does.

        Unless the motion was measured, integrals and current are kept.
        """
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
