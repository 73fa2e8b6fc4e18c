"""Tests of links between keyframes whose predicted poses are wrong by more than the search range of matching."""

from dataclasses import replace

import numpy as np
import pytest
import seafloor_scene as scene

from twin.core import geometry
from twin.core.records import Frame, Readings
from twin.core.settings import EstimatorSettings
from twin.estimate.stereo_vision import StereoVision
from twin.estimate.vision import wide_search
from twin.estimate.vision.pair_matching import SEARCH_PX
from twin.estimate.vision.stereo import Keyframe

RIG = scene.small_rig()
ALTITUDE_M = 2.0
MOTION = geometry.exp(np.array([0.004, -0.006, 0.01, 0.25, 0.08, -0.02]))  # true motion between the keyframes
OFFSET_M = 40 * ALTITUDE_M / RIG.focal_px  # error of the predicted position: 40 px in the image


@pytest.fixture(scope="module")
def views(tmp_path_factory):
    """A source of measurements, an earlier keyframe and a node, at their true poses."""
    floor, rng = scene.plane(0.05, -0.03, seed=2), np.random.default_rng(3)
    with StereoVision(RIG, EstimatorSettings(), tmp_path_factory.mktemp("views"), cell_m=0.01) as vision:
        keyframes = []
        for row, pose in enumerate((first := scene.down_camera(0.3, -0.2, ALTITUDE_M), first @ MOTION)):
            left, right, _ = scene.stereo_pair(floor, RIG, pose, rng)
            colour = [np.repeat(image[..., None], 3, axis=2) for image in (left, right)]
            frame = Frame(row, row / 30, *colour)
            vision.track_frame(frame)
            points = vision.observe_stereo(frame, row)
            assert points is not None
            keyframes.append(Keyframe(row, row, 1, pose, points, Readings()))
        yield vision, *keyframes


def believed(node, offset_m, sigmas):
    """Returns the node at a wrong pose; `sigmas` (6,) of the motion since the earlier keyframe, in camera axes."""
    pose = node.world_from_camera @ geometry.pose(np.eye(3), np.asarray(offset_m, float))
    to_world = geometry.adjoint(pose)
    cov = to_world @ np.diag(np.square(sigmas)) @ to_world.T
    return replace(node, world_from_camera=pose, accumulated_cov=cov)


def measured(views, offset_m, sigmas):
    """Returns the error [m] of the measured position of the node, None if the link could not be measured."""
    vision, earlier, node = views
    motion = vision.measure_motions(believed(node, offset_m, sigmas), [earlier])[0]
    return None if motion is None else np.linalg.norm(motion.a_from_b[:3, 3] - MOTION[:3, 3])


CERTAIN, UNCERTAIN = [1e-3] * 3 + [2e-3] * 3, [1e-3] * 3 + [OFFSET_M] * 3


def test_a_prediction_within_the_search_range_is_measured_without_a_search(views):
    assert measured(views, [2e-3, 0, 0], CERTAIN) < 2e-3


@pytest.mark.parametrize("offset_m", [[OFFSET_M, 0, 0], [0, -OFFSET_M, 0], [0.7 * OFFSET_M, 0.7 * OFFSET_M, 0]])
def test_an_uncertain_prediction_is_searched_in_the_whole_image(views, offset_m):
    assert measured(views, offset_m, UNCERTAIN) < 2e-3


def test_a_confident_prediction_costs_no_search(views, monkeypatch):
    monkeypatch.setattr(wide_search, "coarse_motion", lambda *_: pytest.fail("searched"))
    assert measured(views, [OFFSET_M, 0, 0], CERTAIN) is None


def test_a_motion_that_contradicts_the_prediction_is_rejected(views):
    """The error is along x, where the prediction claims to be known; across it is uncertain."""
    assert measured(views, [OFFSET_M, 0, 0], [1e-3] * 3 + [2e-3, OFFSET_M, OFFSET_M]) is None


def test_the_covariance_of_a_motion_is_the_difference_of_the_accumulated_ones_in_camera_axes(views):
    _, earlier, node = views
    sigmas = np.array([1e-3, 2e-3, 3e-3, 0.1, 0.2, 0.3])
    later = believed(node, [0, 0, 0], sigmas)
    np.testing.assert_allclose(later.motion_cov(earlier), np.diag(sigmas**2), atol=1e-12)
    assert np.abs(later.motion_cov(later)).max() == 0


@pytest.mark.parametrize("axis", range(6))
def test_the_search_starts_where_three_sigmas_of_the_image_positions_exceed_the_range(views, axis):
    """Closed form at the centre of the image; for a rotation about the optical axis, at the median distance from it."""
    _, _, node = views
    spread_px = np.hypot(*(node.points.pixels - [RIG.cx_px, RIG.cy_px]).T)
    depth_m = float(np.median(node.points.xyz[:, 2]))
    per_px = [1 / RIG.focal_px] * 2 + [1 / np.median(spread_px)] + [depth_m / RIG.focal_px] * 2
    limit = SEARCH_PX / 3 * [*per_px, depth_m / np.median(spread_px)][axis]
    for factor, expected in ((0.8, False), (1.2, True)):
        cov = np.zeros((6, 6))
        cov[axis, axis] = (factor * limit) ** 2
        assert wide_search.may_exceed(SEARCH_PX, node.points, cov, RIG) is expected


def test_a_prediction_whose_covariance_is_not_positive_definite_does_not_accept_any_motion():
    """After registrations with the mosaic, an eigenvalue may be negative, here along x."""
    cov, found_cov = np.diag([1e-6] * 3 + [-3.5e-7, 1e-4, 1e-4]), np.eye(6) * 1e-6
    near, far = (geometry.exp(np.array([0, 0, 0, x, 0, 0])) @ MOTION for x in (0.002, 0.5))
    assert wide_search.agrees(near, found_cov, MOTION, cov)
    assert not wide_search.agrees(far, found_cov, MOTION, cov)
