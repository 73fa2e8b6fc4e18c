"""Direction of the vertical from a recorded IMU, for data sets without an attitude."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from twin.core.geometry import Array
from twin.core.records import ImuReadings
from twin.datasets.calibration_files import pose_of
from twin.datasets.readings import SensorQuantity, SensorSeries, read_csv
from twin.datasets.text_files import read_yaml
from twin.errors import TwinError
from twin.estimate.navigation.vertical import GRAVITY_MPS2, InertialNoise, verticals

INERTIAL = SensorQuantity("angular rate or specific force", "imu0", "rad/s or m/s2", 6, 1000.0)
#: Standard deviation of the bias of an accelerometer that states none [m/s2]: 20 mg, as of small MEMS sensors.
USUAL_BIAS_MPS2 = 0.2
_LARGEST_DEVIATION = 100.0
_MOST_OFF = 0.15  # largest relative difference of the mean specific force from gravity
_BIAS = "accelerometer_bias_sigma"
_DENSITIES = ("gyroscope_noise_density", "gyroscope_random_walk", "accelerometer_noise_density")


class InertialErrorModel(NamedTuple):
    """Error model of a recorded IMU.

    Args:
        source: its topic or folder, for notes.
        noise: its noise.
        bias_mps2: standard deviation of the bias of each specific force.
        body_from_sensor: (3, 3) rotation of its axes in the body.
    """

    source: str
    noise: InertialNoise
    bias_mps2: float
    body_from_sensor: Array


def vertical_series(readings: SensorSeries, sensor: InertialErrorModel, notes: list[str]) -> SensorSeries | None:
    """Returns the direction of the vertical in body axes (unit vectors that point upwards) and its standard deviation.

    The standard deviation [rad] is that about each perpendicular axis: the RMS of that of `verticals` and, on top of
    it, the error due to the bias of the accelerometer.

    Args:
        readings: (n, 6) angular rates [rad/s] and specific forces [m/s2] in the axes of the sensor.
        sensor: error model of the IMU.
        notes: sentences on readings that are not used; one is appended if the specific force is not that of gravity.

    Returns:
        The directions; None if the mean specific force differs from gravity by more than 15 %.
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


def read_vertical(root: Path, notes: list[str]) -> SensorSeries | None:
    """Returns the direction of the vertical from the folder imu0 of an EuRoC-like data set; None without one.

    `sensor.yaml` has the noise in the terms of Kalibr, the pose of the IMU in the body (`T_BS`; by default the axes are
    those of the body) and, not in EuRoC's own files, the standard deviation of the bias of the accelerometer
    (`accelerometer_bias_sigma` [m/s2]; by default `USUAL_BIAS_MPS2`).

    Args:
        root: folder of the sensors.
        notes: sentences on readings that are not used, to which sentences are appended.

    Raises:
        TwinError: a file is damaged, or a value is impossible.
    """
    file, description = (root / INERTIAL.folder / name for name in ("data.csv", "sensor.yaml"))
    if not file.exists():
        return None
    tree = read_yaml(description) if description.is_file() else {}
    if missing := [name for name in _DENSITIES if tree.get(name) is None]:
        notes.append(f"The readings in {INERTIAL.folder} are not used: sensor.yaml states no `{missing[0]}`.")
        return None
    rate, walk, force = (_deviation(tree, name, description) for name in _DENSITIES)
    bias = USUAL_BIAS_MPS2 if tree.get(_BIAS) is None else _deviation(tree, _BIAS, description)
    axes = pose_of(tree, "T_BS", description)[:3, :3] if "T_BS" in tree else np.eye(3)
    if not np.allclose(axes @ axes.T, np.eye(3), atol=1e-3):
        raise TwinError(f"{description}: T_BS", "is not a rigid motion", "a rotation matrix and a translation [m]")
    readings = read_csv(file, INERTIAL, np.ones(INERTIAL.n), notes)
    sensor = InertialErrorModel(INERTIAL.folder, InertialNoise(rate, walk, force), bias, axes)
    return None if readings is None else vertical_series(readings, sensor, notes)


def _deviation(tree: Mapping[str, Any], name: str, file: Path) -> float:
    """Returns a noise density or standard deviation of a file; raises TwinError unless it is a number from 0 to 100."""
    value = tree[name]
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value <= _LARGEST_DEVIATION:
        allowed = f"a number from 0 to {_LARGEST_DEVIATION:g}"
        raise TwinError(f"{file}: {name}", f"{str(value)[:60]!r} is not allowed", allowed)
    return float(value)
