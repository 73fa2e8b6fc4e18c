"""Physical sensor: photon numbers by hand, noise by the photon transfer curve, limits of exposure and gain."""

import types

import numpy as np
import pytest
from scipy import stats

from twin.imaging.camera import photo_sensor
from twin.imaging.camera.photo_sensor import PhotoSensor
from twin.imaging.camera.photons import electrons_per_cd, photons_per_lux, vignetting
from twin.imaging.camera.sensor import ExposureSetting
from twin.imaging.image_formation import ImageFormation, RenderedView, StampedPose
from twin.imaging.light.illumination import illumination_of
from twin.imaging.light.spectra import NM, sensitivity
from twin.scenario.model import Scenario

FLAT = types.SimpleNamespace(height_m=np.zeros((9, 9), np.float32), spacing_m=1.0, west_m=-4.0, south_m=-4.0)
BLACK, TOP = 64, 4095


def scenario(sun_lx=1000.0, **sensor):
    return Scenario.model_validate(
        {
            "rig": {"image_width_px": 200, "image_height_px": 150},
            "water": {"jerlov": "clear"},
            "sun": {"illuminance_lx": sun_lx},
            "sensor": {"vignetting_power": 0.0, "bayer": False} | sensor,
        }
    )


def sensor_with(**keys):
    here = scenario(**keys)
    return PhotoSensor(here, here.sensor)


def uniform(cd_m2):
    return np.broadcast_to(np.float32(cd_m2), (150, 200, 3)).copy()


def rendered(sun_lx):
    """Returns the radiance of a white floor under uniform daylight, computed by the image formation model."""
    here = scenario(sun_lx)
    shape = here.rig.image_height_px, here.rig.image_width_px
    white, depth = np.full((*shape, 3), 255, np.uint8), np.full(shape, 2.0, np.float32)
    light = ImageFormation(here, illumination_of(here), FLAT, np.random.default_rng(0))
    return light.radiance(RenderedView(white, depth, 0, StampedPose(np.diag([1.0, -1.0, -1.0, 1.0]), 0.0)))


def test_photons_per_lux_agree_with_the_literature():
    # 54 lx of sunlight are 1 umol of photons per square metre and second, 400 to 700 nm (Thimijan & Heins 1983)
    photons_nm = np.trapezoid(sensitivity() * NM, NM)
    np.testing.assert_allclose(photons_per_lux() * np.trapezoid(NM, NM) / photons_nm, 6.022e17 / 54, rtol=0.03)
    # a watt at 535 nm is 2.693e18 photons per second; a lux of equal-energy light is 1.3702e-5 W/m2 per nm; the
    # Gaussian of 38 nm is as wide as a band of 95.25 nm
    assert photons_per_lux()[1] == pytest.approx(1.3702e-5 * 95.25 * 2.693e18, rel=2e-3)


def test_electrons_scale_with_pixel_area_aperture_and_refractive_index():
    per_cd = electrons_per_cd(scenario().sensor, 1.339)
    assert electrons_per_cd(scenario(pixel_um=6.9).sensor, 1.339) == pytest.approx(4 * per_cd)
    assert electrons_per_cd(scenario(f_number=5.6).sensor, 1.339) == pytest.approx(per_cd / 4)
    assert electrons_per_cd(scenario().sensor, 1.0) == pytest.approx(per_cd * 1.339**2)
    # E = pi / (4 * 1.339^2 * 2.8^2) = 0.05587 lx; 3.51e15 photons; 1.190e-11 m2; 0.55
    assert per_cd[1] == pytest.approx(0.05587 * 3.514e15 * 1.190e-11 * 0.55, rel=2e-3)


def test_vignetting_is_the_fourth_power_of_the_cosine():
    rig = scenario().believed_rig()
    share = vignetting(rig, 4.0)
    tangent2 = (rig.cx_px**2 + rig.cy_px**2) / rig.focal_px**2
    assert share[0, 0] == share[-1, -1] == pytest.approx(1 / (1 + tangent2) ** 2)
    assert share[75, 100] == pytest.approx(1.0, abs=1e-4)
    light, setting = uniform(20.0), ExposureSetting(0.0, 0.015)
    without, vignetted = (sensor_with(vignetting_power=p).raw(light, setting, None) - float(BLACK) for p in (0.0, 4.0))
    np.testing.assert_allclose(vignetted, without * share[..., None], atol=0.5 + 0.5)


@pytest.mark.parametrize("bayer", [False, True])
def test_the_shading_correction_makes_a_uniform_field_uniform_and_its_borders_noisier(bayer):
    sensor = sensor_with(vignetting_power=4.0, shading_correction=True, bayer=bayer)
    light, setting = uniform(20.0), sensor.meter(uniform(20.0))
    image = sensor.image(light, setting, None).astype(int)
    assert np.ptp(image.reshape(-1, 3), axis=0).max() <= 1 < image.min()
    np.testing.assert_allclose(sensor.levels(light, setting), image, atol=1.5)
    rng = np.random.default_rng(0)
    noise = np.std([sensor.image(light, setting, rng) for _ in range(20)], axis=0)
    share = vignetting(scenario().believed_rig(), 4.0)[0, 0]  # shot noise: variance 1 / share of that of the axis
    assert image.mean() == pytest.approx(255 * scenario().imaging.gray_level, rel=0.02)  # metered as delivered
    corner, middle = noise[[0, 1, -2, -1]][:, [0, 1, -2, -1]].mean(), noise[70:80, 95:105].mean()
    assert corner / middle == pytest.approx(share**-0.5, rel=0.1)


@pytest.mark.parametrize("bayer", [False, True])
@pytest.mark.parametrize("gain", [1.0, 4.0])
def test_the_photon_transfer_curve_recovers_gain_and_read_noise(gain, bayer):
    sensor, rng = sensor_with(read_noise_e=4.0, bayer=bayer), np.random.default_rng(1)

    def field(sun_lx):
        raw = sensor.raw(rendered(sun_lx), ExposureSetting(0.0, 0.01, gain), rng) - float(BLACK)
        return [band.ravel() for band in (raw[::2, ::2], raw[1::2, 1::2])] if bayer else raw.reshape(-1, 3).T

    fields = [x for sun_lx in (400, 800, 1200, 1600, 2000) for x in field(sun_lx / gain)]
    mean, variance = (np.array([getattr(x, how)() for x in fields]) for how in ("mean", "var"))
    assert max(x.max() for x in fields) < TOP - BLACK and mean.max() > 0.5 * (TOP - BLACK)
    # Fields of 7,500 pixels or more: the standard error of a variance is 1.6 %, that of the slope of ten is 0.5 %.
    dark = np.concatenate([x for _ in range(4) for x in field(0.0)])
    slope = np.sum((variance - dark.var()) * mean / variance) / np.sum(mean**2 / variance)
    assert slope == pytest.approx(gain * (TOP - BLACK) / 10000, rel=0.02)
    assert np.sqrt(dark.var() - 1 / 12) / slope == pytest.approx(4.0, rel=0.02)
    assert dark.mean() == pytest.approx(0, abs=4 * dark.std() / np.sqrt(dark.size))


def test_digital_numbers_are_proportional_to_electrons():
    electrons = electrons_per_cd(scenario().sensor, 1.339) * 0.01 * 900 / np.pi
    raw = sensor_with().raw(rendered(900.0), ExposureSetting(0.0, 0.01), None)
    np.testing.assert_allclose(raw[0, 0], BLACK + electrons * (TOP - BLACK) / 10000, atol=0.51)


def test_electrons_are_poisson_distributed():
    """Exactly below ten electrons, above in the first three moments."""
    # one digital number per electron, no read noise
    sensor, rng = sensor_with(full_well_e=TOP - BLACK, read_noise_e=0.0), np.random.default_rng(2)
    per_cd = electrons_per_cd(scenario().sensor, 1.339)
    for expected in (0.02, 0.7, 3.0, 9.99, 10.01, 40.0, 900.0):
        fields = [sensor.raw(uniform(expected / per_cd), ExposureSetting(0.0, 1.0), rng) for _ in range(4)]
        electrons = np.array(fields, float).ravel() - BLACK
        n = electrons.size  # 360,000
        assert electrons.mean() == pytest.approx(expected, abs=4 * np.sqrt(expected / n))
        spread = np.sqrt((2 + 1 / expected) / n)  # relative standard error of a variance
        assert electrons.var() == pytest.approx(expected, rel=4 * spread)
        if expected > 9:
            assert stats.skew(electrons) == pytest.approx(expected**-0.5, abs=4 * np.sqrt(6 / n) + 0.003)
            continue
        counts = np.bincount(electrons.astype(int))
        frequencies = n * stats.poisson.pmf(np.arange(counts.size), expected)
        enough = frequencies > 20
        frequencies = frequencies[enough] * counts[enough].sum() / frequencies[enough].sum()
        assert stats.chisquare(counts[enough], frequencies).pvalue > 1e-4


def test_noise_is_independent_between_pixels_and_images():
    sensor, rng = sensor_with(), np.random.default_rng(3)
    one, two = (sensor.raw(uniform(200.0), ExposureSetting(0.0, 0.01), rng).astype(float) for _ in range(2))
    z = (one - one.mean(axis=(0, 1))) / one.std(axis=(0, 1))
    other = (two - two.mean(axis=(0, 1))) / two.std(axis=(0, 1))
    # 90,000 products: standard error 0.0033
    for a, b in ((z, other), (z[:, 1:], z[:, :-1]), (z[1:], z[:-1]), (z[..., 1:], z[..., :-1])):
        assert abs(np.mean(a * b)) < 0.015


def test_full_well_and_gain_limit_the_signal():
    rng = np.random.default_rng(4)
    full = sensor_with().raw(uniform(1e5), ExposureSetting(0.0, 0.015), rng)
    # a full well has no shot noise; the read noise of 2.4 electrons is one digital number
    assert full.max() == TOP and full.min() > TOP - 8 and (sensor_with().develop(full) >= 254).all()
    per_cd = electrons_per_cd(scenario().sensor, 1.339)[1] * 0.01
    half, amplified = (
        sensor_with().raw(uniform(5000 / per_cd), ExposureSetting(0.0, 0.01, g), None)[0, 0, 1] for g in (1, 4)
    )
    assert half == pytest.approx(BLACK + (TOP - BLACK) / 2, abs=1) and amplified == TOP


def test_an_8_bit_sensor_has_8_bit_raw_numbers():
    raw = sensor_with(bits=8).raw(uniform(np.linspace(0, 900, 200)[None, :, None]), ExposureSetting(0.0, 0.015), None)
    assert raw.min() == 4 and raw.max() == 255
    fine = sensor_with().raw(uniform(np.linspace(0, 900, 200)[None, :, None]), ExposureSetting(0.0, 0.015), None)
    assert np.abs(raw / 255 - fine / 4095).max() < 0.6 / 255 + 1 / 4095


def test_exposure_time_is_increased_before_gain_within_the_limits():
    per_cd = electrons_per_cd(scenario().sensor, 1.339).max()
    target_s = 0.45 * 10000 / per_cd  # for 1 cd/m2 at gain 1
    limits = {"exposure_min_ms": 1.0, "exposure_max_ms": 10.0, "gain_max_db": 20.0}
    for light, exposure_s, gain in (
        (target_s / 0.0001, 0.001, 1.0),
        (target_s / 0.004, 0.004, 1.0),
        (target_s / 0.01, 0.01, 1.0),
        (target_s / 0.05, 0.01, 5.0),
        (target_s / 1.0, 0.01, 10.0),
    ):
        sensor = sensor_with(**limits)
        setting = sensor.meter(uniform(light))
        assert setting[1:3] == pytest.approx((exposure_s, gain), rel=1e-4)
        level = sensor.image(uniform(light), setting, None).mean() / 255
        reached = exposure_s * gain * light / target_s
        assert level == pytest.approx(min(0.45 * reached, 1.0), abs=0.003)


def test_exposure_follows_with_its_lag_and_does_not_wind_up():
    sensor = sensor_with(exposure_lag_s=0.5)
    gains = [sensor.meter(uniform(x)).gain for x in [100.0] + [400.0] * 16]
    assert gains[0] == gains[1]
    assert np.log(gains[16] / gains[0]) / np.log(1 / 4) == pytest.approx(1 - np.exp(-1), abs=1e-4)
    dark = sensor_with(exposure_lag_s=0.5, gain_max_db=0.0)
    exposures_s = [dark.meter(uniform(x)).exposure_s for x in [0.0] * 90 + [300.0] * 2]
    assert exposures_s[:91] == pytest.approx([0.015] * 91) and exposures_s[91] < 0.0149
    immediate = sensor_with(exposure_lag_s=0.0)
    signals = [immediate.meter(uniform(x)).gain * x for x in (100.0, 200.0, 200.0)]
    assert signals == pytest.approx([0.45, 0.9, 0.45], rel=1e-5)


def test_a_bayer_pixel_sees_one_band():
    sensor, setting = sensor_with(bayer=True), ExposureSetting(0.0, 0.01)
    raw = {k: sensor.raw(uniform(np.eye(3)[k] * 100), setting, None) for k in range(3)}
    lit = np.array([[raw[k][i, j] > BLACK + 20 for k in range(3)] for i in (0, 1) for j in (0, 1)])
    assert raw[0].shape == (150, 200)
    np.testing.assert_array_equal(lit, [[1, 0, 0], [0, 1, 0], [0, 1, 0], [0, 0, 1]])  # R G / G B


def test_demosaicing_and_white_balance_preserve_grey_and_red():
    sensor = sensor_with(bayer=True)
    setting = ExposureSetting(0.0, 0.01)
    grey = sensor.image(uniform(200.0), setting, None)
    assert (grey == 66).all()  # 200 cd/m2 make 2569 electrons of 10,000 in green
    ramp = sensor.image(uniform(np.linspace(20, 300, 200)[None, :, None]), setting, None)[2:-2, 2:-2].astype(int)
    assert np.ptp(ramp, axis=2).max() <= 1  # linear gradients are interpolated exactly, up to rounding
    red = sensor.image(uniform([200.0, 0.0, 0.0]), setting, None)
    assert (red[..., 0] == grey[..., 0]).all() and not red[..., 1:].any()


def test_colours_are_the_same_with_and_without_bayer_filter():
    smooth = uniform(150.0) + 100 * np.sin(np.arange(200) / 30)[None, :, None] * np.array([1, -1, 0.5])
    setting = ExposureSetting(0.0, 0.01)
    one, three = (sensor_with(bayer=b).image(smooth.astype(np.float32), setting, None) for b in (True, False))
    assert np.abs(one[2:-2, 2:-2].astype(int) - three[2:-2, 2:-2]).max() <= 2


def test_metering_weights_each_band_by_vignetting():
    rng = np.random.default_rng(0)
    light, share = rng.uniform(0, 9, (31, 45, 3)).astype(np.float32), rng.uniform(0, 1, (31, 45)).astype(np.float32)
    want = (light * share[..., None]).mean((0, 1), dtype=np.float64)
    np.testing.assert_allclose(photo_sensor._weighted_mean(light, share), want, rtol=1e-6)
