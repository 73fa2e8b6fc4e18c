"""Refraction by flat ports as the estimators correct it, against rays traced through both faces of the glass."""

import numpy as np
import pytest

from twin.core.records import StereoRig
from twin.core.refraction import FlatPort
from twin.imaging.camera.port import air_coordinates, pinhole, water_rays
from twin.imaging.camera.true_cameras import make_true_cameras
from twin.scenario.file import load_scenario
from twin.scenario.model import PortConfig

PORT = PortConfig(kind="flat", thickness_m=0.01, distance_m=0.02, calibrated_at_m=2.0)
FOCAL_PX = 277.0


def seen_at(radius, depth_m):
    """Returns where an image that is exact at 2 m shows a point with the pinhole position (radius, 0), by its ray."""
    centre_m = pinhole(PORT).centre_m
    point = np.array([[radius * depth_m, 0.0, depth_m + centre_m]])
    origin, direction = water_rays(PORT, air_coordinates(PORT, point))
    return (origin[0, 0] + direction[0, 0] / direction[0, 2] * (2.0 + centre_m - origin[0, 2])) / 2.0


@pytest.mark.parametrize("radius", [0.1, 0.3, 0.55, 0.7])
@pytest.mark.parametrize("depth_m", [1.2, 1.7, 2.5])
def test_the_correction_leaves_one_and_a_half_percent_of_the_error_of_a_traced_ray(radius, depth_m):
    shown = seen_at(radius, depth_m)
    (x, y) = PORT.believed().pinhole_positions(np.array([shown, 0.0]), np.array(depth_m))
    assert abs(shown - radius) * FOCAL_PX > 1e-4 and y == 0
    assert abs(x - radius) < 0.015 * abs(shown - radius) + 1e-9


def test_points_at_the_depth_of_the_calibration_and_on_the_axis_stay():
    port = PORT.believed()
    np.testing.assert_array_equal(port.pinhole_positions(np.array([[0.3, -0.4]]), np.array([2.0])), [[0.3, -0.4]])
    np.testing.assert_array_equal(port.pinhole_positions(np.zeros((1, 2)), np.array([1.0])), np.zeros((1, 2)))


def test_matched_points_of_the_true_cameras_have_the_disparity_and_rows_of_pinhole_cameras():
    """Within 0.005 px, where the uncorrected images are up to 0.1 px off; the depth comes from the same disparity."""
    scenario = load_scenario("reef", ["rig.model=machine_vision_flat", "calibration_error.rotation_sigma_deg=0"])
    cameras, rig = make_true_cameras(scenario), scenario.believed_rig()
    x, y, z = np.meshgrid(np.linspace(-0.5, 0.5, 9), np.linspace(-0.4, 0.4, 7), [1.5, 1.8, 2.4])
    points_m = np.stack([x * z, y * z, z], -1).reshape(-1, 3)
    left = cameras.project(points_m, 0)
    right = cameras.project(points_m - [cameras.rendered_rig.baseline_m, 0, 0], 1)
    corrected = rig.without_refraction(left, right)
    expected_px = rig.focal_px * cameras.rendered_rig.baseline_m / points_m[:, 2]
    before, after = (np.abs(one[:, 0] - two[:, 0] - expected_px).max() for one, two in ((left, right), corrected))
    assert after < 0.005 < 0.03 < before
    assert np.abs(corrected[0][:, 1] - corrected[1][:, 1]).max() < 0.003
    np.testing.assert_allclose(corrected[0], rig.project(points_m), atol=0.005)


def test_rigs_without_a_known_flat_port_are_not_corrected():
    for port in (PortConfig(kind="dome", calibrated_at_m=2.0), PortConfig(kind="flat")):
        assert port.believed() is None
    points = np.ones((2, 2))
    assert StereoRig(64, 48, 50.0, 0.1).without_refraction(points, points)[0] is points
    assert isinstance(PORT.believed(), FlatPort)
