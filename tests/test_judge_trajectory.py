"""Trajectory errors: comparison with evo, invariance to rigid motion, closed forms."""

import copy

import numpy as np
import pytest
from evo.core import metrics as evo_metrics
from evo.core.trajectory import PosePath3D
from hypothesis import given, settings
from hypothesis import strategies as st
from judge_synthetic import drifted, survey

from twin.core import geometry
from twin.core.records import Trajectory
from twin.judge.trajectory_errors import path_errors, track_metrics, trajectory_metrics

RESULT, _, TRUTH, _ = survey()
TRUE = TRUTH.trajectory


@settings(max_examples=20, deadline=None)
@given(st.lists(st.floats(-2.5, 2.5), min_size=6, max_size=6))
def test_anchoring_undoes_any_rigid_motion_of_the_estimate(motion):
    transformed = Trajectory(TRUE.times_s, geometry.exp(np.array(motion)) @ TRUE.world_from_camera)
    errors = path_errors(transformed, TRUE)
    assert errors.distance_m.max() < 1e-12 * 100  # round-off of two 4x4 products in metres
    assert np.abs(errors.heading_rad).max() < 1e-9


def test_ate_agrees_with_evo_aligned_at_the_origin():
    transformed = geometry.exp(np.array([0.1, -0.2, 2.0, 5.0, -3.0, 1.0])) @ RESULT.f2f.world_from_camera
    ours = trajectory_metrics(path_errors(Trajectory(TRUE.times_s, transformed), TRUE))
    reference, estimate = (PosePath3D(poses_se3=list(copy.deepcopy(p))) for p in (TRUE.world_from_camera, transformed))
    estimate.align_origin(traj_ref=reference)
    ape = evo_metrics.APE(evo_metrics.PoseRelation.translation_part)
    ape.process_data(data=(reference, estimate))
    statistics = ape.get_all_statistics()
    assert ours["ate_rmse_m"] == pytest.approx(statistics["rmse"], rel=1e-9)
    assert ours["ate_max_m"] == pytest.approx(statistics["max"], rel=1e-9)
    assert ours["path_m"] == pytest.approx(reference.path_length, rel=1e-9)


def test_a_scale_error_remains_because_no_transform_is_fitted():
    scaled = TRUE.world_from_camera.copy()
    scaled[:, :3, 3] = 1.01 * (scaled[:, :3, 3] - scaled[0, :3, 3]) + scaled[0, :3, 3]
    errors = path_errors(Trajectory(TRUE.times_s, scaled), TRUE)
    expected = 0.01 * np.linalg.norm(TRUE.positions - TRUE.positions[0], axis=1)
    np.testing.assert_allclose(errors.distance_m, expected, atol=1e-12)


def straight(n: int, yaw_rad: float = 0.0, offset_m: float = 0.0) -> Trajectory:
    """Returns a path along x at 1 m per frame, with a heading and height offset from the second frame on."""
    poses = np.tile(geometry.pose(geometry.BODY_FROM_DOWN_CAMERA, np.zeros(3)), (n, 1, 1))
    poses[:, 0, 3] = np.arange(n)
    poses[1:, 2, 3] = offset_m
    poses[1:, :3, :3] = geometry.rotation_from_rpy(0.0, 0.0, yaw_rad) @ geometry.BODY_FROM_DOWN_CAMERA
    return Trajectory(np.arange(n, dtype=float), poses)


def test_a_constant_height_error_has_its_closed_form():
    figures = trajectory_metrics(path_errors(straight(101, offset_m=0.5), straight(101)))
    rmse = 0.5 * np.sqrt(100 / 101)  # the first frame is anchored and has no error
    assert figures["ate_rmse_m"] == pytest.approx(rmse)
    assert figures["z_rmse_m"] == pytest.approx(rmse)
    assert figures["x_rmse_m"] == figures["y_rmse_m"] == 0
    assert figures["end_error_m"] == pytest.approx(0.5)
    assert figures["path_m"] == pytest.approx(100)
    assert figures["drift_percent"] == pytest.approx(0.5)


@pytest.mark.parametrize("yaw_deg", [5.0, 359.0, -359.0, 179.0])
def test_heading_error_is_wrapped(yaw_deg):
    facing_west = geometry.pose(geometry.rotation_from_rpy(0.0, 0.0, np.deg2rad(178)), np.zeros(3))  # wraps at 180 deg
    estimate, truth = straight(5, yaw_rad=np.deg2rad(yaw_deg)), straight(5)
    rotated = (Trajectory(t.times_s, facing_west @ t.world_from_camera) for t in (estimate, truth))
    errors = path_errors(*rotated)
    expected = (yaw_deg + 180) % 360 - 180
    np.testing.assert_allclose(np.rad2deg(errors.heading_rad[1:]), expected, atol=1e-9)


def test_a_shorter_estimate_is_evaluated_over_its_own_frames():
    part = Trajectory(TRUE.times_s[:50], TRUE.world_from_camera[:50])
    assert len(path_errors(part, TRUE).distance_m) == 50
    empty = trajectory_metrics(path_errors(Trajectory(np.zeros(0), np.zeros((0, 4, 4))), TRUE))
    assert set(empty.values()) == {None}


def test_keyframes_of_a_track_after_its_alignment_do_not_enter_the_row_of_the_track():
    keys = RESULT.keyframe_rows
    rng = np.random.default_rng(3)
    drifting = drifted(TRUE.world_from_camera, rng, 1e-3)
    up_to = keys[RESULT.track_of_keyframe <= 2]
    aligned = up_to[:-3]
    expected = np.sqrt(np.mean(np.sum((drifting[aligned, :3, 3] - TRUE.positions[aligned]) ** 2, axis=1)))
    result = copy.copy(RESULT)
    result.before_ga = [RESULT.before_ga[0], drifting[aligned, :3, 3]]
    rows = track_metrics(result, TRUTH)
    assert [row["track"] for row in rows] == [1, 2]
    assert rows[1]["before_ga_rmse_m"] == pytest.approx(expected)
    assert rows[0]["after_ga_rmse_m"] < rows[0]["before_ga_rmse_m"]
    assert rows[1]["ga_ms"] == 200 and rows[1]["nodes"] == len(up_to)
