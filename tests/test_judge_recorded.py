"""Comparison of a replay with a recorded truth: association and alignment as evo, truth that does not fit."""

import copy

import numpy as np
import pytest
from evo.core import metrics as evo_metrics
from evo.core import sync
from evo.core.trajectory import PoseTrajectory3D

from twin.core import geometry
from twin.core.records import StereoRig, SurveyResult, Trajectory
from twin.judge.metrics import EvaluationInput, evaluate
from twin.judge.recorded import (
    RecordedTruth,
    associate,
    in_world,
    recorded_consistency,
    recorded_errors,
    rigid_alignment,
    truth_warnings,
)  # fmt: skip
from twin.judge.trajectory_errors import trajectory_metrics
from twin.report.headline import headline

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


def test_a_frame_counts_once_also_where_the_truth_is_denser_but_shorter_than_the_recording():
    frames_s, true_s = np.arange(3030) / 30, np.arange(3000) / 100
    found = associate(frames_s, true_s)
    assert len(found.estimate) == len(np.unique(found.estimate)) == 900
    assert np.abs(frames_s[found.estimate] - true_s[found.truth]).max() < 0.0051  # the nearest one
    fast_s = np.arange(200) / 200
    assert len(associate(fast_s, np.arange(300) / 120).estimate) == 200  # two frames may have the same true pose


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


def noisy(positions, sigma_m, rng, turn=0.0):
    """Returns poses at noisy positions (n, 3), with equal attitudes that are turned about z [rad]."""
    poses = np.tile(geometry.pose(geometry.rotation_from_rpy(0, 0, turn), np.zeros(3)), (len(positions), 1, 1))
    poses[:, :3, 3] = positions + sigma_m * rng.normal(size=positions.shape)
    return Trajectory(np.arange(len(positions)) / 20, poses)


@pytest.mark.parametrize("scale_m", [0.0, 0.0005])
def test_the_turn_of_the_axes_is_not_judged_over_a_nearly_still_path(scale_m):
    """In noise of 1 mm any turn fits the positions best; 3 of 40 may seem determined."""
    rng, walk = np.random.default_rng(5), scale_m / 10 * np.random.default_rng(6).normal(size=(95, 3)).cumsum(axis=0)
    found = [truth_warnings(noisy(walk, 1e-3, rng), noisy(walk, 1e-3, rng)) for _ in range(40)]
    assert sum("turned by" in " ".join(one) for one in found) <= 3


def test_noise_of_a_truth_is_not_taken_for_another_scale():
    rng, still = np.random.default_rng(8), np.zeros((400, 3))
    assert truth_warnings(noisy(still, 1e-4, rng), noisy(still, 1e-3, rng)) == []


def test_a_turn_of_the_axes_is_found_along_a_curve_in_spite_of_drift():
    rng, t = np.random.default_rng(7), np.linspace(0, 1, 95)
    curve_m = np.column_stack([2 * t, 0.1 * np.sin(3 * t) + 0.03 * np.sin(9 * t), 0 * t])
    drifted = curve_m + 0.001 * rng.normal(size=(95, 3)).cumsum(axis=0)
    assert "turned by 9" in truth_warnings(noisy(drifted, 0, rng), noisy(curve_m, 1e-3, rng, np.pi / 2))[-1]
    assert truth_warnings(noisy(drifted, 0, rng), noisy(curve_m, 1e-3, rng)) == []


def test_a_straight_path_shows_no_turn_about_itself():
    """Bends of 0.1 mm towards opposite sides are fitted best by half a turn about the path."""
    rng, t = np.random.default_rng(9), np.linspace(-1, 1, 60)
    bent = np.column_stack([0.2 * t, 1e-4 * t**2, 0 * t])
    estimate, truth = noisy(bent, 0, rng), noisy(bent * [1, -1, 1], 0, rng)
    assert truth_warnings(estimate, truth) == []
    across = noisy(bent, 0, rng, np.pi / 2)
    assert "turned by 90 degrees" in truth_warnings(estimate, across)[-1]


def test_a_truth_without_poses_is_a_warning(pair):
    estimate, truth = pair
    empty = Trajectory(truth.times_s[:0], truth.world_from_camera[:0])
    assert truth_warnings(estimate, empty) == ["The truth has no poses."]


def test_too_few_true_poses_give_no_error(pair):
    estimate, truth = pair
    few = Trajectory(truth.times_s[:2], truth.world_from_camera[:2])
    assert trajectory_metrics(recorded_errors(estimate, few, "se3"))["ate_rmse_m"] is None


def test_errors_against_a_recorded_truth_are_judged_by_their_covariances():
    """Positions with errors of the claimed covariance have a mean NEES of 3, in camera axes that turn."""
    rng, n, cov = np.random.default_rng(6), 4000, np.diag([4e-6, 1e-6, 9e-6])
    poses = np.array([geometry.exp(np.array([0.3, -0.2, 1.0, 0.5, 0.2, 0.1]) * 0.01 * k) for k in range(n)])
    errors = rng.normal(size=(n, 3)) * np.sqrt(np.diag(cov))
    errors[0] = 0.0
    estimate = poses.copy()
    estimate[:, :3, 3] += np.einsum("nij,nj->ni", poses[:, :3, :3], errors)
    times_s, rows = np.arange(n) / 10, np.arange(0, n, 2)
    path, node_cov = Trajectory(times_s, estimate), np.tile(np.diag([1e-8] * 3 + list(np.diag(cov))), (len(rows), 1, 1))
    result = SurveyResult(path, path, path, rows, np.zeros_like(rows), node_cov)
    moved = geometry.exp(np.array([0.1, 0.2, -0.3, 4.0, 5.0, 6.0]))
    for every, alignment in ((1, "first"), (3, "first"), (1, "none")):
        true = Trajectory(times_s[::every], (np.eye(4) if alignment == "none" else moved) @ poses[::every])
        found = recorded_consistency(result, true, alignment)
        n_errors = len(rows) / every  # their mean chi-square of 3 has the standard deviation sqrt(6 / n)
        assert found["nees_position_mean"] == pytest.approx(3.0, abs=4 * np.sqrt(6 / n_errors)), (every, alignment)
        assert found["within_2sigma_position"] == pytest.approx(0.954, abs=0.02)
    first = Trajectory(times_s[:10], estimate[:10])
    short = SurveyResult(first, first, first, rows[:5], np.zeros(5, np.int64), node_cov[:5])
    expected = np.mean(np.sum(errors[rows[1:5]] ** 2 / np.diag(cov), axis=1))  # not the one at which it was aligned
    found = recorded_consistency(short, Trajectory(times_s[:10], moved @ poses[:10]), "first")
    assert found["nees_position_mean"] == pytest.approx(expected)


def test_a_truth_interpolated_along_a_screw_motion_is_named_and_does_not_judge_covariances():
    """Poses between two true ones, at the speeds of the vehicle, as rounded in a file; those of the vehicle itself."""
    rng, screw = np.random.default_rng(4), np.array([1e-4, -6e-4, -7e-4, -0.014, -0.028, 1.19])
    at, wander = np.cumsum(1 + 0.01 * rng.normal(size=12)), rng.normal(size=(12, 6)) * [1e-3, 1e-3, 1e-3, 0, 0, 0]
    times_s = np.arange(12) / 10
    truth = Trajectory(times_s, np.array([geometry.exp(screw * s).round(7) for s in at]))
    real = Trajectory(
        times_s, np.array([geometry.exp(screw * s) @ geometry.exp(w) for s, w in zip(at, wander, strict=True)])
    )
    rows = np.arange(12)
    result = SurveyResult(real, real, real, rows, rows, np.tile(np.eye(6) * 1e-6, (12, 1, 1)))
    (warning,) = truth_warnings(real, truth)
    assert "interpolated" in warning and recorded_consistency(result, truth, "first") == {}
    assert (
        truth_warnings(truth, real) == [] and recorded_consistency(result, real, "first")["nees_position_mean"] < 1e-9
    )


@pytest.mark.parametrize("offset_s", (1.0, -0.6))
def test_a_truth_whose_clock_is_off_by_up_to_two_seconds_is_named(offset_s):
    times_s = np.arange(0, 30, 0.1)
    true = curve(times_s)
    estimate = Trajectory(times_s, geometry.exp(np.array([0.2, 0.1, -0.4, 1.0, 2.0, 3.0])) @ true.world_from_camera)
    shifted = Trajectory(times_s + offset_s, true.world_from_camera)
    (warning,) = [text for text in truth_warnings(estimate, shifted) if "clock" in text]
    assert f"shifted by {-offset_s:+.2f} s" in warning
    assert not any("clock" in text for text in truth_warnings(estimate, true))


def test_a_straight_path_shows_no_offset_of_the_clock():
    times_s, noise = np.arange(0, 30, 0.1), np.random.default_rng(3).normal(size=(300, 3)) * 1e-3
    poses = np.tile(np.eye(4), (300, 1, 1))
    poses[:, 0, 3] = 0.3 * times_s
    estimate = Trajectory(times_s, poses.copy())
    estimate.world_from_camera[:, :3, 3] += noise
    assert not truth_warnings(estimate, Trajectory(times_s + 1.0, poses))


def test_a_truth_that_covers_a_quarter_of_the_frames_is_named(pair):
    times_s = np.arange(0, 30, 0.1)
    true = curve(times_s)
    part = Trajectory(times_s[:75], true.world_from_camera[:75])
    assert truth_warnings(true, part) == ["Only 75 of 300 frames have a true pose; errors are those of these frames."]


def result_of(path, every):
    rows = np.arange(0, len(path), every)
    return SurveyResult(path, path, path, rows, np.ones_like(rows), np.tile(np.eye(6) * 1e-4, (len(rows), 1, 1)))


def test_two_true_poses_in_another_world_judge_no_covariances():
    path = curve(np.arange(40) / 5)
    truth = Trajectory(path.times_s[[10, 12]], MOVED @ path.world_from_camera[[10, 12]])
    assert recorded_consistency(result_of(path, 2), truth, "se3") == {}
    source = {"reader": "x", "skipped": {}}
    survey = EvaluationInput(
        result_of(path, 2), None, RecordedTruth(truth, "se3"), StereoRig(64, 48, 50.0, 0.1, 1.0), source=source
    )
    assert "Too few frames have a true pose" in headline(evaluate(survey), {})


def test_errors_have_the_axes_of_the_estimates_as_in_the_report():
    """The true z axis lies across the heights of the estimates, whose error is in height alone."""
    path = curve(np.arange(40) / 5)
    poses = path.world_from_camera.copy()
    poses[:, 2, 3] += 0.05 * np.random.default_rng(1).normal(size=40)
    turned = geometry.exp(np.array([np.pi / 2, 0, 0, 1.0, 2.0, 3.0]))
    estimate, truth = Trajectory(path.times_s, poses), Trajectory(path.times_s, turned @ path.world_from_camera)
    survey = EvaluationInput(
        result_of(estimate, 2), None, RecordedTruth(truth, "se3"), StereoRig(64, 48, 50.0, 0.1, 1.0), source={}
    )
    found = evaluate(survey)["trajectory"]["final"]
    assert found["z_rmse_m"] > 5 * max(found["x_rmse_m"], found["y_rmse_m"])
    written = in_world(truth, estimate, "se3")  # trajectory_truth.tum
    shown = trajectory_metrics(recorded_errors(estimate, written, "se3"))
    assert found["z_rmse_m"] == pytest.approx(shown["z_rmse_m"])
    assert found["heading_rmse_deg"] == pytest.approx(shown["heading_rmse_deg"])


def test_a_truth_that_covers_less_than_half_of_the_frames_has_no_other_clock():
    path = curve(np.arange(200) / 10)
    truth = curve(np.arange(-50, 90) / 10)
    (warning,) = truth_warnings(path, truth)
    assert "Only 90 of 200 frames" in warning


def test_a_truth_interpolated_between_the_frames_is_named_where_it_judges_no_covariances():
    rng, knots = np.random.default_rng(3), curve(np.arange(31.0))
    truth = []
    for k in range(600):
        first, second = knots.world_from_camera[k // 20 : k // 20 + 2]
        truth.append(first @ geometry.exp(k % 20 / 20 * geometry.log(geometry.inverse(first) @ second)))
    truth = Trajectory(np.arange(600) / 20, np.array(truth))
    poses = truth.world_from_camera[::10].copy()
    poses[:, :3, 3] += 0.01 * rng.normal(size=(60, 3))
    estimate = Trajectory(np.arange(60) / 2, poses)
    assert recorded_consistency(result_of(estimate, 2), truth, "se3") == {}
    assert any("interpolated" in warning for warning in truth_warnings(estimate, truth))
