"""The scale of matching: pixels are binned where texture is coarser than noise, and nothing moves by it."""

from __future__ import annotations

from contextlib import nullcontext

import cv2
import numpy as np
import pytest

from twin.core.records import Frame, Readings, StereoRig
from twin.estimate.stereo_vision import StereoVision
from twin.estimate.vision import image_scale, matching, stereo
from twin.scenario.model import EstimateConfig

RIG = StereoRig(320, 240, 343.0, 0.3, 30.0, np.eye(4))
DISPARITY_PX = 24


def pair(texel_px: float, contrast: float, noise: float = 2.0) -> tuple[np.ndarray, np.ndarray]:
    """Both views (height, width, 3) of a flat floor whose texture begins at this size, each with its own noise."""
    rng = np.random.default_rng(4)
    wide = RIG.width_px + DISPARITY_PX
    texels = rng.standard_normal((int(RIG.height_px / texel_px) + 2, int(wide / texel_px) + 2)).astype(np.float32)
    floor = cv2.resize(texels, (wide, RIG.height_px), interpolation=cv2.INTER_CUBIC) * contrast + 110
    views = floor[:, : RIG.width_px], floor[:, DISPARITY_PX:]
    grey = [np.clip(v + noise * rng.standard_normal(v.shape), 0, 255).astype(np.uint8) for v in views]
    return np.dstack([grey[0]] * 3), np.dstack([grey[1]] * 3)


@pytest.mark.parametrize(("texel_px", "contrast", "expected"), [(2.0, 12.0, (1,)), (12.0, 4.0, (2, 4))])
def test_pixels_are_binned_where_the_texture_is_coarser_than_the_noise(texel_px, contrast, expected):
    left, right = pair(texel_px, contrast)
    assert image_scale.binning(left, right, RIG, EstimateConfig()) in expected


def test_an_image_that_shows_nothing_stays_as_it_is():
    flat = np.full((240, 320, 3), 90, np.uint8)
    assert image_scale.binning(flat, flat, RIG, EstimateConfig()) == 1


def test_an_image_is_not_binned_to_a_broken_pixel():
    left, right = pair(12.0, 4.0)
    odd = StereoRig(319, 239, 343.0, 0.3, 30.0, np.eye(4))
    assert image_scale.binning(left[:239, :319], right[:239, :319], odd, EstimateConfig()) == 1


@pytest.mark.parametrize("by", [1, 2, 4])
def test_a_binned_rig_sees_a_point_where_the_binned_image_shows_it(by):
    point = np.array([[0.31, -0.2, 2.0]])
    (u, v), (binned_u, binned_v) = RIG.project(point)[0], RIG.binned(by).project(point)[0]
    assert np.allclose([binned_u, binned_v], [(u - (by - 1) / 2) / by, (v - (by - 1) / 2) / by], atol=1e-12)
    columns, rows = np.meshgrid(np.arange(320), np.arange(240))
    spot = np.exp(-((columns - u) ** 2 + (rows - v) ** 2) / (2 * 9.0**2)).astype(np.float32)
    small = matching.binned(spot, by)
    rows, columns = np.indices(small.shape)
    assert np.average(columns, weights=small) == pytest.approx(binned_u, abs=1e-3)
    assert np.average(rows, weights=small) == pytest.approx(binned_v, abs=1e-3)


def test_binning_by_four_halves_the_noise_twice():
    noise = np.random.default_rng(1).standard_normal((240, 320)).astype(np.float32)
    assert matching.binned(noise, 4).std() == pytest.approx(0.25, rel=0.02)


def test_where_pixels_are_taken_together_no_band_counts_more_than_another():
    scene, lit = np.random.default_rng(2).integers(60, 200, (240, 320), np.uint8), np.full((240, 320), 128, np.uint8)
    images = [np.stack([scene if band == k else lit for band in range(3)], axis=2) for k in range(3)]
    red, green, blue = (matching.normalise(matching.gray(image, 2)) for image in images)
    np.testing.assert_allclose(red.astype(float), green, atol=1)
    np.testing.assert_allclose(red.astype(float), blue, atol=1)


def test_where_corners_are_few_a_grid_covers_the_image_best_places_first():
    left, _ = pair(24.0, 12.0, noise=0.5)
    image = matching.normalise(matching.gray(left, 2))
    points = matching.corners(image, 500, 11)
    assert len(points) > 250
    strength = cv2.cornerMinEigenVal(image, 7)[tuple(points.astype(int).T[::-1])]
    assert np.all(np.diff(strength) <= 0)
    assert np.all((points >= 7) & (points < [160 - 7, 120 - 7]))
    assert len(np.unique(points, axis=0)) == len(points)


def test_where_corners_are_many_they_are_taken():
    left, _ = pair(2.0, 12.0)
    points = matching.corners(matching.normalise(matching.gray(left)), 500, 11)
    assert len(np.unique(np.diff(np.unique(points[:, 0])))) > 1  # no grid


def test_the_scale_is_that_of_the_first_pair_that_shows_something_and_until_then_no_motion_is_claimed(tmp_path):
    vision = StereoVision(RIG, EstimateConfig(), 0.01, tmp_path, lambda _: nullcontext())
    dark, coarse, fine = (np.full((240, 320, 3), 90, np.uint8),) * 2, pair(12.0, 4.0), pair(2.0, 12.0)
    seen = []
    for k, images in enumerate((dark, dark, coarse, fine)):
        frame = Frame(k, k / 30, *images, Readings())
        status = vision.track_frame(frame)[1]
        seen.append((status, vision.observe_stereo(frame, k) is not None, vision.binning))
    blind = "too few points matched"
    assert seen == [("ok", False, 1), (blind, False, 1), (blind, True, 2), (blind, True, 2)]


def test_coarse_texture_is_matched_at_the_border_as_well_as_in_the_middle():
    """Made even by what lies around, matches at the border err by 0.05 px: there, less lies around."""
    left, right = (matching.gray(image, 2) for image in pair(12.0, 25.0, noise=0.0))
    rig, disparity_px = RIG.binned(2), DISPARITY_PX / 2
    dense_px = np.full(left.shape, disparity_px, np.float32)

    def largest_error_px(*images):
        points = stereo.points_of_pair(*images, dense_px, rig, 500, 15)
        return np.abs(points.measured[:, 2] * rig.focal_px - disparity_px).max()

    assert largest_error_px(left, right) < 0.002
    assert largest_error_px(*(matching.normalise(image).astype(np.float32) for image in (left, right))) > 0.02
