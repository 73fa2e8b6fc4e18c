"""Kalman filter of the pose and velocity of the camera between keyframes."""

import numpy as np
import pytest

from twin.core import geometry
from twin.estimate.vision.motion_filter import MotionFilter

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
    """Oracle: steady state of the alpha-beta filter for white acceleration (Kalata 1984), for poses as uncertain as in
    marine snow. At constant velocity, the true error is smaller than the claimed one.
    """
    sigma, acceleration = 0.02, 2.0
    motion_filter, errors, nees = track(np.full(6, sigma), 300, np.random.default_rng(2))
    index = acceleration * INTERVAL_S**2 / sigma
    alpha = 1 - ((4 + index - np.sqrt(8 * index + index**2)) / 4) ** 2
    # the 2 % are left for the turn of the axes by 3 mrad per frame
    np.testing.assert_allclose(np.diag(motion_filter.cov), alpha * sigma**2, rtol=0.02)
    assert np.sqrt(np.mean(errors[50:] ** 2)) < np.sqrt(alpha) * sigma
    assert 1 < nees[50:].mean() < 6.5


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
