"""Caustics: light is conserved, the pattern follows the waves, fades with depth and is consistent in both cameras."""

import types

import numpy as np
import pytest

from twin.core import geometry
from twin.errors import TwinError
from twin.imaging.caustics import CELLS, GRAVITY_MPS2, SLOPE_RMS, TILE_M, WATER_INDEX, Caustics
from twin.imaging.illumination import Illumination, daylight_at, illumination_of
from twin.imaging.image_formation import ImageFormation, StampedPose
from twin.imaging.water import medium
from twin.scenario.model import Scenario, SunConfig, WaterConfig

CLEAR = medium(WaterConfig(jerlov="clear"))
FLAT = types.SimpleNamespace(height_m=np.zeros((9, 9), np.float32), spacing_m=1.0, west_m=-4.0, south_m=-4.0)


def scenario(**sun):
    keys = {"illuminance_lx": 1000.0, "depth_m": 4.0, "caustics": 1.0} | sun
    rig = {"image_width_px": 160, "image_height_px": 120}
    return Scenario.model_validate({"rig": rig, "sun": keys, "water": {"jerlov": "clear"}})


def caustics_at(depth_m, focused_share, water, seed):
    sun = SunConfig(illuminance_lx=1000.0, depth_m=depth_m, caustics=focused_share)
    return Caustics(Illumination(water, daylight_at(sun, water, 0.0)), seed)


def image_formation(here):
    return ImageFormation(here, illumination_of(here), FLAT, np.random.default_rng(0))


@pytest.mark.parametrize(("depth_m", "jerlov"), [(1.0, "clear"), (4.0, "IB"), (20.0, "II")])
def test_waves_conserve_light(depth_m, jerlov):
    caustics = caustics_at(depth_m, 1.0, medium(WaterConfig(jerlov=jerlov)), 3)
    for time_s in (0.0, 1.7):
        light = caustics.pattern(time_s)
        assert light.mean(dtype=np.float64) == pytest.approx(1.0, abs=1e-5)
        assert light.min() > -1e-3


def test_in_shallow_water_caustics_follow_the_curvature_of_the_surface():
    """Before rays cross, I = 1 / det(1 - displacement per slope * slope gradient): the ratio of areas."""
    depth_m = 0.15
    caustics = caustics_at(depth_m, 1.0, CLEAR, 1)
    east, north = (s.astype(np.float64) for s in caustics.slopes(0.4))
    assert np.sqrt((east**2 + north**2).mean()) == pytest.approx(SLOPE_RMS, rel=1e-5)
    k = 2 * np.pi * np.fft.fftfreq(CELLS, TILE_M / CELLS)

    def gradient(values, axis):
        along = k[None] if axis == 1 else k[:, None]
        return np.fft.ifft2(1j * along * np.fft.fft2(values)).real

    per_slope_m = (1 - 1 / WATER_INDEX) * depth_m
    det = (1 - per_slope_m * gradient(east, 1)) * (1 - per_slope_m * gradient(north, 0))
    det -= per_slope_m**2 * gradient(east, 0) * gradient(north, 1)
    assert det.min() > 0.5
    light = caustics.pattern(0.4)
    # the formula holds at the surface, up to 2 cm away from the floor point; that and the cell size reduce contrast
    assert np.corrcoef(light.ravel(), (1 / det).ravel())[0, 1] > 0.97
    assert light.std() == pytest.approx((1 / det).std(), rel=0.1)


def test_waves_have_the_dispersion_of_deep_water():
    """The phase of each wave changes by omega t with omega^2 = g k, downwind."""
    caustics = caustics_at(1.0, 1.0, CLEAR, 1)
    before, after = (np.fft.fft2(caustics.slopes(t)[0]) for t in (0.0, 0.05))
    column = 4  # waves of 1 m, a quarter of the tile, that travel east
    phase = np.angle(after[0, column] / before[0, column])
    assert phase == pytest.approx(-0.05 * np.sqrt(GRAVITY_MPS2 * 2 * np.pi * column / TILE_M), rel=1e-3)


def test_contrast_decreases_with_depth_turbidity_and_diffuse_light():
    contrast = [caustics_at(d, 1.0, medium(WaterConfig(jerlov="IB")), 1).pattern(0.0).std() for d in (5.0, 15.0, 40.0)]
    assert contrast[0] > 2 * contrast[1] > 4 * contrast[2] > 0
    murky = caustics_at(5.0, 1.0, medium(WaterConfig(jerlov="II")), 1).pattern(0.0).std()
    assert murky < 0.5 * contrast[0]
    half = caustics_at(5.0, 0.5, medium(WaterConfig(jerlov="IB")), 1).pattern(0.0)
    np.testing.assert_allclose(half.std(), contrast[0] / 2, rtol=1e-4)


def test_the_pattern_depends_on_the_seed_and_changes_with_time():
    one, same, other = (caustics_at(4.0, 1.0, CLEAR, seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(one.pattern(0.3), same.pattern(0.3))
    assert np.corrcoef(one.pattern(0.0).ravel(), other.pattern(0.0).ravel())[0, 1] < 0.3
    moved = [np.corrcoef(one.pattern(0.0).ravel(), one.pattern(t).ravel())[0, 1] for t in (1 / 30, 2.0)]
    assert moved[0] > 0.6 and moved[1] < 0.3


def test_both_cameras_see_the_same_caustics_on_the_floor():
    """On a level floor at 2 m the right image is the left one shifted by the disparity, and matches the pattern."""
    here = scenario()
    light, rig = image_formation(here), here.believed_rig()
    pose = geometry.pose(geometry.BODY_FROM_DOWN_CAMERA, np.array([0.37, -1.2, 2.0]))
    white, depth = np.full((120, 160, 3), 255, np.uint8), np.full((120, 160), 2.0, np.float32)
    left, right = (light.radiance(white, depth, camera, StampedPose(pose, 0.5))[..., 1] for camera in (0, 1))
    pixel_m = 2.0 / rig.focal_px
    shift = rig.baseline_m / pixel_m
    column = np.arange(30, 150)
    moved = np.array([np.interp(column, np.arange(160), row) for row in left])
    shifted = np.array([np.interp(column - shift, np.arange(160), row) for row in right])
    assert np.abs(shifted - moved).mean() < 0.02 * left.mean() and left.std() > 0.2 * left.mean()
    # each pixel shows the pattern at the intersection of its ray with the floor
    pattern = caustics_at(4.0, 1.0, CLEAR, here.seed).pattern(0.5)
    for v, u in [(0, 0), (60, 80), (101, 17)]:
        east = 0.37 + (u - rig.cx_px) * pixel_m * pose[0, 0] + (v - rig.cy_px) * pixel_m * pose[0, 1]
        north = -1.2 + (u - rig.cx_px) * pixel_m * pose[1, 0] + (v - rig.cy_px) * pixel_m * pose[1, 1]
        col, row = east * CELLS / TILE_M, north * CELLS / TILE_M
        j, i = int(np.floor(col)), int(np.floor(row))
        w, h = col - j, row - i
        at = lambda r, c: pattern[r % CELLS, c % CELLS]  # noqa: E731
        expected = (1 - h) * ((1 - w) * at(i, j) + w * at(i, j + 1)) + h * (
            (1 - w) * at(i + 1, j) + w * at(i + 1, j + 1)
        )
        assert left[v, u] == pytest.approx(1000 / np.pi * expected, rel=2e-3)


def test_without_caustics_daylight_is_uniform():
    light = image_formation(scenario(caustics=0.0))
    pose = geometry.pose(geometry.BODY_FROM_DOWN_CAMERA, np.array([0.0, 0.0, 2.0]))
    white, depth = np.full((120, 160, 3), 255, np.uint8), np.full((120, 160), 2.0, np.float32)
    np.testing.assert_allclose(light.radiance(white, depth, 0, StampedPose(pose, 0.0)), 1000 / np.pi, rtol=1e-5)


@pytest.mark.parametrize(
    ("sun", "message"),
    [
        ({"caustics": 0.5}, r"sun\.caustics: 0\.5: there is no surface"),
        ({"depth_m": 2.0}, r"sun\.depth_m: 2: the cameras are above the surface \(allowed: more than 2\.2\)"),
    ],
)
def test_daylight_without_enough_water_above_is_rejected(sun, message):
    with pytest.raises(TwinError, match=message):
        daylight_at(SunConfig(illuminance_lx=10.0, **sun), CLEAR, 2.2)
