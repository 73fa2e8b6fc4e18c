"""Comparison of a replay with a recorded truth: association and alignment as evo, truth that does not fit."""

import copy

import numpy as np
import pytest
from evo.core import metrics as evo_metrics
from evo.core import sync
from evo.core.trajectory import PoseTrajectory3D

from twin.core import geometry
from twin.core.records import Trajectory
from twin.judge.recorded import associate, recorded_errors, rigid_alignment, truth_warnings
from twin.judge.trajectory import trajectory_metrics

RNG = np.random.default_rng(2)
MOVED = geometry.exp(np.array([0.4, -1.1, 2.0, 5.0, -3.0, 1.0]))


def curve(times_s):
    """Returns a smooth trajectory of a camera."""
    poses = [geometry.exp(np.array([0.1 * t, 0.2 * np.sin(t), 0.3, t, np.sin(2 * t), 0.3 * t**2])) for t in times_s]
    return Trajectory(np.asarray(times_s), np.array(poses))


@pytest.fixture
def pair():
    """Estimates at 5 Hz with noise, in another world; truth at 100 Hz with another phase, and a gap."""
    estimate, true_s = curve(np.arange(40) / 5), np.arange(900) / 100 + 0.0031
    noise = np.array([geometry.exp(0.01 * RNG.normal(size=6)) for _ in range(40)])
    moved = Trajectory(estimate.times_s, MOVED @ estimate.world_from_camera @ noise)
    return moved, curve(true_s[(true_s < 2.985) | (true_s > 3.7)])


def evo(path):
    poses = list(path.world_from_camera)
    return PoseTrajectory3D(poses_se3=poses, timestamps=path.times_s)


@pytest.mark.parametrize("swapped", [False, True])
def test_poses_are_associated_as_evo_does(pair, swapped):
    first, second = reversed(pair) if swapped else pair
    found = associate(first.times_s, second.times_s)
    a, b = sync.associate_trajectories(evo(first), evo(second), max_diff=0.01)
    np.testing.assert_array_equal(first.times_s[found.estimate], a.timestamps)
    np.testing.assert_array_equal(second.times_s[found.truth], b.timestamps)
    assert 30 < len(found.estimate) < 40


@pytest.mark.parametrize("alignment", ["se3", "first", "none"])
def test_the_absolute_trajectory_error_is_that_of_evo(pair, alignment):
    true, estimate = sync.associate_trajectories(evo(pair[1]), evo(pair[0]), max_diff=0.01)
    estimate = copy.deepcopy(estimate)
    if alignment == "se3":
        estimate.align(true)
    elif alignment == "first":
        estimate.align_origin(true)
    error = evo_metrics.APE(evo_metrics.PoseRelation.translation_part)
    error.process_data((true, estimate))
    found = trajectory_metrics(recorded_errors(*pair, alignment))
    assert found["ate_rmse_m"] == pytest.approx(error.get_statistic(evo_metrics.StatisticsType.rmse), abs=1e-9)
    assert found["ate_max_m"] == pytest.approx(error.get_statistic(evo_metrics.StatisticsType.max), abs=1e-9)


def test_a_rigid_motion_is_undone_also_for_positions_in_a_plane():
    points = RNG.normal(size=(20, 3)) * [1, 2, 0]
    for motion in (geometry.exp(RNG.normal(size=6)) for _ in range(8)):
        np.testing.assert_allclose(rigid_alignment(points, geometry.transform(motion, points)), motion, atol=1e-9)


def test_a_truth_of_another_clock_unit_or_body_is_named(pair):
    estimate, truth = pair
    assert truth_warnings(estimate, truth) == []
    later = Trajectory(truth.times_s + 1e6, truth.world_from_camera)
    assert "another clock" in truth_warnings(estimate, later)[0]
    millimetres = truth.world_from_camera.copy()
    millimetres[:, :3, 3] *= 1000
    assert "another unit" in truth_warnings(estimate, Trajectory(truth.times_s, millimetres))[0]
    body = truth.world_from_camera @ geometry.pose(geometry.rotation_from_rpy(np.pi, 0, np.pi / 2), np.zeros(3))
    found = truth_warnings(estimate, Trajectory(truth.times_s, body))
    assert "turned by 180 degrees" in found[0] and "another body" in found[0]


def test_a_truth_without_poses_is_a_warning(pair):
    estimate, truth = pair
    empty = Trajectory(truth.times_s[:0], truth.world_from_camera[:0])
    assert truth_warnings(estimate, empty) == ["The truth has no poses."]


def test_too_few_true_poses_give_no_error(pair):
    estimate, truth = pair
    few = Trajectory(truth.times_s[:2], truth.world_from_camera[:2])
    assert trajectory_metrics(recorded_errors(estimate, few, "se3"))["ate_rmse_m"] is None
