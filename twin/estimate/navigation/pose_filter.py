"""Extended Kalman filter of the online pose.

Frame-to-frame motion predicts the pose; registrations with the mosaic (F2M) and navigation sensors correct it. All
covariances of poses and motions refer to [rotation, translation] (rad, m) in camera axes.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.records import Readings, SensorNoise, StereoRig
from twin.kernels import kernel

_GATE = 30.0  # largest chi2 (6 degrees of freedom) of a pose in `correct_pose`; above it, the pose is rejected
SENSORS = ("pressure", "ahrs", "dvl", "usbl", "beacons", "vertical")  # navigation sensors, in the order of their gates
PRESSURE, AHRS, DVL, USBL, BEACONS, VERTICAL = range(6)
#: Largest chi2 of a reading with 1, 2 and 3 components; one in 1e9 exceeds it.
_READING_GATES = (37.3, 41.4, 44.8)
#: Number of consecutive readings of each sensor that are rejected before it is believed: 10 s at 30 frames per second,
#: for the DVL, whose readings contradict each motion of vision anew, 2 s.
_PATIENCE = (300, 300, 30, 5, 20, 300)


class PoseFilter:
    """Extended Kalman filter of one pose.

    Errors are motions [rotation, translation] (rad, m) in camera axes: pose = true pose @ exp(error). The initial pose
    is known with a standard deviation of 1e-4 rad and 1e-4 m.

    Attributes:     world_from_camera, cov: (4, 4), (6, 6) estimated pose and covariance of its error.
    pressure_ahrs: error model of the pressure sensor and the AHRS.     gates: states of the gates of all sensors.
    """

    def __init__(self, world_from_camera: Array, rig: StereoRig, noise: SensorNoise):
        self.world_from_camera: Array = world_from_camera
        self.cov: Array = np.diag([1e-8] * 3 + [1e-8] * 3)
        self.rig, self.noise = rig, noise
        camera_from_body = geometry.inverse(rig.body_from_camera)
        self.pressure_ahrs = PressureAhrsModel(camera_from_body, noise.pressure_m**2, noise.attitude_sigmas_rad)
        self.gates = ReadingGates(np.zeros((len(SENSORS), 3), np.int64), np.zeros((len(SENSORS), 3)))

    def correct_pose(self, measured: Array, cov: Array, motion_cov: Array) -> Array | None:
        """Fuses a pose measured relative to an earlier pose, such as the result of a registration with the mosaic.

        Only the motion since the earlier pose is constrained: with the covariances S of this motion (`motion_cov`, at
        most that of the pose, `clip_covariance`) and R of the measurement (`cov`), the gain is S (S + R)^-1, and the
        covariance decreases by the gain times S (Schmidt-Kalman filter, with the earlier pose as consider parameter).

        Returns:
            (6, 6) decrease of the covariance of the pose; None if the measurement was rejected as an outlier.
        """
        chi2, pose, decrease = _correct(self.world_from_camera, self.cov, measured, cov, motion_cov)
        if chi2 > _GATE:
            return None
        self.reset(pose, self.cov - decrease)
        return decrease

    def fuse_position_fixes(self, readings: Readings) -> Readings:
        """Fuses the readings that are taken only at keyframes: an acoustic position fix, and the beacons detected.

        Returns:
            The readings without the position fix and the beacons that were rejected.
        """
        counts, beacons = self.rejected, []
        if readings.usbl_m is not None:
            rotation = self.world_from_camera[:3, :3]
            residual = readings.usbl_m - self.world_from_camera[:3, 3]
            self._update(USBL, residual, np.hstack([np.zeros((3, 3)), rotation]), np.eye(3) * self.noise.usbl_m**2)
        for sighting in readings.beacons or ():
            beacon = np.array(self.noise.beacons_m[sighting.beacon])
            expected, jacobian = project_beacon(self.world_from_camera, beacon, self.rig)
            before = self.rejected[BEACONS]
            if np.isfinite(expected).all():
                residual = np.array(sighting.pixel) - expected
                self._update(BEACONS, residual, jacobian, np.eye(2) * self.noise.beacon_px**2)
            if self.rejected[BEACONS] == before:
                beacons.append(sighting)
        used = self.without_rejected(readings, counts)
        return used if used.beacons is None else replace(used, beacons=tuple(beacons))

    @property
    def rejected(self) -> NDArray[np.int64]:
        """Returns the number (6,) of rejected readings of each sensor in `SENSORS`."""
        return self.gates.counts[:, 1].copy()

    def without_rejected(self, readings: Readings, counts: NDArray[np.int64]) -> Readings:
        """Returns readings without those, except beacons, of sensors with rejections since `rejected` was `counts`."""
        names = ("pressure_z_m", "ahrs_rpy_rad", "dvl_mps", "usbl_m", None, "up")
        changed = zip(names, self.rejected > counts, strict=True)
        return replace(readings, **{name: None for name, is_rejected in changed if name and is_rejected})

    def fuse_vertical(self, readings: Readings) -> None:
        """Fuses the direction of the vertical, if it was measured, as far as it is more precise than the pose.

        A bias of the accelerometer is in all readings. Along the axes of the predicted direction's covariance,
        components with a variance above s^2, that of a reading, are reduced to s^2, and never below it.
        """
        if readings.up is None:
            return
        measured = self.rig.body_from_camera[:3, :3].T @ readings.up
        across, predicted = perpendicular_axes(measured), self.world_from_camera[2, :3]
        jacobian = np.hstack([across @ geometry.skew(predicted), np.zeros((2, 3))])
        variances, axes = np.linalg.eigh(jacobian @ self.cov @ jacobian.T)
        above = variances > self.noise.up_rad**2 * (1 + 1e-9)
        if above.any():
            known = axes[:, above].T
            noise = self.noise.up_rad**2 / (1 - self.noise.up_rad**2 / variances[above])
            self._update(VERTICAL, -known @ across @ predicted, known @ jacobian, np.diag(noise))

    def reset(self, world_from_camera: Array, cov: Array) -> None:
        """Replaces pose and covariance, for example by those of a global alignment."""
        self.world_from_camera, self.cov = geometry.nearest_rigid(world_from_camera), cov

    def _update(self, sensor: int, residual: Array, jacobian: Array, cov: Array) -> None:
        pose = self.world_from_camera, self.cov
        self.world_from_camera, self.cov, _ = fuse_reading(*pose, residual, jacobian, cov, self.gates, sensor)


def perpendicular_axes(direction: Array) -> Array:
    """Returns two unit vectors (2, 3) that are perpendicular to a unit vector (3,) and to each other."""
    turned = geometry.skew(direction)
    first = turned @ np.eye(3)[int(np.argmin(np.abs(direction)))]
    first = first / np.linalg.norm(first)
    return np.stack([first, turned @ first])


def project_beacon(world_from_camera: Array, beacon_m: Array, rig: StereoRig) -> tuple[Array, Array]:
    """Projects a beacon, at the position (3,) in the world [m], into the left image.

    Returns:
        Column and row (2,) [px], NaN for a beacon behind the camera or at a depth of up to 1 mm, and their Jacobian
        (2, 6) with respect to an increment [rotation, translation] (rad, m) of the pose in camera axes.
    """
    point = geometry.transform(geometry.inverse(world_from_camera), beacon_m[None])
    x, y, depth = point[0]
    by_point = np.array([[1, 0, -x / depth], [0, 1, -y / depth]]) * rig.focals_px[:, None] / depth
    return rig.project(point)[0], by_point @ np.hstack([geometry.skew(point[0]), -np.eye(3)])


class ReadingGates(NamedTuple):
    """States of the gates that reject readings, one row per sensor in `SENSORS`; arrays are modified in place."""

    #: (6, 3) numbers of readings: consecutive contradictions of the same kind; rejected; disputed, i.e. used although
    #: they contradict the pose.
    counts: NDArray[np.int64]
    residuals: Array  #: (6, 3) residual of the last reading that contradicted the pose


class PressureAhrsModel(NamedTuple):
    """Error model of the pressure sensor and the AHRS."""

    camera_from_body: Array  #: (4, 4) pose of the body in the camera
    pressure_m2: float  #: variance of the height measured by the pressure sensor [m^2]
    attitude_sigmas_rad: Array  #: (3,) standard deviations of roll, pitch and yaw measured by the AHRS [rad]


@kernel
def fuse_pressure_ahrs(world_from_camera, cov, model, height_m, rpy_rad, gates):
    """Updates a pose with readings of height and attitude (Kalman update).

    Args:
        world_from_camera, cov: (4, 4), (6, 6) pose and covariance before the update.
        height_m, rpy_rad: readings of the height of the left camera in the world [m], and of roll, pitch and yaw (3,)
            of the body in the world [rad]; NaN where there is no reading.

    Returns:
        Pose (4, 4) and covariance (6, 6) after the update.
    """
    pose = world_from_camera
    if not np.isnan(height_m):
        by_pose, residual, height_cov = np.zeros((1, 6)), np.empty(1), np.empty((1, 1))
        geometry.copy_into(by_pose[0, 3:], pose[2, :3])
        residual[0], height_cov[0, 0] = height_m - pose[2, 3], model.pressure_m2
        pose, cov, _ = fuse_reading(pose, cov, residual, by_pose, height_cov, gates, PRESSURE)
    if not np.isnan(rpy_rad[0]):
        measured, attitude_cov = _camera_attitude(rpy_rad, model.camera_from_body[:3, :3], model.attitude_sigmas_rad)
        residual = geometry.so3_log(np.ascontiguousarray(pose[:3, :3].T) @ measured)
        pose, cov, _ = fuse_reading(pose, cov, residual, np.eye(3, 6), attitude_cov, gates, AHRS)
    return pose, cov


@kernel
def predict(world_from_camera, cov, a_from_b, motion_cov):
    """Returns the pose (4, 4) and its covariance (6, 6) after a motion `a_from_b` with covariance `motion_cov`.

    These are equations (3) to (5) of Negahdaripour & Madjidi (2003).
    """
    return geometry.compose(world_from_camera, a_from_b), geometry.transport_covariance(cov, a_from_b) + motion_cov


@kernel
def clip_covariance(cov: Array, reference: Array, lower: float = 0.0, upper: float = np.inf) -> Array:
    """Returns a covariance (n, n) limited to the range from `lower` to `upper` times a reference covariance.

    The limits apply to the eigenvalues of L^-1 cov L^-T, with L L^T = reference (Cholesky factor L).

    Raises:
        LinAlgError: the reference covariance is not positive definite.
    """
    root = np.linalg.cholesky(reference)
    inverse_root = np.linalg.inv(root)
    values, axes = np.linalg.eigh(inverse_root @ cov @ inverse_root.T)
    axes = root @ axes
    return axes * np.minimum(np.maximum(values, lower), upper) @ axes.T


@kernel
def fuse_reading(world_from_camera, prior, residual, jacobian, cov, gates, sensor):
    """Updates a pose with a reading (Kalman update), unless the reading contradicts the pose.

    It does if the chi-square of its residual is above the limit. If many readings in succession contradict the pose in
    the same way, the pose is taken to be wrong: its covariance is increased by that of the error they imply.

    Args:
        sensor: index of the sensor in `SENSORS`.

    Returns:
        Pose (4, 4) and covariance (6, 6) after the update, and whether the reading was used.
    """
    counts, last, n = gates.counts[sensor], gates.residuals[sensor], len(residual)
    innovation_cov = geometry.product(geometry.product(jacobian, prior), jacobian.T) + cov
    if _chi2(residual, innovation_cov) > _READING_GATES[n - 1]:
        as_before = _chi2(residual - last[:n], innovation_cov) <= _READING_GATES[n - 1]
        counts[0] = counts[0] + 1 if as_before else 1
        geometry.copy_into(last[:n], residual)
        if counts[0] <= _PATIENCE[sensor]:
            counts[1] += 1
            return world_from_camera, prior, False
        counts[2] += 1
        error = jacobian.T @ np.linalg.solve(geometry.product(jacobian, jacobian.T), residual)
        prior = prior + np.outer(error, error)
    else:
        counts[0] = 0
    pose, cov = kalman_update(world_from_camera, prior, residual, jacobian, cov)
    return pose, cov, True


@kernel
def _chi2(residual, cov):
    return np.sum(residual * np.linalg.solve(cov, residual))


@kernel
def kalman_update(world_from_camera, prior, residual, jacobian, cov):
    """Updates a pose with an observation (Kalman update in Joseph form).

    Args:
        world_from_camera, prior: (4, 4), (6, 6) pose and covariance before the update.
        residual, jacobian, cov: (k,), (k, 6), (k, k) observation minus its prediction, Jacobian of the prediction with
            respect to an increment of the pose, and covariance of the observation.

    Returns:
        Pose (4, 4) and covariance (6, 6) after the update.
    """
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


@kernel
def _correct(world_from_camera, prior, measured, cov, motion_cov):
    """Kernel of `PoseFilter.correct_pose`: chi-square of the innovation, corrected pose, decrease of the covariance."""
    motion_cov = clip_covariance(motion_cov, prior, 0.0, 1.0)
    residual = geometry.log(geometry.inverse(world_from_camera) @ measured)
    inverse = np.linalg.inv(motion_cov + cov)
    gain = motion_cov @ inverse
    return residual @ inverse @ residual, world_from_camera @ geometry.exp(gain @ residual), gain @ motion_cov


def camera_attitude(rpy_rad: Array, camera_from_body: Array, noise: SensorNoise) -> tuple[Array, Array]:
    """Returns the rotation world_from_camera (3, 3) of an AHRS reading (3,) [rad], and its covariance (3, 3) in camera
    axes.

    The errors of roll, pitch and yaw are treated as rotations about the x, y and z axes of the body.
    """
    return _camera_attitude(rpy_rad, camera_from_body[:3, :3], noise.attitude_sigmas_rad)


@kernel
def _camera_attitude(rpy, camera_from_body, sigmas):
    """Compiled kernel of `camera_attitude`, for a rotation `camera_from_body` (3, 3) and `sigmas` (3,) [rad]."""
    to_camera = np.ascontiguousarray(camera_from_body)
    root = to_camera * sigmas
    return geometry.rotation_from_rpy(rpy[0], rpy[1], rpy[2]) @ to_camera.T, root @ root.T
