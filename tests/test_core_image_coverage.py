"""Coverage of points by images, compared with projections of each point into each image."""

import numpy as np
import pytest

from twin.core import geometry
from twin.core.image_coverage import NOT_SHOWN, image_coverage
from twin.core.records import StereoRig

RIG = StereoRig(320, 240, 277.0, 0.15, principal_point_px=(170.0, 112.0))


@pytest.mark.parametrize("baseline_m", [0.0, 0.15])
def test_the_coverage_is_that_of_projections_into_both_images(baseline_m):
    rng = np.random.default_rng(2)
    points = rng.uniform([-3, -3, -1.5], [3, 3, 2.5], (500, 3))  # some above the cameras
    poses = np.tile(np.eye(4), (6, 1, 1))
    for pose in poses:
        pose[:3, :3] = geometry.rotation_from_rpy(*rng.uniform(-0.6, 0.6, 3)) @ geometry.BODY_FROM_DOWN_CAMERA
        pose[:3, 3] = rng.uniform(-1, 1, 3) + [0, 0, 1]
    shown = np.zeros((6, 500), bool)
    for k, pose in enumerate(poses):
        in_camera = geometry.transform(geometry.inverse(pose), points)
        pixels = RIG.project(in_camera), RIG.project(in_camera - [baseline_m, 0, 0])
        inside = [((-0.5 <= p) & (p <= np.array([319.5, 239.5]))).all(axis=1) for p in pixels]
        shown[k] = inside[0] & inside[1] & (in_camera[:, 2] > 0)
    found = image_coverage(points, poses, RIG, baseline_m)
    assert shown.any(axis=0).sum() > 50
    np.testing.assert_array_equal(found.n_images, shown.sum(axis=0))
    np.testing.assert_array_equal(found.first, np.where(shown.any(axis=0), shown.argmax(axis=0), NOT_SHOWN))
    above = np.where(shown, poses[:, 2, 3, None] - points[:, 2], np.nan)
    some = shown.any(axis=0)
    np.testing.assert_allclose(found.height_m[some], np.nanmean(above[:, some], axis=0))
    assert np.isnan(found.height_m[~some]).all()
