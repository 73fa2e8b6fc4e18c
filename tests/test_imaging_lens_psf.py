"""Point spread function of the lens: MTF against its closed form, circle of confusion, lateral colour."""

import numpy as np
import pytest
from scipy.integrate import quad

from twin.errors import TwinError
from twin.imaging.camera.lens_psf import LensPsf, defocus_of, diffraction_mtf, mtf
from twin.scenario.model import Scenario

WIDTH, HEIGHT = 200, 150
U, V = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))


def scenario(sensor=None, **lens):
    rig = {"image_width_px": WIDTH, "image_height_px": HEIGHT}
    sections = {"rig": rig, "lens": lens} | ({} if sensor is None else {"sensor": sensor})
    return Scenario.model_validate(sections)


def psf(here):
    return LensPsf(here, here.believed_rig())


def contrast(here, cycles_per_px, angle_deg, band):
    """Returns the contrast of a transferred wave relative to that of the wave."""
    angle = np.deg2rad(angle_deg)
    phase = 2 * np.pi * cycles_per_px * (np.cos(angle) * U + np.sin(angle) * V)
    light = np.repeat((10 + np.cos(phase))[..., None], 3, 2).astype(np.float32)
    inside = np.s_[20:-20, 20:-20]
    return 2 * np.mean(((psf(here).transfer(light)[..., band] - 10) * np.exp(-1j * phase))[inside]).real


@pytest.mark.parametrize("f_number", [2.0, 2.8, 8.0])
def test_the_mtf_of_diffraction_is_the_overlap_of_two_pupils(f_number):
    """The MTF is the common area of two discs of diameter 1 whose centres are s apart, relative to that of one."""
    sensor = scenario({"f_number": f_number, "pixel_um": 3.45}).sensor
    for nu in (0.05, 0.25, 0.5):
        s = nu / 3.45 * 0.55 * f_number
        half_lens = quad(lambda x: np.sqrt(0.25 - x**2), min(s / 2, 0.5), 0.5)[0]
        assert diffraction_mtf(nu, 550.0, sensor) == pytest.approx(4 * half_lens / (np.pi / 4), abs=1e-7)


@pytest.mark.parametrize("band", [0, 1, 2])
@pytest.mark.parametrize("angle_deg", [0.0, 45.0, 90.0])
@pytest.mark.parametrize("f_number", [2.8, 8.0])
def test_waves_lose_the_contrast_of_the_closed_form_at_half_the_nyquist_frequency(f_number, angle_deg, band):
    here = scenario({"f_number": f_number}, diffraction=True, blur_px=(0.5, 0.3, 0.6))
    want = mtf(here.lens, here.sensor, band, 0.25)
    assert 0.2 < want < 0.85
    # separable terms are within 0.005 of the kernel, which is cut off at 4 px
    assert contrast(here, 0.25, angle_deg, band) == pytest.approx(want, abs=0.015)


def test_a_gaussian_blur_has_its_standard_deviation():
    spot = np.full((HEIGHT, WIDTH, 3), 10, np.float32)
    spot[75, 100] += 1.0
    out = psf(scenario(blur_px=(0.8, 1.0, 1.2))).transfer(spot).astype(float) - 10
    out = out[70:81, 95:106]
    np.testing.assert_allclose(out.sum((0, 1)), 1.0, atol=1e-3)
    for band, sigma in enumerate((0.8, 1.0, 1.2)):
        assert (out[..., band] * np.arange(-5, 6) ** 2).sum() == pytest.approx(sigma**2, rel=0.05)


def test_a_lens_without_blur_returns_the_same_array():
    light = np.ones((HEIGHT, WIDTH, 3), np.float32)
    plain = psf(scenario({}))
    assert plain.transfer(light) is light and plain.out_of_focus(light, light[..., 0]) is light


@pytest.mark.parametrize("depth_m", [0.3, 0.6, 1.2, 5.0])
def test_the_blur_of_a_point_out_of_focus_has_the_size_of_the_circle_of_confusion(depth_m):
    """The thin lens: a point at z is focused v' behind the lens, the sensor is at v; c = aperture |v' - v| / v'."""
    sensor = {"f_number": 0.9, "pixel_um": 20.0}
    here = scenario(sensor, focus_m=1.0)
    focal_m = here.believed_rig().focal_px * 20e-6
    # image distances of the depths z and 1 m; the model neglects the focal length, 3.5 mm, against them
    at, focused = (1 / (1 / focal_m - 1 / z) for z in (depth_m, 1.0))
    diameter_px = focal_m / 0.9 * abs(at - focused) / at / 20e-6
    assert defocus_of(here, here.believed_rig()).confusion_px(here.believed_rig().focal_px, depth_m) == pytest.approx(
        diameter_px, rel=0.01
    )
    spot = np.repeat(np.exp(-((U - 100) ** 2 + (V - 75) ** 2) / 8.0)[..., None], 3, 2).astype(np.float32)
    out = psf(here).out_of_focus(spot, np.full((HEIGHT, WIDTH), depth_m, np.float32))[..., 1].astype(float)
    assert out.sum() == pytest.approx(spot[..., 1].sum(), rel=1e-4)
    grown = (out * (U - 100) ** 2).sum() / out.sum() - 4.0
    # the variance of a disc is c^2 / 16; the antialiased edge adds up to 0.1 px^2
    assert grown == pytest.approx(diameter_px**2 / 16, rel=0.05, abs=0.1 * (diameter_px > 3) + 0.002)


def test_points_in_focus_are_sharp():
    light = np.random.default_rng(0).gamma(2, 20, (HEIGHT, WIDTH, 3)).astype(np.float32)
    here = psf(scenario({"f_number": 0.9, "pixel_um": 20.0}, focus_m=1.0))
    depth = np.where(U < 100, 1.0, 3.0).astype(np.float32)
    out = here.out_of_focus(light, depth)
    np.testing.assert_allclose(out[:, 1:99], light[:, 1:99], rtol=1e-4)
    assert np.abs(out[:, 101:] - light[:, 101:]).mean() > 0.3


def test_lateral_colour_magnifies_red_and_blue_about_the_centre():
    spots = [(40, 30), (160, 120), (100, 75)]
    light = sum(np.exp(-((U - u) ** 2 + (V - v) ** 2) / 8.0) for u, v in spots)
    out = psf(scenario(lateral_colour=(0.01, -0.005))).transfer(np.repeat(light[..., None], 3, 2).astype(np.float32))
    np.testing.assert_array_equal(out[..., 1], light.astype(np.float32))
    for band, scale in ((0, 1.01), (2, 0.995)):
        for u, v in spots:
            near = out[..., band] * (np.hypot(U - u, V - v) < 12)
            centre = np.array([(near * U).sum(), (near * V).sum()]) / near.sum()
            middle = np.array([(WIDTH - 1) / 2, (HEIGHT - 1) / 2])
            np.testing.assert_allclose(centre - middle, scale * (np.array([u, v]) - middle), atol=0.02)


def test_a_disc_of_diffraction_wider_than_the_kernel_is_refused():
    """Its radius is 1.22 wavelengths times the f-number: 4 px of 3.45 um at f / 18.9 in red."""
    for f_number, fits in ((18.8, True), (19.0, False)):
        sensor = {"pixel_um": 3.45, "f_number": f_number}
        if fits:
            psf(scenario(sensor, diffraction=True))
        else:
            with pytest.raises(TwinError, match="lens.diffraction: its disc has a radius of 4.0 px .*up to 18.9"):
                psf(scenario(sensor, diffraction=True))
