"""Tests of eqs. (1) and (2), and of structure and motion from two stereo pairs."""

import numpy as np
import pytest

from twin.core import geometry
from twin.estimate.vision import observation_equations, two_view_motion
from twin.estimate.vision.motion_filter import MotionFilter
from twin.estimate.vision.observation_equations import PairMeasurements

BASELINE_M = 0.15


def floor_points(rng, n=200):
    depth = rng.uniform(1.0, 3.0, n)
    xy = rng.uniform(-0.5, 0.5, (n, 2))
    return np.column_stack([xy * depth[:, None], depth])


def measure(points, a_from_b):
    """Returns (x, y, disparity) of points given in a, as measured in a and in b."""
    in_b = geometry.transform(geometry.inverse(a_from_b), points)
    return [np.column_stack([p[:, :2], np.full(len(p), BASELINE_M)]) / p[:, 2:] for p in (points, in_b)]


def test_the_image_jacobian_is_the_derivative_of_the_projection():
    points = floor_points(np.random.default_rng(0), 20)
    x, y = (points[:, :2] / points[:, 2:]).T
    rows = observation_equations.image_jacobian(x, y, points[:, 2])
    step = 1e-6
    for k in range(6):
        moved = [geometry.transform(geometry.inverse(geometry.exp(np.eye(6)[k] * s)), points) for s in (step, -step)]
        numeric = np.subtract(*(m[:, :2] / m[:, 2:] for m in moved)) / (2 * step)
        np.testing.assert_allclose(rows[:, :, k], numeric, atol=1e-8)


def test_the_closed_form_recovers_the_twist_from_the_flow():
    points = floor_points(np.random.default_rng(1))
    x, y = (points[:, :2] / points[:, 2:]).T
    twist = np.array([0.01, -0.02, 0.005, 0.03, 0.02, -0.01])
    flow = observation_equations.image_jacobian(x, y, points[:, 2]) @ twist
    solved = two_view_motion.closed_form_motion(x, y, points[:, 2], flow, np.ones(len(x)))
    np.testing.assert_allclose(solved, twist, atol=1e-12)


def test_exact_depth_motion_is_exact_for_finite_motion_and_ignores_outliers():
    rng = np.random.default_rng(2)
    true = geometry.exp(np.array([0.02, -0.03, 0.05, 0.1, -0.05, 0.04]))
    b, a = measure(floor_points(rng), true)
    a[:40, :2] += rng.uniform(0.05, 0.2, (40, 2))
    motion = np.eye(4)
    for _ in range(3):
        motion = two_view_motion.exact_depth_motion(a, b, BASELINE_M, motion)
    np.testing.assert_allclose(geometry.inverse(motion), true, atol=1e-6)


def test_exact_depth_motion_is_the_pose_of_the_later_pair_in_the_earlier_pair():
    true = geometry.exp(np.array([0.02, -0.03, 0.05, 0.1, -0.05, 0.04]))
    start = true @ geometry.exp(np.array([0.003, 0.003, -0.003, 0.01, -0.01, 0.01]))
    a, b = measure(floor_points(np.random.default_rng(7)), true)
    motion = two_view_motion.exact_depth_motion(a, b, BASELINE_M, start)
    assert motion is not None
    np.testing.assert_allclose(motion, true, atol=1e-9)
    a[:, 2] *= 2  # the depth of a is not used
    again = two_view_motion.exact_depth_motion(a, b, BASELINE_M, start)
    assert again is not None
    np.testing.assert_array_equal(again, motion)


def pair_motion(a, b, sigma, guess):
    cov = np.tile(np.diag(sigma**2), (len(a), 1, 1))
    return two_view_motion.pair_motion(PairMeasurements(a, b, cov, cov), BASELINE_M, guess)


def test_too_few_points_give_no_motion():
    points = floor_points(np.random.default_rng(3), 8)
    a, b = measure(points, np.eye(4))
    assert pair_motion(a, b, np.full(3, 1e-3), np.eye(4)) is None
    assert two_view_motion.exact_depth_motion(a, b, BASELINE_M, np.eye(4)) is None


@pytest.mark.parametrize("seed", [94, 322, 472, 643, 1617, 2697, 2731, 4896])
def test_wrong_matches_give_no_motion_that_is_not_finite(seed):
    # seeds with which the iteration diverged, or met a singular matrix
    rng = np.random.default_rng(seed)
    n, spread = int(rng.integers(12, 40)), rng.choice([0.01, 0.1, 0.3])
    b = np.column_stack([rng.uniform(-spread, spread, (n, 2)), rng.uniform(0.03, 0.15, n)])
    a = b + rng.normal(0, rng.choice([1e-3, 1e-2, 0.1]), (n, 3))
    n_wrong = rng.integers(0, n + 1)
    a[:n_wrong, :2] = rng.uniform(-0.5, 0.5, (n_wrong, 2))
    cov_b = np.tile(np.eye(3) * 1e-6, (n, 1, 1))
    cov_a, n_measured = cov_b.copy(), 3
    if rng.random() < 0.5:
        cov_a[:, 2, 2], a[:, 2], n_measured = 1.0, 0.0, 2
    guess = geometry.exp(np.concatenate([rng.normal(0, 0.2, 3), rng.normal(0, 0.3, 3)]))
    settings = two_view_motion.PairMotionSettings(n_measured=n_measured)
    with np.errstate(all="ignore"):
        motion = two_view_motion.pair_motion(PairMeasurements(a, b, cov_a, cov_b), BASELINE_M, guess, settings)
        closed_form = two_view_motion.exact_depth_motion(a, b, BASELINE_M, guess)
    assert motion is None or np.isfinite(motion.cov).all()
    assert closed_form is None or np.isfinite(closed_form).all()


def test_a_pose_that_is_not_finite_is_not_fused():
    tracker = MotionFilter()
    tracker.predict(0.1)
    before = tracker.pose.copy()
    assert not tracker.correct(np.full((4, 4), np.nan), np.eye(6) * 1e-6)
    np.testing.assert_array_equal(tracker.pose, before)


def test_jacobians_of_the_transfer_agree_with_finite_differences():
    rng = np.random.default_rng(4)
    a_from_b = geometry.exp(rng.normal(size=6) * 0.1)
    b = measure(floor_points(rng, 5), a_from_b)[1]
    _, jacobian_point, jacobian_motion = observation_equations.transfer(b, a_from_b, BASELINE_M)
    step = 1e-6
    for k in range(3):
        up, down = (
            observation_equations.transfer(b + s * np.eye(3)[k], a_from_b, BASELINE_M)[0] for s in (step, -step)
        )
        np.testing.assert_allclose(jacobian_point[:, :, k], (up - down) / (2 * step), atol=1e-7)
    for k in range(6):
        up, down = (
            observation_equations.transfer(b, a_from_b @ geometry.exp(s * np.eye(6)[k]), BASELINE_M)[0]
            for s in (step, -step)
        )
        np.testing.assert_allclose(jacobian_motion[:, :, k], (up - down) / (2 * step), atol=1e-7)


def test_pair_motion_is_unbiased_and_its_covariance_is_consistent():
    """NEES with six degrees of freedom over 150 samples: mean 6, standard error sqrt(12 / 150) = 0.28."""
    rng = np.random.default_rng(5)
    true = geometry.exp(np.array([0.01, -0.02, 0.03, 0.4, -0.2, 0.05]))
    sigma = np.full(3, 3e-4)
    nees, errors = [], []
    for _ in range(150):
        a, b = (z + rng.normal(size=z.shape) * sigma for z in measure(floor_points(rng, 120), true))
        motion = pair_motion(a, b, sigma, true @ geometry.exp(rng.normal(size=6) * 0.01))
        assert motion is not None
        error = geometry.log(geometry.inverse(true) @ motion.a_from_b)
        errors.append(error)
        nees.append(error @ np.linalg.solve(motion.cov, error))
    assert np.mean(nees) == pytest.approx(6, abs=1.6)  # Huber weights reduce the Gaussian efficiency a little
    standard_error = np.std(errors, axis=0) / np.sqrt(len(errors))
    assert np.all(np.abs(np.mean(errors, axis=0)) < 4 * standard_error)


def test_pair_motion_without_one_disparity_is_unbiased_and_its_covariance_is_consistent():
    """Eq. (2), which takes the noisy depth of b as exact, has a bias of 0.02 m on the same points."""
    rng, sigma = np.random.default_rng(5), np.array([1e-3, 1e-3, 4e-3])
    true = geometry.exp(np.array([0.01, -0.02, 0.03, 0.25, -0.1, 0.05]))
    settings = two_view_motion.PairMotionSettings(n_measured=2)
    errors, nees, exact_depth_errors = [], [], []
    for _ in range(200):
        a, b = (z + rng.normal(size=z.shape) * sigma for z in measure(floor_points(rng), true))
        cov_b = np.tile(np.diag(sigma**2), (len(b), 1, 1))
        cov_a = cov_b.copy()
        a[:, 2], cov_a[:, 2, 2] = 0.0, 1.0
        motion = two_view_motion.pair_motion(PairMeasurements(a, b, cov_a, cov_b), BASELINE_M, true, settings)
        assert motion is not None
        errors.append(geometry.log(geometry.inverse(true) @ motion.a_from_b))
        nees.append(errors[-1] @ np.linalg.solve(motion.cov, errors[-1]))
        exact = two_view_motion.exact_depth_motion(a, b, BASELINE_M, true)
        assert exact is not None
        exact_depth_errors.append(geometry.log(geometry.inverse(true) @ exact))
    standard_error = np.std(errors, axis=0) / np.sqrt(len(errors))
    assert np.abs(np.mean(errors, axis=0) / standard_error).max() < 4
    assert np.abs(np.mean(exact_depth_errors, axis=0) / standard_error).max() > 10
    assert np.mean(nees) == pytest.approx(6, rel=0.25)


def test_the_covariance_includes_the_effect_of_a_common_bias():
    """It is J J' sigma^2, with J the derivative of the motion by a shift of all points (finite differences)."""
    true = geometry.exp(np.array([0.01, -0.02, 0.03, 0.4, -0.2, 0.05]))
    a, b = measure(floor_points(np.random.default_rng(8), 400), true)
    cov, common_sigma, step = np.tile(np.eye(3) * 1e-10, (len(a), 1, 1)), 2e-4, 1e-6
    settings = two_view_motion.PairMotionSettings(common_sigma=common_sigma)
    motion = two_view_motion.pair_motion(PairMeasurements(a, b, cov, cov), BASELINE_M, true, settings)
    assert motion is not None
    shifted = [
        two_view_motion.pair_motion(PairMeasurements(a + bias, b, cov, cov), BASELINE_M, true)
        for bias in np.eye(3) * step
    ]
    jacobian = np.column_stack([geometry.log(geometry.inverse(true) @ m.a_from_b) / step for m in shifted])
    # independent noise of 1e-5 contributes 1e-6 to the mean of 400 points: a ten thousandth of the variance
    expected = jacobian @ jacobian.T * common_sigma**2
    np.testing.assert_allclose(motion.cov, expected, atol=0.02 * np.abs(expected).max())


def test_eq_2_is_biased_by_noise_of_depth_and_joint_estimation_is_not():
    """Errors in variables: with 3 px of disparity noise, the closed form of eq. (2) underestimates the translation."""
    rng = np.random.default_rng(6)
    true = geometry.exp(np.array([0.0, 0.0, 0.0, 0.4, 0.0, 0.0]))
    sigma = np.array([1e-4, 1e-4, 8e-3])
    exact_depth, joint = [], []
    for _ in range(40):
        a, b = (z + rng.normal(size=z.shape) * sigma for z in measure(floor_points(rng, 200), true))
        first = two_view_motion.exact_depth_motion(b, a, BASELINE_M, geometry.inverse(true))
        second = pair_motion(a, b, sigma, true)
        assert first is not None and second is not None
        exact_depth.append(geometry.inverse(first)[0, 3] - 0.4)
        joint.append(second.a_from_b[0, 3] - 0.4)
    assert abs(np.mean(joint)) < 0.5 * abs(np.mean(exact_depth))


def test_an_offset_of_all_disparities_is_estimated_from_the_motions_of_near_and_far_points():
    """Its error agrees with its standard deviation: the mean of 60 squared ratios has a standard error of 0.18."""
    rng, offset, ratios, estimates = np.random.default_rng(8), 2e-3, [], []
    sigma = np.array([2e-4, 2e-4, 3e-4])
    true = geometry.exp(np.array([0.01, -0.02, 0.05, 0.25, -0.1, 0.03]))
    for _ in range(60):
        a, b = measure(floor_points(rng, 300), true)
        shift = np.array([0, 0, offset])
        noisy = [z + shift + sigma * rng.normal(size=z.shape) for z in (a, b)]
        found = pair_motion(*noisy, sigma, true).disparity_offset
        estimates.append(found.estimate)
        ratios.append((found.estimate - offset) / found.sigma)
    assert np.mean(estimates) == pytest.approx(offset, rel=0.1)
    assert np.mean(np.square(ratios)) == pytest.approx(1.0, abs=0.6)


def test_over_a_level_floor_the_offset_of_all_disparities_is_unknown():
    rng, sigma = np.random.default_rng(9), np.full(3, 2e-4)
    level = np.column_stack([rng.uniform(-1, 1, (300, 2)), np.full(300, 2.0)])
    true = geometry.exp(np.array([0, 0, 0.05, 0.25, -0.1, 0]))
    relief = level + np.column_stack([np.zeros((300, 2)), rng.uniform(-0.3, 0.3, 300)])
    sigmas = []
    for points in (level, relief):
        noisy = [z + sigma * rng.normal(size=z.shape) for z in measure(points, true)]
        sigmas.append(pair_motion(*noisy, sigma, true).disparity_offset.sigma)
    assert sigmas[0] > 5 * sigmas[1]
