"""Motion predicted by an IMU: against an integrated path, with its covariance, and after blindness."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from twin.core import geometry
from twin.core.records import GRAVITY_MPS2, ImuErrorModel, ImuReadings, StereoRig
from twin.estimate.vision.inertial_filter import InertialFilter

RATE_HZ, FRAME_HZ = 120.0, 30.0
QUIET = ImuErrorModel(1e-5, 1e-7, 1e-4, 1e-6, 1e-4, 1e-3)
REAL = ImuErrorModel(1.7e-4, 1.9e-5, 2e-3, 3e-3, 8.7e-3, 0.196)  # ADIS16448
RIG = StereoRig(
    320, 240, 300.0, 0.15, FRAME_HZ, geometry.pose(geometry.BODY_FROM_DOWN_CAMERA, np.array([0.2, 0.1, -0.05]))
)


def rates(t):
    return np.array([0.2 * np.sin(1.1 * t), 0.15 * np.cos(0.7 * t) - 0.15, 0.25 * np.sin(0.5 * t)])


def acceleration(t):  # in the world
    return np.array([0.3 * np.sin(0.9 * t), 0.2 * np.sin(1.3 * t), 0.1 * np.sin(1.7 * t)])


def path(duration_s, hz):
    """Returns times, poses world_from_body and IMU readings (rates, forces) of an integrated motion (DOP853)."""

    def derivative(t, y):
        return np.concatenate([(y[:9].reshape(3, 3) @ geometry.skew(rates(t))).ravel(), y[12:], acceleration(t)])

    times = np.arange(round(duration_s * hz) + 1) / hz
    start = np.concatenate([geometry.so3_exp(np.array([0.1, -0.05, 0.4])).ravel(), np.zeros(6)])
    states = solve_ivp(derivative, (0, times[-1]), start, "DOP853", times, rtol=1e-11, atol=1e-12).y.T
    poses = [geometry.pose(y[:9].reshape(3, 3), y[9:12]) for y in states]
    up = np.array([0.0, 0.0, GRAVITY_MPS2])
    forces = [pose[:3, :3].T @ (acceleration(t) + up) for t, pose in zip(times, poses, strict=True)]
    return times, np.array(poses), np.array([rates(t) for t in times]), np.array(forces)


def flown(noise, true_noise, blind, duration_s=12.0, seed=0, sigma=(2e-4, 3e-4)):
    """Returns errors (n, 6) and covariances (n, 6, 6) of the camera's pose; frames of `blind` have no measured pose."""
    rng, n = np.random.default_rng(seed), round(RATE_HZ / FRAME_HZ)
    times, poses, turn, force = path(duration_s, RATE_HZ)
    bias = np.concatenate(
        [true_noise.rate_bias * rng.standard_normal(3), true_noise.force_bias * rng.standard_normal(3)]
    )
    values = np.hstack([turn, force]) + bias
    values[:, :3] += true_noise.rate_density * np.sqrt(RATE_HZ) * rng.standard_normal((len(times), 3))
    values[:, 3:] += true_noise.force_density * np.sqrt(RATE_HZ) * rng.standard_normal((len(times), 3))
    cameras = poses @ RIG.body_from_camera
    found = InertialFilter(RIG, noise, ImuReadings(times[:1], values[:1, :3], values[:1, 3:]), np.zeros(6))
    cov, errors, covs = np.diag([sigma[0] ** 2] * 3 + [sigma[1] ** 2] * 3), [], []
    for k in range(n, len(times), n):
        part = slice(k - n + 1, k + 1)
        found.predict(1 / FRAME_HZ, ImuReadings(times[part], values[part, :3], values[part, 3:]))
        true = geometry.inverse(cameras[0]) @ cameras[k]
        if not blind[0] <= times[k] < blind[1]:
            measured = true @ geometry.exp(np.sqrt(np.diag(cov)) * rng.standard_normal(6))
            assert found.correct(measured, cov)
        errors.append(geometry.log(geometry.inverse(true) @ found.pose))
        covs.append(found.cov)
    return np.array(errors), np.array(covs)


def test_a_perfect_imu_predicts_the_path():
    errors, _ = flown(QUIET, ImuErrorModel(*[0.0] * 6), (2.0, 8.0), 8.0, sigma=(2e-5, 2e-5))
    blind = errors[round(2.0 * FRAME_HZ) :]
    assert np.linalg.norm(blind[:, :3], axis=1).max() < 3e-4
    assert np.linalg.norm(blind[:, 3:], axis=1).max() < 2e-2


def test_three_blind_seconds_are_bridged_and_the_errors_are_as_large_as_claimed():
    nees, ends = [], []
    for seed in range(20):
        errors, covs = flown(REAL, REAL, (9.0, 12.1), seed=seed)
        nees.append([e @ np.linalg.solve(c, e) for e, c in zip(errors[60::15], covs[60::15], strict=True)])
        ends.append(np.linalg.norm(errors[-1, 3:]))
    assert 0.6 < np.mean(nees) / 6 < 1.4
    assert np.median(ends) < 0.06 and max(ends) < 0.2


def test_the_prediction_is_better_than_a_constant_velocity():
    from twin.estimate.vision.motion_filter import MotionFilter

    times, poses, _, _ = path(12.0, FRAME_HZ)
    cameras, plain = poses @ RIG.body_from_camera, MotionFilter()
    for k in range(1, len(times)):
        plain.predict(1 / FRAME_HZ)
        if times[k] < 9.0:
            plain.correct(geometry.inverse(cameras[0]) @ cameras[k], np.eye(6) * 1e-8)
    lost = np.linalg.norm((geometry.inverse(cameras[0]) @ cameras[-1])[:3, 3] - plain.pose[:3, 3])
    errors, _ = flown(REAL, REAL, (9.0, 12.1))
    assert np.linalg.norm(errors[-1, 3:]) < 0.2 * lost


def test_a_new_reference_changes_only_the_pose():
    times, _, turn, force = path(1.0, RATE_HZ)
    found = InertialFilter(RIG, REAL, ImuReadings(times[:1], turn[:1], force[:1]), np.zeros(6))
    for k in range(4, 60, 4):
        found.predict(1 / FRAME_HZ, ImuReadings(times[k - 3 : k + 1], turn[k - 3 : k + 1], force[k - 3 : k + 1]))
    velocity = found.velocity
    found.restart()
    np.testing.assert_allclose(found.pose, np.eye(4), atol=1e-12)
    np.testing.assert_array_equal(found.velocity, velocity)
    assert not found.cov.any()


def test_a_gap_in_the_readings_makes_the_prediction_uncertain():
    times, _, turn, force = path(1.0, RATE_HZ)
    found = [InertialFilter(RIG, REAL, ImuReadings(times[:1], turn[:1], force[:1]), np.zeros(6)) for _ in range(2)]
    found[0].predict(1 / FRAME_HZ, ImuReadings(times[1:5], turn[1:5], force[1:5]))
    found[1].predict(1 / FRAME_HZ)
    assert (np.diag(found[1].cov) > 10 * np.diag(found[0].cov))[:3].all()


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_the_bias_of_the_gyroscope_is_found(axis):
    times, poses, turn, force = path(10.0, RATE_HZ)
    turn = turn + 0.01 * np.eye(3)[axis]
    cameras = poses @ RIG.body_from_camera
    found = InertialFilter(RIG, REAL, ImuReadings(times[:1], turn[:1], force[:1]), np.zeros(6))
    for k in range(4, len(times), 4):
        found.predict(1 / FRAME_HZ, ImuReadings(times[k - 3 : k + 1], turn[k - 3 : k + 1], force[k - 3 : k + 1]))
        found.correct(geometry.inverse(cameras[0]) @ cameras[k], np.diag([1e-8] * 3 + [1e-7] * 3))
    true = geometry.adjoint(geometry.inverse(RIG.body_from_camera))[:3, :3] @ rates(times[-1])
    np.testing.assert_allclose(found.velocity[:3], true, atol=1e-3)


@pytest.mark.parametrize("rate_hz", [90.0, 100.0, 40.0])
def test_the_prediction_ends_at_the_frame_also_if_no_reading_does(rate_hz):
    """At a constant velocity of 0.5 m/s, whose readings are exact at any rate."""
    times_s, velocity = np.arange(0, 12, 1 / rate_hz), np.array([0.5, 0.0, 0.0])
    cov, rng, errors, to_camera = np.diag([3e-4**2] * 3 + [5e-4**2] * 3), np.random.default_rng(1), [], None
    to_camera = RIG.body_from_camera[:3, :3].T
    found = InertialFilter(RIG, REAL, still(times_s[:1]).until(0.0), np.zeros(6))
    for k in range(1, 330):
        part = times_s[(times_s > (k - 1) / FRAME_HZ + 1e-9) & (times_s <= k / FRAME_HZ + 1e-9)]
        found.predict(1 / FRAME_HZ, still(part).until(k / FRAME_HZ))
        true = geometry.pose(np.eye(3), to_camera @ velocity * k / FRAME_HZ)
        if k > 100:
            errors.append(np.linalg.norm((geometry.inverse(true) @ found.pose)[:3, 3]))
        assert found.correct(true @ geometry.exp(np.sqrt(np.diag(cov)) * rng.standard_normal(6)), cov)
    assert np.sqrt(np.mean(np.square(errors))) < 1.5 * np.sqrt(np.trace(found.cov[3:, 3:])) + 3e-4


def still(times_s):
    return ImuReadings(times_s, np.zeros((len(times_s), 3)), np.tile([0, 0, GRAVITY_MPS2], (len(times_s), 1)))


def test_readings_last_until_the_time_of_the_frame():
    given = ImuReadings(np.array([1.0, 1.1]), np.arange(6.0).reshape(2, 3), np.arange(6.0, 12.0).reshape(2, 3))
    later = given.until(1.15)
    assert later.times_s.tolist() == [1.0, 1.1, 1.15]
    for before, after in zip(given[1:], later[1:], strict=True):
        np.testing.assert_array_equal(after, [*before, before[-1]])
    assert given.until(1.1) is given and len(still(np.zeros(0)).until(2.0).times_s) == 0


def test_an_imu_slower_than_the_camera_leaves_no_gap_but_a_silent_one_does():
    sigmas = []
    for n_silent in (1, 6):
        times_s = np.arange(0, 1, 1 / RATE_HZ)
        found = InertialFilter(RIG, REAL, still(times_s[:1]), np.zeros(6))
        for k in range(1, 20):
            found.predict(1 / FRAME_HZ, still(times_s[4 * k - 3 : 4 * k + 1]))
            found.correct(np.eye(4), np.eye(6) * 1e-8)
        for _ in range(n_silent):
            found.predict(1 / FRAME_HZ, still(np.zeros(0)))
        sigmas.append(np.sqrt(np.trace(found.cov[:3, :3])))
    assert sigmas[0] < 2e-3 and sigmas[1] > 3e-2
