"""Radiance in water with single scattering: closed forms in limiting cases, and backscatter against quadrature."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad

from twin.errors import TwinError
from twin.imaging.light.backscatter import backscatter_per_m
from twin.imaging.light.illumination import Illumination, daylight_at
from twin.imaging.light.lamp_light import LampLight
from twin.imaging.light.lamps import LED_BEAM, beam_share, colour, light_sources_in_camera
from twin.imaging.light.optics import Optics, SceneView, WaterSurface
from twin.imaging.light.phase_function import Scatterer, phase_at, phase_of
from twin.imaging.light.spectra import CENTRE_NM, NM, WIDTH_NM, band_weights, spectrum_of
from twin.imaging.light.water import (
    downwelling_per_m,
    medium,
    read_spectrum,
)
from twin.scenario.model import LampConfig, Scenario, SunConfig, WaterConfig

RIG = Scenario.model_validate({"rig": {"image_width_px": 96, "image_height_px": 64}}).believed_rig()
CLEAR, DARK = WaterConfig(jerlov="clear"), SunConfig(illuminance_lx=0)
NO_DAYLIGHT = daylight_at(DARK, medium(CLEAR), 0.0)
#: A lamp at the position of the left camera, with its beam along the optical axis.
AT_CAMERA = LampConfig(position_m=tuple(RIG.body_from_camera[:3, 3]), intensity_cd=1000.0)
TWO_LAMPS = (
    LampConfig(position_m=(0.25, 0.35, -0.05), pan_deg=-8.0, intensity_cd=1500.0),
    LampConfig(position_m=(0.25, -0.35, -0.05), tilt_deg=10.0, intensity_cd=900.0),
)
CENTRE = (RIG.height_px // 2, RIG.width_px // 2)


def floor(depth_m, albedo=255):
    shape = (RIG.height_px, RIG.width_px)
    return np.full((*shape, 3), albedo, np.uint8), np.full(shape, depth_m, np.float32)


def optics_with(water, lamps, sun, altitude_m=0.0, scattering="single"):
    properties = medium(water, scattering)
    return Optics(RIG, Illumination(properties, daylight_at(sun, properties, altitude_m)), lamps)


def rays():
    """Returns the unit viewing directions (H, W, 3) of the pixels."""
    v, u = np.mgrid[: RIG.height_px, : RIG.width_px]
    ray = np.stack([(u - RIG.cx_px) / RIG.focal_px, (v - RIG.cy_px) / RIG.focal_px, np.ones_like(u, float)], -1)
    return ray / np.linalg.norm(ray, axis=-1, keepdims=True)


def test_radiance_under_daylight_in_clear_water_is_albedo_over_pi():
    rng = np.random.default_rng(0)
    albedo = rng.integers(0, 256, (RIG.height_px, RIG.width_px, 3), dtype=np.uint8)
    light = optics_with(CLEAR, (), SunConfig(illuminance_lx=1000)).radiance(albedo, floor(3.0)[1], 0)
    np.testing.assert_allclose(light, 1000 / np.pi * albedo / 255, rtol=1e-5)


@pytest.mark.filterwarnings("error")
def test_the_illuminance_of_a_missing_floor_is_nan_also_in_clear_water():
    depth = floor(3.0)[1]
    depth[0, 0] = np.inf
    lux = optics_with(CLEAR, (), SunConfig(illuminance_lx=1000)).floor_lx(depth, 0)
    assert np.isnan(lux[0, 0]).all() and lux[CENTRE] == pytest.approx(1000, rel=1e-5)


def test_a_lamp_in_clear_water_obeys_the_inverse_square_law_and_lamberts_cosine():
    optics = optics_with(CLEAR, (AT_CAMERA,), DARK)
    light = optics.radiance(*floor(2.0), 0)
    cos = rays()[..., 2]
    # The angles of emission, incidence and view are equal; the beam is interpolated linearly between table angles.
    share = np.interp(np.rad2deg(np.arccos(cos)), [0, 10, 20, 30, 35, 40], [1, 0.96, 0.87, 0.75, 0.63, 0.5])
    expected = 1000 / np.pi * share * cos * (cos / 2.0) ** 2
    np.testing.assert_allclose(light[..., 1], expected, rtol=2e-3)  # the beam table is coarse near the axis
    np.testing.assert_allclose(optics.radiance(*floor(4.0), 0), light / 4, rtol=1e-4)


def test_doubling_the_path_squares_the_transmission():
    water = medium(WaterConfig(jerlov="II"))
    ratio = []
    for depth_m in (1.5, 3.0):
        backscatter = optics_with(WaterConfig(jerlov="II"), (AT_CAMERA,), DARK).radiance(*floor(depth_m, 0), 0)[CENTRE]
        wet = (
            optics_with(WaterConfig(jerlov="II"), (AT_CAMERA,), DARK).radiance(*floor(depth_m), 0)[CENTRE] - backscatter
        )
        ratio.append(wet / optics_with(CLEAR, (AT_CAMERA,), DARK).radiance(*floor(depth_m), 0)[CENTRE])
    np.testing.assert_allclose(ratio[1], ratio[0] ** 2, rtol=1e-3)
    # to the floor and back, half a pixel off the axis
    np.testing.assert_allclose(ratio[0], np.exp(-water.attenuation_per_m * 3.0), rtol=1e-3)


def test_backscatter_grows_with_range_to_that_of_open_water():
    optics = optics_with(WaterConfig(jerlov="1C"), TWO_LAMPS, DARK)
    near, far, open_water = (optics.radiance(*floor(d, 0), 0) for d in (1.0, 3.0, np.inf))
    assert (near < far).all() and (far <= open_water).all()
    np.testing.assert_array_equal(open_water, optics.radiance(*floor(np.inf, 255), 0))
    np.testing.assert_allclose(optics.radiance(*floor(1e4), 0), open_water, rtol=1e-3)


@pytest.mark.parametrize("lamps", [(), (TWO_LAMPS[0].model_copy(update={"intensity_cd": 0.0}),)])
def test_without_lamps_or_intensity_there_is_no_light(lamps):
    assert not optics_with(WaterConfig(jerlov="9C"), lamps, DARK).radiance(*floor(2.0), 0).any()


WORLDS = pytest.mark.parametrize("jerlov", ["IB", "II", "3C"])
ABOVE = SunConfig(illuminance_lx=40.0, depth_m=12.0)
SAMPLES = 3000  # per ray: at the kinks of the beam table the sum has an error of second order in the step


def summed_backscatter(sources, water, depth_m, pixels):
    """Returns the backscatter (n, 3) in front of a level floor by the midpoint rule along each ray."""
    ray = rays()[tuple(np.transpose(pixels))]
    step = depth_m / ray[:, 2] / SAMPLES
    range_m = (np.arange(SAMPLES) + 0.5) * step[:, None]
    return backscatter_per_m(sources, water, ray, range_m).sum(1) * step[:, None]


def optics_and_sources(jerlov, camera, sun=ABOVE):
    water = WaterConfig(jerlov=jerlov)
    optics = optics_with(water, TWO_LAMPS, sun, altitude_m=2.0)
    return optics, optics.lamp_light[camera], medium(water, "single")


@WORLDS
def test_the_veil_of_daylight_scattered_once_is_a_geometric_series(jerlov):
    """Light falls as exp(-K z) to the depth z below the camera, and is lost as exp(-c r) over the range r to it."""
    water, day = medium(WaterConfig(jerlov=jerlov), "single"), optics_and_sources(jerlov, 0)[1].sources.daylight
    optics, cosine = optics_with(WaterConfig(jerlov=jerlov), (), ABOVE, altitude_m=2.0), rays()[CENTRE][2]
    lost = day.attenuation_per_m * cosine + day.camera_loss_per_m
    phase = phase_at(water.scatterers, np.array([-cosine]))[0]
    expected = day.illuminance_lx * water.scattering_per_m * phase * -np.expm1(-lost * 2.0 / cosine) / lost
    np.testing.assert_allclose(optics.radiance(*floor(2.0, 0), 0)[CENTRE], expected, rtol=0.01)


@WORLDS
@pytest.mark.parametrize("camera", [0, 1])
def test_backscatter_is_the_integral_over_the_ray(jerlov, camera):
    """Within 1 % of the midpoint rule, which agrees with quadrature (below)."""
    optics, sources, water = optics_and_sources(jerlov, camera)
    pixels = [(v, u) for v in range(0, 64, 9) for u in range(0, 96, 9)]
    for depth_m in (0.7, 2.0, 6.0):
        backscatter = optics.radiance(*floor(depth_m, 0), camera)[tuple(np.transpose(pixels))]
        np.testing.assert_allclose(backscatter, summed_backscatter(sources, water, depth_m, pixels), rtol=0.01)


def backscatter_by_quadrature(jerlov, pixel, depth_m):
    """Returns green backscatter from the table, by scipy's quad to 1e-6, and by the midpoint rule."""
    optics, sources, water = optics_and_sources(jerlov, 0)
    ray = rays()[pixel]
    backscatter = optics.radiance(*floor(depth_m, 0), 0)[pixel][1]
    green = lambda r: backscatter_per_m(sources, water, ray, np.array([r]))[0, 1]  # noqa: E731
    exact = quad(green, 0, depth_m / ray[2], epsrel=1e-6, limit=300)[0]
    return backscatter, exact, summed_backscatter(sources, water, depth_m, [pixel])[0, 1]


@pytest.mark.parametrize(("jerlov", "pixel"), [("IB", (20, 70)), ("3C", (63, 3))])
def test_quadrature_agrees_with_the_midpoint_rule_and_the_table(jerlov, pixel):
    backscatter, exact, summed = backscatter_by_quadrature(jerlov, pixel, 2.0)
    assert summed == pytest.approx(exact, rel=1e-4) and backscatter == pytest.approx(exact, rel=0.01)


@pytest.mark.slow
@WORLDS
def test_backscatter_agrees_with_quadrature_over_the_image(jerlov):
    pixels = [(v, u) for v in range(0, 64, 21) for u in range(0, 96, 19)]
    results = [backscatter_by_quadrature(jerlov, pixel, 2.0) for pixel in pixels]
    worst = max(abs(backscatter / exact - 1) for backscatter, exact, _ in results)
    print(f"\n{jerlov}: backscatter within {100 * worst:.2f} % of quadrature at {len(pixels)} pixels")
    assert worst < 0.01


@pytest.mark.parametrize("jerlov", ["IB", "II", "3C"])
def test_the_direct_signal_agrees_with_the_formula(jerlov):
    """Two lamps and daylight over a level floor, computed with numpy; within 0.1 %."""
    water = medium(WaterConfig(jerlov=jerlov))
    sun = SunConfig(illuminance_lx=300.0, depth_m=9.0, sky_share=0.0)  # the beam comes from the zenith: mu0 = 1
    optics = optics_with(WaterConfig(jerlov=jerlov), TWO_LAMPS, sun, altitude_m=2.0)
    sources = light_sources_in_camera(RIG, TWO_LAMPS, NO_DAYLIGHT, 0)
    for depth_m in (0.8, 2.0, 4.0):
        direct = optics.parts(*floor(depth_m), 0).direct
        points = rays() * (depth_m / rays()[..., 2:])
        range_m = np.linalg.norm(points, axis=-1)[..., None]
        lux = 300.0 * np.exp(-downwelling_per_m(water) * (9.0 - 2.0 + depth_m))
        for position, axis, lamp in zip(sources.position_m, sources.axis, TWO_LAMPS, strict=True):
            from_lamp = points - position
            d = np.linalg.norm(from_lamp, axis=-1)[..., None]
            strength = lamp.intensity_cd * beam_share((from_lamp / d) @ axis, np.array(LED_BEAM))[..., None]
            lux = lux + strength / d**2 * (from_lamp[..., 2:] / d) * np.exp(-water.attenuation_per_m * d)
        expected = lux / np.pi * np.exp(-water.attenuation_per_m * range_m)
        np.testing.assert_allclose(direct, expected, rtol=1e-3)


@pytest.mark.parametrize("beam", [LED_BEAM, ((0.0, 1.0), (10.0, 0.5), (20.0, 0.05), (30.0, 0.0))])
@pytest.mark.parametrize("jerlov", ["IB", "II", "3C"])
def test_a_shadow_removes_the_unscattered_light_of_a_lamp(jerlov, beam):
    """Scattered and all light are tables over angle and distance: within 0.5 % of all light in the brightest pixel."""
    water = medium(WaterConfig(jerlov=jerlov))
    lamp = LampConfig(position_m=(0.2, 0.3, 0.0), pan_deg=-8.0, beam=beam)
    optics = optics_with(WaterConfig(jerlov=jerlov), (lamp,), DARK, scattering="full")
    source = light_sources_in_camera(RIG, (lamp,), NO_DAYLIGHT, 0)
    for depth_m in (0.8, 2.0, 4.0):
        scene = floor(depth_m)
        shape = scene[1].shape
        views = [SceneView(lit=np.full((1, *shape), lit, np.uint8)) for lit in (1, 0)]
        lit, dark = (optics.parts(*scene, 0, view).direct for view in views)
        points = rays() * (depth_m / rays()[..., 2:])
        from_lamp = points - source.position_m[0]
        d = np.linalg.norm(from_lamp, axis=-1)[..., None]
        strength = lamp.intensity_cd * beam_share((from_lamp / d) @ source.axis[0], np.array(beam))[..., None]
        lux = strength / d**2 * (from_lamp[..., 2:] / d) * np.exp(-water.attenuation_per_m * d)
        expected = lux / np.pi * np.exp(-water.attenuation_per_m * np.linalg.norm(points, axis=-1)[..., None])
        assert (np.abs(lit - dark - expected) < 5e-3 * lit.max(axis=(0, 1))).all()


def test_daylight_is_attenuated_by_kd_and_depth_below_the_surface():
    """With a tilted camera the depth below the surface counts, not the depth along the optical axis."""
    water, sun = WaterConfig(jerlov="1C", turbidity=0.0), SunConfig(illuminance_lx=1e4, depth_m=6.0, sky_share=0.0)
    optics, per_m = optics_with(water, (), sun, altitude_m=2.0), downwelling_per_m(medium(water))
    np.testing.assert_allclose(per_m, medium(water).absorption_per_m)  # no scattering, sun in the zenith
    np.testing.assert_allclose(optics.floor_lx(floor(2.0)[1], 0)[CENTRE], 1e4 * np.exp(-6 * per_m), rtol=1e-3)
    tilted = np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, np.sin(0.3), np.cos(0.3), 4.0]])
    illuminance_lx = optics.floor_lx(floor(2.0)[1], 0, SceneView(surface=WaterSurface(None, tilted)))
    below = 4.0 + 2.0 * (np.cos(0.3) + np.sin(0.3) * (rays()[..., 1] / rays()[..., 2]))
    expected = np.cos(0.3) * 1e4 * np.exp(-below[..., None] * per_m)  # the floor is at right angles to the axis
    np.testing.assert_allclose(illuminance_lx, expected, rtol=1e-3)


def test_a_beam_table_shapes_the_light_and_is_dark_beyond_its_last_angle():
    spot = AT_CAMERA.model_copy(update={"beam": ((0.0, 1.0), (10.0, 0.5), (20.0, 0.5))})
    light = optics_with(CLEAR, (spot,), DARK).radiance(*floor(2.0), 0)[..., 1]
    cos = rays()[..., 2]
    off_deg = np.rad2deg(np.arccos(cos))
    share = light / (1000 / np.pi * cos**3 / 4)
    inside = (off_deg > 10.5) & (off_deg < 19.5)
    np.testing.assert_allclose(share[inside], 0.5, rtol=1e-3)
    near = off_deg < 9.5
    np.testing.assert_allclose(share[near], 1 - 0.05 * off_deg[near], atol=0.01)
    assert not light[off_deg > 20.5].any()
    # a beam that does not reach the field of view adds no backscatter
    sideways = spot.model_copy(update={"tilt_deg": 90.0})
    assert not optics_with(WaterConfig(jerlov="II"), (sideways,), DARK).radiance(*floor(2.0), 0)[40:].any()


@pytest.mark.parametrize("scattering", ["none", "single", "full"])
def test_a_lamp_gives_no_light_to_points_behind_it_even_if_its_beam_reaches_90_deg(scattering):
    even = AT_CAMERA.model_copy(update={"beam": ((0.0, 1.0), (90.0, 1.0))})
    water = medium(WaterConfig(jerlov="II"), scattering)
    light = LampLight(light_sources_in_camera(RIG, (even,), NO_DAYLIGHT, 0), water)
    lux, _ = light.lux(0, np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 1e-6], [1.0, 0.0, -1e-6], [0.0, 0.0, -1.0]]))
    assert (lux[:2] > 100).all() and not lux[2:].any()
    np.testing.assert_array_equal(beam_share(np.array([1.0, 0.0, -1e-9, -1.0]), np.array(even.beam)), [1, 1, 0, 0])


def test_the_colour_of_a_lamp_follows_planck_at_equal_luminance():
    np.testing.assert_allclose(colour(6500.0), 1.0, rtol=1e-12)
    warm = colour(3000.0)

    def planck(nm, kelvin):
        light, h, k = 299792458.0, 6.62607015e-34, 1.380649e-23
        return (nm * 1e-9) ** -5 / np.expm1(h * light / (nm * 1e-9 * k * kelvin))

    def photons(band, kelvin):
        centre, width = CENTRE_NM[band], WIDTH_NM[band]
        return quad(lambda nm: np.exp(-(((nm - centre) / width) ** 2) / 2) * nm * planck(nm, kelvin), 400, 700)[0]

    ratio = np.array([photons(band, 3000) / photons(band, 6500) for band in range(3)])
    np.testing.assert_allclose(warm / warm[1], ratio / ratio[1], rtol=1e-3)  # summed in steps of 1 nm
    assert warm @ [0.2126, 0.7152, 0.0722] == pytest.approx(1.0, abs=1e-12)
    lamp = AT_CAMERA.model_copy(update={"colour_temperature_k": 3000.0})
    for scattering in ("single", "full"):
        white = optics_with(WaterConfig(jerlov="II"), (AT_CAMERA,), DARK, 0.0, scattering).parts(*floor(2.0), 0)
        coloured = optics_with(WaterConfig(jerlov="II"), (lamp,), DARK, 0.0, scattering).parts(*floor(2.0), 0)
        for was, now in zip(white, coloured, strict=True):
            if was is not None:  # no forward scatter with single scattering
                np.testing.assert_allclose(now, was * warm, rtol=1e-4)


def test_the_backscatter_of_one_lamp_agrees_with_the_formula():
    sources = light_sources_in_camera(RIG, (AT_CAMERA,), NO_DAYLIGHT, 0)
    settings = WaterConfig(jerlov="II", turbidity=2.0, phase_function="henyey_greenstein", mean_cosine=0.9)
    water = medium(settings, "single")
    range_m = 1.7
    got = backscatter_per_m(LampLight(sources, water), water, np.array([0.0, 0.0, 1.0]), np.array([range_m]))[0]
    b, c = water.scattering_per_m, water.attenuation_per_m
    np.testing.assert_allclose(b, 2.0 * medium(WaterConfig(jerlov="II")).scattering_per_m)
    straight_back = float(phase_of(Scatterer("henyey_greenstein", 0.0, (0.9,)), np.array(np.pi)))
    # the phase table has finite cells
    np.testing.assert_allclose(got, b * straight_back * 1000 / range_m**2 * np.exp(-2 * c * range_m), rtol=1e-3)


def test_given_water_properties_replace_the_water_type_and_are_scaled_by_turbidity():
    given = WaterConfig(absorption_per_m=(0.5, 0.1, 0.2), scattering_per_m=(0.1, 0.2, 0.3), turbidity=2.0)
    np.testing.assert_allclose(medium(given).absorption_per_m, [0.5, 0.1, 0.2])
    np.testing.assert_allclose(medium(given).scattering_per_m, [0.2, 0.4, 0.6])
    of_type = WaterConfig(jerlov="III")
    a, b = medium(of_type)[:2]
    given = WaterConfig(absorption_per_m=tuple(a), scattering_per_m=tuple(b))
    same = optics_with(given, TWO_LAMPS, DARK).radiance(*floor(2.0), 0)
    np.testing.assert_array_equal(same, optics_with(of_type, TWO_LAMPS, DARK).radiance(*floor(2.0), 0))


def test_a_spectrum_is_averaged_over_the_bands(tmp_path):
    file = tmp_path / "lake.csv"
    file.write_text("# nm, a, b\n350, 0.0, 1.0\n400, 0.2, 1.0\n500, 0.0, 1.0\n700, 0.4, 1.0\n")
    absorption, scattering = read_spectrum(file)
    np.testing.assert_allclose(absorption, np.interp(NM, [400, 500, 700], [0.2, 0.0, 0.4]))
    water = medium(WaterConfig(spectrum_file=str(file), turbidity=3.0))
    np.testing.assert_allclose(water.absorption_per_m, band_weights(spectrum_of("led")) @ absorption)
    np.testing.assert_allclose(water.scattering_per_m, 3.0)
    assert (scattering == 1.0).all()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "0 rows"),
        ("400, 1\n700, 1", "2 columns"),
        ("nm, a, b\n400, 1, 1", "cannot be read: .*'nm'"),
        ("400, 1, 1\n650, 1, 1", "covers 400 to 650 nm .*allowed: 400 to 700"),
        ("400, 1, 1\n400, 1, 1\n700, 1, 1", "do not increase"),
        ("400, 1, 1\n550, -0.1, 1\n700, 1, 1", "negative or not finite at 550 nm"),
        ("400, 1, 1\n550, nan, 1\n700, 1, 1", "negative or not finite at 550 nm"),
        (None, "no such file .*lake.csv"),
    ],
)
def test_an_invalid_spectrum_is_rejected(tmp_path, text, message):
    file = tmp_path / "lake.csv"
    if text is not None:
        file.write_text(text)
    with pytest.raises(TwinError, match=r"water\.spectrum_file: .*" + message):
        medium(WaterConfig(spectrum_file=str(file)))


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"absorption_per_m": (1, 1, 1)}, r"water\.scattering_per_m: missing"),
        ({"scattering_per_m": (1, 1, 1)}, r"water\.absorption_per_m: missing"),
        ({"scattering_per_m": (1, 1, 1), "spectrum_file": "a.csv"}, r"water\.scattering_per_m: given twice"),
    ],
)
def test_incomplete_or_duplicate_water_properties_are_rejected(keys, message):
    with pytest.raises(TwinError, match=message):
        medium(WaterConfig(**keys))


def test_beams_tilt_to_the_bow_and_pan_to_port():
    straight = light_sources_in_camera(RIG, (AT_CAMERA,), NO_DAYLIGHT, 0)
    np.testing.assert_allclose(straight.axis, [[0, 0, 1]], atol=1e-12)
    bow = light_sources_in_camera(RIG, (AT_CAMERA.model_copy(update={"tilt_deg": 90.0}),), NO_DAYLIGHT, 0)
    np.testing.assert_allclose(bow.axis, [[0, -1, 0]], atol=1e-12)  # up in the image
    port = light_sources_in_camera(RIG, (AT_CAMERA.model_copy(update={"pan_deg": 90.0}),), NO_DAYLIGHT, 0)
    np.testing.assert_allclose(port.axis, [[-1, 0, 0]], atol=1e-12)  # left in the image
    right = light_sources_in_camera(RIG, (AT_CAMERA,), NO_DAYLIGHT, 1)
    np.testing.assert_allclose(right.position_m, [[-RIG.baseline_m, 0, 0]], atol=1e-12)


@given(slope_x=st.floats(-0.5, 0.5), slope_y=st.floats(-0.5, 0.5))
def test_a_slanted_floor_is_lit_by_the_cosine_to_its_normal(slope_x, slope_y):
    # A plane z = 2 + slope_x x + slope_y y along ray (x', y', 1): depth = 2 / (1 - slope_x x' - slope_y y').
    ray = rays() / rays()[..., 2:]
    depth = 2.0 / (1 - slope_x * ray[..., 0] - slope_y * ray[..., 1])
    albedo, _ = floor(2.0)
    light = optics_with(CLEAR, (AT_CAMERA,), DARK).radiance(albedo, depth.astype(np.float32), 0)
    normal = np.array([slope_x, slope_y, -1.0]) / np.sqrt(1 + slope_x**2 + slope_y**2)
    cos = np.maximum(-rays() @ normal, 0)
    expected = 1000 / np.pi * beam_share(rays()[..., 2], np.array(LED_BEAM)) * cos / (depth**2 * (ray**2).sum(-1))
    # The smaller one-sided slope has an error of half a pixel of curvature: about slope / focal, < 1 % of the cosine.
    np.testing.assert_allclose(light[..., 1], expected, rtol=2e-2, atol=0.2)


def test_a_depth_edge_does_not_change_the_adjacent_floor():
    albedo, depth = floor(2.0)
    whole = optics_with(CLEAR, TWO_LAMPS, DARK).radiance(albedo, depth, 0)
    depth[:, 50:] = np.inf
    cut = optics_with(CLEAR, TWO_LAMPS, DARK).radiance(albedo, depth, 0)
    np.testing.assert_array_equal(cut[:, :50], whole[:, :50])
    assert not cut[:, 50:].any()
