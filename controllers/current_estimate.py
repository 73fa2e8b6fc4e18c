"""Estimate of the horizontal current from thrust and motion, for the feed-forward of the pose controller."""

from typing import NamedTuple

import numpy as np

from twin.core.geometry import Array
from twin.kernels import kernel

#: Model of the current estimate: spectral densities of unmodelled acceleration [m2/s3] and of the change of the current
#: [m2/s3], about that of gusts of 0.1 m/s over 10 s; variances of the measured velocity, and of an unknown current.
_ACCELERATION_PSD, _CURRENT_PSD, _VELOCITY_VARIANCE, _MOST_CURRENT_VARIANCE = 1e-3, 3e-3, 4e-4, 0.1
_MOST_CURRENT_MPS = 1.0  # limit of the estimate: a vehicle that is held fast looks as if it were in a strong current


class CurrentEstimate(NamedTuple):
    """Estimate of the horizontal current, modified in place by `update_current`."""

    current: Array  # (3,) in the world [m/s]; its vertical part stays 0, because trim errors would look like one
    velocity: Array  # (3,) predicted velocity in body axes [m/s]
    #: (2, 3) covariance of velocity and current along forward and left: their variances, and the covariance [m2/s2]
    cov: Array
    force: Array  # (3,) of the thrusters since the last update, in body axes [N]


def unknown_current() -> CurrentEstimate:
    cov = np.tile([_VELOCITY_VARIANCE, _MOST_CURRENT_VARIANCE, 0.0], (2, 1))
    return CurrentEstimate(np.zeros(3), np.zeros(3), cov, np.zeros(3))


@kernel
def update_current(flow, hull, pose, twist, period_s):
    """Updates the estimate of the horizontal current by the measured velocity: a Kalman filter per body axis."""
    # States: velocity v and current c, with m v' = F - D(v - c) for thrust F and drag D of the hull model; where the
    # drag hardly depends on the current, the estimate of it changes little.
    current = rotate_to_body(pose, flow.current)
    change = np.zeros(3)
    for k in range(2):
        through, mass = flow.velocity[k] - current[k], hull.inertia[3 + k]
        linear, quadratic = hull.linear_drag[3 + k], hull.quadratic_drag[3 + k]
        drag = (linear + quadratic * abs(through)) * through
        rate = (linear + 2 * quadratic * abs(through)) / mass
        slope = 1 - np.exp(-rate * period_s)  # of the velocity after a period over the current: exponential integrator
        v = flow.velocity[k] + (flow.force[k] - drag) / mass * (slope / rate if rate > 1e-9 else period_s)
        vv, cc, vc = flow.cov[k]
        keep = 1 - slope
        vv, vc = keep * keep * vv + 2 * keep * slope * vc + slope * slope * cc, keep * vc + slope * cc
        vv, cc = vv + _ACCELERATION_PSD * period_s, min(cc + _CURRENT_PSD * period_s, _MOST_CURRENT_VARIANCE)
        gain = 1 / (vv + _VELOCITY_VARIANCE)
        innovation = twist[3 + k] - v
        flow.velocity[k], change[k] = v + vv * gain * innovation, vc * gain * innovation
        flow.cov[k, 0], flow.cov[k, 1], flow.cov[k, 2] = vv - vv * vv * gain, cc - vc * vc * gain, vc - vv * vc * gain
    for i in range(2):
        for k in range(2):
            flow.current[i] += pose[i, k] * change[k]
        flow.current[i] = min(max(flow.current[i], -_MOST_CURRENT_MPS), _MOST_CURRENT_MPS)


@kernel
def rotate_to_body(pose, vector):
    result = np.zeros(3)
    for i in range(3):
        for k in range(3):
            result[i] += pose[k, i] * vector[k]
    return result
