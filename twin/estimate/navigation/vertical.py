"""Direction of the vertical from the angular rates and specific forces of an inertial measurement unit (IMU).

Extended Kalman filter of attitude and gyroscope bias (multiplicative: Markley 2003, "Attitude error representations for
Kalman filtering"), run forwards and backwards over the record; the two estimates at a time share no reading but one,
and their mean is weighted by their variances (two-filter smoother, Fraser & Potter 1969). The heading is unobservable.

The specific force f of a body with rotation R (world_from_body) and acceleration a is R' (a + g z). The filter treats
R' a as noise: an acceleration of `_ACCELERATION_MPS2`, correlated over `_ACCELERATION_S`.
"""

import numpy as np

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.records import GRAVITY_MPS2, ImuErrorModel, ImuReadings
from twin.kernels import kernel

_ACCELERATION_MPS2, _ACCELERATION_S = 0.1, 1.0  # standard deviation and correlation time of a vehicle's acceleration
_GYROSCOPE_BIAS_RADPS = 0.02  # standard deviation of the bias at the start
_JERK_RADPS3 = 5.0  # second derivative of the angular rates, which are interpolated linearly between readings
_START_S = 1.0  # the mean specific force over this time gives the first attitude


def verticals(readings: ImuReadings, noise: ImuErrorModel) -> tuple[Array, Array]:
    """Returns upward unit vectors (n, 3) in the axes of the IMU, and standard deviations (n,) about each axis [rad].

    These include the noise of both sensors, the bias of the gyroscope and the accelerations of the vehicle, not the
    bias of the accelerometer: a bias b adds an error of b / g, common to all readings.
    """
    times_s, rates, forces = (np.ascontiguousarray(values, np.float64) for values in readings)
    density = np.hypot(noise.force_density, _ACCELERATION_MPS2 * np.sqrt(2 * _ACCELERATION_S))
    model = noise.rate_density**2, noise.rate_walk**2, density**2
    ahead, ahead_rad2 = _filtered(times_s, rates, forces, *model)
    back, back_rad2 = _filtered(-times_s[::-1], -rates[::-1], forces[::-1].copy(), *model)
    information = 1 / ahead_rad2, 1 / back_rad2[::-1]
    up = ahead * information[0][:, None] + back[::-1] * information[1][:, None]
    return up / np.linalg.norm(up, axis=1, keepdims=True), (information[0] + information[1]) ** -0.5


@kernel
def _filtered(times_s, rates, forces, rate_density2, rate_walk2, force_density2):
    """Returns the vertical (n, 3) after each reading and its variance (n,) about each perpendicular axis [rad^2]."""
    # errors of the state are [rotation in body axes, gyroscope bias]: true rotation = rotation @ exp(error)
    n = len(times_s)
    up, variance, bias = np.empty((n, 3)), np.empty(n), np.zeros(3)
    rotation = _level(_first_vertical(times_s, rates, forces))
    cov = np.zeros((6, 6))
    for i in range(3):
        cov[i, i] = (2 * _ACCELERATION_MPS2 / GRAVITY_MPS2) ** 2 + (_GYROSCOPE_BIAS_RADPS * _START_S) ** 2
        cov[3 + i, 3 + i] = _GYROSCOPE_BIAS_RADPS**2
    interval_s = (times_s[-1] - times_s[0]) / max(n - 1, 1)
    for k in range(n):
        step_s = times_s[k] - times_s[k - 1] if k > 0 else 0.0
        if k > 0:
            turn = geometry.so3_exp(((rates[k - 1] + rates[k]) / 2 - bias) * step_s)
            rotation = np.ascontiguousarray(rotation @ turn)
            advance = np.eye(6)
            geometry.copy_into(advance[:3, :3], np.ascontiguousarray(turn.T))
            for i in range(3):
                advance[i, 3 + i] = -step_s
            cov = geometry.transform_covariance(advance, cov)
            added = rate_density2 * step_s + min(1.0, (step_s**3 / 12 * _JERK_RADPS3) ** 2)
            for i in range(3):
                cov[i, i] += added
                cov[3 + i, 3 + i] += rate_walk2 * step_s
        vertical = rotation[2].copy()
        by_error = np.zeros((3, 6))
        geometry.copy_into(by_error[:, :3], GRAVITY_MPS2 * geometry.skew(vertical))
        weight_s = step_s if k > 0 else interval_s  # a reading stands for the time since the one before it
        noise = np.eye(3) * (force_density2 / max(min(weight_s, _ACCELERATION_S), 1e-6))
        gain = cov @ by_error.T @ np.linalg.inv(by_error @ cov @ by_error.T + noise)
        step = gain @ (forces[k] - GRAVITY_MPS2 * vertical)
        rotation = np.ascontiguousarray(rotation @ geometry.so3_exp(step[:3].copy()))
        bias = bias + step[3:]
        keep = np.eye(6) - gain @ by_error
        cov = geometry.transform_covariance(keep, cov) + gain @ noise @ gain.T
        up[k] = rotation[2]
        variance[k] = (cov[0, 0] + cov[1, 1] + cov[2, 2] - up[k] @ np.ascontiguousarray(cov[:3, :3]) @ up[k]) / 2
    return up, variance


@kernel
def _first_vertical(times_s, rates, forces):
    """Returns the direction (3,), at the first reading, of the mean specific force over the first `_START_S`."""
    mean, turned = forces[0].copy(), np.eye(3)
    for k in range(1, len(times_s)):
        if times_s[k] - times_s[0] > _START_S:
            break
        turned = turned @ geometry.so3_exp((rates[k - 1] + rates[k]) / 2 * (times_s[k] - times_s[k - 1]))
        mean += turned @ forces[k]
    return mean / np.linalg.norm(mean)


@kernel
def _level(up):
    """Returns a rotation (3, 3) world_from_body whose third row is the unit vector `up` (3,)."""
    other = np.zeros(3)
    other[np.argmin(np.abs(up))] = 1.0
    first = np.cross(other, up)
    first /= np.linalg.norm(first)
    rotation = np.empty((3, 3))
    rotation[0], rotation[1], rotation[2] = first, np.cross(up, first), up
    return rotation
