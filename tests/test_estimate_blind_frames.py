"""Frames without a measured motion: their poses are the most likely ones between the measured frames."""

import numpy as np

from twin.core import geometry
from twin.core.records import Readings, SensorNoise, StereoRig
from twin.estimate.blind_frames import BlindFrame, aligned, blind_frame

MOUNT = geometry.pose(geometry.BODY_FROM_DOWN_CAMERA, np.zeros(3))
RIG = StereoRig(320, 240, 277.0, 0.15, 10.0, MOUNT)
NOISE = SensorNoise(pressure_m=0.01)
SIGMA_M = 0.02  # of each component of a predicted step
COV = np.diag([1e-6] * 3 + [SIGMA_M**2] * 3)


def test_heights_of_blind_frames_are_those_of_a_dense_least_squares_fit():
    """Unknowns z of 12 frames between two known ones: steps of 0 with SIGMA_M, readings with 0.01 m."""
    rng, n = np.random.default_rng(2), 12
    path = np.tile(MOUNT, (n + 2, 1, 1))
    path[:, 0, 3], path[-1, 2, 3] = 0.1 * np.arange(n + 2), 0.05
    read = 0.03 + 0.01 * rng.normal(size=n)
    step = MOUNT.copy()
    step = geometry.inverse(MOUNT) @ geometry.pose(np.eye(3), np.array([0.1, 0.0, 0.0])) @ MOUNT
    blind = [BlindFrame(k + 1, step, COV, Readings(pressure_z_m=float(read[k])), False) for k in range(n)]
    z = aligned(path, blind, {0, n + 1}, RIG, NOISE)[:, 2, 3]
    differences = np.diff(np.eye(n + 2), axis=0) / SIGMA_M
    a = np.vstack([differences, np.eye(n + 2)[1:-1] / 0.01])
    b = np.concatenate([np.zeros(n + 1), read / 0.01])
    known = a[:, [0, -1]] @ [0.0, 0.05]
    expected = np.linalg.lstsq(a[:, 1:-1], b - known, rcond=None)[0]
    # rotations of 1 mrad per frame are free, too: they move a step of 0.1 m by 0.1 mm
    np.testing.assert_allclose(z[1:-1], expected, atol=3e-4)
    assert z[0] == 0.0 and z[-1] == 0.05


def drifting(rng, n, biased):
    """Returns true poses, an estimated path and blind frames: predictions that brake while the vehicle flies on."""
    true = np.array([geometry.pose(np.eye(3), np.array([0.03 * k, 0.0, 0.0])) @ MOUNT for k in range(n)])
    blind, state = [], (np.eye(4), np.zeros((6, 6)))
    for k in range(5, n - 5):
        speed = 0.03 * np.exp(-max(0, k - 20) / 10) if biased else 0.03
        step = geometry.inverse(MOUNT) @ geometry.pose(np.eye(3), np.array([speed, 0.0, 0.0])) @ MOUNT
        after = state[0] @ step, geometry.transport_covariance(state[1], step) + COV
        heights = Readings(pressure_z_m=float(true[k][2, 3] + 0.01 * rng.normal()))
        blind.append(blind_frame(k, state, after, heights, biased))
        state = after
    return true, blind


def test_the_motion_of_a_blind_frame_is_that_since_the_previous_one():
    true, blind = drifting(np.random.default_rng(0), 40, biased=False)
    for frame in blind:
        np.testing.assert_allclose(frame.motion, geometry.inverse(true[frame.row - 1]) @ true[frame.row], atol=1e-12)
        np.testing.assert_allclose(frame.cov, COV, atol=1e-12)


def test_blind_frames_do_not_follow_the_noise_of_each_reading():
    """Thirty frames: the readings of 0.01 m are averaged, and predictions that brake are closed at the end."""
    for seed in range(5):
        true, blind = drifting(np.random.default_rng(seed), 40, biased=True)
        found = aligned(true, blind, set(), RIG, NOISE)
        error = found[:, :3, 3] - true[:, :3, 3]
        read = np.array([frame.readings.pressure_z_m for frame in blind]) - true[5:-5, 2, 3]
        assert np.sqrt(np.mean(error[:, 2] ** 2)) < 0.8 * np.sqrt(np.mean(read**2))
        # 0.9 m flown; the predictions are right for 0.45 m, then brake; with equal weights 0.12 m
        assert np.abs(error[:, 0]).max() < 0.05


def test_blind_frames_at_the_end_are_dead_reckoning_and_a_path_without_any_stays():
    true, blind = drifting(np.random.default_rng(1), 40, biased=False)
    path = true[:35].copy()
    found = aligned(path, blind, set(), RIG, NOISE)
    np.testing.assert_allclose(found[:, :2, 3], true[:35, :2, 3], atol=1e-3)
    assert np.array_equal(aligned(path, [], set(), RIG, NOISE), path)
    assert np.array_equal(aligned(path, blind, set(range(35)), RIG, NOISE), path)  # all of them are keyframes
