"""Correction of a rolling shutter: against points seen from the exact pose of each row."""

from dataclasses import replace

import numpy as np
import pytest

from twin.core import geometry
from twin.core.records import StereoRig
from twin.estimate.vision.rolling_shutter import at_mid_exposure

RIG = StereoRig(320, 240, 277.0, 0.15, readout_s=0.016)
TWISTS = [*(0.5 * np.eye(6)), np.array([0.2, -0.3, 0.4, 0.5, -0.4, 0.2])]


def seen(xyz, twist):
    """Returns normalised (x, y, disparity) (n, 3) of points (n, 3), each from the pose at the time of its own row."""
    found = xyz[:, :2] / xyz[:, 2:]
    for _ in range(8):
        time_s = RIG.readout_s * ((found[:, 1] * RIG.focal_px + RIG.cy_px) / (RIG.height_px - 1) - 0.5)
        moved = np.array(
            [geometry.transform(geometry.inverse(geometry.exp(twist * t)), p) for t, p in zip(time_s, xyz, strict=True)]
        )
        found = moved[:, :2] / moved[:, 2:]
    return np.column_stack([found, RIG.baseline_m / moved[:, 2]])


@pytest.mark.parametrize("twist", TWISTS)
def test_the_correction_leaves_two_percent_of_the_motion_during_the_readout(twist):
    x, y, z = np.random.default_rng(0).uniform((-0.55, -0.42, 1.5), (0.55, 0.42, 2.5), (60, 3)).T
    xyz = np.column_stack([x * z, y * z, z])
    true = np.column_stack([x, y, RIG.baseline_m / z])
    shown = seen(xyz, twist)
    error_px = np.abs(at_mid_exposure(shown, twist, RIG) - true).max() * RIG.focal_px
    shift_px = np.abs(shown - true).max() * RIG.focal_px
    assert error_px < 0.02 * shift_px and shift_px > 0.1


def test_a_global_shutter_and_an_unknown_motion_change_nothing():
    points = np.array([[0.1, 0.2, 0.08]])
    assert at_mid_exposure(points, TWISTS[0], replace(RIG, readout_s=0.0)) is points
    assert at_mid_exposure(points, None, RIG) is points
