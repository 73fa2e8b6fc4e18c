"""Noise of matches and covariance of links: row differences, pixel locking, scatter of residuals, relief."""

import numpy as np
import pytest
import seafloor_scene as scene

from twin.core import geometry
from twin.core.records import Readings
from twin.core.settings import EstimatorSettings
from twin.estimate.vision import matching, patches, stereo, two_view_motion
from twin.estimate.vision.image_spool import ImageSpool
from twin.estimate.vision.observation_equations import (
    PairMeasurements,
    PixelLocking,
    linearise,
    motion_normal_equations,
    transfer,
)
from twin.estimate.vision.pair_matching import PairMatcher
from twin.estimate.vision.stereo import Keyframe
from twin.estimate.vision.two_view_motion import PairMotionSettings

RIG = scene.small_rig()
PATCH_PX = 11
SIGMA = 0.05 / RIG.focal_px
TRUE = geometry.exp(np.array([0.001, -0.001, 0.0005, 0.2, -0.1, 0.001]))


def covs(n):
    """Returns independent positions in both images: x and disparity share the noise of the left one."""
    return np.tile(np.array([[1.0, 0, 1], [0, 0.5, 0], [1, 0, 2]]) * SIGMA**2, (n, 1, 1))


def noise(rng, n):
    return rng.normal(size=(n, 3)) @ np.linalg.cholesky(covs(1)[0]).T


def smooth_floor(rng, n=300):
    """Returns points at whole pixels of b, normalised (x, y, disparity), of an undulating floor 2 m below."""
    pixels = np.column_stack([rng.integers(8, RIG.width_px - 8, n), rng.integers(8, RIG.height_px - 8, n)])
    x, y = RIG.normalised(pixels).T
    depth = 2.0 + 0.02 * np.sin(3 * x + rng.uniform(0, 6)) + 0.02 * np.sin(4 * y + rng.uniform(0, 6))
    return np.column_stack([x, y, RIG.baseline_m / depth])


def locking_of(a, b):
    """Returns the derivatives by the amplitude of pixel locking for patches that are not warped."""
    derivatives = []
    for points, template in ((a, False), (b, True)):
        left = points[:, :2] * RIG.focal_px + [RIG.cx_px, RIG.cy_px]
        right = left - np.column_stack([points[:, 2] * RIG.focal_px, np.zeros(len(points))])
        left, right = (patches.locking_shifts(p, np.tile(np.eye(2), (len(p), 1, 1)), PATCH_PX) for p in (left, right))
        derivatives.append(stereo.fused_shift(left * (not template), right, covs(len(points)), RIG))
    return PixelLocking(*derivatives)


def nees_of(make, trials, settings=lambda locking: PairMotionSettings(locking=locking)):
    """Returns the NEES (trials,) of motions measured from the points that `make(rng)` returns, and their RMSE [m]."""
    rng, nees, square = np.random.default_rng(7), [], []
    for _ in range(trials):
        a, b, locking = make(rng)
        cov = covs(len(a))
        motion = two_view_motion.pair_motion(PairMeasurements(a, b, cov, cov), RIG.baseline_m, TRUE, settings(locking))
        assert motion is not None
        error = geometry.log(geometry.inverse(TRUE) @ motion.a_from_b)
        nees.append(error @ np.linalg.solve(motion.cov, error))
        square.append(error[3:] @ error[3:])
    return np.array(nees), np.sqrt(np.mean(square))


def with_noise(rng, growth=None, amplitude_px=0.0):
    """Returns noisy measurements of a smooth floor; `growth(b)` (n, 1) multiplies the noise of each point in a."""
    b = smooth_floor(rng)
    a, _, _ = transfer(b, TRUE, RIG.baseline_m)
    locking = locking_of(a, b)
    factor = 1.0 if growth is None else growth(b)
    a = a + noise(rng, len(a)) * factor + locking.a * amplitude_px
    return a, b + noise(rng, len(b)) + locking.b * amplitude_px, locking


def fused_rows(rng, n, sigma_px, offset_px=0.0):
    left, right = (rng.normal(size=(n, 2)) * sigma_px for _ in range(2))
    return left, right + [0, offset_px]


def test_row_differences_measure_the_noise_of_matches_apart_from_a_common_offset():
    """Of 400 points, the ratio has a standard error of 1.17 / 20 = 6 %."""
    cov = np.tile(np.eye(2) * 0.05**2, (400, 1, 1))
    for offset_px in (0.0, 0.22):
        rows = fused_rows(np.random.default_rng(1), 400, 0.17, offset_px)
        assert stereo.row_noise_ratio(*rows, cov) == pytest.approx(0.17 / 0.05, rel=0.15)
        assert stereo.row_noise_ratio(*fused_rows(np.random.default_rng(2), 400, 0.05, offset_px), cov) == 1
    assert stereo.row_noise_ratio(*fused_rows(np.random.default_rng(3), 400, 0.02), cov) == 1  # never smaller
    assert stereo.row_noise_ratio(*fused_rows(np.random.default_rng(4), 20, 0.5), cov[:20]) == 1  # too few points


def test_a_shift_of_both_positions_moves_the_fused_point_as_predicted():
    """`fuse` is linear in the positions; oracle: its difference."""
    rng = np.random.default_rng(5)
    root = rng.normal(size=(6, 2, 2)) * 0.1
    cov = root @ root.transpose(0, 2, 1) + np.eye(2) * 1e-3
    left, right, left_shift, right_shift = (rng.uniform(0, 100, (6, 2)) for _ in range(4))
    before, fused_cov = stereo.fuse(left, right, cov, RIG)
    after, _ = stereo.fuse(left + left_shift, right + right_shift, cov, RIG)
    np.testing.assert_allclose(stereo.fused_shift(left_shift, right_shift, fused_cov, RIG), after - before, atol=1e-12)


def test_pixel_locking_has_a_period_of_one_pixel_and_vanishes_where_the_phase_varies_over_the_patch():
    pixels = np.array([[10.0, 20.5], [10.25, 20.75], [11.25, 3.75]])
    same = np.tile(np.eye(2), (3, 1, 1))
    expected = np.array([[0.0, 0.0], [-1.0, 1.0], [-1.0, 1.0]])
    np.testing.assert_allclose(patches.locking_shifts(pixels, same, PATCH_PX), expected, atol=1e-12)
    across = same + np.array([[0.0, 1 / PATCH_PX], [0.0, 0.0]])  # columns shift by one pixel from first to last row
    np.testing.assert_allclose(patches.locking_shifts(pixels, across, PATCH_PX)[:, 0], 0, atol=1e-12)
    np.testing.assert_allclose(patches.locking_shifts(pixels, across, PATCH_PX)[:, 1], expected[:, 1], atol=1e-12)


def test_pixel_locking_is_estimated_along_and_the_covariance_stays_consistent():
    """NEES of six degrees of freedom, mean of 80: standard error 0.39. Without the unknown, both are larger."""

    def biased(rng):
        return with_noise(rng, amplitude_px=0.012)

    nees, rmse_m = nees_of(biased, 80)
    old_nees, old_rmse_m = nees_of(biased, 80, lambda _: PairMotionSettings())
    assert nees.mean() == pytest.approx(6, abs=1.6)
    assert old_nees.mean() > 9
    assert rmse_m < 0.9 * old_rmse_m


def test_the_covariance_follows_the_scatter_of_single_points():
    """Noise that grows towards one side of the image, unknown to the reported covariances, as relief makes it."""

    def growing(rng):
        return with_noise(rng, growth=lambda b: 1 + 2 * (np.abs(b[:, :1]) > 0.3))

    nees, _ = nees_of(growing, 80, lambda _: PairMotionSettings())
    assert nees.mean() == pytest.approx(6, abs=1.6)


@pytest.mark.parametrize("growth", [1.0, 6.0])
def test_the_covariance_follows_the_scatter_of_points_without_disparity(growth):
    """As frames between keyframes are matched: two coordinates per point; NEES of six, standard error of 40 is 0.55."""
    rng, nees = np.random.default_rng(11), []
    settings = PairMotionSettings(n_measured=2)
    for _ in range(40):
        b = smooth_floor(rng)
        a, _, _ = transfer(b, TRUE, RIG.baseline_m)
        a = a + noise(rng, len(a)) * np.where(np.abs(b[:, :1]) > 0.3, growth, 1.0)
        cov_a = covs(len(a)) * np.outer([1, 1, 0], [1, 1, 0])
        cov_a[:, 2, 2] = 1.0
        measured = PairMeasurements(a, b + noise(rng, len(b)), cov_a, covs(len(b)))
        motion = two_view_motion.pair_motion(measured, RIG.baseline_m, TRUE, settings)
        assert motion is not None
        error = geometry.log(geometry.inverse(TRUE) @ motion.a_from_b)
        nees.append(error @ np.linalg.solve(motion.cov, error))
    assert 4 < np.mean(nees) < 8


def test_the_scatter_of_noise_as_reported_gives_the_reported_covariance():
    """Law: where the reported covariances hold, nothing changes. Of 300 points, each sigma is known to about 5 %."""
    rng = np.random.default_rng(9)
    log_ratios = []
    for _ in range(10):
        a, b, _ = with_noise(rng)
        measured = PairMeasurements(a, b, covs(len(a)), covs(len(b)))
        scatter = two_view_motion.pair_motion(measured, RIG.baseline_m, TRUE)
        assert scatter is not None
        observations = linearise(measured, measured.b, scatter.a_from_b, RIG.baseline_m)
        information = motion_normal_equations(observations, np.ones(len(a)))[0]
        log_ratios.append((np.linalg.slogdet(scatter.cov)[1] + np.linalg.slogdet(information)[1]) / 12)
    assert np.exp(np.mean(log_ratios)) == pytest.approx(1, abs=0.06)


RELIEF_RIG = scene.small_rig(240, 180)


def crowded_floor():
    """Returns a floor with steep mounds, 0.45 m high and 1 m apart, whose flanks occlude each other."""
    nodes = np.linspace(-4, 4, 201)
    x, y = np.meshgrid(nodes, nodes)
    height = 0.45 * np.clip(1.6 * np.sin(6 * x + 1.0) * np.sin(6 * y), -1, 1)
    return scene.Seafloor(height, 0.04, -4.0, -4.0, scene.smooth_texture(3, 1024, 1.6), 0.005)


@pytest.fixture(scope="module")
def relief_nees(tmp_path_factory):
    """NEES of the links between pairs of views of steep relief, in random directions."""
    floor, rng, spool = crowded_floor(), np.random.default_rng(4), ImageSpool(tmp_path_factory.mktemp("relief"))
    matcher, nees = PairMatcher(RELIEF_RIG, spool, PATCH_PX), []

    def keyframe(pose, believed):
        pair = [scene.render_view(floor, RELIEF_RIG, p, samples=1) for p in (pose, pose @ RELIEF_RIG.left_from_right)]
        images = [np.repeat(scene.digitise(image, rng, 2.0)[..., None], 3, axis=2) for image, _ in pair]
        gray = matching.gray(images[0]), matching.gray(images[1])
        dense_px = (RELIEF_RIG.focal_px * RELIEF_RIG.baseline_m / pair[0][1]).astype(np.float32)
        settings = EstimatorSettings(points=300, patch_px=PATCH_PX)
        points = stereo.match_stereo_points(*gray, dense_px, RELIEF_RIG, settings)
        row = int(rng.integers(2**31))
        spool.put(row, *images, gray)
        return Keyframe(row, row, 1, believed, points, Readings())

    for _ in range(8):
        pose = scene.down_camera(*rng.uniform(-1.5, 1.5, 2), 2.2)
        bearing, turn = rng.uniform(0, 2 * np.pi), rng.normal(size=3) * 0.01
        motion = geometry.exp(np.concatenate([turn, [0.35 * np.cos(bearing), 0.35 * np.sin(bearing), 0.0]]))
        earlier, node = keyframe(pose, pose), keyframe(pose @ motion, pose @ motion)
        matched = matcher.match(node, [earlier])[0]
        found = matcher.motion(node, earlier, matched)
        assert found is not None
        error = geometry.log(geometry.inverse(motion) @ found.a_from_b)
        nees.append(error @ np.linalg.solve(found.cov, error))
    matcher.close()
    spool.close()
    return np.array(nees)


def test_claimed_sigma_of_links_over_steep_relief_is_within_a_factor_of_1_5_of_the_error(relief_nees):
    """Mean NEES of 8 links: 6 if consistent, with a standard error of 1.2."""
    assert 6 / 1.5**2 < relief_nees.mean() < 6 * 1.5**2


def test_over_a_level_floor_the_noise_is_not_taken_for_pixel_locking():
    """All points are displaced by the same fraction of a pixel, in both images."""
    depth_m = RIG.focal_px * RIG.baseline_m / 15.1  # disparity 15.1 px
    motion = geometry.pose(np.eye(3), np.array([12.1, -8.1, 0]) * depth_m / RIG.focal_px)

    def make(rng):
        pixels = np.column_stack([rng.integers(30, RIG.width_px - 30, 300), rng.integers(30, RIG.height_px - 30, 300)])
        b = np.column_stack([RIG.normalised(pixels), np.full(300, RIG.baseline_m / depth_m)])
        a = transfer(b, motion, RIG.baseline_m)[0]
        a, b = a + noise(rng, 300), b + noise(rng, 300)
        return a, b, locking_of(a, b)

    rng, nees = np.random.default_rng(5), []
    for _ in range(20):
        a, b, locking = make(rng)
        cov, settings = covs(300), PairMotionSettings(locking=locking)
        found = two_view_motion.pair_motion(PairMeasurements(a, b, cov, cov), RIG.baseline_m, motion, settings)
        assert found is not None
        error = geometry.log(geometry.inverse(motion) @ found.a_from_b)
        nees.append(error @ np.linalg.solve(found.cov, error))
    assert np.mean(nees) < 12  # 6 expected
