"""Kalman updates of a pose with readings, and the gates that reject readings which contradict the pose."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core import geometry
from twin.core.geometry import Array
from twin.kernels import kernel

SENSORS = ("pressure", "ahrs", "dvl", "usbl", "beacons", "vertical")  # navigation sensors, in the order of their gates
PRESSURE, AHRS, DVL, USBL, BEACONS, VERTICAL = range(6)
_READING_GATES = (37.3, 41.4, 44.8)  # chi2 of a reading with 1, 2 and 3 components; one in 1e9 exceeds it
#: Number of consecutive readings of each sensor that contradict the pose before they are disputed: 10 s at 30 frames
#: per second, for the DVL, whose readings contradict each motion of vision anew, 2 s.
_PATIENCE = (300, 300, 30, 5, 20, 300)
#: A disputed sensor is believed if at least this many motions were predicted, not measured, since it last agreed. If
#: all motions were measured, the pose cannot have jumped, so the sensor is wrong.
_MANY_PREDICTED = 10


class ReadingGates(NamedTuple):
    """States of the gates that reject readings, one row per sensor in `SENSORS`; arrays are modified in place."""

    #: (6, 5) numbers of readings: contradicting in succession; rejected; disputed, because many before them contradict
    #: alike; believed of these; and number of motions that were predicted since the sensor last agreed.
    counts: NDArray[np.int64]
    residuals: Array  #: (6, 3) residual of the last reading that contradicted the pose

    def add_prediction(self) -> None:
        self.counts[:, 4] += 1


def open_gates() -> ReadingGates:
    return ReadingGates(np.zeros((len(SENSORS), 5), np.int64), np.zeros((len(SENSORS), 3)))


@kernel
def fuse_reading(world_from_camera, prior, residual, jacobian, cov, gates, sensor):
    """Updates a pose (4, 4) and covariance (6, 6) with a reading unless its chi-square is too high; returns if used."""
    # many readings in succession that contradict the pose alike, predicted for a while since they agreed, increase its
    # covariance by that of the implied error
    counts, last, n = gates.counts[sensor], gates.residuals[sensor], len(residual)
    innovation_cov = geometry.product(geometry.product(jacobian, prior), jacobian.T) + cov
    if _chi2(residual, innovation_cov) > _READING_GATES[n - 1]:
        as_before = _chi2(residual - last[:n], innovation_cov) <= _READING_GATES[n - 1]
        counts[0] = counts[0] + 1 if as_before else 1
        geometry.copy_into(last[:n], residual)
        is_disputed = counts[0] > _PATIENCE[sensor]
        counts[2] += is_disputed
        if not is_disputed or counts[4] < _MANY_PREDICTED:
            counts[1] += 1
            return world_from_camera, prior, False
        counts[3] += 1
        error = jacobian.T @ np.linalg.solve(geometry.product(jacobian, jacobian.T), residual)
        prior = prior + np.outer(error, error)
    else:
        counts[0], counts[4] = 0, 0
    pose, cov = kalman_update(world_from_camera, prior, residual, jacobian, cov)
    return pose, cov, True


@kernel
def _chi2(residual, cov):
    return np.sum(residual * np.linalg.solve(cov, residual))


@kernel
def kalman_update(world_from_camera, prior, residual, jacobian, cov):
    """Returns a pose (4, 4) and its covariance (6, 6) after a Kalman update in Joseph form."""
    # `residual` (k,): observation minus its prediction; `jacobian` (k, 6): of the prediction with respect to an
    # increment of the pose; `cov` (k, k): of the observation
    gain = _gain(prior, jacobian, cov)
    keep, noise, step = np.eye(6), np.zeros((6, 6)), np.zeros(6)
    for i in range(6):
        for m in range(len(residual)):
            step[i] += gain[i, m] * residual[m]
            for k in range(6):
                keep[i, k] -= gain[i, m] * jacobian[m, k]
                for n in range(len(residual)):
                    noise[i, k] += gain[i, m] * cov[m, n] * gain[k, n]
    return geometry.compose(world_from_camera, geometry.exp(step)), geometry.transform_covariance(keep, prior) + noise


@kernel
def _gain(prior, jacobian, cov):
    """Returns the Kalman gain P J' (J P J' + R)^-1 (6, k), by elimination; P `prior` (6, 6), R `cov` (k, k)."""
    size = len(cov)
    gain, innovation_cov = np.zeros((6, size)), cov.copy()
    for m in range(size):
        for i in range(6):
            for k in range(6):
                gain[i, m] += prior[i, k] * jacobian[m, k]
    for m in range(size):
        for n in range(size):
            for i in range(6):
                innovation_cov[m, n] += jacobian[m, i] * gain[i, n]
    for m in range(size):
        for n in range(m + 1, size):
            ratio = innovation_cov[m, n] / innovation_cov[m, m]
            for k in range(m, size):
                innovation_cov[k, n] -= ratio * innovation_cov[k, m]
            for i in range(6):
                gain[i, n] -= ratio * gain[i, m]
    for m in range(size - 1, -1, -1):
        for i in range(6):
            gain[i, m] /= innovation_cov[m, m]
            for n in range(m):
                gain[i, n] -= innovation_cov[m, n] * gain[i, m]
    return gain
