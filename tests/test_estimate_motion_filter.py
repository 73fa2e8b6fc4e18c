"""Kalman filter of the pose and velocity of the camera between keyframes, and the covariance of its poses."""

import itertools

import numpy as np
import pytest
import scipy.linalg

from twin.core import geometry
from twin.core.records import StereoRig
from twin.estimate.vision import f2f
from twin.estimate.vision.motion_filter import MotionFilter
from twin.estimate.vision.two_view_motion import Motion

INTERVAL_S = 1 / 30
VELOCITY = np.array([0.0, 0.0, 0.1, 0.3, -0.1, 0.0])


def track(sigma, n, rng, velocity=VELOCITY):
    """Returns the filter after n frames at constant velocity, measured with noise, and its errors (n, 6) and NEES."""
    motion_filter, true, errors, nees = MotionFilter(), np.eye(4), [], []
    cov = np.diag(np.asarray(sigma) ** 2)
    for _ in range(n):
        true = true @ geometry.exp(velocity * INTERVAL_S)
        motion_filter.predict(INTERVAL_S)
        assert motion_filter.correct(true @ geometry.exp(rng.normal(size=6) * sigma), cov)
        errors.append(geometry.log(geometry.inverse(motion_filter.pose) @ true))
        nees.append(errors[-1] @ np.linalg.solve(motion_filter.cov, errors[-1]))
    return motion_filter, np.array(errors), np.array(nees)


def test_exact_poses_pass_unchanged():
    _, errors, _ = track(np.full(6, 1e-6), 20, np.random.default_rng(1))
    assert np.abs(errors).max() < 6e-6


def test_poses_of_few_pixels_are_smoothed_over_many_frames():
    """Oracle: the discrete Riccati equation of one axis with white acceleration, for poses as uncertain as in marine
    snow. At constant velocity, the true error is smaller than the claimed one.
    """
    sigma, density, t = 0.02, 2.0**2 * INTERVAL_S, INTERVAL_S
    process_cov = density * np.array([[t**3 / 3, t**2 / 2], [t**2 / 2, t]])
    transition, seen = np.array([[1, t], [0, 1]]), np.array([[1.0, 0.0]])
    predicted = scipy.linalg.solve_discrete_are(transition.T, seen.T, process_cov, [[sigma**2]])[0, 0]
    alpha = predicted / (predicted + sigma**2)
    motion_filter, errors, nees = track(np.full(6, sigma), 300, np.random.default_rng(2))
    # the 2 % are left for the turn of the axes by 3 mrad per frame
    np.testing.assert_allclose(np.diag(motion_filter.cov), alpha * sigma**2, rtol=0.02)
    assert np.sqrt(np.mean(errors[50:] ** 2)) < np.sqrt(alpha) * sigma
    assert 1 < nees[50:].mean() < 6.5


@pytest.mark.parametrize("rate_hz", [5, 10, 15])
def test_an_exactly_measured_jitter_does_not_build_up_in_the_velocity(rate_hz):
    """Oracle for exact poses with jitter s, each relative to the last one. The steady gain of the velocity is g = 1.268
    (in units of one over the interval), the factor of its old error 1 - g. With the differences d of the jitter, the
    prediction errs by d(k+1) - g d(k) - g (1-g) d(k-1) - ..., of standard deviation
    s sqrt(1 + (1+g)^2 + g^4 / (1 - (1-g)^2)) = 2.99 s. For accelerations that are constant within an interval, g is 2,
    and the error grows with the number of frames.
    """
    rng, jitter, found = np.random.default_rng(6), 1e-3, []
    for _ in range(4):
        motion_filter, poses = MotionFilter(), [geometry.exp(jitter * rng.normal(size=6)) for _ in range(120)]
        for last, now in itertools.pairwise(poses):
            motion = geometry.inverse(last) @ now
            motion_filter.restart()
            motion_filter.predict(1 / rate_hz)
            found.append(geometry.log(geometry.inverse(motion_filter.pose) @ motion))
            assert motion_filter.correct(motion, np.eye(6) * (0.1 * jitter) ** 2)
    assert np.sqrt(np.mean(np.square(found))) == pytest.approx(2.99 * jitter, rel=0.06)


def test_a_jump_is_rejected_and_the_pose_follows_the_velocity():
    motion_filter, _, _ = track(np.full(6, 0.001), 60, np.random.default_rng(3))
    motion_filter.predict(INTERVAL_S)
    before, velocity = motion_filter.pose, motion_filter.velocity
    assert not motion_filter.correct(before @ geometry.exp(np.array([0, 0, 0, 0.3, 0, 0])), np.eye(6) * 1e-6)
    np.testing.assert_array_equal(motion_filter.pose, before)
    np.testing.assert_array_equal(motion_filter.velocity, velocity)
    np.testing.assert_allclose(velocity, VELOCITY, atol=0.1)


def test_the_same_jump_is_plausible_after_a_second_without_measurement():
    """The bound grows with time: at 2 m/s2 (1 sigma), 0.3 m within a second are ordinary."""
    motion_filter, _, _ = track(np.full(6, 0.001), 60, np.random.default_rng(3))
    for _ in range(30):
        motion_filter.predict(INTERVAL_S)
    jump = motion_filter.pose @ geometry.exp(np.array([0, 0, 0, 0.3, 0, 0]))
    assert motion_filter.correct(jump, np.eye(6) * 1e-6)


def test_the_first_measured_velocity_may_be_high():
    """A camera that moves at 1.5 m/s when tracking starts is not an outlier."""
    motion_filter, _, _ = track(np.full(6, 0.001), 10, np.random.default_rng(4), np.array([0, 0, 0, 1.5, 0, 0]))
    assert motion_filter.velocity[3] == pytest.approx(1.5, abs=0.15)


def test_a_new_reference_keeps_the_velocity_and_has_no_pose_error():
    motion_filter, _, _ = track(np.full(6, 0.001), 60, np.random.default_rng(5))
    velocity = motion_filter.velocity.copy()
    motion_filter.restart()
    np.testing.assert_array_equal(motion_filter.pose, np.eye(4))
    np.testing.assert_array_equal(motion_filter.velocity, velocity)
    assert not motion_filter.cov.any()


IMAGE = np.zeros((48, 64), np.uint8)
NO_POINTS = f2f._Reference(IMAGE, np.zeros((0, 2), np.float32), np.zeros((0, 3)), np.zeros((0, 3, 3)))


class MeasuredPoses(f2f.FrameToFrame):
    """Tracks without images: each pose relative to the reference is measured with an error common to all poses and
    one of its own, both of standard deviation `sigma`; the first `n_measured` frames are measured."""

    def __init__(self, sigma, seed, n_measured=1000, tracked_share=1.0):
        super().__init__(StereoRig(64, 48, 55.0, 0.15), 11)
        self.rng, self.sigma = np.random.default_rng(seed), sigma
        self.n_measured, self.tracked_share = n_measured, tracked_share
        self.true = self.true_reference = np.eye(4)
        self.started = True
        self._set_reference(NO_POINTS)

    def _set_reference(self, reference):
        super()._set_reference(reference)
        self.common, self.true_reference = self.sigma * self.rng.normal(size=6), self.true

    def _locate(self, image, reference, predicted):
        self.n_measured -= 1
        if self.n_measured < 0:
            return None
        error = self.common + self.sigma * self.rng.normal(size=6)
        measured = geometry.inverse(self.true_reference) @ self.true @ geometry.exp(error)
        motion = Motion(measured, np.eye(6) * 2 * self.sigma**2, 100, 1.0)
        return f2f._Located(motion, 1.0, self.tracked_share, 0.05, NO_POINTS)

    def fly(self, n):
        """Tracks n frames and returns the error (6,) of the pose since the start."""
        pose = np.eye(4)
        for _ in range(n):
            self.true = self.true @ geometry.exp(VELOCITY * INTERVAL_S)
            pose = pose @ self.step(IMAGE, INTERVAL_S)[0].a_from_b
        return geometry.log(geometry.inverse(pose) @ self.true)


def test_the_covariance_since_the_keyframe_includes_the_error_common_to_all_frames():
    """A filter averages only errors that change from frame to frame: its own covariance is too small."""
    nees, claimed = [], []
    for seed in range(60):
        tracker = MeasuredPoses(0.02, seed)
        error = tracker.fly(20)
        nees.append(error @ np.linalg.solve(tracker.cov_since_keyframe, error))
        claimed.append(error @ np.linalg.solve(tracker.filter.cov, error))
    assert 2.5 < np.mean(nees) < 7.5
    assert np.mean(claimed) > 9


def test_the_covariance_since_the_keyframe_is_that_of_one_pose_not_the_sum_over_frames():
    tracker = MeasuredPoses(0.002, seed=1)
    tracker.fly(20)
    np.testing.assert_allclose(tracker.cov_since_keyframe, np.eye(6) * 2 * 0.002**2, atol=1e-9)


def test_the_covariance_since_the_keyframe_grows_with_each_reference_and_each_lost_frame():
    tracker = MeasuredPoses(0.002, seed=1, n_measured=3, tracked_share=0.5)  # every measured frame becomes a reference
    variances = []
    for _ in range(6):
        tracker.fly(1)
        variances.append(np.trace(tracker.cov_since_keyframe[3:, 3:]))
    assert variances[2] > 2.9 * variances[0]
    assert np.all(np.diff(variances) > 0)
