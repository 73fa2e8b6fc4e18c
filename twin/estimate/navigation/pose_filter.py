"""Dead reckoning from frame to frame, and the extended Kalman filter of the online pose.

Visual motion fused with the DVL predicts the pose; registrations with the mosaic (F2M) and navigation sensors correct
it. Covariances of poses and motions refer to [rotation, translation] (rad, m) in the axes of the current camera.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.records import BeaconDetection, Displacement, Readings, SensorNoise, StereoRig
from twin.estimate.navigation.dvl import DvlIntegrator, DvlModel, DvlState, fuse_dvl
from twin.estimate.navigation.kalman import (
    AHRS,
    BEACONS,
    PRESSURE,
    USBL,
    VERTICAL,
    ReadingGates,
    fuse_reading,
    open_gates,
)
from twin.estimate.vision.two_view_motion import Motion
from twin.kernels import kernel

_GATE = 30.0  # largest chi2 (6 degrees of freedom) of a pose in `correct_pose`; above it, the pose is rejected


class DeadReckoningState(NamedTuple):
    """State of dead reckoning after a frame. The arrays are not modified in place."""

    f2f: Array  #: (4, 4) world_from_camera from frame-to-frame motion alone
    #: online, cov: (4, 4), (6, 6) online estimate of world_from_camera, and its covariance.
    online: Array
    cov: Array
    #: since_node, since_node_cov: (4, 4), (6, 6) motion since the last node from vision and DVL, and its covariance.
    since_node: Array
    since_node_cov: Array


class FrameAiding(NamedTuple):
    """Error models of the sensors that are read at every frame; states, whose arrays are modified in place."""

    camera_from_body: Array  #: (4, 4) pose of the body in the camera
    pressure_m2: float  #: variance of the height measured by the pressure sensor [m^2]
    attitude_sigmas_rad: Array  #: (3,) standard deviations of roll, pitch and yaw measured by the AHRS [rad]
    dvl: DvlModel
    dvl_state: DvlState
    gates: ReadingGates


def readings_as_arrays(readings: Readings) -> tuple[float, Array, Array]:
    """Returns height z [m], roll, pitch, yaw (3,) [rad] and body velocity (3,) [m/s]; NaN where there is no reading."""
    height, angles, velocity = readings.pressure_z_m, readings.ahrs_rpy_rad, readings.dvl_mps
    missing = np.full(3, np.nan)
    return (
        np.nan if height is None else height,
        missing if angles is None else angles,
        missing if velocity is None else velocity,
    )


@kernel
def dead_reckon(
    last: DeadReckoningState, aiding: FrameAiding, a_from_b: Array, cov: Array, height_m: float, rpy_rad: Array,
    velocity_mps: Array,
) -> tuple[DeadReckoningState, Array]:  # fmt: skip
    """Advances by a frame with a visual motion and readings; also returns the motion (4, 4) fused with the DVL."""
    # if the DVL has readings at some frames only, that is its mean per frame since the last one
    update = fuse_dvl(aiding.dvl_state, aiding.dvl, a_from_b, cov, velocity_mps, aiding.gates)
    online, online_cov, since_node, since_node_cov = last.online, last.cov, last.since_node, last.since_node_cov
    moved = update.motion
    if update.duration_s > aiding.dvl.step_s:
        online, online_cov = undo(online, online_cov, update.replaced, update.replaced_cov)
        since_node, since_node_cov = undo(since_node, since_node_cov, update.replaced, update.replaced_cov)
        moved = geometry.exp(geometry.log(moved) * (aiding.dvl.step_s / update.duration_s))
    online, online_cov = predict(online, online_cov, update.motion, update.cov)
    online, online_cov = fuse_pressure_ahrs(online, online_cov, aiding, height_m, rpy_rad)
    since_node, since_node_cov = predict(since_node, since_node_cov, update.motion, update.cov)
    f2f = geometry.compose(last.f2f, a_from_b)
    return DeadReckoningState(f2f, online, online_cov, since_node, since_node_cov), moved


@kernel
def predict(world_from_camera, cov, a_from_b, motion_cov):
    """Returns the pose (4, 4) and its covariance (6, 6) after a motion, eqs. (3) to (5) of the paper."""
    return geometry.compose(world_from_camera, a_from_b), geometry.transport_covariance(cov, a_from_b) + motion_cov


@kernel
def undo(world_from_camera, cov, motion, motion_cov):
    """Returns the pose (4, 4) and covariance (6, 6) before a motion and its noise, as corrected since then."""
    # what corrections have taken from the noise of the motion is not taken again
    back = geometry.inverse(motion)
    before = cov - clip_covariance(motion_cov, cov, 0.0, 1.0)
    return geometry.compose(world_from_camera, back), geometry.transport_covariance(before, back)


@kernel
def fuse_pressure_ahrs(world_from_camera, cov, aiding, height_m, rpy_rad):
    pose = world_from_camera
    if not np.isnan(height_m):
        by_pose, residual, height_cov = np.zeros((1, 6)), np.empty(1), np.empty((1, 1))
        geometry.copy_into(by_pose[0, 3:], pose[2, :3])
        residual[0], height_cov[0, 0] = height_m - pose[2, 3], aiding.pressure_m2
        pose, cov, _ = fuse_reading(pose, cov, residual, by_pose, height_cov, aiding.gates, PRESSURE)
    if not np.isnan(rpy_rad[0]):
        measured, attitude_cov = camera_attitude(rpy_rad, aiding.camera_from_body, aiding.attitude_sigmas_rad)
        residual = geometry.so3_log(np.ascontiguousarray(pose[:3, :3].T) @ measured)
        pose, cov, _ = fuse_reading(pose, cov, residual, np.eye(3, 6), attitude_cov, aiding.gates, AHRS)
    return pose, cov


@kernel
def camera_attitude(rpy_rad: Array, camera_from_body: Array, sigmas_rad: Array) -> tuple[Array, Array]:
    """Returns the rotation world_from_camera (3, 3) of an AHRS reading (3,), and its covariance in camera axes."""
    # errors of roll, pitch and yaw, of standard deviations (3,), are rotations about the axes of the body
    to_camera = np.ascontiguousarray(camera_from_body[:3, :3])
    root = to_camera * sigmas_rad
    return geometry.rotation_from_rpy(rpy_rad[0], rpy_rad[1], rpy_rad[2]) @ to_camera.T, root @ root.T


class PoseFilter:
    """Extended Kalman filter of the online pose, with the state of dead reckoning.

    Errors are motions in camera axes: pose = true pose @ exp(error). The initial pose is known with a standard
    deviation of 1e-4 rad and 1e-4 m. Attributes are those of `DeadReckoningState`, with the online pose as
    `world_from_camera`, and `cov_at_node` (6, 6), its covariance at the last node in the camera axes there.
    """

    def __init__(self, world_from_camera: Array, rig: StereoRig, noise: SensorNoise):
        self.world_from_camera: Array = world_from_camera
        self.cov: Array = np.eye(6) * 1e-8
        self.f2f: Array = world_from_camera.copy()
        self.since_node, self.since_node_cov, self.cov_at_node = np.eye(4), np.zeros((6, 6)), np.zeros((6, 6))
        self.rig, self.noise = rig, noise
        self._pressure_ahrs = geometry.inverse(rig.body_from_camera), noise.height_sigma_m**2, noise.attitude_sigmas_rad
        self.gates = open_gates()
        self.dvl = DvlIntegrator(rig, noise)

    @property
    def state(self) -> DeadReckoningState:
        """Returns the state of dead reckoning at the last frame; `dead_reckon` advances it by one frame."""
        cov = np.ascontiguousarray(self.cov)
        return DeadReckoningState(self.f2f, self.world_from_camera, cov, self.since_node, self.since_node_cov)

    @state.setter
    def state(self, state: DeadReckoningState) -> None:
        self.f2f, self.world_from_camera, self.cov, self.since_node, self.since_node_cov = state

    def aiding(self, interval_s: float) -> FrameAiding:
        return FrameAiding(*self._pressure_ahrs, self.dvl.model(interval_s), self.dvl.state, self.gates)

    def advance(self, motion: Motion, readings: Readings, interval_s: float, is_measured: bool = True) -> Array:
        """Advances by a frame with a visual motion, measured or not; returns it (4, 4) after fusion with the DVL."""
        if not is_measured:
            self.gates.add_prediction()
        arrays = readings_as_arrays(readings)
        self.state, moved = dead_reckon(self.state, self.aiding(interval_s), motion.a_from_b, motion.cov, *arrays)
        return moved

    def start_from_node(self, number: int) -> Displacement | None:
        """Restarts the motion since the last node at node `number`; returns the displacement by the DVL until then."""
        self.since_node, self.since_node_cov, self.cov_at_node = np.eye(4), np.zeros((6, 6)), self.cov
        return self.dvl.displacement_at_node(number)

    def correct_pose(self, measured: Array, cov: Array, motion_cov: Array) -> Array | None:
        """Fuses a pose measured relative to an earlier pose, such as the result of a registration with the mosaic.

        Only the motion since the earlier pose is constrained: with the covariances S of this motion (`motion_cov`, at
        most that of the pose, `clip_covariance`) and R of the measurement (`cov`), the gain is S (S + R)^-1, and the
        covariance decreases by the gain times S (Schmidt-Kalman filter, with the earlier pose as consider parameter).
        Returns the decrease (6, 6); None if the measurement was rejected as an outlier.
        """
        chi2, pose, decrease = _correct(self.world_from_camera, self.cov, measured, cov, motion_cov)
        if not chi2 <= _GATE:  # nor if it is NaN
            return None
        self.reset(pose, self.cov - decrease)
        return decrease

    def fuse_earlier(self, readings: Readings, motion: Array, motion_cov: Array) -> Readings:
        """Fuses readings taken before a motion (4, 4) of this covariance (6, 6); returns those not rejected."""
        rejected, motion_cov = self.rejected, clip_covariance(motion_cov, self.cov, 0.0, 1.0)
        earlier = undo(self.world_from_camera, self.cov, motion, motion_cov)
        height_m, rpy_rad, _ = readings_as_arrays(readings)
        self.world_from_camera, self.cov = fuse_pressure_ahrs(*earlier, self.aiding(1.0), height_m, rpy_rad)
        readings = self.fuse_position_fixes(readings)
        self.reset(*predict(self.world_from_camera, self.cov, motion, motion_cov))
        return self.without_rejected(readings, rejected)

    def fuse_position_fixes(self, readings: Readings) -> Readings:
        """Fuses the readings that are taken only at keyframes, position fix and beacons; returns those not rejected."""
        usbl_m, beacons = readings.usbl_m, readings.beacons
        if usbl_m is not None:
            residual, rotation = usbl_m - self.world_from_camera[:3, 3], self.world_from_camera[:3, :3]
            jacobian = np.hstack([np.zeros((3, 3)), rotation])
            usbl_m = usbl_m if self._update(USBL, residual, jacobian, np.eye(3) * self.noise.usbl_m**2) else None
        if beacons is not None:
            beacons = tuple(sighting for sighting in beacons if self._fuse_beacon(sighting))
        return replace(readings, usbl_m=usbl_m, beacons=beacons)

    def _fuse_beacon(self, sighting: BeaconDetection) -> bool:
        """Returns whether a beacon was not rejected; one predicted behind the camera is neither used nor rejected."""
        beacon_m = np.array(self.noise.beacons_m[sighting.beacon])
        expected, jacobian = project_beacon(self.world_from_camera, beacon_m, self.rig)
        cov = np.eye(2) * self.noise.beacon_px**2
        return not np.isfinite(expected).all() or self._update(BEACONS, sighting.pixel - expected, jacobian, cov)

    @property
    def rejected(self) -> NDArray[np.int64]:
        return self.gates.counts[:, 1].copy()

    def without_rejected(self, readings: Readings, counts: NDArray[np.int64]) -> Readings:
        """Returns readings without those, except beacons, of sensors with rejections since `rejected` was `counts`."""
        names = ("pressure_z_m", "ahrs_rpy_rad", "dvl_mps", "usbl_m", None, "up")
        changed = zip(names, self.rejected > counts, strict=True)
        return replace(readings, **{name: None for name, is_rejected in changed if name and is_rejected})

    def fuse_vertical(self, readings: Readings) -> None:
        """Fuses the direction of the vertical, if it was measured, as far as it is more precise than the pose."""
        # a bias of the accelerometer is in all readings: along the axes of the predicted direction's covariance,
        # components above the variance s^2 of a reading are reduced to s^2, and never below it
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
        self.world_from_camera, self.cov = geometry.nearest_rigid(world_from_camera), cov

    def _update(self, sensor: int, residual: Array, jacobian: Array, cov: Array) -> bool:
        pose = self.world_from_camera, self.cov
        self.world_from_camera, self.cov, used = fuse_reading(*pose, residual, jacobian, cov, self.gates, sensor)
        return used


def perpendicular_axes(direction: Array) -> Array:
    """Returns two unit vectors (2, 3) that are perpendicular to a unit vector (3,) and to each other."""
    turned = geometry.skew(direction)
    first = turned @ np.eye(3)[int(np.argmin(np.abs(direction)))]
    first = first / np.linalg.norm(first)
    return np.stack([first, turned @ first])


def project_beacon(world_from_camera: Array, beacon_m: Array, rig: StereoRig) -> tuple[Array, Array]:
    """Returns the pixel (2,) of a beacon at a position (3,) in the world [m]; NaN up to a depth of 1 mm."""
    # and its Jacobian (2, 6) with respect to an increment [rotation, translation] (rad, m) of the pose in camera axes
    point = geometry.transform(geometry.inverse(world_from_camera), beacon_m[None])
    x, y, depth = point[0]
    by_point = np.array([[1, 0, -x / depth], [0, 1, -y / depth]]) * rig.focals_px[:, None] / depth
    return rig.project(point)[0], by_point @ np.hstack([geometry.skew(point[0]), -np.eye(3)])


@kernel
def clip_covariance(cov: Array, reference: Array, lower: float = 0.0, upper: float = np.inf) -> Array:
    """Returns a covariance (n, n) limited to `lower` to `upper` times a positive definite reference covariance."""
    # the limits apply to eigenvalues of L^-1 cov L^-T, L L^T = reference
    root = np.linalg.cholesky(reference)
    inverse_root = np.linalg.inv(root)
    values, axes = np.linalg.eigh(inverse_root @ cov @ inverse_root.T)
    axes = root @ axes
    return axes * np.minimum(np.maximum(values, lower), upper) @ axes.T


@kernel
def _correct(world_from_camera, prior, measured, cov, motion_cov):
    """Kernel of `PoseFilter.correct_pose`: chi-square of the innovation, corrected pose, decrease of the covariance."""
    motion_cov = clip_covariance(motion_cov, prior, 0.0, 1.0)
    residual = geometry.log(geometry.inverse(world_from_camera) @ measured)
    inverse = np.linalg.inv(motion_cov + cov)
    gain = motion_cov @ inverse
    return residual @ inverse @ residual, world_from_camera @ geometry.exp(gain @ residual), gain @ motion_cov
