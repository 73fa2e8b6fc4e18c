"""Errors of calibration: where the true cameras see points, by OpenCV's projection, in the documented directions."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from twin.imaging.true_cameras import make_view
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


def view_with(**calibration):
    here = Scenario.model_validate(
        {"rig": {"image_width_px": 320, "image_height_px": 240}, "calibration_error": calibration}
    )
    return make_view(here), here.believed_rig()


def by_opencv(rig, errors: dict, eye: int) -> np.ndarray:
    """Pixels (n, 2) of POINTS, given in the axes of the ideal eye."""
    side = "right" if eye else "left"
    centre = np.array([rig.cx_px, rig.cy_px]) + errors.get(f"{side}_principal_point_error_px", (0.0, 0.0))
    focal = rig.focal_px * (1 + errors.get("focal_error", 0.0))
    angles = [errors.get(f"right_{k}_deg", 0.0) for k in ("yaw", "pitch", "roll")]
    turn = Rotation.from_euler("YXZ", angles, degrees=True) if eye else Rotation.identity()
    matrix = np.array([[focal, 0, centre[0]], [0, focal, centre[1]], [0, 0, 1]])
    return cv2.projectPoints(POINTS, turn.inv().as_rotvec(), np.zeros(3), matrix, np.zeros(5))[0][:, 0]


@pytest.mark.parametrize("errors", ERRORS)
def test_the_true_cameras_see_points_where_opencv_does(errors):
    view, rig = view_with(**errors)
    for eye in (0, 1):
        np.testing.assert_allclose(view.project(POINTS, eye), by_opencv(rig, errors, eye), atol=1e-9)


@pytest.mark.parametrize("errors", ERRORS)
def test_the_images_are_those_of_the_true_cameras(errors):
    """Light that tells its own place: a pixel where a point is projected to shows the point."""
    view, _ = view_with(**errors)
    u, v = np.meshgrid(np.arange(view.rig.width_px), np.arange(view.rig.height_px))
    light = np.stack([u, v, u], axis=-1).astype(np.float32)
    for eye in (0, 1):
        seen = view.frame(view.raw(light, np.full(u.shape, 2.0, np.float32), eye))
        for place, ideal in zip(view.project(POINTS, eye), view.rig.project(POINTS), strict=True):
            shown = cv2.remap(seen[..., :2], *place.astype(np.float32).reshape(2, 1, 1), cv2.INTER_LINEAR).ravel()
            np.testing.assert_allclose(shown, ideal, atol=0.04)  # OpenCV's places are whole 1/32 px


def test_errors_point_where_they_are_said_to():
    """Of the right camera: up shows the floor lower, away from the left one to the left, clockwise turns it back."""
    ahead, aside = np.array([[0.0, 0.0, 2.0]]), np.array([[0.5, 0.0, 2.0]])
    _, rig = view_with()
    up, away, clockwise = (view_with(**{f"right_{k}_deg": 1.0})[0] for k in ("pitch", "yaw", "roll"))
    step_px = rig.focal_px * np.tan(np.deg2rad(1.0))
    np.testing.assert_allclose(up.project(ahead, 1)[0] - [rig.cx_px, rig.cy_px], [0, step_px], atol=1e-9)
    np.testing.assert_allclose(away.project(ahead, 1)[0] - [rig.cx_px, rig.cy_px], [-step_px, 0], atol=1e-9)
    assert clockwise.project(aside, 1)[0, 1] < rig.cy_px - 1
    for view in (up, away, clockwise):
        np.testing.assert_allclose(view.project(POINTS, 0), rig.project(POINTS), atol=1e-9)


def test_with_a_longer_baseline_than_believed_the_floor_comes_out_too_near():
    """Depth is f b / disparity: 1 % more of the baseline is 1 % more of disparity."""
    view, rig = view_with(baseline_error=0.01)
    in_right = POINTS - [view.rig.baseline_m, 0.0, 0.0]
    disparity_px = view.project(POINTS, 0)[:, 0] - view.project(in_right, 1)[:, 0]
    np.testing.assert_allclose(rig.focal_px * rig.baseline_m / disparity_px, POINTS[:, 2] / 1.01, rtol=1e-12)


def test_a_lens_that_folds_shows_no_point_twice():
    """With k1 = -0.2 a point 66 deg off the axis would be seen in the middle again; no ray of the lens leads there."""
    here = Scenario.model_validate({"rig": {"image_width_px": 320, "image_height_px": 240}, "lens": {"k1": -0.2}})
    aside = np.array([[2.2, 0.0, 1.0], [0.0, -2.27, 1.0]])
    assert np.isnan(make_view(here).project(aside)).all()
    assert np.isfinite(make_view(here).project(POINTS)).all()
