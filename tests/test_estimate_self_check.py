"""Self-check of the estimators: rectification errors from row differences, repeating texture, and findings."""

from dataclasses import replace

import numpy as np
import pytest
from judge_synthetic import survey
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.spatial.transform import Rotation

from twin.core import geometry
from twin.core.quality import CalibrationEstimate, DisparityOffset, DistortionError, EpipolarError, EstimationQuality
from twin.core.records import StereoObservation, StereoRig
from twin.estimate.calibration_errors import disparity_offset, mean_views
from twin.estimate.self_check import check_survey, with_length_error
from twin.estimate.vision import matching
from twin.estimate.vision.epipolar_calibration import EpipolarCalibration
from twin.estimate.vision.image_quality import repetition
from twin.estimate.vision.stereo import StereoPoints

RIG = StereoRig(320, 240, 277.0, 0.15)
NOISE_PX = 0.05


def matched(rotation, offset_px, seed=0, n=400, noise=1.0, k1=0.0):
    """Returns stereo points of a right camera that is turned by a rotation vector and whose principal point is off."""
    rng = np.random.default_rng(seed)
    pixels = np.column_stack([rng.uniform(30, 310, n), rng.uniform(10, 230, n)]).round().astype(np.float32)
    disparity = RIG.baseline_m / rng.uniform(1.5, 2.5, n)
    left = RIG.normalised(pixels)
    right = np.column_stack([left[:, 0] - disparity, left[:, 1], np.ones(n)])
    turned = right @ geometry.so3_exp(np.asarray(rotation, float))  # directions in the axes of the camera
    rows = (turned[:, 1] / turned[:, 2] - left[:, 1]) * RIG.focal_px + offset_px
    rows += noise * NOISE_PX * rng.standard_normal(n)
    rows += k1 * left[:, 1] * (np.sum(right[:, :2] ** 2, axis=1) - np.sum(left**2, axis=1)) * RIG.focal_px
    measured = np.column_stack([left, disparity])
    cov = np.tile(np.diag([1.0, 0.5, 2.0]) * (NOISE_PX / RIG.focal_px) ** 2 / 2, (n, 1, 1))
    xyz = np.column_stack([left, np.ones(n)]) * (RIG.baseline_m / disparity)[:, None]
    return StereoPoints(pixels, np.zeros((n, 2)), disparity * RIG.focal_px, measured, cov, xyz, rows)


def calibrated(rotation, offset_px, n_pairs=10):
    calibration = EpipolarCalibration()
    for seed in range(n_pairs):
        calibration.add(matched(rotation, offset_px, seed), RIG, 11)
    return calibration


@pytest.mark.parametrize("rotation", [(1e-3, 0, 0), (0, 2e-3, 0), (0, 0, -3e-3), (5e-4, -1e-3, 2e-3)])
def test_row_differences_give_pitch_yaw_and_roll_of_the_right_camera(rotation):
    report = calibrated(np.array(rotation), 0.0).report()
    assert np.all(np.abs(report.estimate[:3] - rotation) < 4 * report.sigma[:3])
    assert np.all(report.sigma[:3] < 2e-4)


def test_an_offset_of_the_principal_point_is_distinguished_from_a_pitch_by_the_curvature_of_the_rows():
    report = calibrated(np.zeros(3), 0.5, n_pairs=40).report()
    assert report.estimate[3] * RIG.focal_px == pytest.approx(0.5, abs=0.03)
    assert abs(report.estimate[0]) * RIG.focal_px < 0.03


def test_nothing_is_removed_from_a_rectified_pair():
    calibration = calibrated(np.zeros(3), 0.0)
    image = np.random.default_rng(1).integers(0, 255, (240, 320, 3)).astype(np.uint8)
    assert not calibration.update(RIG)
    assert calibration.rectify(image, RIG) is image


def pattern_px(noise, k1, n_pairs=25):
    """Returns the systematic row difference [px] of pairs with matching noise and an error k1 of the distortion."""
    calibration = EpipolarCalibration()
    for seed in range(n_pairs):
        calibration.add(matched(np.array([3e-4, -2e-4, 1e-3]), 0.0, seed, noise=noise, k1=k1), RIG, 11)
    return calibration.report().pattern * RIG.focal_px


def test_matching_noise_has_no_pattern_however_large_and_a_distortion_error_has_one():
    """Noise of eight times the claimed one, 0.4 px, is averaged over 33 points of a region and 25 pairs: 0.014 px."""
    assert pattern_px(noise=1.0, k1=0.0) < 0.005
    assert pattern_px(noise=8.0, k1=0.0) < 0.01  # after subtraction of its expectation
    assert pattern_px(noise=1.0, k1=1.0) > 0.2
    assert pattern_px(noise=8.0, k1=1.0) > 0.2


def test_the_rectified_image_is_the_image_of_a_camera_without_the_error():
    rotation = np.array([1.5e-3, 0, -4e-3])
    smooth = gaussian_filter(np.random.default_rng(2).uniform(0, 255, (240, 320)), 3)
    levels = (smooth - smooth.min()) / np.ptp(smooth) * 220 + 15
    v, u = np.mgrid[:240, :320].astype(float)
    rays = np.stack([(u - RIG.cx_px) / RIG.focal_px, (v - RIG.cy_px) / RIG.focal_px, np.ones_like(u)], axis=-1)
    turned = rays @ geometry.so3_exp(rotation).T
    x, y = turned[..., 0] / turned[..., 2], turned[..., 1] / turned[..., 2]
    seen = map_coordinates(
        levels, [y * RIG.focal_px + RIG.cy_px, x * RIG.focal_px + RIG.cx_px], order=3, mode="nearest"
    )
    seen = np.repeat(seen.round().astype(np.uint8)[..., None], 3, axis=2)
    calibration = calibrated(rotation, 0.0, n_pairs=40)
    assert calibration.update(RIG)
    restored = calibration.rectify(seen, RIG)[8:-8, 8:-8, 0].astype(float)
    assert np.abs(restored - levels[8:-8, 8:-8]).mean() < 1.0
    assert np.abs(seen[8:-8, 8:-8, 0] - levels[8:-8, 8:-8]).mean() > 2.5


def texture(seed=0):
    fine = gaussian_filter(np.random.default_rng(seed).standard_normal((240, 320)), 1.5)
    return matching.normalise((128 + 300 * fine).astype(np.float32))


@pytest.mark.parametrize("offset_px", [0.2 + 1 / 64, -0.7 + 1 / 64])
def test_rectification_moves_images_by_exact_fractions_of_a_pixel(offset_px):
    """Warps that round positions to 1/32 px err by up to 0.016 px, which is 0.003 deg of pitch or yaw."""
    v, u = np.mgrid[:240, :320].astype(float)

    def image(row):
        return 128 + 60 * np.sin(2 * np.pi * (row / 9 + u / 14))

    calibration = EpipolarCalibration()
    calibration.removed = np.array([0.0, 0.0, 0.0, offset_px / RIG.focal_px])
    found = calibration.rectify(np.repeat(np.rint(image(v))[..., None], 3, axis=2).astype(np.uint8), RIG)[..., 0]
    slope, error = (x[8:-8, 8:-8] for x in (np.gradient(image(v + offset_px), axis=0), found - image(v + offset_px)))
    assert np.sum(slope * error) / np.sum(slope**2) == pytest.approx(0.0, abs=0.002)


@pytest.mark.parametrize("offset_px", [0.05, -0.12])
def test_rectification_keeps_small_shifts_of_images_with_little_contrast(offset_px):
    """They change integers by less than 1/2: independent rounding would undo the shift almost completely."""
    noise = np.random.default_rng(3).normal(0, 0.7, (240, 320, 3))
    source = np.rint(100 + 20 * gaussian_filter(noise, (1.5, 1.5, 0)) + noise).astype(np.uint8)
    calibration = EpipolarCalibration()
    calibration.removed = np.array([0.0, 0.0, 0.0, offset_px / RIG.focal_px])
    found = calibration.rectify(source, RIG)
    v, u, band = np.indices(source.shape, float)
    exact = map_coordinates(source.astype(float), [v + offset_px, u, band], order=3, mode="nearest")
    slope, error = (x[8:-8, 8:-8] for x in (np.gradient(exact, axis=0), found - exact))
    assert np.sum(slope * error) / np.sum(slope**2) == pytest.approx(0.0, abs=0.004)


def test_repetition_distinguishes_a_tiled_from_a_random_texture():
    tile = texture()[:24, :32]
    assert repetition(texture(), 11) < 0.35
    assert repetition(np.tile(tile, (10, 10)), 11) > 0.9
    assert repetition(np.full((240, 320), 128, np.uint8), 11) == 0.0


def test_bright_and_dark_areas_as_large_as_a_patch_are_no_repetition():
    """Their autocorrelation exp(-d^2 / 4 s^2) is 0.62 at a distance of one patch, without a peak there."""
    areas = gaussian_filter(np.random.default_rng(4).normal(size=(480, 640)), 8.0)
    assert repetition((128 + 40 * areas / areas.std()).clip(0, 255).astype(np.uint8), 11) < 0.35


OBSERVATION = StereoObservation(0, 400, 0.2, 0.0, 0.0, 0.04, 0.05, 0.2)


def survey_result():
    """Returns the result of a synthetic survey, with positions known to 1 mm at a depth of 2 m."""
    result = survey()[0]
    n = len(result.keyframe_rows)
    return replace(result, node_cov=np.tile(np.eye(6) * 1e-6, (n, 1, 1)), keyframe_depth_m=np.full(n, 2.0))


PATTERN = EpipolarError(np.zeros(4), np.full(4, 1e-5), np.zeros(4), 0.2 / 277.0)


def quality(**changes):
    return EstimationQuality(links_tried=100, link_residual=1.0, link_chi2=1.0, frame_sigma_m=0.003)._replace(**changes)


@pytest.mark.parametrize(
    ("changes", "observed", "check"),
    [
        ({"frames_lost": 20}, {}, "frames_lost"),
        ({"nodes_bridged": 1}, {}, "nodes_bridged"),
        ({"links_failed": 30}, {}, "links_failed"),
        ({"link_chi2": 5.0}, {}, "link_chi2"),
        ({"alignment_converged": False}, {}, "alignment"),
        ({"link_residual": 3.0}, {}, "link_residual"),
        ({"frame_sigma_m": 0.05}, {}, "frame_sigma"),
        ({}, {"n_points": 20}, "points"),
        ({"epipolar": PATTERN}, {}, "row_pattern"),
        ({"disparity_offset": DisparityOffset(-1e-3, 1e-4)}, {}, "disparity_offset"),
        ({"distortion": DistortionError(0.03, 0.002)}, {}, "distortion"),
        ({"lasting_residuals": {"AHRS": 1.5}}, {}, "lasting_AHRS"),
        ({}, {"row_offset_px": -0.3}, "row_offset"),
        ({}, {"repetition": 0.9}, "repetition"),
    ],
)
def test_each_check_finds_its_fault_and_nothing_else(changes, observed, check):
    result = survey_result()
    good = replace(result, quality=quality(), stereo_observations=[OBSERVATION])
    bad = replace(result, quality=quality(**changes), stereo_observations=[OBSERVATION._replace(**observed)])
    assert [finding.check for finding in check_survey(good, RIG)] == []
    assert [finding.check for finding in check_survey(bad, RIG)] == [check]


YAW = EpipolarError(np.array([0, np.deg2rad(0.04), 0, 0]), np.full(4, 1e-5), np.zeros(4))


def test_an_error_of_the_rectification_is_judged_by_its_effect_in_millimetres():
    """0.04 deg at a depth of 2 m and a baseline of 0.15 m: 0.93 % of the reach of the path, 18.6 mm of the depth."""
    result = replace(survey_result(), quality=quality(epipolar=YAW), stereo_observations=[OBSERVATION])
    elevation, keys = survey()[1], result.keyframe_rows
    assert float(np.nanmedian(elevation.sigma_m)) == pytest.approx(0.008)
    reach_m = np.linalg.norm(result.final.positions[keys] - result.final.positions[keys[0]], axis=1).max()
    (far,) = check_survey(result, RIG, elevation)
    assert far.check == "yaw" and far.value == pytest.approx(0.0093 * reach_m, rel=0.01)
    assert far.limit == pytest.approx(3 * 3**0.5 * 1e-3) and f"{1000 * far.value:.2g} mm over" in far.sentence
    result.node_cov[:, 3:, 3:] = np.eye(3) * (far.value / 3) ** 2 / 3 * 1.01
    assert check_survey(result, RIG, elevation) == []
    sharp = replace(elevation, sigma_m=elevation.sigma_m * np.float32(0.5))
    (high,) = check_survey(result, RIG, sharp)
    assert high.value == pytest.approx(0.0186, rel=0.01) and "19 mm at 2 m, their standard" in high.sentence


def test_a_yaw_that_the_motions_exclude_is_judged_as_a_distortion():
    """0.04 deg moves rows by 0.19 px times x y, in RMS over the image 0.016 px."""
    for offset, expected in ((DisparityOffset(1e-4, 1e-4), []), (DisparityOffset(5e-4, 2e-4), ["yaw"])):
        known = quality(epipolar=YAW, disparity_offset=offset)
        result = replace(survey_result(), quality=known, stereo_observations=[OBSERVATION])
        assert [finding.check for finding in check_survey(result, RIG)] == expected
    large = YAW._replace(estimate=YAW.estimate * 15)
    known = quality(epipolar=large, disparity_offset=DisparityOffset(1e-4, 1e-4))
    result = replace(survey_result(), quality=known, stereo_observations=[OBSERVATION])
    (finding,) = check_survey(result, RIG)
    corner = np.array([320, 240]) / 2 / RIG.focal_px
    share = YAW.estimate[1] * 15 * np.prod(corner) / 3 * 2.0 / RIG.baseline_m
    assert finding.check == "row_pattern" and finding.length_error == pytest.approx(share, rel=1e-6)


def test_an_error_of_all_lengths_is_part_of_the_covariances():
    result, elevation = (
        replace(survey_result(), quality=quality(epipolar=YAW), stereo_observations=[OBSERVATION]),
        survey()[1],
    )
    findings = check_survey(result, RIG, elevation)
    inflated, higher = with_length_error(result, elevation, findings)
    share, poses = findings[0].length_error, result.final.world_from_camera[result.keyframe_rows]
    assert share == pytest.approx(0.0093, rel=0.01)
    added_m2 = np.trace((inflated.node_cov - result.node_cov)[:, 3:, 3:], axis1=1, axis2=2)
    np.testing.assert_allclose(added_m2, (share * np.linalg.norm(poses[:, :3, 3] - poses[0, :3, 3], axis=1)) ** 2)
    scaled = poses[:, :3, 3] + share * (poses[:, :3, 3] - poses[0, :3, 3])  # the error that the covariance describes
    error = np.einsum("nji,nj->ni", poses[:, :3, :3], scaled - poses[:, :3, 3])[1:]
    added = (inflated.node_cov - result.node_cov)[1:, 3:, 3:]
    np.testing.assert_allclose(added, error[:, :, None] * error[:, None, :], atol=1e-12)
    known = np.isfinite(elevation.sigma_m)
    np.testing.assert_allclose((higher.sigma_m**2 - elevation.sigma_m**2)[known], (share * 2.0) ** 2, rtol=1e-4)
    assert higher.variances.calibration - elevation.variances.calibration == pytest.approx((share * 2.0) ** 2)
    assert with_length_error(result, elevation, [])[0] is result


def test_a_distortion_is_a_finding_if_it_is_significant_and_larger_than_errors_of_matching():
    """k1 changes disparities of 20.8 px at 2 m by 2 k1 times themselves: 0.2 px for k1 = 0.0048."""
    for found, expected in (
        ((0.02, 0.002), True),
        ((0.02, 0.006), False),
        ((-0.02, 0.002), True),
        ((0.0047, 1e-4), False),
    ):
        result = replace(survey_result(), quality=quality(distortion=DistortionError(*found)))
        findings = check_survey(replace(result, stereo_observations=[OBSERVATION]), RIG)
        assert [finding.check for finding in findings] == ["distortion"] * expected
        assert not expected or findings[0].length_error == pytest.approx(0.04)


def test_the_effect_of_a_row_pattern_on_positions_is_left_to_the_alignment():
    result, elevation = survey_result(), survey()[1]
    result = replace(result, quality=quality(epipolar=PATTERN), stereo_observations=[OBSERVATION])
    (finding,) = check_survey(result, RIG, elevation)
    inflated, higher = with_length_error(result, elevation, [finding])
    np.testing.assert_array_equal(inflated.node_cov, result.node_cov)
    known = np.isfinite(elevation.sigma_m)
    assert np.all(higher.sigma_m[known] > elevation.sigma_m[known])


def test_heights_that_differ_between_sets_of_keyframes_are_a_finding():
    result, elevation = replace(survey_result(), quality=quality(), stereo_observations=[OBSERVATION]), survey()[1]
    assert check_survey(result, RIG, replace(elevation, scatter=1.9)) == []
    (finding,) = check_survey(result, RIG, replace(elevation, scatter=2.1))
    assert finding.check == "scatter" and "2.1 times their standard deviation" in finding.sentence


def test_an_uncertain_position_is_a_finding():
    result = replace(survey_result(), quality=quality(), stereo_observations=[OBSERVATION])
    result.node_cov[-1, 3:, 3:] = np.eye(3) * 0.1**2
    assert [finding.check for finding in check_survey(result, RIG)] == ["sigma"]


def test_offsets_of_links_that_share_a_node_count_as_one():
    """Oracle: 40 links from 10 nodes with equal errors per node have the error of 10 independent links."""
    rng, errors, sigma = np.random.default_rng(3), [], 0.0
    for _ in range(300):
        shared = np.repeat(rng.normal(size=10), 4) * 1e-3
        combined = disparity_offset([DisparityOffset(value, 1e-3) for value in shared], 10, 1.0, 277.0)
        errors.append(combined.estimate)
        sigma = combined.sigma
    assert np.std(errors) == pytest.approx(1e-3 / np.sqrt(10), rel=0.1)
    assert sigma == pytest.approx(1e-3 / np.sqrt(10), rel=0.4)
    assert disparity_offset([], 10, 1.0, 277.0) is None
    assert disparity_offset([DisparityOffset(0.02, 0.002)] * 40, 10, 1.0, 277.0) is None  # 0.55 px: a level floor


def test_the_variance_grows_with_the_views_of_the_same_floor():
    """A line of 200 nodes with the overlap 3/4 shows each point 1 + 2 (3/4 + 1/2 + 1/4) = 4 times."""
    poses = np.tile(np.eye(4), (200, 1, 1))
    poses[:, 0, 3] = np.arange(200) * 0.25 * RIG.width_px / RIG.fx_px * 2.0
    assert mean_views(poses, np.full(200, 2.0), RIG) == pytest.approx(4.0, rel=0.01)
    once, often = (disparity_offset([DisparityOffset(1e-3, 1e-4)] * 40, 10, views, 277.0) for views in (1.0, 5.0))
    assert often.sigma == pytest.approx(once.sigma * (1 + 0.25 * 4) ** 0.5)
    assert mean_views(poses[:0], np.zeros(0), RIG) == 1.0


def test_views_are_the_overlaps_of_rectangles_in_the_axes_of_each_camera():
    rng = np.random.default_rng(5)
    turns = Rotation.from_rotvec(rng.normal(0.0, 0.7, (20, 3))).as_matrix()
    depth_m, poses = rng.uniform(1.0, 3.0, 20), np.tile(np.eye(4), (20, 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = turns, rng.normal(0.0, 0.6, (20, 3))
    seen = np.einsum("iba,ikb->ika", turns, poses[None, :, :3, 3] - poses[:, None, :3, 3]) / depth_m[:, None, None]
    overlap = np.clip(1 - np.abs(seen[..., :2] * [RIG.fx_px / RIG.width_px, RIG.fy_px / RIG.height_px]), 0.0, None)
    assert mean_views(poses, depth_m, RIG) == pytest.approx(overlap.prod(axis=2).sum() / 20, rel=1e-12)


def test_offsets_that_contradict_each_other_are_uncertain():
    agreeing = disparity_offset([DisparityOffset(2e-3, 1e-3)] * 20, 20, 1.0, 277.0)
    contrary = disparity_offset([DisparityOffset(2e-3 + 0.02 * (-1) ** k, 1e-3) for k in range(20)], 20, 1.0, 277.0)
    assert agreeing.estimate == pytest.approx(contrary.estimate)
    assert contrary.sigma == pytest.approx(20 * agreeing.sigma)


def test_the_value_of_a_finding_of_a_row_offset_is_comparable_with_its_limit():
    result = replace(survey_result(), quality=quality(), stereo_observations=[OBSERVATION._replace(row_offset_px=-0.3)])
    (finding,) = check_survey(result, RIG)
    assert finding.value == 0.3 > finding.limit and "-0.30 px" in finding.sentence


def test_a_yaw_that_the_calibration_leads_to_expect_is_no_finding_for_an_estimator_that_does_not_calibrate_itself():
    """0.04 deg is within 3 sigma of 0.02 deg, not of 0.01; what a self-calibration leaves is judged as before."""
    known = {sigma: replace(RIG, yaw_sigma_rad=np.deg2rad(sigma)) for sigma in (0.02, 0.01)}
    plugin = replace(survey_result(), quality=quality(epipolar=YAW), stereo_observations=[OBSERVATION])
    calibrated = replace(
        plugin, quality=quality(epipolar=YAW, calibration=CalibrationEstimate(0.0, 0.0, np.eye(2) * 1e-8))
    )
    assert check_survey(plugin, known[0.02]) == []
    assert [found.check for found in check_survey(plugin, known[0.01])] == ["yaw"]
    assert [found.check for found in check_survey(calibrated, known[0.02])] == ["yaw"]
