"""Autopilot of a vehicle that is steered by fins: it keeps the vehicle on its path at the planned speed.

Feed-forward of the trim on a circle of the curvature of the path, and linear state feedback u = u_trim - K (x - x_trim)
with integral action. The bow points along the planned velocity through the estimated current.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from twin.core import geometry
from twin.core.geometry import Array

#: Limits of the integrals of the position error along and across the path, and upwards [m s].
_MOST_INTEGRAL = np.array([20.0, 20.0, 20.0])
_CURRENT_S = 6.0  # time constant of the estimate of the current; at first, that since the start
_MOST_ERROR = np.array([1.5, 1.0, 0.5])  # position error that is corrected at once [m]


class TrimTable(NamedTuple):
    """Steady flight at the cruise speed on circles of k curvatures, positive to the left; angles in rad."""

    curvature_per_m: Array  #: (k,) increasing
    attitude: Array  #: (k, 3) roll, pitch, and yaw minus course
    twist: Array  #: (k, 6) [angular, linear] velocity in body axes
    inputs: Array  #: (k, n) thrusts [N], then angles of the movable fins


class FinAutopilot:
    """Autopilot with its state: integrals of the position error, and the estimate of the current across the bow.

    Args:
        gains: (n, 15) feedback gains K of the errors of position along the course, to its left and up, roll, pitch,
            yaw, twist (6), and of the integrals of the position errors.
        most: (n,) greatest inputs, backwards the same.
    """

    def __init__(self, table: TrimTable, gains: Array, most: Array, speed_mps: float, period_s: float):
        self._table, self._gains, self.most = table, gains, most
        self._speed_mps, self._period_s = speed_mps, period_s
        self._integral, self._current = np.zeros(3), np.zeros(2)
        self._since_start_s = 0.0

    def inputs(
        self, pose: Array, twist: Array, position: Array, velocity: Array, acceleration: Array, is_measured: bool
    ) -> Array:
        """Returns the inputs (n,), thrusts [N] and angles [rad], and updates the state.

        Args:
            pose, twist: estimated pose world_from_body (4, 4), and [angular, linear] velocity (6,) in the body.
            position, velocity, acceleration: `Reference` of the body in the world.
            is_measured: whether the motion was measured; else integrals and current are kept.
        """
        through = velocity[:2] - self._current
        speed = float(np.hypot(*through))
        rate = float(through[0] * acceleration[1] - through[1] * acceleration[0]) / speed**2
        attitude, trim_twist, trim_inputs = self._trim(rate / speed)
        ratio = speed / self._speed_mps
        course = np.arctan2(velocity[1], velocity[0])
        wanted = attitude + np.array([0.0, -np.arctan2(velocity[2], speed), np.arctan2(through[1], through[0])])
        rpy = np.array(geometry.rpy_from_rotation(pose[:3, :3]))
        offset = pose[:3, 3] - position
        c, s = np.cos(course), np.sin(course)
        error = np.array([c * offset[0] + s * offset[1], c * offset[1] - s * offset[0], offset[2]])
        error = np.clip(error, -_MOST_ERROR, _MOST_ERROR)
        turned = (rpy - wanted + np.pi) % (2 * np.pi) - np.pi
        water = pose[:3, :3].T @ np.append(self._current, 0.0)
        moving = twist - ratio * trim_twist - np.concatenate([np.zeros(3), water])
        state = np.concatenate([error, turned, moving, self._integral])
        inputs = trim_inputs - self._gains @ state
        limited = np.clip(inputs, -self.most, self.most)
        if is_measured:
            self._learn(error, pose, float(moving[4]), saturated=bool((inputs != limited).any()))
        return limited

    def _trim(self, curvature_per_m: float) -> tuple[Array, Array, Array]:
        table = self._table
        columns = (table.attitude, table.twist, table.inputs)
        first, second, third = (
            np.array([np.interp(curvature_per_m, table.curvature_per_m, column) for column in part.T]) for part in columns
        )
        return first, second, third

    def _learn(self, error: Array, pose: Array, drift_mps: float, saturated: bool) -> None:
        """Updates the integrals and the current: what moves the vehicle across its bow faster than in its trim."""
        if not saturated:
            self._integral = np.clip(self._integral + self._period_s * error, -_MOST_INTEGRAL, _MOST_INTEGRAL)
        self._since_start_s += self._period_s
        lag_s = min(max(self._since_start_s, 5 * self._period_s), _CURRENT_S)
        self._current = self._current + self._period_s / lag_s * drift_mps * pose[:2, 1]
