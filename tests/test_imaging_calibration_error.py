"""Calibration errors: true projections agree with OpenCV and have the documented directions."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from twin.imaging.camera.true_cameras import make_true_cameras
from twin.scenario.model import Scenario

POINTS = np.array([[0.0, 0.0, 2.0], [0.6, 0.4, 2.0], [-0.5, 0.3, 1.5], [0.3, -0.45, 3.0]])
ERRORS = [
    {"focal_error": 0.02},
    {"left_principal_point_error_px": (3.0, -2.0), "right_principal_point_error_px": (-1.5, 4.0)},
    {"right_roll_deg": 1.0},
    {"right_pitch_deg": 0.7},
    {"right_yaw_deg": -0.9},
    {"focal_error": -0.01, "right_roll_deg": -1.0, "right_pitch_deg": 0.5, "right_yaw_deg": 0.4, "baseline_error": 0.1},
]


def cameras_with(**calibration):
    here = Scenario.model_validate(
        {"rig": {"image_width_px": 320, "image_height_px": 240}, "calibration_error": calibration}
    )
    return make_true_cameras(here), here.believed_rig()


def pixels_by_opencv(rig, errors: dict, camera: int) -> np.ndarray:
    """Returns the pixels (n, 2) of POINTS, which are given in the axes of the ideal camera."""
    side = "right" if camera else "left"
    centre = np.array([rig.cx_px, rig.cy_px]) + errors.get(f"{side}_principal_point_error_px", (0.0, 0.0))
    focal = rig.focal_px * (1 + errors.get("focal_error", 0.0))
    angles = [errors.get(f"right_{k}_deg", 0.0) for k in ("yaw", "pitch", "roll")]
    rotation = Rotation.from_euler("YXZ", angles, degrees=True) if camera else Rotation.identity()
    matrix = np.array([[focal, 0, centre[0]], [0, focal, centre[1]], [0, 0, 1]])
    return cv2.projectPoints(POINTS, rotation.inv().as_rotvec(), np.zeros(3), matrix, np.zeros(5))[0][:, 0]


@pytest.mark.parametrize("errors", ERRORS)
def test_points_project_as_in_opencv(errors):
    cameras, rig = cameras_with(**errors)
    for camera in (0, 1):
        np.testing.assert_allclose(cameras.project(POINTS, camera), pixels_by_opencv(rig, errors, camera), atol=1e-9)


@pytest.mark.parametrize("errors", ERRORS)
def test_frames_show_points_at_their_projection(errors):
    """The rendered light encodes its own column and row, so that a pixel of the frame identifies the point it shows."""
    cameras, _ = cameras_with(**errors)
    u, v = np.meshgrid(np.arange(cameras.rendered_rig.width_px), np.arange(cameras.rendered_rig.height_px))
    light = np.stack([u, v, u], axis=-1).astype(np.float32)
    for camera in (0, 1):
        frame = cameras.rectify(cameras.sample(light, np.full(u.shape, 2.0, np.float32), camera))
        for pixel, ideal in zip(cameras.project(POINTS, camera), cameras.rendered_rig.project(POINTS), strict=True):
            shown = cv2.remap(frame[..., :2], *pixel.astype(np.float32).reshape(2, 1, 1), cv2.INTER_LINEAR).ravel()
            np.testing.assert_allclose(shown, ideal, atol=0.04)  # OpenCV rounds positions to 1/32 px


def test_rotation_errors_have_the_documented_signs():
    """Right camera pitched up: the floor appears lower; yawed outwards: to the left; rolled clockwise: rotated back."""
    ahead, aside = np.array([[0.0, 0.0, 2.0]]), np.array([[0.5, 0.0, 2.0]])
    _, rig = cameras_with()
    up, outwards, clockwise = (cameras_with(**{f"right_{k}_deg": 1.0})[0] for k in ("pitch", "yaw", "roll"))
    step_px = rig.focal_px * np.tan(np.deg2rad(1.0))
    np.testing.assert_allclose(up.project(ahead, 1)[0] - [rig.cx_px, rig.cy_px], [0, step_px], atol=1e-9)
    np.testing.assert_allclose(outwards.project(ahead, 1)[0] - [rig.cx_px, rig.cy_px], [-step_px, 0], atol=1e-9)
    assert clockwise.project(aside, 1)[0, 1] < rig.cy_px - 1
    for cameras in (up, outwards, clockwise):
        np.testing.assert_allclose(cameras.project(POINTS, 0), rig.project(POINTS), atol=1e-9)


def test_a_baseline_longer_than_believed_underestimates_depth():
    """Depth is f b / disparity: a 1 % longer baseline gives 1 % more disparity."""
    cameras, rig = cameras_with(baseline_error=0.01)
    in_right = POINTS - [cameras.rendered_rig.baseline_m, 0.0, 0.0]
    disparity_px = cameras.project(POINTS, 0)[:, 0] - cameras.project(in_right, 1)[:, 0]
    np.testing.assert_allclose(rig.focal_px * rig.baseline_m / disparity_px, POINTS[:, 2] / 1.01, rtol=1e-12)


def test_points_beyond_the_fold_of_a_lens_are_not_projected():
    """With k1 = -0.2 the distortion polynomial maps a point 66 deg off the axis to the image centre."""
    here = Scenario.model_validate({"rig": {"image_width_px": 320, "image_height_px": 240}, "lens": {"k1": -0.2}})
    aside = np.array([[2.2, 0.0, 1.0], [0.0, -2.27, 1.0]])
    assert np.isnan(make_true_cameras(here).project(aside)).all()
    assert np.isfinite(make_true_cameras(here).project(POINTS)).all()
