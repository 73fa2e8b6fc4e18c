"""Claims on registering patches, on textures that are sums of waves: known at every point, no interpolation."""

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
    """A texture of forty waves, five pixels long and more."""

    def __init__(self, seed=0, longest_px=20):
        rng = np.random.default_rng(seed)
        angle, length = rng.uniform(0, np.pi, 40), rng.uniform(5, longest_px, 40)
        self.wave = 2 * np.pi / length * np.stack([np.cos(angle), np.sin(angle)])
        self.phase = rng.uniform(0, 2 * np.pi, 40)

    def at(self, points):
        """Brightness (n,) at points (n, 2): mean 128, deviation about 30."""
        return 128 + 30 * np.cos(points @ self.wave + self.phase).sum(axis=-1) / np.sqrt(20)


def pixels(shape=SHAPE):
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    return np.stack([columns, rows], axis=-1).astype(float)


def pair(warp, shift, light=None, noise=0.0, seed=0, longest_px=20):
    """Source, target and where points of the source are in the target: centre + warp (p - centre) + shift."""
    waves, rng, centre = Waves(seed, longest_px), np.random.default_rng(seed + 1000), np.array([80.0, 60.0])
    source = waves.at(pixels())
    target = waves.at((pixels() - centre - shift) @ np.linalg.inv(warp).T + centre)
    if light is not None:
        target = (target - 128) * light(pixels()) + 128
    images = [np.clip(i + rng.normal(size=i.shape) * noise + 0.5, 0, 255).astype(np.uint8) for i in (source, target)]
    columns, rows = np.meshgrid(np.arange(45, 120, 6), np.arange(35, 90, 6))
    points = np.column_stack([columns.ravel(), rows.ravel()]).astype(float)
    return images, points, (points - centre) @ warp.T + centre + shift


def register(images, points, guess, warp, levels=0):
    source, target = (patches.pyramid(i, levels) for i in images)
    cut = patches.cut(source, points, PATCH_PX)
    return patches.register(cut, patches.splines(target), guess, np.tile(warp, (len(points), 1, 1)))


@pytest.mark.parametrize("name", WARPS)
@pytest.mark.parametrize("shift", [(0.0, 0.0), (3.25, -1.5), (0.5, 0.75)])
def test_patches_are_found_to_thousandths_of_a_pixel_however_slanted(name, shift):
    """Grey levels are whole numbers: 0.29 of rounding noise on a gradient of about 12 over 121 pixels: 0.002 px."""
    images, points, true = pair(WARPS[name], np.array(shift))
    found = register(images, points, true + [0.6, -0.4], WARPS[name])
    assert found.ok.mean() > 0.95
    error = (found.points - true)[found.ok]
    assert np.all(np.abs(error.mean(axis=0)) < 0.002)
    assert np.all(error.std(axis=0) < 0.01)


def test_a_quarter_of_the_image_finds_patches_eight_pixels_off():
    images, points, true = pair(WARPS["slant"], np.array([2.0, 1.0]), longest_px=100)
    found = register(images, points, true + [8.0, 0.0], WARPS["slant"], levels=2)
    assert found.ok.mean() > 0.9
    assert np.median(np.abs(found.points - true)[found.ok]) < 0.02  # long waves are shallow: rounding shows


def test_a_coarse_level_places_the_point_itself_not_the_coarse_pixel_nearest_to_it():
    """The finer levels switched off: the coarsest is good to tenths of its 4 px; its pixels lie up to 2 px off."""
    images, points, true = pair(WARPS["turn"], np.array([2.0, 1.0]), longest_px=100)
    source, target = (patches.pyramid(i, 2) for i in images)
    cut = patches.cut(source, points, PATCH_PX)
    cut[:2] = [level._replace(energy=np.zeros(len(points))) for level in cut[:2]]
    warp = np.tile(WARPS["turn"], (len(points), 1, 1))
    error = patches.register(cut, patches.splines(target), true, warp).points - true
    assert np.sqrt(np.mean(error**2)) < 0.5


def test_light_that_changes_across_the_patch_does_not_move_the_match():
    """The lamps move with the vehicle: brightness changes by one per cent a pixel between the two images."""
    images, points, true = pair(np.eye(2), np.array([0.3, 0.2]), light=lambda p: 0.8 + 0.01 * (p[..., 1] - 60))
    found = register(images, points, true, np.eye(2))
    assert np.all(np.abs((found.points - true)[found.ok].mean(axis=0)) < 0.003)


def test_the_covariance_of_a_match_is_true():
    """Both images err: squared error over two covariances has a mean of 2; 900 patches give it to 0.07."""
    squared = []
    for seed in range(8):
        images, points, true = pair(np.eye(2), np.array([0.3, 0.6]), noise=4.0, seed=seed)
        found = register(images, points, true, np.eye(2))
        error = (found.points - true)[found.ok]
        squared.append(np.einsum("ni,nij,nj->n", error, np.linalg.inv(2 * found.cov[found.ok]), error))
    assert np.mean(np.concatenate(squared)) == pytest.approx(2.0, rel=0.25)


def test_another_texture_is_not_taken_for_the_patch():
    images, points, true = pair(np.eye(2), np.zeros(2))
    other = pair(np.eye(2), np.zeros(2), seed=7)[0][1]
    assert register([images[0], other], points, true, np.eye(2)).ok.mean() < 0.02


def test_an_even_patch_and_one_outside_are_not_found():
    even = np.full(SHAPE, 90, np.uint8)
    points = np.array([[80.0, 60.0], [2.0, 60.0]])
    assert not register([even, even], points, points, np.eye(2)).ok.any()


def test_the_slope_is_that_of_the_plane_under_the_patch_though_another_surface_looks_in():
    rows, columns = np.mgrid[:40, :40]
    disparity = (20 + 0.1 * columns - 0.05 * rows).astype(np.float32)
    disparity[:, 24:] += 30  # a cliff beside the patch
    disparity[20:22, 18:20] = np.nan
    slope = patches.disparity_slope(disparity, np.array([[21.0, 20.0], [20.0, 20.0]]), PATCH_PX)
    np.testing.assert_allclose(slope[0], [0.1, -0.05], atol=1e-4)


def test_an_unknown_disparity_has_no_slope():
    nothing = np.full((40, 40), np.nan, np.float32)
    assert np.all(patches.disparity_slope(nothing, np.array([[20.0, 20.0]]), PATCH_PX) == 0)


RIG = StereoRig(160, 120, 150.0, 0.2, 30.0, np.eye(4))


def test_fused_matches_are_the_least_squares_estimate_given_equal_rows():
    """Oracle: generalised least squares for (x, y, disparity) from both places (4 numbers, 3 unknowns)."""
    rng = np.random.default_rng(3)
    root = rng.normal(size=(2, 2))
    cov = root @ root.T * 1e-2 + np.eye(2) * 1e-3
    left, right = np.array([[90.0, 50.0]]), np.array([[70.0, 50.1]])
    measured, joint = stereo.fuse(left, right, cov[None], RIG)
    floor = np.eye(2) * stereo._FLOOR_PX**2
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
def test_a_match_on_another_row_or_beyond_infinity_is_none(right, possible):
    assert stereo.on_one_row(np.array([[90.0, 50.0]]), np.array([right])).item() == possible


def test_at_the_border_those_are_found_that_err_inwards_so_only_what_is_well_inside_counts():
    rig = StereoRig(SHAPE[1], SHAPE[0], 160.0, 0.3, 30.0, np.eye(4))
    rows = np.arange(12.0, 108.0, 2.0)
    errors = {column: [] for column in (6.0, 9.0)}  # half a patch and what interpolation needs, and three pixels more
    for seed in range(12):
        images, *_ = pair(np.eye(2), np.zeros(2), noise=25.0, seed=seed)
        for column, found in errors.items():
            points = np.column_stack([np.full(len(rows), column), rows])
            match = register(images, points, points, np.eye(2))
            found.append((match.points - points)[match.ok, 0])
    border, inside = (np.concatenate(found) for found in errors.values())
    sure = [3 * error.std() / np.sqrt(len(error)) for error in (border, inside)]
    assert border.mean() > sure[0] and abs(inside.mean()) < sure[1]
    assert stereo.well_inside(np.array([[6.0, 50.0], [9.0, 50.0]]), rig, PATCH_PX).tolist() == [False, True]
