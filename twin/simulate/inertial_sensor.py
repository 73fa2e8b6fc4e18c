"""Inertial measurement unit (IMU): angular rates and specific forces with white noise and randomly walking biases."""

from __future__ import annotations

import math

import numpy as np

from twin.core.geometry import Array
from twin.core.records import ImuReadings
from twin.errors import TwinError
from twin.scenario.model import ImuConfig
from twin.simulate.hull import GRAVITY_MPS2


def inertial_quantities(rotation: Array, rate_radps: Array, acceleration_mps2: Array) -> Array:
    """Returns the true [angular rate, specific force] (6,) in body axes [rad/s, m/s2].

    The specific force is R' (a + g z), with g = GRAVITY_MPS2 and z the unit vector upwards.

    Args:
        rotation: (3, 3) rotation R world_from_body.
        acceleration_mps2: (3,) acceleration a of the origin of the body, in world axes.
    """
    return np.concatenate([rate_radps, rotation.T @ (acceleration_mps2 + [0.0, 0.0, GRAVITY_MPS2])])


def imu_rate_hz(settings: ImuConfig, motion_rate_hz: float) -> float:
    """Returns the rate of the readings [Hz]: that of the scenario or, without one, of the simulated motion.

    Raises:
        TwinError: the rate of the scenario is above that of the simulated motion.
    """
    if settings.rate_hz is None:
        return motion_rate_hz
    if settings.rate_hz > motion_rate_hz * (1 + 1e-9):
        problem = f"{settings.rate_hz:g}: above the rate of the simulated motion"
        raise TwinError("imu.rate_hz", problem, f"up to {motion_rate_hz:g} with this vehicle and rig.frame_rate_hz")
    return settings.rate_hz


class InertialSensor:
    """Inertial measurement unit at the origin of the body.

    The true values of the simulated motion are interpolated linearly at the times of the readings, k / rate with k = 0,
    1, 2, ... Noise model of Kalibr: at a rate f, white noise of density s has the standard deviation s sqrt(f), and the
    bias changes from reading to reading by steps of w / sqrt(f), with w the density of its random walk.

    Args:
        motion_rate_hz: rate of the values given to `add`.
        start: (6,) true [angular rate, specific force] at 0 s, in body axes [rad/s, m/s2].
        rng: random generator of this sensor only.

    Raises:
        TwinError: the rate of the readings is above that of the simulated motion.
    """

    def __init__(self, settings: ImuConfig, motion_rate_hz: float, start: Array, rng: np.random.Generator):
        self._rate_hz, self._motion_rate_hz, self._rng = imu_rate_hz(settings, motion_rate_hz), motion_rate_hz, rng
        densities = settings.gyroscope_noise_density, settings.accelerometer_noise_density
        walks = settings.gyroscope_random_walk, settings.accelerometer_random_walk
        biases = settings.gyroscope_bias_sigma_radps, settings.accelerometer_bias_sigma_mps2
        self._sigma = np.repeat(densities, 3) * math.sqrt(self._rate_hz)
        self._walk = np.repeat(walks, 3) / math.sqrt(self._rate_hz)
        self._bias = np.repeat(biases, 3) * rng.standard_normal(6)
        self._true, self._first = [start], 0  # values since the last call of `read`, and the number of the first one
        self._n_read = 0

    def add(self, true: Array) -> None:
        """Adds the true [angular rate, specific force] (6,) of the next step of the motion, in body axes."""
        self._true.append(true)

    def read(self) -> ImuReadings:
        """Returns the readings since the last call, or since 0 s, up to the time of the last value added."""
        last = self._first + len(self._true) - 1
        ratio = self._motion_rate_hz / self._rate_hz
        end = math.floor(last / ratio + 1e-9) + 1
        numbers = np.arange(self._n_read, end)
        positions, known = numbers * ratio, np.arange(self._first, last + 1)
        true = np.column_stack([np.interp(positions, known, column) for column in np.transpose(self._true)])
        white, steps = self._rng.standard_normal((len(numbers), 2, 6)).transpose(1, 0, 2)
        biases = self._bias + np.cumsum(np.vstack([np.zeros(6), self._walk * steps]), axis=0)
        self._bias = biases[-1]
        values = true + biases[:-1] + self._sigma * white
        self._true, self._first, self._n_read = self._true[-1:], last, end
        return ImuReadings(numbers / self._rate_hz, values[:, :3], values[:, 3:])
