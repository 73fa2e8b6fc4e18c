"""Variances of heights by cause: the parts are the whole."""

from dataclasses import replace

import numpy as np
import pytest
from seafloor_scene import Seafloor, down_camera, small_rig, smooth_texture, stereo_pair

from twin.core.quality import CalibrationEstimate
from twin.core.records import HeightVariances, MapGrid
from twin.estimate.mapping.map_builder import KeyframePath, build_map, with_scatter

RIG = small_rig(160, 120)
GRID = MapGrid(-2.0, 1.6, 0.02, 160, 200)
POSE_COV = np.diag([0.0, 0.0, 0.0, 0.0, 0.0, 0.003**2])


@pytest.fixture(scope="module")
def mapped():
    x, y = np.meshgrid(np.linspace(-4, 4, 81), np.linspace(-4, 4, 81))
    floor = Seafloor(0.1 * np.sin(2 * x) * np.cos(3 * y), 0.1, -4.0, -4.0, smooth_texture(3, 1024, 1.5), 0.008)
    poses, rng = np.stack([down_camera(0.1 * k, 0, 1.8) for k in range(3)]), np.random.default_rng(2)
    pairs = [stereo_pair(floor, RIG, pose, rng)[:2] for pose in poses]
    views = [(np.repeat(left[..., None], 3, 2), np.repeat(right[..., None], 3, 2)) for left, right in pairs]
    calibration = CalibrationEstimate(cov=np.diag([1e-4, 1e-3]) ** 2)
    path = KeyframePath(poses, np.tile(POSE_COV, (3, 1, 1)), np.zeros((3, 6, 6)))
    return build_map(views, path, RIG, GRID, calibration=calibration)


def whole(elevation):
    return np.mean(elevation.sigma_m[elevation.typical].astype(float) ** 2)


def test_the_parts_are_the_mean_variance_of_the_typical_cells(mapped):
    assert all(part > 0 for part in mapped.variances)
    assert sum(mapped.variances) == pytest.approx(whole(mapped), rel=0.01)  # the calibration changes the order a little


def test_the_part_of_poses_is_that_of_the_height_of_a_level_camera(mapped):
    """A height error of 3 mm of the poses alone, as nearly all of the floor is less steep than 30 degrees."""
    assert mapped.variances.pose == pytest.approx(0.003**2, rel=0.1)


def test_what_multiplies_or_adds_to_the_sigmas_is_in_the_parts(mapped):
    other = replace(mapped, height_m=mapped.height_m + 10 * mapped.sigma_m)
    scattered = with_scatter(mapped, mapped, other)
    assert (scattered.scatter or 0) > 2 and sum(scattered.variances) == pytest.approx(whole(scattered), rel=1e-4)


@pytest.mark.parametrize(("relief_m", "noise_m", "share"), [(0.0, 0.002, 0.0), (0.004, 0.0, 1.0), (0.004, 0.004, 0.5)])
def test_roughness_that_differs_between_two_halves_is_noise_of_the_depths(mapped, relief_m, noise_m, share):
    """The whole map has the mean of the independent noise of the halves, and their common relief."""
    rng, shape = np.random.default_rng(5), mapped.height_m.shape
    floor = relief_m * rng.standard_normal(shape)
    halves = [floor + noise_m * 2**0.5 * rng.standard_normal(shape) for _ in range(2)]
    one, other, full = (replace(mapped, height_m=h.astype(np.float32)) for h in (*halves, np.mean(halves, axis=0)))
    before, after = mapped.variances, with_scatter(full, one, other)
    scale = max(after.scatter or 0, 1) ** 2
    assert after.variances.relief == pytest.approx(scale * share * before.relief, abs=0.05 * scale * before.relief)
    assert sum(after.variances) == pytest.approx(scale * sum(before))


def empty():
    return build_map([], KeyframePath(np.zeros((0, 4, 4)), *np.zeros((2, 0, 6, 6))), RIG, GRID)


def test_a_map_without_heights_has_no_variances():
    assert empty().variances == HeightVariances()
