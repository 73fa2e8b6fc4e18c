"""Image scale: pixels are binned where the texture is coarser than the noise, without shifting any point."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from twin.core.records import Frame, StereoRig
from twin.core.settings import EstimatorSettings
from twin.estimate.stereo_vision import StereoVision
from twin.estimate.vision import matching, stereo

RIG = StereoRig(320, 240, 343.0, 0.3, 30.0, np.eye(4))
DISPARITY_PX = 24


def stereo_pair(texel_px: float, contrast: float, noise: float = 2.0) -> tuple[np.ndarray, np.ndarray]:
    """Returns both images (height, width, 3) of a flat floor with texels of this size, with independent noise."""
    rng = np.random.default_rng(4)
    wide = RIG.width_px + DISPARITY_PX
    texels = rng.standard_normal((int(RIG.height_px / texel_px) + 2, int(wide / texel_px) + 2)).astype(np.float32)
    floor = cv2.resize(texels, (wide, RIG.height_px), interpolation=cv2.INTER_CUBIC) * contrast + 110
    views = floor[:, : RIG.width_px], floor[:, DISPARITY_PX:]
    levels = [np.clip(v + noise * rng.standard_normal(v.shape), 0, 255).astype(np.uint8) for v in views]
    return np.dstack([levels[0]] * 3), np.dstack([levels[1]] * 3)


@pytest.mark.parametrize(("texel_px", "contrast", "expected"), [(2.0, 12.0, (1,)), (12.0, 4.0, (2, 4))])
def test_pixels_are_binned_where_the_texture_is_coarser_than_the_noise(texel_px, contrast, expected):
    left, right = stereo_pair(texel_px, contrast)
    assert stereo.choose_binning(left, right, RIG, EstimatorSettings()) in expected


def test_an_image_without_texture_is_not_binned():
    flat = np.full((240, 320, 3), 90, np.uint8)
    assert stereo.choose_binning(flat, flat, RIG, EstimatorSettings()) == 1


def test_an_image_is_not_binned_if_its_size_is_not_a_multiple():
    left, right = stereo_pair(12.0, 4.0)
    odd = StereoRig(319, 239, 343.0, 0.3, 30.0, np.eye(4))
    assert stereo.choose_binning(left[:239, :319], right[:239, :319], odd, EstimatorSettings()) == 1


@pytest.mark.parametrize("by", [1, 2, 4])
def test_a_binned_rig_projects_a_point_to_its_pixel_in_the_binned_image(by):
    point = np.array([[0.31, -0.2, 2.0]])
    (u, v), (binned_u, binned_v) = RIG.project(point)[0], RIG.binned(by).project(point)[0]
    assert np.allclose([binned_u, binned_v], [(u - (by - 1) / 2) / by, (v - (by - 1) / 2) / by], atol=1e-12)
    columns, rows = np.meshgrid(np.arange(320), np.arange(240))
    spot = np.exp(-((columns - u) ** 2 + (rows - v) ** 2) / (2 * 9.0**2)).astype(np.float32)
    small = matching.binned(spot, by)
    rows, columns = np.indices(small.shape)
    assert np.average(columns, weights=small) == pytest.approx(binned_u, abs=1e-3)
    assert np.average(rows, weights=small) == pytest.approx(binned_v, abs=1e-3)


@pytest.mark.parametrize("by", [2, 3])
def test_the_default_principal_point_of_a_size_that_is_no_multiple_keeps_its_place_in_the_image(by):
    """Binning cuts off the last column and row: the centre of the binned image is not that of the full image."""
    rig, point = StereoRig(319, 241, 343.0, 0.3), np.array([[0.31, -0.2, 2.0]])
    expected = (rig.project(point)[0] + 0.5) / by - 0.5
    np.testing.assert_allclose(rig.binned(by).project(point)[0], expected, atol=1e-12)


def test_binning_by_four_reduces_the_noise_to_a_quarter():
    noise = np.random.default_rng(1).standard_normal((240, 320)).astype(np.float32)
    assert matching.binned(noise, 4).std() == pytest.approx(0.25, rel=0.02)


def test_a_binned_gray_image_weights_all_colour_bands_equally():
    scene, uniform = (
        np.random.default_rng(2).integers(60, 200, (240, 320), np.uint8),
        np.full((240, 320), 128, np.uint8),
    )
    images = [np.stack([scene if band == k else uniform for band in range(3)], axis=2) for k in range(3)]
    red, green, blue = (matching.normalise(matching.gray(image, 2)) for image in images)
    np.testing.assert_allclose(red.astype(float), green, atol=1)
    np.testing.assert_allclose(red.astype(float), blue, atol=1)


def test_where_corners_are_few_a_grid_of_points_is_returned_strongest_first():
    left, _ = stereo_pair(24.0, 12.0, noise=0.5)
    image = matching.normalise(matching.gray(left, 2))
    points = matching.corners(image, 500, 11)
    assert len(points) > 250
    strength = cv2.cornerMinEigenVal(image, 7)[tuple(points.astype(int).T[::-1])]
    assert np.all(np.diff(strength) <= 0)
    assert np.all((points >= 7) & (points < [160 - 7, 120 - 7]))
    assert len(np.unique(points, axis=0)) == len(points)


def test_where_corners_are_many_they_are_not_on_a_grid():
    left, _ = stereo_pair(2.0, 12.0)
    points = matching.corners(matching.normalise(matching.gray(left)), 500, 11)
    assert len(np.unique(np.diff(np.unique(points[:, 0])))) > 1


def test_the_first_textured_pair_sets_the_scale_and_tracking_fails_until_then(tmp_path):
    dark, darker = ((np.full((240, 320, 3), grey, np.uint8),) * 2 for grey in (90, 80))
    coarse, fine = stereo_pair(12.0, 4.0), stereo_pair(2.0, 12.0)
    results = []
    with StereoVision(RIG, EstimatorSettings(), tmp_path, cell_m=0.01) as vision:
        for k, (left, right) in enumerate((dark, darker, coarse, fine)):
            frame = Frame(k, k / 30, left, right)
            status = vision.track_frame(frame)[1]
            results.append((status, vision.observe_stereo(frame, k) is not None, vision.binning))
    failed = "too few points matched"
    assert results == [("ok", False, 1), (failed, False, 1), (failed, True, 2), (failed, True, 2)]


def test_coarse_texture_is_matched_as_accurately_at_the_border_as_in_the_centre():
    """Matches in locally normalised images have errors of 0.05 px at the border, where the neighbourhood is cut off."""
    left, right = (matching.gray(image, 2) for image in stereo_pair(12.0, 25.0, noise=0.0))
    rig, disparity_px = RIG.binned(2), DISPARITY_PX / 2
    dense_px = np.full(left.shape, disparity_px, np.float32)

    def largest_error_px(left_image, right_image):
        settings = EstimatorSettings(points=500, patch_px=15)
        points = stereo.match_stereo_points(left_image, right_image, dense_px, rig, settings)
        return np.abs(points.measured[:, 2] * rig.focal_px - disparity_px).max()

    assert largest_error_px(left, right) < 0.002
    assert largest_error_px(*(matching.normalise(image).astype(np.float32) for image in (left, right))) > 0.02
