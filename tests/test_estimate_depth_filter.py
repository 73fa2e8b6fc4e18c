"""Tests of the Kalman depth filter against closed forms."""

import numpy as np
import pytest
from seafloor_scene import digitise, down_camera, plane, render_view, small_rig

from twin.core import geometry
from twin.estimate.mapping import depth_filter
from twin.estimate.mapping.depth_filter import GATE, DepthMap, fuse, motion_depth, propagate

RIG = small_rig(160, 120)
EXACT = np.zeros((6, 6))
CAMERA = (RIG.focal_px, 1.0, 1.0)  # of an image of 3 x 3 pixels
FOCAL_BASELINE = RIG.focal_px * RIG.baseline_m


def depth_of_plane(slope_x, slope_y, world_from_camera):
    """Returns the depth (H, W) of the plane z = slope_x x + slope_y y, in closed form."""
    u, v = np.meshgrid(np.arange(RIG.width_px), np.arange(RIG.height_px))
    rays = np.stack([(u - RIG.cx_px) / RIG.focal_px, (v - RIG.cy_px) / RIG.focal_px, np.ones(u.shape)], -1)
    normal = np.array([-slope_x, -slope_y, 1.0])
    return (-normal @ world_from_camera[:3, 3] / (rays @ world_from_camera[:3, :3].T @ normal)).astype(np.float32)


def depth_map(depth, variance):
    return DepthMap(np.asarray(depth, np.float32), np.full(np.shape(depth), variance, np.float32))


def test_n_fusions_give_the_mean_and_an_nth_of_the_variance():
    rng = np.random.default_rng(0)
    measured = 2 + 0.005 * rng.normal(size=(20, 8, 8))  # half the assumed noise: nothing is rejected by the gate
    state = depth_map(measured[0], 1e-4)
    for depth in measured[1:]:
        state = fuse(state, depth_map(depth, 1e-4))
    np.testing.assert_allclose(state.variance_m2, 1e-4 / 20, rtol=1e-5)
    np.testing.assert_allclose(state.depth_m, measured.mean(axis=0), atol=2e-6)


@pytest.mark.parametrize(("share", "passes"), [(0.98, True), (1.02, False)])
def test_the_gate_is_relative_to_p_plus_r(share, passes):
    p, r = 1e-6, 1e-4  # a gate relative to P alone would reject both
    innovation = share * np.sqrt(GATE * (p + r))
    state = fuse(depth_map(np.full((4, 4), 2.0), p), depth_map(np.full((4, 4), 2.0 + innovation), r))
    assert (state.variance_m2 < p).all() == passes


def test_an_update_by_a_much_more_accurate_measurement_keeps_its_variance():
    state = fuse(depth_map(np.full((2, 2), 2.0), 1e6), depth_map(np.full((2, 2), 2.0), 1e-8))
    assert (state.variance_m2 > 0.9e-8).all()


MOTIONS = [
    ((0.1, 0.0, 0.0), (0.0, 0.0, 0.0)),
    ((0.13, -0.07, 0.05), (0.03, -0.04, 0.1)),
    ((0.0, 0.05, 0.0), (0.0, 0.0, 3.0)),
]


@pytest.mark.parametrize(("shift", "turn"), MOTIONS)
def test_a_slanted_plane_is_propagated_exactly(shift, turn):
    first = down_camera(0, 0, 2.0)
    second = down_camera(shift[0], shift[1], 2.0 + shift[2], turn)
    old, new = (depth_of_plane(0.5, -0.3, pose) for pose in (first, second))
    # new stereo has an error of 3 mm and a large variance, so the result is the propagated depth
    newer = depth_map(new + 0.003, 1e-2)
    fused, inherited = propagate(depth_map(old, 1e-8), newer, geometry.inverse(second) @ first, EXACT, RIG)
    assert inherited.mean() > 0.6
    # tolerance: change of the slope over 3 mm of linearisation error, and float32
    assert np.abs(fused.depth_m - new)[inherited].max() < 1e-4


def test_pixels_without_new_stereo_depth_have_the_propagated_depth():
    first, second = down_camera(0, 0, 2.0), down_camera(0.1, 0.02, 2.0)
    old, new = (depth_of_plane(0.3, 0.2, pose) for pose in (first, second))
    hole = new.copy()
    hole[40:80, 60:100] = np.nan
    fused = propagate(depth_map(old, 1e-6), depth_map(hole, 1e-6), geometry.inverse(second) @ first, EXACT, RIG)[0]
    # linearised at the old depth of the nearest pixel, which is half a pixel of slope off
    assert np.isfinite(fused.depth_m[42:78, 62:98]).all()
    assert np.nanmax(np.abs(fused.depth_m - new)[40:80, 60:100]) < 2e-3


def test_depth_is_not_interpolated_across_a_step():
    old = np.full((120, 160), 2.0, np.float32)
    old[:, 80:] = 1.5
    first, second = down_camera(0, 0, 2.0), down_camera(0.004, 0.003, 2.0)
    blank = np.full_like(old, np.nan)
    fused = propagate(depth_map(old, 1e-6), depth_map(blank, 1e-6), geometry.inverse(second) @ first, EXACT, RIG)[0]
    known = fused.depth_m[np.isfinite(fused.depth_m)]
    assert np.minimum(np.abs(known - 2.0), np.abs(known - 1.5)).max() < 1e-5


def test_propagation_adds_the_variance_of_the_relative_pose():
    depth = np.full((120, 160), 2.0, np.float32)
    cov = np.zeros((6, 6))
    cov[5, 5] = 0.01**2  # along the optical axis
    fused = propagate(depth_map(depth, 1e-4), depth_map(depth * np.nan, 1e-4), np.eye(4), cov, RIG)[0]
    np.testing.assert_allclose(fused.variance_m2[5:-5, 5:-5], 2e-4, rtol=1e-4)


@pytest.mark.parametrize(("guess", "min_ratio"), [(1.02, 0.25), (1.003, 0.6)])
def test_motion_depth_converges_to_the_plane(guess, min_ratio):
    """Initial depth errors of 2 % (0.4 px of disparity, 0.6 px of flow) and 0.3 %; sigma is conservative for 2 %."""
    rng = np.random.default_rng(5)
    rig = small_rig()
    floor, first, second = plane(0.3, 0.2), down_camera(0, 0, 2.0), down_camera(0.2, 0.01, 2.02, (0.01, 0.02, 0.01))
    old = digitise(render_view(floor, rig, first)[0], rng, 2.0).astype(np.float32)
    image, truth = render_view(floor, rig, second)
    new = digitise(image, rng, 2.0).astype(np.float32)
    estimate = motion_depth(new, old, depth_map(truth * guess, 1e-3), geometry.inverse(first) @ second, EXACT, rig)
    inside = np.s_[45:-10, 10:-10]
    assert np.isfinite(estimate.depth_m[inside]).mean() > 0.95
    error_px = rig.focal_px * rig.baseline_m * (1 / estimate.depth_m - 1 / truth)[inside]
    z = ((estimate.depth_m - truth) / np.sqrt(estimate.variance_m2))[inside]
    assert abs(np.nanmedian(error_px)) < 0.02
    assert min_ratio < np.nanpercentile(np.abs(z), 68.3) < 1.3


def test_the_variance_of_motion_depth_includes_that_of_the_relative_pose():
    """J cov J' against finite differences of the disparity that best explains the flow of a perturbed pose."""
    old_from_new = geometry.inverse(down_camera(0, 0, 2.0)) @ down_camera(0.2, 0.03, 2.05, (0.02, 0.03, 0.1))
    disparity = np.full((3, 3), FOCAL_BASELINE / 1.7, np.float32)
    points = np.array([[(u - 1) / RIG.focal_px, (v - 1) / RIG.focal_px, 1.0] for v in range(3) for u in range(3)]) * 1.7

    def flow(pose, scale=1.0):
        moved = geometry.transform(pose, points * scale)
        return RIG.focal_px * moved[:, :2] / moved[:, 2:]

    step = 1e-5
    along = (flow(old_from_new, 1 / (1 + step)) - flow(old_from_new)) / (step * FOCAL_BASELINE / 1.7)
    for axis in range(6):
        motion = np.zeros(6)
        motion[axis] = step
        shift = flow(old_from_new @ geometry.exp(motion)) - flow(old_from_new)
        expected = np.sum(shift * along, 1) / np.sum(along**2, 1)
        cov = np.outer(motion, motion)
        variance = depth_filter._pose_variance(disparity, old_from_new, cov, CAMERA, FOCAL_BASELINE)
        np.testing.assert_allclose(np.sqrt(variance.ravel()), np.abs(expected), rtol=2e-3, atol=1e-9)


def test_two_images_from_the_same_place_give_no_depth_from_motion():
    image, disparity = np.full((3, 3), 100, np.float32), np.full((3, 3), FOCAL_BASELINE / 2, np.float32)
    variance = depth_filter._pose_variance(disparity, np.eye(4), np.eye(6), CAMERA, FOCAL_BASELINE)
    assert np.isnan(variance).all()
    current = depth_map(image / 50, 1e-4)
    fused = fuse(current, DepthMap(current.depth_m, variance))
    np.testing.assert_array_equal(fused.variance_m2, current.variance_m2)
