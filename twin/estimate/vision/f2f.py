"""Frame-to-frame motion (F2F) at video rate, by tracking the points of the last keyframe."""

from typing import NamedTuple

import numpy as np

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.records import ImuErrorModel, ImuReadings, StereoRig
from twin.estimate.vision import matching, observation_equations, two_view_motion
from twin.estimate.vision.inertial_filter import InertialFilter
from twin.estimate.vision.motion_filter import MotionFilter
from twin.estimate.vision.observation_equations import PairMeasurements
from twin.estimate.vision.rolling_shutter import at_mid_exposure
from twin.estimate.vision.stereo import StereoPoints
from twin.estimate.vision.two_view_motion import Motion, PairMotionSettings

MAX_POINTS = 150  # only the strongest points are tracked; keyframes correct the drift between them
NOT_MATCHED = "too few points matched"  # status of a frame
_MIN_TRACKED = 0.7  # if a smaller fraction of the reference points is tracked, the frame becomes the reference
MIN_MATCHED = 0.25  # smallest fraction of the reference points that must be tracked; in pure noise, about a tenth are
_MIN_INLIERS = 0.5  # smallest fraction of the tracked points that must agree with a motion
_MAX_RESIDUAL_PX = 1.0  # largest median residual of the tracked points; windows of a rigid scene are tracked to 0.5 px
_PREDICTION_SIGMAS = 3.0  # the search covers prediction errors up to this many standard deviations
_MOST_LEVELS = 4  # pyramid levels above the full image
_UNKNOWN_VARIANCE = 1.0  # variance of the normalised disparity, which a single image does not measure


class _Reference(NamedTuple):
    image: matching.Image  #: (height, width) normalised left image
    pixels: matching.Points  #: (n, 2) positions of the points in the image [px]
    measured: Array  #: (n, 3) normalised (x, y, disparity) of the points
    cov: Array  #: (n, 3, 3) covariance of each row of `measured`

    def xyz(self, baseline_m: float) -> Array:
        x, y, disparity = self.measured.T
        return np.column_stack([x, y, np.ones_like(x)]) * (baseline_m / disparity[:, None])


class _Located(NamedTuple):
    #: pose of the image in the reference camera, its covariance and the number of inliers.
    motion: Motion
    inlier_share: float  #: fraction of the tracked points that are inliers, 0 to 1
    tracked_share: float  #: fraction of the points of the reference that were tracked, 0 to 1
    residual_px: float  #: median distance between the tracked and the fitted positions of the points [px]
    as_reference: _Reference  #: the image with the tracked points, which can replace the reference


class FrameToFrame:
    """Frame-to-frame motion by tracking the points of the last keyframe.

    Every frame is matched with the image `reference` and its points: the last keyframe (None before the first one), or
    a later frame once too few of the points are tracked. Structure is estimated together with motion
    (`two_view_motion.pair_motion`); the motion between two frames follows from their poses relative to the reference.
    If each frame were matched with the previous one and depth taken as exact, as in eq. (2) of Negahdaripour & Madjidi
    (2003), matching errors would accumulate: the bias of pitch was 1.25 mrad over fine texture (this method: 0.1 +- 0.1
    mrad) and 4 mrad over coarse texture (0.5 +- 0.7 mrad).

    A Kalman filter of pose in the reference camera and velocity (`motion_filter`) fuses the measured pose with the
    prediction from the velocity, because the acceleration of a vehicle is limited, whereas a pose from few and noisy
    pixels may have any error. With an IMU, it predicts the motion (`inertial_filter`). A step fails if too few points
    are tracked or agree, or if the measured pose contradicts the prediction; the predicted motion is then returned,
    with a large covariance.
    """

    def __init__(
        self, rig: StereoRig, patch_px: int, imu_noise: ImuErrorModel | None = None, stops_if_blind: bool = True
    ):
        self.rig, self.patch_px, self._imu_noise = rig, patch_px, imu_noise
        self.reference: _Reference | None = None
        self.started = False
        self.filter: MotionFilter | InertialFilter = MotionFilter(stops_if_blind)
        self._reference_cov = np.zeros((6, 6))  # of the pose of the reference in the last keyframe
        self._common_cov = np.zeros((6, 6))  # see `cov_since_keyframe`

    def restart(self, image: matching.Image, points: StereoPoints, velocity: Array | None = None) -> None:
        """Makes a new keyframe, with its normalised left image, the reference, with the strongest of its points."""
        # a `velocity` (6,) of the camera [rad/s, m/s] that was measured otherwise replaces that of the filter
        if velocity is not None and isinstance(self.filter, MotionFilter):
            self.filter.set_velocity(velocity)
        strongest = slice(MAX_POINTS)
        measured, cov = _at_left_pixels(points, self.rig)
        measured = at_mid_exposure(measured, self.filter.velocity, self.rig)
        self._reference_cov = np.zeros((6, 6))
        self._set_reference(_Reference(image, points.pixels[strongest], measured[strongest], cov[strongest]))

    def step(
        self, image: matching.Image, interval_s: float | None = None, unusable: str = "", imu: ImuReadings | None = None
    ) -> tuple[Motion, str]:
        """Returns the motion from the last frame to this normalised image, and "ok" or the reason for a failure.

        At the first frame, these are the identity and "ok". As covariance of a measured motion, that of the pose of
        this frame in the reference camera is returned: the errors of successive motions partly cancel, so the sum of
        these is an upper bound. The interval is by default that of the frame rate; `unusable` is the reason why the
        frame must not be matched; `imu` has the readings since the last frame, which are used if there are some at the
        first frame.
        """
        if not self.started:
            self.started = True
            if self._imu_noise is not None and imu is not None and len(imu.times_s):
                self.filter = InertialFilter(self.rig, self._imu_noise, imu, np.zeros(6))
            return Motion(np.eye(4), np.eye(6) * 1e-12, 0, 0.0), "ok"
        last_from_reference = geometry.inverse(self.filter.pose)
        last_cov = self.filter.cov
        self.filter.predict(1 / self.rig.frame_rate_hz if interval_s is None else interval_s, imu)
        reference = None if unusable else self.reference
        located = None if reference is None else self._locate(image, reference, self.filter.pose)
        status = unusable or self._fuse(located)
        motion = last_from_reference @ self.filter.pose
        if status != "ok":
            self._common_cov = geometry.transport_covariance(self._common_cov, motion)
        if located is None or status != "ok":
            if isinstance(self.filter, InertialFilter):
                added = self.filter.cov - geometry.transport_covariance(last_cov, motion)
                return Motion(motion, _positive(added), 0, np.inf), status
            return constant_velocity_motion(motion), status
        cov = self.filter.cov.copy()
        if located.tracked_share < _MIN_TRACKED:
            self._reference_cov = self.cov_since_keyframe
            self._set_reference(located.as_reference)
        return located.motion._replace(a_from_b=motion, cov=cov), status

    def _fuse(self, located: _Located | None) -> str:
        """Fuses a measured pose with the prediction; returns "ok", or the reason why it was not used."""
        if located is None or located.tracked_share < MIN_MATCHED:
            return NOT_MATCHED
        if located.inlier_share < _MIN_INLIERS or located.residual_px > _MAX_RESIDUAL_PX:
            return "too few points agree"
        used = self.filter.correct(located.motion.a_from_b, located.motion.cov)
        if used:
            self._common_cov = located.motion.cov - self.filter.cov
        return "ok" if used else "motion contradicts the prediction"

    @property
    def cov_since_keyframe(self) -> Array:
        """Returns the covariance (6, 6) of the last frame's pose relative to the last keyframe, in the frame's axes."""
        # frames are matched with the same points, whose errors are common, whereas the filter assumes independent ones;
        # its covariance is replaced by that of the last measured pose, plus growth since then and that of the reference
        return geometry.transport_covariance(self._reference_cov, self.filter.pose) + self._common_cov + self.filter.cov

    def _set_reference(self, reference: _Reference) -> None:
        self.reference, self._common_cov = reference, np.zeros((6, 6))
        self.filter.restart()

    def _pyramid_levels(self, depth_m: Array) -> int:
        """Returns the number of pyramid levels above the full image that errors of predicted positions require."""
        # the tracker finds points within half its window, doubled by each level; the error is by the variances of
        # rotation about x and y and of translation across the axis, at the median depth
        variance = np.diag(self.filter.cov)
        across = variance[3:5] / float(np.median(depth_m)) ** 2
        error_px = _PREDICTION_SIGMAS * self.rig.focal_px * float(np.sqrt(np.max(variance[[1, 0]] + across)))
        levels = int(np.ceil(np.log2(max(error_px / (self.patch_px / 2), 1.0))))
        return int(np.clip(levels, 1, _MOST_LEVELS))

    def _locate(self, image: matching.Image, reference: _Reference, predicted: Array) -> _Located | None:
        """Returns the pose of an image in the reference camera with the tracked points; None if too few are inliers."""
        current_from_reference = geometry.inverse(predicted)
        points = geometry.transform(current_from_reference, reference.xyz(self.rig.baseline_m))
        guess = self.rig.project(points).astype(np.float32)
        levels = self._pyramid_levels(points[:, 2])
        tracked, ok = matching.track(reference.image, image, reference.pixels, guess, self.patch_px, levels)
        pixels, measured, cov = tracked[ok], reference.measured[ok], reference.cov[ok]
        current, current_cov = np.zeros_like(measured), np.zeros_like(cov)
        seen = np.column_stack([self.rig.normalised(pixels), self.rig.baseline_m / points[ok, 2]])
        current[:, :2] = at_mid_exposure(seen, self.filter.velocity, self.rig)[:, :2]
        current_cov[:, :2, :2] = cov[:, :2, :2]
        current_cov[:, 2, 2] = _UNKNOWN_VARIANCE
        inflation = matching.variance_inflation(pixels, self.patch_px)
        settings = PairMotionSettings(variance_inflation=inflation, n_measured=2)
        pair = PairMeasurements(current, measured, current_cov, cov)
        motion = two_view_motion.pair_motion(pair, self.rig.baseline_m, current_from_reference, settings)
        if motion is None:
            return None
        adjoint = geometry.adjoint(motion.a_from_b)
        fitted = observation_equations.transfer(measured, motion.a_from_b, self.rig.baseline_m)[0]
        residual_px = float(np.median(np.linalg.norm(fitted[:, :2] - current[:, :2], axis=1))) * self.rig.focal_px
        # without orthogonalisation, rounding errors would double with every frame
        pose = geometry.nearest_rigid(geometry.inverse(motion.a_from_b))
        current[:, 2] = fitted[:, 2]
        return _Located(
            motion._replace(a_from_b=pose, cov=adjoint @ motion.cov @ adjoint.T),
            inlier_share=motion.n_points / len(pixels),
            tracked_share=float(ok.mean()),
            residual_px=residual_px,
            as_reference=_Reference(image, pixels, current, cov),
        )


def _at_left_pixels(points: StereoPoints, rig: StereoRig) -> tuple[Array, Array]:
    """Returns normalised (x, y, disparity) (n, 3) at the pixels of the left image, and their covariance (n, 3, 3)."""
    # frames are matched with the left image alone, where half the row difference, by which `stereo.fuse` moves a point,
    # would appear as motion; the covariance of (x, y) is that before the fusion
    measured, cov = points.measured.copy(), points.cov.copy()
    measured[:, :2] = rig.normalised(points.pixels)
    cov[:, 0, 0] += cov[:, 0, 1] ** 2 / cov[:, 1, 1]
    cov[:, 0, 1] *= 2
    cov[:, 1, 0] *= 2
    cov[:, 1, 1] *= 2
    return measured, cov


def _positive(cov: Array) -> Array:
    values, axes = np.linalg.eigh((cov + cov.T) / 2)
    return axes * np.asarray(np.maximum(values, 1e-14), np.float64) @ axes.T


def constant_velocity_motion(motion: Array) -> Motion:
    """Returns a motion (4, 4) predicted at constant velocity, with a large covariance."""
    twist = geometry.log(motion)
    sigma = np.concatenate([np.full(3, 0.01), np.full(3, 0.01 + np.linalg.norm(twist[3:]))])
    return Motion(motion, np.diag(np.asarray(sigma**2, np.float64)), 0, np.inf)
