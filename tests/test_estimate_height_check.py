"""Tests of path and map without the truth: heights of legs there and back, readings, and the distortion by motions."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from twin.core import geometry
from twin.core.records import ElevationMap, MapGrid, Readings, SensorNoise, StereoRig
from twin.estimate.calibration_errors import lasting_residuals
from twin.estimate.mapping.map_builder import MIN_COMMON, flown_back, with_scatter
from twin.estimate.vision.image_errors import change_by_distortion
from twin.estimate.vision.observation_equations import PairMeasurements
from twin.estimate.vision.two_view_motion import pair_motion

GRID = MapGrid(0.0, 1.0, 0.02, 50, 80)
RIG = StereoRig(
    320, 240, 277.0, 0.15, body_from_camera=geometry.pose(geometry.BODY_FROM_DOWN_CAMERA, np.array([0.1, 0.2, -0.1]))
)


def lawnmower(heading_rad, legs=4, n=12):
    """Returns positions (n, 3) on legs there and back, turned by a heading, and whether each is on a leg back."""
    x = np.concatenate([np.arange(n)[:: (-1) ** leg] for leg in range(legs)]) * 0.2
    y, back = np.repeat(np.arange(legs) * 0.6, n), np.repeat(np.arange(legs) % 2 == 1, n)
    return np.column_stack([x, y, np.zeros(len(x))]) @ geometry.rotation_from_rpy(0, 0, heading_rad).T, back


@pytest.mark.parametrize("heading_deg", [0, 50, 90, 200])
def test_legs_there_and_back_are_told_apart_in_any_direction(heading_deg):
    """The keyframes at the turns belong to either."""
    positions, back = lawnmower(np.deg2rad(heading_deg))
    found, inner = flown_back(positions), (np.arange(len(back)) % 12 > 0) & (np.arange(len(back)) % 12 < 11)
    assert np.all(found[inner] == back[inner]) or np.all(found[inner] != back[inner])


def test_of_a_path_in_one_direction_every_other_keyframe_is_compared():
    np.testing.assert_array_equal(flown_back(np.arange(30).reshape(10, 3) * 0.1), np.arange(10) % 2 == 1)


def maps(ratio, seed=0, n_common=4000):
    """Returns a map of zeros and two maps whose independent errors are `ratio` times their standard deviations."""
    rng, sigma = np.random.default_rng(seed), np.full((50, 80), 0.004, np.float32)
    colours = np.zeros((50, 80, 3), np.uint8)
    parts = [np.float32(ratio * 0.004) * rng.standard_normal((50, 80)).astype(np.float32) for _ in range(2)]
    parts[0].ravel()[n_common:] = np.nan
    return [ElevationMap(GRID, height, sigma, colours) for height in (np.zeros_like(sigma), *parts)]


def test_standard_deviations_that_heights_contradict_are_multiplied_by_the_scatter():
    """The RMS of 4000 normal numbers is known to 1 / sqrt(8000) = 1.1 %."""
    for ratio in (2.5, 0.7):
        full, *parts = maps(ratio)
        found = with_scatter(replace(full, common_m2=np.float32(0.003**2)), *parts)
        assert found.scatter == pytest.approx(ratio, rel=0.04)
        np.testing.assert_allclose(found.sigma_m, 0.004 * max(found.scatter, 1.0), rtol=1e-6)
        np.testing.assert_allclose(found.repeatability_m, np.sqrt(7e-6) * max(found.scatter, 1.0), rtol=1e-5)


def test_mismatches_in_one_set_do_not_enlarge_the_standard_deviations():
    """3 % of the cells are 50 standard deviations off: the RMS of all would be 6."""
    full, one, other = maps(0.7)
    one.height_m[np.random.default_rng(1).random(one.height_m.shape) < 0.03] += np.float32(0.2)
    assert with_scatter(full, one, other).scatter == pytest.approx(0.7, rel=0.1)


def test_a_few_common_cells_are_no_test():
    full, one, other = maps(3.0, n_common=MIN_COMMON - 1)
    assert with_scatter(full, one, other) is full
    assert with_scatter(*maps(3.0, n_common=MIN_COMMON)).scatter == pytest.approx(3.0, rel=0.25)


def nodes(bend_deg, rise_m, seed, n=30, bias_deg=0.0):
    """Returns nodes on a level path with readings of their true pose, estimated on a path that is bent and rises."""
    rng, noise, found = np.random.default_rng(seed), SensorNoise(), []
    for share in np.linspace(0, 1, n):
        bent = geometry.rotation_from_rpy(0, np.deg2rad(bend_deg) * np.sin(np.pi * share), 0)
        pose = geometry.pose(bent @ geometry.BODY_FROM_DOWN_CAMERA, np.array([share, 0.0, 2.0 + rise_m * share]))
        angles = noise.attitude_sigmas_rad * rng.standard_normal(3) + np.deg2rad(bias_deg) * np.array([1.0, 0, 0])
        readings = Readings(pressure_z_m=2.0 + noise.pressure_m * rng.standard_normal(), ahrs_rpy_rad=angles)
        found.append(SimpleNamespace(world_from_camera=pose, readings=readings))
    return found


def test_readings_with_white_noise_contradict_no_path():
    """The chance of 4 standard deviations is far below 1 in 1000 for each of 600 sensors."""
    assert sum(len(lasting_residuals(nodes(0.0, 0.0, seed), RIG, SensorNoise())) for seed in range(300)) <= 1


def test_a_bent_or_rising_path_differs_from_the_readings_by_its_error():
    """RMS of half a sine: bend / sqrt(2), of one of three axes; of a ramp: rise / sqrt(3)."""
    bent = [lasting_residuals(nodes(1.2, 0.0, seed), RIG, SensorNoise()) for seed in range(10)]
    assert all(set(found) == {"AHRS"} for found in bent)
    assert np.mean([found["AHRS"] for found in bent]) == pytest.approx(1.2 / 2**0.5 / 0.2 / 3**0.5, rel=0.05)
    rising = [lasting_residuals(nodes(0.0, 0.04, seed), RIG, SensorNoise()) for seed in range(10)]
    assert all(set(found) == {"pressure"} for found in rising)
    assert np.mean([found["pressure"] for found in rising]) == pytest.approx(0.04 / 0.01 / 3**0.5, rel=0.1)


def test_more_noise_than_stated_is_no_lasting_residual():
    """Products of independent residuals have the mean 0, whatever their size."""
    noisy = replace(SensorNoise(), attitude_rad=np.deg2rad(0.2) / 1.5, heading_rad=np.deg2rad(0.5) / 1.5)
    assert sum("AHRS" in lasting_residuals(nodes(0.0, 0.0, seed), RIG, noisy) for seed in range(100)) <= 1


@pytest.mark.parametrize("k1", [0.0, -0.02])
def test_the_distortion_by_the_motions_is_unbiased_at_any_noise(k1):
    """Points at 1.4 to 2.1 m, moved by 0.2 m, with 0.2 px of noise; derivatives at measured points gave 0.14 too much.

    The mean of 25 estimates is within 4 of its standard deviations, and these have the size that is claimed.
    """
    rng, found = np.random.default_rng(5), []
    motion = geometry.exp(np.array([0.002, -0.003, 0.004, 0.05, 0.2, 0.01]))  # b in a
    cov = np.diag([1.0, 0.5, 2.0]) * (0.2 / RIG.focal_px) ** 2
    for _ in range(25):
        x, y = rng.uniform(-0.55, 0.55, 500), rng.uniform(-0.42, 0.42, 500)
        depth_m = 1.75 + 0.3 * np.sin(3 * x) * np.cos(4 * y) + 0.03 * rng.standard_normal(500)
        in_b = np.column_stack([x, y, np.ones(500)]) * depth_m[:, None]
        pairs = []
        for xyz in (geometry.transform(motion, in_b), in_b):
            exact = np.column_stack([xyz[:, :2], np.full(500, RIG.baseline_m)]) / xyz[:, 2:]
            noise = rng.standard_normal((500, 3)) * np.sqrt(np.diag(cov))
            pairs.append(exact + k1 * change_by_distortion(exact) + noise)
        measured = PairMeasurements(*pairs, *np.tile(cov, (2, 500, 1, 1)))
        found.append(pair_motion(measured, RIG.baseline_m, motion).distortion)
    estimate, sigma = np.array(found).T
    assert abs(estimate.mean() - k1) < 4 * sigma.mean() / 25**0.5
    assert estimate.std(ddof=1) == pytest.approx(sigma.mean(), rel=0.4)


def test_sensors_without_readings_have_no_residuals():
    bare = [SimpleNamespace(world_from_camera=np.eye(4), readings=Readings())] * 5
    assert lasting_residuals(bare, RIG, SensorNoise()) == {} == lasting_residuals([], RIG, SensorNoise())
