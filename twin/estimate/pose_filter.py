"""The online position: frame-to-frame motion predicts, registration with the mosaic and navigation sensors correct."""

from __future__ import annotations

import numpy as np
from numba import njit

from twin import geometry
from twin.geometry import Array
from twin.records import Readings, SensorNoise, StereoRig

_GATE = 30.0  # chi2 beyond which a 6-DOF correction contradicts the prediction


class PoseFilter:
    """Extended Kalman filter of one pose; the error is a motion [w, t] in the camera, applied on the right."""

    def __init__(self, world_from_camera: Array, rig: StereoRig, noise: SensorNoise):
        self.world_from_camera = world_from_camera
        self.cov = np.diag([1e-8] * 3 + [1e-8] * 3)
        self.camera_from_body = geometry.inverse(rig.body_from_camera)
        self.rig, self.noise = rig, noise

    def predict(self, a_from_b: Array, cov: Array) -> None:
        """Composes a relative motion with its covariance, eqs. (3) to (5)."""
        self.world_from_camera = self.world_from_camera @ a_from_b
        self.cov = carried(self.cov, a_from_b) + cov

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
        moved = clipped(since, self.cov, most=1.0)
        residual = geometry.log(geometry.inverse(self.world_from_camera) @ measured)
        inverse = np.linalg.inv(moved + cov)
        if residual @ inverse @ residual > _GATE:
            return None
        gain = moved @ inverse
        learnt = np.asarray(gain @ moved, np.float64)
        self.reset(self.world_from_camera @ geometry.exp(gain @ residual), self.cov - learnt)
        return learnt

    def aid(self, readings: Readings) -> None:
        """Fuses what the navigation sensors said of height and attitude."""
        if readings.pressure_z_m is not None:
            jacobian = np.concatenate([np.zeros(3), self.world_from_camera[2, :3]])[None]
            residual = np.array([readings.pressure_z_m - self.world_from_camera[2, 3]])
            self._update(residual, jacobian, np.array([[self.noise.pressure_m**2]]))
        if readings.ahrs_rpy_rad is not None:
            measured, cov = attitude(readings.ahrs_rpy_rad, self.camera_from_body, self.noise)
            residual = geometry.so3_log(self.world_from_camera[:3, :3].T @ measured)
            self._update(residual, np.eye(3, 6), cov)

    def fix(self, readings: Readings) -> None:
        """Fuses what tells the position at key points: an acoustic fix, beacons in view."""
        if readings.usbl_m is not None:
            rotation = self.world_from_camera[:3, :3]
            residual = readings.usbl_m - self.world_from_camera[:3, 3]
            self._update(residual, np.hstack([np.zeros((3, 3)), rotation]), np.eye(3) * self.noise.usbl_m**2)
        for sighting in readings.beacons or ():
            beacon = np.array(self.noise.beacons_m[sighting.beacon])
            predicted, jacobian = self._sight(beacon)
            if np.isfinite(predicted).all():
                self._update(np.array(sighting.pixel) - predicted, jacobian, np.eye(2) * self.noise.beacon_px**2)

    def _sight(self, beacon_m: Array) -> tuple[Array, Array]:
        """Pixel (2,) where a beacon (3,) is to be seen, NaN behind the camera; its derivative (2, 6) by the motion."""
        point = geometry.transform(geometry.inverse(self.world_from_camera), beacon_m[None])
        x, y, depth = point[0]
        by_point = np.array([[1, 0, -x / depth], [0, 1, -y / depth]]) * self.rig.focal_px / depth
        return self.rig.project(point)[0], by_point @ np.hstack([geometry.skew(point[0]), -np.eye(3)])

    def reset(self, world_from_camera: Array, cov: Array) -> None:
        """Takes a pose and covariance from elsewhere: a measured motion, a global alignment."""
        self.world_from_camera, self.cov = geometry.rigid(world_from_camera), cov

    def _update(self, residual: Array, jacobian: Array, cov: Array) -> None:
        self.world_from_camera, self.cov = _updated(self.world_from_camera, self.cov, residual, jacobian, cov)


def clipped(cov: Array, other: Array, least: float = 0.0, most: float = np.inf) -> Array:
    """A covariance (n, n), cut to between `least` and `most` times another, in the axes that both have in common."""
    root = np.linalg.cholesky(other)
    inward = np.linalg.inv(root)
    sizes, axes = np.linalg.eigh(inward @ cov @ inward.T)
    axes = root @ axes
    return np.asarray(axes * np.clip(sizes, least, most) @ axes.T, np.float64)


@njit(cache=True, nogil=True)
def carried(cov: Array, a_from_b: Array) -> Array:
    """The covariance (6, 6) of pose a, in the axes of b that it is carried to."""
    carry = geometry.adjoint(geometry.inverse(a_from_b))
    return carry @ cov @ carry.T


@njit(cache=True, nogil=True)
def _updated(world_from_camera, prior, residual, jacobian, cov):
    """Pose and covariance after an observation (k,) with its derivative (k, 6) and covariance (k, k); Joseph's form."""
    gain = np.linalg.solve(jacobian @ prior @ jacobian.T + cov, jacobian @ prior).T.copy()
    keep = np.eye(6) - gain @ jacobian
    return world_from_camera @ geometry.exp(gain @ residual), keep @ prior @ keep.T + gain @ cov @ gain.T


def attitude(rpy_rad: Array, camera_from_body: Array, noise: SensorNoise) -> tuple[Array, Array]:
    """Rotation of the camera in the world by an AHRS reading, with its covariance (3, 3) in the camera."""
    sigmas = np.array([noise.attitude_rad, noise.attitude_rad, noise.heading_rad])
    return _attitude(rpy_rad, camera_from_body[:3, :3], sigmas)


@njit(cache=True, nogil=True)
def _attitude(rpy, camera_from_body, sigmas):
    to_camera = np.ascontiguousarray(camera_from_body)
    spread = to_camera * sigmas
    return geometry.rotation_from_rpy(rpy[0], rpy[1], rpy[2]) @ to_camera.T, spread @ spread.T
