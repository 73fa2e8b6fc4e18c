"""Tests of patch matching on textures that are sums of waves, known at every point without interpolation."""

import numpy as np
import pytest

from twin.core.records import StereoRig
from twin.estimate.vision import patches, stereo

PATCH_PX = 11
SHAPE = (120, 160)
TURN = np.deg2rad(20)
WARPS = {
    "shift": np.eye(2),
    "slant": np.array([[0.8, 0.15], [0.0, 1.0]]),
    "turn": np.array([[np.cos(TURN), -np.sin(TURN)], [np.sin(TURN), np.cos(TURN)]]),
}


class Waves:
    """A texture of forty sine waves of at least five pixels."""

    def __init__(self, seed=0, longest_px=20):
        rng = np.random.default_rng(seed)
        angle, length = rng.uniform(0, np.pi, 40), rng.uniform(5, longest_px, 40)
        self.wave = 2 * np.pi / length * np.stack([np.cos(angle), np.sin(angle)])
        self.phase = rng.uniform(0, 2 * np.pi, 40)

    def at(self, points):
        """Returns the brightness (n,) at points (n, 2): mean 128, standard deviation about 30."""
        return 128 + 30 * np.cos(points @ self.wave + self.phase).sum(axis=-1) / np.sqrt(20)


def pixels(shape=SHAPE):
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    return np.stack([columns, rows], axis=-1).astype(float)


def pair(warp, shift, light=None, noise=0.0, seed=0, longest_px=20):
    """Returns [source, target], points in the source, and their true positions centre + warp (p - centre) + shift."""
    waves, rng, centre = Waves(seed, longest_px), np.random.default_rng(seed + 1000), np.array([80.0, 60.0])
    source = waves.at(pixels())
    target = waves.at((pixels() - centre - shift) @ np.linalg.inv(warp).T + centre)
    if light is not None:
        target = (target - 128) * light(pixels()) + 128
    noisy = (image + rng.normal(size=image.shape) * noise for image in (source, target))
    images = [np.floor(np.clip(image + 0.5, 0, 255)).astype(np.float32) for image in noisy]  # as of `matching.gray`
    columns, rows = np.meshgrid(np.arange(45, 120, 6), np.arange(35, 90, 6))
    points = np.column_stack([columns.ravel(), rows.ravel()]).astype(float)
    return images, points, (points - centre) @ warp.T + centre + shift


def match(images, points, guess, warp, levels=0):
    source, target = (patches.pyramid(i, levels) for i in images)
    templates = patches.extract_templates(source, points, PATCH_PX)
    warps = np.tile(warp, (len(points), 1, 1))
    return patches.match_templates(templates, patches.spline_coefficients(target), guess, warps)


@pytest.mark.parametrize("name", WARPS)
@pytest.mark.parametrize("shift", [(0.0, 0.0), (3.25, -1.5), (0.5, 0.75)])
def test_warped_patches_are_matched_to_thousandths_of_a_pixel(name, shift):
    """Tolerance: rounding noise of 0.29 grey levels and gradients of about 12 over 121 pixels give 0.002 px."""
    images, points, true = pair(WARPS[name], np.array(shift))
    matched = match(images, points, true + [0.6, -0.4], WARPS[name])
    assert matched.ok.mean() > 0.95
    error = (matched.points - true)[matched.ok]
    assert np.all(np.abs(error.mean(axis=0)) < 0.002)
    assert np.all(error.std(axis=0) < 0.01)


def test_a_pyramid_of_two_levels_matches_patches_from_eight_pixels_away():
    images, points, true = pair(WARPS["slant"], np.array([2.0, 1.0]), longest_px=100)
    matched = match(images, points, true + [8.0, 0.0], WARPS["slant"], levels=2)
    assert matched.ok.mean() > 0.9
    assert (
        np.median(np.abs(matched.points - true)[matched.ok]) < 0.02
    )  # gradients of long waves are small compared with rounding


def test_a_coarse_level_matches_the_point_itself_not_the_nearest_coarse_pixel():
    """Finer levels are disabled: the error is a tenth of a coarse pixel (4 px); its centre is up to 2 px off."""
    images, points, true = pair(WARPS["turn"], np.array([2.0, 1.0]), longest_px=100)
    source, target = (patches.pyramid(i, 2) for i in images)
    templates = patches.extract_templates(source, points, PATCH_PX)
    templates[:2] = [level._replace(energy=np.zeros(len(points))) for level in templates[:2]]
    warp = np.tile(WARPS["turn"], (len(points), 1, 1))
    error = patches.match_templates(templates, patches.spline_coefficients(target), true, warp).points - true
    assert np.sqrt(np.mean(error**2)) < 0.5


def test_a_change_of_illumination_across_the_patch_does_not_shift_the_match():
    """Lamps move with the vehicle; here brightness changes by one per cent per pixel between the two images."""
    images, points, true = pair(np.eye(2), np.array([0.3, 0.2]), light=lambda p: 0.8 + 0.01 * (p[..., 1] - 60))
    matched = match(images, points, true, np.eye(2))
    assert np.all(np.abs((matched.points - true)[matched.ok].mean(axis=0)) < 0.003)


def test_the_covariance_of_a_match_is_consistent():
    """Both images are noisy: squared error over twice the covariance has mean 2, standard error 0.07 (900 patches)."""
    squared = []
    for seed in range(8):
        images, points, true = pair(np.eye(2), np.array([0.3, 0.6]), noise=4.0, seed=seed)
        matched = match(images, points, true, np.eye(2))
        error = (matched.points - true)[matched.ok]
        squared.append(np.einsum("ni,nij,nj->n", error, np.linalg.inv(2 * matched.cov[matched.ok]), error))
    assert np.mean(np.concatenate(squared)) == pytest.approx(2.0, rel=0.25)


def test_a_different_texture_is_not_matched():
    images, points, true = pair(np.eye(2), np.zeros(2))
    other = pair(np.eye(2), np.zeros(2), seed=7)[0][1]
    assert match([images[0], other], points, true, np.eye(2)).ok.mean() < 0.02


def test_uniform_patches_and_patches_across_the_border_are_not_matched():
    uniform = np.full(SHAPE, 90, np.float32)
    points = np.array([[80.0, 60.0], [2.0, 60.0]])
    assert not match([uniform, uniform], points, points, np.eye(2)).ok.any()


def test_the_slope_is_that_of_the_surface_at_the_patch_centre_despite_another_surface():
    rows, columns = np.mgrid[:40, :40]
    disparity = (20 + 0.1 * columns - 0.05 * rows).astype(np.float32)
    disparity[:, 24:] += 30  # a cliff at the edge of the patch
    disparity[20:22, 18:20] = np.nan
    slope = patches.disparity_slope(disparity, np.array([[21.0, 20.0], [20.0, 20.0]]), PATCH_PX)
    np.testing.assert_allclose(slope[0], [0.1, -0.05], atol=1e-4)


def test_an_unknown_disparity_has_no_slope():
    unknown = np.full((40, 40), np.nan, np.float32)
    assert np.all(patches.disparity_slope(unknown, np.array([[20.0, 20.0]]), PATCH_PX) == 0)


RIG = StereoRig(160, 120, 150.0, 0.2, 30.0, np.eye(4))


def test_fused_matches_are_the_least_squares_estimate_given_equal_rows():
    """Oracle: generalised least squares for (x, y, disparity) from both positions (4 measurements, 3 unknowns)."""
    rng = np.random.default_rng(3)
    root = rng.normal(size=(2, 2))
    cov = root @ root.T * 1e-2 + np.eye(2) * 1e-3
    left, right = np.array([[90.0, 50.0]]), np.array([[70.0, 50.1]])
    measured, joint = stereo.fuse(left, right, cov[None], RIG)
    floor = np.eye(2) * stereo._MIN_SIGMA_PX**2
    model = np.array([[1, 0, 0], [0, 1, 0], [1, 0, -1], [0, 1, 0]], float)
    weight = np.linalg.inv(np.kron(np.eye(2), cov + floor))
    expected_cov = np.linalg.inv(model.T @ weight @ model)
    expected = expected_cov @ model.T @ weight @ np.concatenate([left[0], right[0]])
    expected[:2] -= [RIG.cx_px, RIG.cy_px]
    np.testing.assert_allclose(measured[0] * RIG.focal_px, expected, atol=1e-9)
    np.testing.assert_allclose(joint[0] * RIG.focal_px**2, expected_cov, atol=1e-9)


@pytest.mark.parametrize(
    ("right", "possible"), [((70.0, 50.9), True), ((70.0, 51.1), False), ((70.0, 48.9), False), ((89.7, 50.0), False)]
)
def test_matches_on_another_row_or_without_positive_disparity_are_rejected(right, possible):
    assert stereo.satisfies_epipolar(np.array([[90.0, 50.0]]), np.array([right])).item() == possible


def test_matches_at_the_border_are_biased_inwards_and_well_inside_excludes_them():
    rig = StereoRig(SHAPE[1], SHAPE[0], 160.0, 0.3, 30.0, np.eye(4))
    rows = np.arange(12.0, 108.0, 2.0)
    errors = {column: [] for column in (6.0, 9.0)}  # just enough for patch and interpolation, and 3 px more
    for seed in range(12):
        images, *_ = pair(np.eye(2), np.zeros(2), noise=25.0, seed=seed)
        for column, samples in errors.items():
            points = np.column_stack([np.full(len(rows), column), rows])
            matches = match(images, points, points, np.eye(2))
            samples.append((matches.points - points)[matches.ok, 0])
    border, inside = (np.concatenate(samples) for samples in errors.values())
    bound = [3 * error.std() / np.sqrt(len(error)) for error in (border, inside)]
    assert border.mean() > bound[0] and abs(inside.mean()) < bound[1]
    assert stereo.well_inside(np.array([[6.0, 50.0], [9.0, 50.0]]), rig, PATCH_PX).tolist() == [False, True]


def test_a_patch_at_the_border_reads_no_pixel_outside_of_the_image():
    """The uppermost position of the patch, rounded to single precision, lies 5e-7 px above the first row of knots."""
    target = np.random.default_rng(3).normal(size=(60, 80)).astype(np.float32)
    warp = np.array([[1.0, 0.0], [-0.0012883614637495544, 1.000395122060182]])
    row, values = 6.008417462653595, np.empty(121, np.float32)
    assert row >= 5 * abs(warp[1]).sum() + 1
    spline = patches.spline_coefficients([target])[0]
    patches._sample.py_func(spline, 40.0, row, warp, 5, values)
    assert np.abs(values).max() < 2 * np.abs(target).max()
