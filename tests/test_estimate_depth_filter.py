"""The Kalman depth filter against closed forms."""

import numpy as np
import pytest
from seafloor_scene import digitise, down_camera, look, plane, small_rig

from twin.core import geometry
from twin.estimate.mapping import depth_filter
from twin.estimate.mapping.depth_filter import GATE, DepthMap, carry, fuse, motion_depth

RIG = small_rig(160, 120)
EXACT = np.zeros((6, 6))
FOCAL_BASELINE = RIG.focal_px * RIG.baseline_m


def depth_of_plane(slope_x, slope_y, world_from_camera):
    """Depth map of z = slope_x x + slope_y y, in closed form."""
    u, v = np.meshgrid(np.arange(RIG.width_px), np.arange(RIG.height_px))
    rays = np.stack([(u - RIG.cx_px) / RIG.focal_px, (v - RIG.cy_px) / RIG.focal_px, np.ones(u.shape)], -1)
    normal = np.array([-slope_x, -slope_y, 1.0])
    return (-normal @ world_from_camera[:3, 3] / (rays @ world_from_camera[:3, :3].T @ normal)).astype(np.float32)


def even(depth, variance):
    return DepthMap(np.asarray(depth, np.float32), np.full(np.shape(depth), variance, np.float32))


def test_n_fusions_have_the_mean_and_an_nth_of_the_variance():
    rng = np.random.default_rng(0)
    seen = 2 + 0.005 * rng.normal(size=(20, 8, 8))  # half the claimed noise: nothing meets the gate
    state = even(seen[0], 1e-4)
    for depth in seen[1:]:
        state = fuse(state, even(depth, 1e-4))
    np.testing.assert_allclose(state.variance_m2, 1e-4 / 20, rtol=1e-5)
    np.testing.assert_allclose(state.depth_m, seen.mean(axis=0), atol=2e-6)


@pytest.mark.parametrize(("share", "passes"), [(0.98, True), (1.02, False)])
def test_the_gate_is_on_p_plus_r(share, passes):
    p, r = 1e-6, 1e-4  # a gate on P alone would reject both
    innovation = share * np.sqrt(GATE * (p + r))
    state = fuse(even(np.full((4, 4), 2.0), p), even(np.full((4, 4), 2.0 + innovation), r))
    assert (state.variance_m2 < p).all() == passes


def test_an_update_by_a_far_better_measurement_never_claims_certainty():
    state = fuse(even(np.full((2, 2), 2.0), 1e6), even(np.full((2, 2), 2.0), 1e-8))
    assert (state.variance_m2 > 0.9e-8).all()


MOTIONS = [
    ((0.1, 0.0, 0.0), (0.0, 0.0, 0.0)),
    ((0.13, -0.07, 0.05), (0.03, -0.04, 0.1)),
    ((0.0, 0.05, 0.0), (0.0, 0.0, 3.0)),
]


@pytest.mark.parametrize(("shift", "turn"), MOTIONS)
def test_a_slanted_plane_is_carried_exactly(shift, turn):
    first = down_camera(0, 0, 2.0)
    second = down_camera(shift[0], shift[1], 2.0 + shift[2], turn)
    old, new = (depth_of_plane(0.5, -0.3, pose) for pose in (first, second))
    # what is new is 3 mm off and so uncertain that the result is what was carried
    carried = carry(even(old, 1e-8), even(new + 0.003, 1e-2), geometry.inverse(second) @ first, EXACT, RIG)
    assert carried.taken.mean() > 0.6
    # what is left is the slope over the 3 mm of linearisation, and float32
    assert np.abs(carried.fused.depth_m - new)[carried.taken].max() < 1e-4


def test_pixels_without_new_stereo_keep_what_was_carried():
    first, second = down_camera(0, 0, 2.0), down_camera(0.1, 0.02, 2.0)
    old, new = (depth_of_plane(0.3, 0.2, pose) for pose in (first, second))
    hole = new.copy()
    hole[40:80, 60:100] = np.nan
    fused = carry(even(old, 1e-6), even(hole, 1e-6), geometry.inverse(second) @ first, EXACT, RIG).fused
    # the guess is the old depth of the nearest pixel: half a pixel of slope off, which the ratio of rays scales
    assert np.isfinite(fused.depth_m[42:78, 62:98]).all()
    assert np.nanmax(np.abs(fused.depth_m - new)[40:80, 60:100]) < 2e-3


def test_nothing_is_interpolated_across_a_step():
    old = np.full((120, 160), 2.0, np.float32)
    old[:, 80:] = 1.5
    first, second = down_camera(0, 0, 2.0), down_camera(0.004, 0.003, 2.0)
    blank = np.full_like(old, np.nan)
    fused = carry(even(old, 1e-6), even(blank, 1e-6), geometry.inverse(second) @ first, EXACT, RIG).fused
    known = fused.depth_m[np.isfinite(fused.depth_m)]
    assert np.minimum(np.abs(known - 2.0), np.abs(known - 1.5)).max() < 1e-5


def test_the_relative_pose_adds_its_variance():
    depth = np.full((120, 160), 2.0, np.float32)
    cov = np.zeros((6, 6))
    cov[5, 5] = 0.01**2  # along the axis: straight into depth
    fused = carry(even(depth, 1e-4), even(depth * np.nan, 1e-4), np.eye(4), cov, RIG).fused
    np.testing.assert_allclose(fused.variance_m2[5:-5, 5:-5], 2e-4, rtol=1e-4)


@pytest.mark.parametrize(("guess", "least_z"), [(1.02, 0.25), (1.003, 0.6)])
def test_depth_from_motion_finds_the_plane(guess, least_z):
    """From 2 % off (0.4 px of stereo disparity, 0.6 px of flow) and 0.3 %; from afar sigma is on the safe side."""
    rng = np.random.default_rng(5)
    rig = small_rig()
    floor, first, second = plane(0.3, 0.2), down_camera(0, 0, 2.0), down_camera(0.2, 0.01, 2.02, (0.01, 0.02, 0.01))
    old = digitise(look(floor, rig, first)[0], rng, 2.0).astype(np.float32)
    image, truth = look(floor, rig, second)
    new = digitise(image, rng, 2.0).astype(np.float32)
    found = motion_depth(new, old, even(truth * guess, 1e-3), geometry.inverse(first) @ second, EXACT, rig)
    inside = np.s_[45:-10, 10:-10]
    assert np.isfinite(found.depth_m[inside]).mean() > 0.95
    error_px = rig.focal_px * rig.baseline_m * (1 / found.depth_m - 1 / truth)[inside]
    z = ((found.depth_m - truth) / np.sqrt(found.variance_m2))[inside]
    assert abs(np.nanmedian(error_px)) < 0.02
    assert least_z < np.nanpercentile(np.abs(z), 68.3) < 1.3


def test_motion_depth_is_as_uncertain_as_the_relative_pose_makes_it():
    """J cov J' against a finite difference: the disparity that best explains the flow of a slightly other pose."""
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
        variance = depth_filter._pose_variance(
            disparity, old_from_new[:3, :3].copy(), old_from_new[:3, 3].copy(), cov, RIG.focal_px, FOCAL_BASELINE
        )
        np.testing.assert_allclose(np.sqrt(variance.ravel()), np.abs(expected), rtol=2e-3, atol=1e-9)
