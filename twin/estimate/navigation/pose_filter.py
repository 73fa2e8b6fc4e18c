"""The online position: frame-to-frame motion predicts, registration with the mosaic and navigation sensors correct."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.records import Readings, SensorNoise, StereoRig

_GATE = 30.0  # chi2 beyond which a 6-DOF correction contradicts the prediction


class PoseFilter:
    """Extended Kalman filter of one pose; the error is a motion [w, t] in the camera, applied on the right."""

    def __init__(self, world_from_camera: Array, rig: StereoRig, noise: SensorNoise):
        self.world_from_camera = world_from_camera
        self.cov = np.diag([1e-8] * 3 + [1e-8] * 3)
        self.rig, self.noise = rig, noise
        self.level = Level(geometry.inverse(rig.body_from_camera), noise.pressure_m**2, _sigmas(noise))

    def correct_pose(self, measured: Array, cov: Array, since: Array) -> Array | None:
        """Fuses a pose measured against something laid earlier.

        What had been laid errs by what the position had erred by until then, so the measurement tells of the motion
        since only: the gain is S (S + R)^-1, and the covariance falls by the gain times S, which is less than by an
        absolute position (Schmidt's consider filter, with the past position considered).

        Args:
            measured: (4, 4).
            cov: R, (6, 6) of the measurement.
            since: (6, 6) of the motion since; taken for S as far as the position knows no less.

        Returns:
            (6, 6) by how much the covariance fell; None where the measurement contradicts the prediction beyond both
            uncertainties and is refused.
        """
        chi2, pose, learnt = _corrected(self.world_from_camera, self.cov, measured, cov, since)
        if chi2 > _GATE:
            return None
        self.reset(pose, self.cov - learnt)
        return learnt

    def fix(self, readings: Readings) -> None:
        """Fuses what tells the position at keyframes: an acoustic fix, beacons in view."""
        if readings.usbl_m is not None:
            rotation = self.world_from_camera[:3, :3]
            residual = readings.usbl_m - self.world_from_camera[:3, 3]
            self._update(residual, np.hstack([np.zeros((3, 3)), rotation]), np.eye(3) * self.noise.usbl_m**2)
        for sighting in readings.beacons or ():
            beacon = np.array(self.noise.beacons_m[sighting.beacon])
            predicted, jacobian = sight(self.world_from_camera, beacon, self.rig)
            if np.isfinite(predicted).all():
                self._update(np.array(sighting.pixel) - predicted, jacobian, np.eye(2) * self.noise.beacon_px**2)

    def reset(self, world_from_camera: Array, cov: Array) -> None:
        """Takes a pose and covariance from elsewhere: a measured motion, a global alignment."""
        self.world_from_camera, self.cov = geometry.rigid(world_from_camera), cov

    def _update(self, residual: Array, jacobian: Array, cov: Array) -> None:
        self.world_from_camera, self.cov = updated(self.world_from_camera, self.cov, residual, jacobian, cov)


def sight(world_from_camera: Array, beacon_m: Array, rig: StereoRig) -> tuple[Array, Array]:
    """Pixel (2,) where a beacon (3,) is to be seen, NaN behind the camera; its derivative (2, 6) by the motion."""
    point = geometry.transform(geometry.inverse(world_from_camera), beacon_m[None])
    x, y, depth = point[0]
    by_point = np.array([[1, 0, -x / depth], [0, 1, -y / depth]]) * rig.focal_px / depth
    return rig.project(point)[0], by_point @ np.hstack([geometry.skew(point[0]), -np.eye(3)])


class Level(NamedTuple):
    """What is believed of the sensors of height and attitude: (4, 4) of the body, variance [m2], deviations (3,)."""

    camera_from_body: Array
    pressure_m2: float
    attitude_rad: Array


@njit(cache=True, nogil=True)
def aided(world_from_camera, cov, level, height_m, rpy_rad):
    """Pose and covariance after what the sensors said of height and attitude; NaN: nothing."""
    pose = world_from_camera
    if not np.isnan(height_m):
        by_pose, off, spread = np.zeros((1, 6)), np.empty(1), np.empty((1, 1))
        geometry.put(by_pose[0, 3:], pose[2, :3])
        off[0], spread[0, 0] = height_m - pose[2, 3], level.pressure_m2
        pose, cov = updated(pose, cov, off, by_pose, spread)
    if not np.isnan(rpy_rad[0]):
        measured, spread = _attitude(rpy_rad, level.camera_from_body[:3, :3], level.attitude_rad)
        off = geometry.so3_log(np.ascontiguousarray(pose[:3, :3].T) @ measured)
        pose, cov = updated(pose, cov, off, np.eye(3, 6), spread)
    return pose, cov


@njit(cache=True, nogil=True)
def predicted(world_from_camera, cov, a_from_b, motion_cov):
    """Composes a relative motion with its covariance, eqs. (3) to (5)."""
    return geometry.compose(world_from_camera, a_from_b), carried(cov, a_from_b) + motion_cov


@njit(cache=True, nogil=True)
def clipped(cov: Array, other: Array, least: float = 0.0, most: float = np.inf) -> Array:
    """A covariance (n, n), cut to between `least` and `most` times another, in the axes that both have in common."""
    root = np.linalg.cholesky(other)
    inward = np.linalg.inv(root)
    sizes, axes = np.linalg.eigh(inward @ cov @ inward.T)
    axes = root @ axes
    return axes * np.minimum(np.maximum(sizes, least), most) @ axes.T


@njit(cache=True, nogil=True)
def carried(cov: Array, a_from_b: Array) -> Array:
    """The covariance (6, 6) of pose a, in the axes of b that it is carried to."""
    return geometry.sandwich(geometry.adjoint(geometry.inverse(a_from_b)), cov)


@njit(cache=True, nogil=True)
def updated(world_from_camera, prior, residual, jacobian, cov):
    """Pose and covariance after an observation (k,) with its derivative (k, 6) and covariance (k, k); Joseph's form."""
    gain = _gain(prior, jacobian, cov)
    keep, noise, step = np.eye(6), np.zeros((6, 6)), np.zeros(6)
    for i in range(6):
        for m in range(len(residual)):
            step[i] += gain[i, m] * residual[m]
            for k in range(6):
                keep[i, k] -= gain[i, m] * jacobian[m, k]
                for n in range(len(residual)):
                    noise[i, k] += gain[i, m] * cov[m, n] * gain[k, n]
    return geometry.compose(world_from_camera, geometry.exp(step)), geometry.sandwich(keep, prior) + noise


@njit(cache=True, nogil=True)
def _gain(prior, jacobian, cov):
    """P J' (J P J' + R)^-1 (6, k), by elimination: k is three at most."""
    size = len(cov)
    gain, spread = np.zeros((6, size)), cov.copy()
    for m in range(size):
        for i in range(6):
            for k in range(6):
                gain[i, m] += prior[i, k] * jacobian[m, k]
    for m in range(size):
        for n in range(size):
            for i in range(6):
                spread[m, n] += jacobian[m, i] * gain[i, n]
    for m in range(size):
        for n in range(m + 1, size):
            share = spread[m, n] / spread[m, m]
            for k in range(m, size):
                spread[k, n] -= share * spread[k, m]
            for i in range(6):
                gain[i, n] -= share * gain[i, m]
    for m in range(size - 1, -1, -1):
        for i in range(6):
            gain[i, m] /= spread[m, m]
            for n in range(m):
                gain[i, n] -= spread[m, n] * gain[i, m]
    return gain


@njit(cache=True, nogil=True)
def _corrected(world_from_camera, prior, measured, cov, since):
    """How far a measured pose is off (chi2), the pose that it leads to, and by how much the covariance falls."""
    moved = clipped(since, prior, 0.0, 1.0)
    residual = geometry.log(geometry.inverse(world_from_camera) @ measured)
    inverse = np.linalg.inv(moved + cov)
    gain = moved @ inverse
    return residual @ inverse @ residual, world_from_camera @ geometry.exp(gain @ residual), gain @ moved


def attitude(rpy_rad: Array, camera_from_body: Array, noise: SensorNoise) -> tuple[Array, Array]:
    """Rotation of the camera in the world by an AHRS reading, with its covariance (3, 3) in the camera."""
    return _attitude(rpy_rad, camera_from_body[:3, :3], _sigmas(noise))


def _sigmas(noise: SensorNoise) -> Array:
    """Deviations of roll, pitch and yaw (3,) [rad]."""
    return np.array([noise.attitude_rad, noise.attitude_rad, noise.heading_rad])


@njit(cache=True, nogil=True)
def _attitude(rpy, camera_from_body, sigmas):
    to_camera = np.ascontiguousarray(camera_from_body)
    spread = to_camera * sigmas
    return geometry.rotation_from_rpy(rpy[0], rpy[1], rpy[2]) @ to_camera.T, spread @ spread.T
