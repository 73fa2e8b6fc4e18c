"""Dense disparity: unbiased, honest about its noise, blind to lamps, silent where only one eye sees."""

import numpy as np
import pytest
from seafloor_scene import digitise, down_camera, look, plane, small_rig, stereo_pair

from twin.estimate import disparity, epipolar

RIG = small_rig()
INSIDE = np.s_[10:-10, 60:-10]


def on_slanted_plane(noise):
    rng = np.random.default_rng(1)
    left, right, depth = stereo_pair(plane(0.4, 0.3), RIG, down_camera(0, 0, 2.0, (0.03, -0.02, 0.3)), rng, noise)
    found = disparity.dense_disparity(left, right, 64)
    return found, RIG.focal_px * RIG.baseline_m / depth


@pytest.fixture(scope="module")
def slanted():
    return on_slanted_plane(noise=2.0)


def test_disparity_is_unbiased_on_a_slanted_plane(slanted):
    found, truth = slanted
    error = (found.disparity_px - truth)[INSIDE]
    # by strips of like fraction of a pixel: pixel-locking would show as a bias that depends on it
    fraction = (truth[INSIDE] % 1 * 5).astype(int)
    biases = [np.nanmedian(error[fraction == k]) for k in range(5)]
    assert np.abs(biases).max() < 0.02
    assert np.nanpercentile(np.abs(error), 90) < 0.15


def test_nearly_every_pixel_seen_by_both_eyes_has_a_disparity(slanted):
    found, _ = slanted
    assert np.isfinite(found.disparity_px[INSIDE]).mean() > 0.97


def test_sigma_is_the_error_within_a_third(slanted):
    found, truth = slanted
    z = ((found.disparity_px - truth) / found.sigma_px)[INSIDE]
    assert 0.7 < np.nanpercentile(np.abs(z), 68.3) < 1.3


@pytest.mark.parametrize("noise", [4.0, 6.0])
def test_sigma_follows_the_noise(noise):
    found, truth = on_slanted_plane(noise)
    z = ((found.disparity_px - truth) / found.sigma_px)[INSIDE]
    assert 0.7 < np.nanpercentile(np.abs(z), 68.3) < 1.4


def test_the_margin_that_only_the_left_eye_sees_is_rejected():
    rng = np.random.default_rng(2)
    left, right, depth = stereo_pair(plane(), RIG, down_camera(0, 0, 1.5), rng)
    found = disparity.dense_disparity(left, right, 64)
    margin = int(RIG.focal_px * RIG.baseline_m / depth[0, 0]) - 2
    assert np.isnan(found.disparity_px[:, :margin]).mean() > 0.98


def test_lamps_and_veil_that_differ_between_the_eyes_do_not_bias():
    rng = np.random.default_rng(3)
    floor, pose = plane(0.2, 0.1), down_camera(0, 0, 2.0)
    left, depth = look(floor, RIG, pose)
    right, _ = look(floor, RIG, pose @ RIG.left_from_right)
    u = np.linspace(0, 1, RIG.width_px)
    lit = [image * (0.4 + 0.6 * np.exp(-((u - at) ** 2) / 0.2)) * 0.5 + 40 + 40 * at * u for image, at in
           ((left, 0.4), (right, 0.6))]  # fmt: skip
    found = disparity.dense_disparity(*(digitise(image, rng, 2.0) for image in lit), 64)
    error = (found.disparity_px - RIG.focal_px * RIG.baseline_m / depth)[INSIDE]
    assert abs(np.nanmedian(error)) < 0.02
    assert np.nanpercentile(np.abs(error), 90) < 0.3


def test_images_without_texture_yield_nothing():
    rng = np.random.default_rng(4)
    gray = [digitise(np.full((240, 320), 100.0), rng, 2.0) for _ in range(2)]
    assert np.isfinite(disparity.dense_disparity(*gray, 64).disparity_px).mean() < 0.1


def test_the_search_follows_the_scene_and_opens_again_when_lost():
    reach = disparity.Reach(RIG)
    widest = reach.max_disparity_px
    reach.see(np.full((240, 320), 20.0, np.float32))
    assert 25 < reach.max_disparity_px < 40
    reach.see(np.full((240, 320), np.nan, np.float32))
    assert reach.max_disparity_px == widest


def test_the_stereo_equations_are_the_two_view_equations_of_the_rig():
    right_from_left = np.linalg.inv(RIG.left_from_right)
    view = epipolar.two_view(right_from_left, RIG.matrix, RIG.baseline_m)
    np.testing.assert_allclose(view.matrix, epipolar.STEREO.matrix, atol=1e-12)
    np.testing.assert_allclose(view.epipole, epipolar.STEREO.epipole, atol=1e-12)
