"""Direction of the vertical from a recorded IMU, for data sets without an attitude."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from twin.core.geometry import Array
from twin.core.records import ImuReadings
from twin.datasets.readings import SensorSeries
from twin.estimate.navigation.vertical import GRAVITY_MPS2, InertialNoise, verticals

#: Standard deviation of the bias of an accelerometer that states none [m/s2]: 20 mg, as of small MEMS sensors.
USUAL_BIAS_MPS2 = 0.2
_MOST_OFF = 0.15  # largest relative difference of the mean specific force from gravity


class InertialErrorModel(NamedTuple):
    """Error model of a recorded IMU."""

    source: str  #: its topic or folder, for notes
    noise: InertialNoise
    bias_mps2: float  #: standard deviation of the bias of each specific force
    body_from_sensor: Array  #: (3, 3) rotation of its axes in the body


def vertical_series(readings: SensorSeries, sensor: InertialErrorModel, notes: list[str]) -> SensorSeries | None:
    """Returns the direction of the vertical in body axes (unit vectors that point upwards) and its standard deviation.

    The standard deviation [rad] is that about each perpendicular axis: the RMS of that of `verticals` and, on top of
    it, the error due to the bias of the accelerometer. If the mean specific force differs from gravity by more than
    15 %, the result is None, and a note says so.

    Args:
        readings: (n, 6) angular rates [rad/s] and specific forces [m/s2] in the axes of the sensor.
    """
    rates, forces = readings.values[:, :3], readings.values[:, 3:]
    mean_mps2 = float(np.linalg.norm(forces, axis=1).mean())
    if abs(mean_mps2 / GRAVITY_MPS2 - 1) > _MOST_OFF:
        notes.append(
            f"The readings of {sensor.source} are not used: their mean specific force is {mean_mps2:.3g} m/s2, that of "
            f"gravity is {GRAVITY_MPS2} m/s2."
        )
        return None
    up, sigma_rad = verticals(ImuReadings(readings.times_s, rates, forces), sensor.noise)
    sigma = float(np.hypot(np.sqrt(np.mean(sigma_rad**2)), sensor.bias_mps2 / GRAVITY_MPS2))
    return SensorSeries(readings.times_s, up @ sensor.body_from_sensor.T, np.array([sigma]))
