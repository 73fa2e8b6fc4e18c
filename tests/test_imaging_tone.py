"""Tone curve and white balance: the standard's values, inverse, grey references, and limits of the factors."""

import numpy as np
import pytest

from twin.imaging.camera.photo_sensor import PhotoSensor
from twin.imaging.camera.photons import electrons_per_cd
from twin.imaging.camera.tone import LOG_STOPS, linear_of, tone
from twin.imaging.camera.white_balance import MOST, WhiteBalance
from twin.imaging.light.lamps import colour
from twin.imaging.light.spectra import band_weights, spectrum_of, water_spectrum
from twin.imaging.light.water import downwelling_per_m, medium
from twin.scenario.model import Scenario

GREY = np.full((30, 40, 3), 20.0, np.float32)


def sensor_with(**keys):
    here = Scenario.model_validate(
        {
            "rig": {"image_width_px": 64, "image_height_px": 48},
            "sensor": {"vignetting_power": 0.0, "bayer": False, "exposure_lag_s": 0.0} | keys,
        }
    )
    return PhotoSensor(here, here.sensor)


def image_of(sensor, radiance):
    """Returns the mean grey levels (3,) of a noise-free image of uniform radiance (3,), metered on itself."""
    light = np.broadcast_to(np.asarray(radiance, np.float32), (48, 64, 3)).copy()
    sensor.meter(light)
    return sensor.image(light, sensor.meter(light), None).mean(axis=(0, 1))


def test_the_srgb_curve_is_that_of_the_standard():
    """IEC 61966-2-1: 8-bit codes and their linear light, as tabulated for L = ((V + 0.055) / 1.055)^2.4."""
    codes = np.array([1, 10, 11, 64, 128, 188, 255])
    linear = np.array([0.000303527, 0.003035270, 0.003346536, 0.051269458, 0.215860501, 0.502886458, 1.0])
    np.testing.assert_allclose(255 * tone(linear, "srgb"), codes, atol=2e-3)
    # the two parts of the curve meet at the limit, within the rounding of its constants
    ends = tone(np.array([0.0031308, 0.0031309]), "srgb")
    assert ends[1] - ends[0] == pytest.approx(12.92e-7, rel=0.1)


def test_the_logarithmic_curve_gives_equal_steps_to_equal_ratios():
    signal = 2.0 ** np.arange(-3, 1)
    np.testing.assert_allclose(np.diff(tone(signal, "log")), 1 / LOG_STOPS, rtol=0.12)
    assert tone(np.array([0.0, 1.0]), "log").tolist() == [0.0, 1.0]


@pytest.mark.parametrize("curve", ["linear", "srgb", "log"])
def test_curves_are_inverted_and_increase(curve):
    levels = np.linspace(0, 1, 101)
    np.testing.assert_allclose(tone(np.array([linear_of(v, curve) for v in levels]), curve), levels, atol=1e-7)
    assert (np.diff(tone(levels, curve)) > 0).all()


@pytest.mark.parametrize("curve", ["linear", "srgb", "log"])
def test_auto_exposure_reaches_the_grey_level_after_the_curve(curve):
    assert image_of(sensor_with(tone_curve=curve), [20.0] * 3).max() == pytest.approx(0.45 * 255, abs=1.0)


def test_grey_world_makes_the_mean_of_each_band_equal():
    tinted = [8.0, 20.0, 14.0]
    assert np.ptp(image_of(sensor_with(), tinted)) > 50
    balanced = sensor_with(white_balance="grey_world")
    assert np.ptp(image_of(balanced, tinted)) <= 2
    # the factors are the inverse ratios of the electrons
    sensor = balanced._sensor
    electrons = electrons_per_cd(sensor, 1.339) * tinted
    light = np.broadcast_to(np.array(tinted, np.float32), (48, 64, 3)).copy()
    np.testing.assert_allclose(balanced.meter(light).white, electrons.max() / electrons, rtol=1e-5)


def test_grey_world_limits_its_factors_and_follows_with_the_lag_of_the_exposure():
    light = np.broadcast_to(np.array([0.001, 20.0, 14.0], np.float32), (48, 64, 3)).copy()
    assert sensor_with(white_balance="grey_world").meter(light).white[0] == pytest.approx(MOST)
    slow = sensor_with(white_balance="grey_world", exposure_lag_s=0.5)
    red_light = np.broadcast_to(np.array([40.0, 20.0, 20.0], np.float32), (48, 64, 3)).copy()
    first = slow.meter(np.full((48, 64, 3), 20.0, np.float32)).white
    factors = [slow.meter(red_light).white[2] / first[2] for _ in range(16)]
    # log factors approach their target, here 40 / 20 electrons against blue, with time constant 0.5 s at 30 Hz
    electrons = electrons_per_cd(Scenario.model_validate({"sensor": {}}).sensor, 1.339)
    target = np.log(40 * electrons[0] / (20 * electrons[2])) - np.log(first[2])
    assert np.log(factors[15]) == pytest.approx(target * (1 - np.exp(-15 / 15)), rel=1e-3)


@pytest.mark.parametrize("kelvin", [3000.0, 6500.0, 9000.0])
def test_a_temperature_preset_makes_a_surface_in_that_light_grey(kelvin):
    preset = sensor_with(white_balance="temperature", white_temperature_k=kelvin)
    assert np.ptp(image_of(preset, 20 * colour(kelvin))) <= 2
    assert np.ptp(image_of(preset, 20 * colour(20000.0))) > 10


def test_a_water_preset_makes_a_floor_at_the_planned_altitude_grey():
    preset, here = sensor_with(white_balance="water"), Scenario()
    path_m = 2 * here.plan.altitude_m
    light = 20 * np.exp(-path_m * downwelling_per_m(medium(here.water, path_m=path_m, light="daylight")))
    assert light[0] / light[1] < 0.7 and np.ptp(image_of(preset, light)) <= 2


@pytest.mark.parametrize(("lamps", "light"), [([], "daylight"), ([{"position_m": [0.2, 0, 0]}], "led")])
def test_without_scattering_a_water_preset_compensates_the_absorption_over_the_path(lamps, light):
    keys = {"sensor": {"white_balance": "water"}, "imaging": {"scattering": "none"}, "lamps": lamps}
    here = Scenario.model_validate(keys)
    absorption, _ = water_spectrum(here.water.jerlov, here.water.source)
    left = band_weights(spectrum_of(light)) @ np.exp(-2 * here.plan.altitude_m * absorption)
    factors = WhiteBalance(here, np.ones(3)).factors(np.ones(3), 0.0)
    np.testing.assert_allclose(factors, left.max() / left, rtol=1e-9)


def test_gains_multiply_the_raw_signals():
    levels = image_of(sensor_with(white_balance="gains", white_gains=(3.0, 1.0, 2.0)), [20.0] * 3)
    electrons = electrons_per_cd(Scenario.model_validate({"sensor": {}}).sensor, 1.339) * [3, 1, 2]
    np.testing.assert_allclose(levels / levels.max(), electrons / electrons.max(), atol=0.01)


@pytest.mark.parametrize("balance", ["white_light", "grey_world", "temperature", "water", "gains"])
def test_a_saturated_image_is_white(balance):
    sensor = sensor_with(white_balance=balance)
    assert (
        sensor.develop(np.full((48, 64, 3), 4095, np.uint16), sensor.meter(np.full((48, 64, 3), 20, np.float32)).white)
        == 255
    ).all()
