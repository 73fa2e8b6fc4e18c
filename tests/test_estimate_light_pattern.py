"""Tests of dense disparity in turbid water: light pattern of the cameras and noise in interpolated images."""

import numpy as np
import pytest
from seafloor_scene import digitise, down_camera, plane, render_view, small_rig

from twin.core.records import MapGrid
from twin.core.settings import EstimatorSettings
from twin.estimate.mapping.map_builder import KeyframePath, build_map
from twin.estimate.stereo_vision import StereoVision
from twin.estimate.vision import disparity
from twin.estimate.vision.light_pattern import (
    DEGREE,
    light_pattern,
    pattern_coefficients,
    pattern_difference,
    pattern_fit,
)
from twin.estimate.vision.matching import luma

RIG = small_rig(80, 60)  # images binned by 4
INSIDE = np.s_[4:-4, 16:-4]


def faint_pair(x_m, altitude_m, rng, lamps=0.0, contrast=0.1):
    """Returns float images of a flat floor of low contrast in the light of lamps, and the true disparity [px]."""
    floor = plane(texture_px_m=0.03)
    floor = floor._replace(texture=100 + (floor.texture - 127) * np.float32(contrast))
    pose = down_camera(x_m, 0.3 * x_m, altitude_m)
    v, u = np.mgrid[-1:1:60j, -1:1:80j]
    light = lamps * np.exp(-(u**2) / 0.5 - (v - 0.2) ** 2 / 0.6)
    left, right = (
        digitise(render_view(floor, RIG, p)[0] + light, rng, 0.5).astype(np.float32)
        for p in (pose, pose @ RIG.left_from_right)
    )
    return (left, right), RIG.focal_px * RIG.baseline_m / altitude_m


@pytest.mark.parametrize("fraction", [0.25, 0.5, 0.75])
def test_noise_of_interpolated_pixels_does_not_bias_disparities_of_faint_texture(fraction):
    """Uncorrected, they are 0.09 px too near to a half pixel where the standard deviation of a disparity is 0.2 px."""
    rng, errors = np.random.default_rng(1), []
    for x_m in np.arange(12) * 0.7:
        pair, truth = faint_pair(x_m, RIG.focal_px * RIG.baseline_m / (4 + fraction), rng)
        errors.append(disparity.match_densely(*pair).fine.disparity_px[INSIDE] - truth)
    assert abs(np.nanmedian(errors)) < 0.03


def test_the_light_of_lamps_is_not_matched_as_texture_once_it_is_known():
    rng = np.random.default_rng(2)
    surveyed = [faint_pair(x_m, 2.2, rng, lamps=60.0, contrast=0.06) for x_m in np.arange(12) * 0.7]
    truth = surveyed[0][1]
    coefficients = pattern_coefficients([pattern_fit(pair) for pair, _ in surveyed])
    assert coefficients is not None
    pattern = light_pattern(coefficients, (60, 80))

    def gross(left, right):
        found = [disparity.match_densely(p[0] - left, p[1] - right).fine for p, _ in surveyed]
        error = np.abs(np.array([f.with_sigma_below(0.5).disparity_px for f in found]) - truth)
        return np.mean(error[np.isfinite(error)] > 1), np.isfinite(error).mean()

    (wrong, known), (wrong_before, _) = gross(*pattern), gross(np.float32(0), np.float32(0))
    assert wrong_before > 0.02
    assert wrong < 0.1 * wrong_before
    assert known > 0.5


def test_the_map_of_a_faintly_textured_floor_is_right_without_the_light_pattern():
    rng = np.random.default_rng(2)
    x_m = np.arange(12) * 0.3
    grays = [faint_pair(x, 2.2, rng, lamps=60.0, contrast=0.06)[0] for x in x_m]
    pairs = [tuple(np.repeat(g[..., None], 3, 2).astype(np.uint8) for g in pair) for pair in grays]
    path = KeyframePath(np.array([down_camera(x, 0.3 * x, 2.2) for x in x_m]), *np.zeros((2, len(x_m), 6, 6)))
    fits = [pattern_fit([luma(image) for image in pair]) for pair in pairs]
    pattern = light_pattern(pattern_coefficients(fits), (60, 80))
    grid = MapGrid(-1.0, 2.0, 0.1, 30, 52)
    median, median_before = (
        np.nanmedian(np.abs(build_map(pairs, path, RIG, grid, pattern=p).height_m)) for p in (pattern, 0 * pattern)
    )
    assert median < 0.08  # 0.2 px of disparity
    assert median < 0.5 * median_before


def test_coefficients_that_vary_between_the_images_as_much_as_their_mean_are_left_in_the_images():
    rng = np.random.default_rng(3)
    fits = rng.normal(0.0, 1.0, (30, 2, 7, 7))
    fits[:, :, 0, 2] += 20.0  # the light
    coefficients = pattern_coefficients(list(fits))
    assert coefficients is not None
    found, mean = pattern_fit(light_pattern(coefficients, (60, 80))), fits.mean(axis=0)
    np.testing.assert_allclose(found[:, 0, 2], mean[:, 0, 2], rtol=0.02)
    others = np.ones((2, 7, 7), bool)
    others[:, 0, 2] = False
    assert np.sum(found[others] ** 2) < 0.5 * np.sum(mean[others] ** 2)


def test_texture_that_dominates_the_light_is_not_taken_for_a_light_pattern():
    """The images of the survey overlap by 90 %, so that their mean contains the texture of the floor."""
    rng = np.random.default_rng(3)
    fits = [pattern_fit(faint_pair(x_m, 2.2, rng, lamps=4.0, contrast=1.0)[0]) for x_m in np.arange(12) * 0.2]
    assert pattern_coefficients(list(fits)) is None


def test_the_brightness_of_the_images_does_not_decide_whether_there_is_a_light_pattern():
    rng = np.random.default_rng(4)
    fits = rng.normal(0.0, 1.0, (20, 2, 7, 7))
    fits[:, :, 0, 0] += 100.0
    assert pattern_coefficients(list(fits)) is None


def test_one_keyframe_has_no_light_pattern():
    assert pattern_coefficients([np.ones((2, 7, 7))]) is None


def test_the_difference_of_two_light_patterns_is_that_of_their_images():
    a, b = np.random.default_rng(5).normal(0.0, 1.0, (2, 2, DEGREE + 1, DEGREE + 1))
    images = light_pattern(a, (600, 800)) - light_pattern(b, (600, 800)) - (a - b)[:, 0, 0, None, None]
    assert pattern_difference(a, b) == pytest.approx(np.sqrt((images**2).mean((1, 2))).max(), rel=0.02)
    assert pattern_difference(a, None) == pytest.approx(pattern_difference(None, a))


def test_a_pair_is_matched_again_for_the_map_only_where_the_light_pattern_has_changed_noticeably(tmp_path):
    pair, _ = faint_pair(0.0, 2.2, np.random.default_rng(6), contrast=1.0)
    left, right = (np.repeat(image[..., None], 3, axis=2).astype(np.uint8) for image in pair)
    pattern = np.zeros((2, DEGREE + 1, DEGREE + 1))
    with StereoVision(RIG, EstimatorSettings(), tmp_path) as vision:
        found = disparity.match_densely(*pair)
        vision.spool.put(7, left, right, tuple(pair), found)
        vision._known_patterns[7] = pattern
        for change, known in ((0.1, True), (1.0, False)):
            changed = pattern.copy()
            changed[1, 1, 0] = change  # a slope of the right image; its RMS is 0.58 of this
            image, other = vision._map_view(7, changed)
            np.testing.assert_array_equal(image, left)
            expected = found.fine.disparity_px if known else right
            np.testing.assert_allclose(other.disparity_px if known else other, expected, atol=0.002)
