"""Sun and sky in the water: Snell, Lambert's cosine, shadows, conservation of energy, and the Monte Carlo reference."""

import types

import numpy as np
import pytest

from twin.core.records import StereoRig
from twin.imaging.image_formation import ImageFormation, RenderedView, StampedPose
from twin.imaging.light.daylight import DaylightVeil, floor_daylight
from twin.imaging.light.illumination import Illumination, daylight_at, illumination_of
from twin.imaging.light.light_field import LightField
from twin.imaging.light.optics import Optics, SceneView, WaterSurface
from twin.imaging.light.phase_function import BandWater, Scatterer
from twin.imaging.light.shadows import Shadows
from twin.imaging.light.spectra import band_weights, spectrum_of, water_spectrum
from twin.imaging.light.sun_sky import CRITICAL_COSINE, SunSky, direction_to_sun, sky_radiance
from twin.imaging.light.water import downwelling_per_m, medium
from twin.imaging.reference.pixel_light import (
    Effort,
    PixelRay,
    ReferenceScene,
    Sunlight,
    batch_mean,
    pixel_light,
    plane_light,
)
from twin.reproduce.light_cell import GREEN, looking_down
from twin.scenario.file import load_scenario
from twin.scenario.model import SEA_WATER_INDEX, Scenario, SunConfig, WaterConfig

RIG = StereoRig(96, 64, 80.0, 0.1)
CENTRE = (RIG.height_px // 2, RIG.width_px // 2)
UP = np.array([0.0, 0.0, 1.0])
HG = Scatterer("henyey_greenstein", 0.0, (0.924,))
#: Water, elevation of the sun [deg], depth of the camera and range of the floor [m].
CELLS = [("IB", 90.0, 2.0, 1.0), ("II", 45.0, 8.0, 2.0), ("3C", 45.0, 3.0, 1.0)]


def optics_under(sun, water=None, altitude_m=0.0):
    properties = medium(water or WaterConfig(jerlov="clear"))
    return Optics(RIG, Illumination(properties, daylight_at(sun, properties, altitude_m)), ())


def level(depth_m, albedo=255):
    shape = RIG.height_px, RIG.width_px
    return np.full((*shape, 3), albedo, np.uint8), np.full(shape, depth_m, np.float32)


def rays():
    """Returns the viewing directions (H, W, 3) of the pixels, z = 1."""
    v, u = np.mgrid[: RIG.height_px, : RIG.width_px]
    return np.stack([(u - RIG.cx_px) / RIG.focal_px, (v - RIG.cy_px) / RIG.focal_px, np.ones_like(u, float)], -1)


def plane(slope_x, slope_y):
    """Returns depth (H, W) of the plane z = 2 + slope_x x + slope_y y in camera axes, and its normal in the world."""
    depth = 2.0 / (1 - slope_x * rays()[..., 0] - slope_y * rays()[..., 1])
    normal = np.array([slope_x, -slope_y, 1.0])  # x is east, y is south, z is down
    return depth.astype(np.float32), normal / np.linalg.norm(normal)


@pytest.mark.parametrize(("elevation_deg", "azimuth_deg"), [(90.0, 30.0), (60.0, 0.0), (45.0, 120.0), (10.0, -90.0)])
def test_the_sun_is_refracted_by_snells_law_and_keeps_its_azimuth(elevation_deg, azimuth_deg):
    east, north, up = direction_to_sun(elevation_deg, azimuth_deg)
    sine = np.hypot(east, north)
    assert SEA_WATER_INDEX * sine == pytest.approx(np.sin(np.deg2rad(90 - elevation_deg)), abs=1e-12)
    assert sine**2 + up**2 == pytest.approx(1.0)
    if sine > 1e-9:
        assert np.rad2deg(np.arctan2(north, east)) == pytest.approx(azimuth_deg)


def test_the_sky_appears_in_a_cone_and_gives_one_lux():
    x, w = np.polynomial.legendre.leggauss(400)
    mu, w = CRITICAL_COSINE + (1 - CRITICAL_COSINE) * (x + 1) / 2, w * (1 - CRITICAL_COSINE) / 2
    light = 2 * np.pi * w * sky_radiance(mu)
    assert (light * mu).sum() == pytest.approx(1.0, rel=1e-4)
    assert SunSky(sky_share=1.0).mean_cosine == pytest.approx((light * mu).sum() / light.sum(), rel=1e-4)
    assert np.rad2deg(np.arccos(CRITICAL_COSINE)) == pytest.approx(48.3, abs=0.1)
    assert not sky_radiance(np.array([CRITICAL_COSINE - 1e-6, 0.1, -0.5])).any()
    # Fresnel at normal incidence: 1 - ((n - 1) / (n + 1))^2; at 60 deg in air 0.941
    overhead, slanted = sky_radiance(np.array([1.0, np.sqrt(1 - (np.sin(np.pi / 3) / SEA_WATER_INDEX) ** 2)]))
    assert slanted / overhead == pytest.approx(0.9407 / 0.97889, rel=2e-3)


@pytest.mark.parametrize(("slope_x", "slope_y"), [(0.0, 0.0), (0.6, 0.0), (-0.6, 0.3), (-3.0, 0.0)])
@pytest.mark.parametrize("azimuth_deg", [0.0, 130.0])
def test_a_slope_is_lit_by_the_cosine_to_the_refracted_sun(slope_x, slope_y, azimuth_deg):
    sun = SunConfig(illuminance_lx=1000.0, elevation_deg=50.0, azimuth_deg=azimuth_deg, sky_share=0.0)
    depth, normal = plane(slope_x, slope_y)
    if not (0 < depth).all():
        depth = np.where(depth > 0, depth, np.inf).astype(np.float32)
    to_sun = np.array(direction_to_sun(50.0, azimuth_deg))
    light = optics_under(sun).radiance(level(2.0)[0], depth, 0)[CENTRE]
    # half a pixel of curvature of the normal from the depth: below 2 % of the cosine, as for lamps
    np.testing.assert_allclose(light, 1000 / np.pi * max(normal @ to_sun, 0.0) / to_sun[2], rtol=0.02, atol=0.1)


@pytest.mark.parametrize("slope_x", [0.0, 0.5, 1.0])
def test_the_light_of_the_sky_on_a_slope_is_that_of_quadrature(slope_x):
    """The quadratic form represents the light within 2 % of that on a level floor."""
    light = floor_daylight(daylight_at(SunConfig(illuminance_lx=1.0, sky_share=1.0), medium(WaterConfig()), 0.0))
    normal = np.array([slope_x, 0.0, 1.0]) / np.hypot(slope_x, 1.0)
    rng = np.random.default_rng(0)
    mu, azimuth = rng.uniform(CRITICAL_COSINE, 1, 200_000), rng.uniform(0, 2 * np.pi, 200_000)
    facing = normal[0] * np.sqrt(1 - mu**2) * np.cos(azimuth) + normal[2] * mu
    expected = 2 * np.pi * (1 - CRITICAL_COSINE) * (sky_radiance(mu) * np.maximum(facing, 0)).mean()
    four = np.append(normal, 1.0)
    assert four @ light.rest_lx[1] @ four == pytest.approx(expected, abs=0.02)


def wall(height_m, spacing_m=0.05):
    """Returns a flat floor, 10 m by 10 m, with a wall along y at x = 0 that falls to the floor within one cell."""
    n = round(10 / spacing_m) + 1
    height = np.zeros((n, n), np.float32)
    height[:, n // 2] = height_m
    return types.SimpleNamespace(height_m=height, spacing_m=spacing_m, west_m=-5.0, south_m=-5.0)


@pytest.mark.long
def test_the_shadow_of_a_wall_is_its_height_over_the_tangent_of_the_refracted_elevation():
    pose, depth = looking_down(2.0), np.full((RIG.height_px, RIG.width_px), 2.0, np.float32)
    to_sun = np.array(direction_to_sun(30.0, 180.0))  # in the west
    lit = Shadows(wall(0.5), RIG, [np.zeros((0, 3))] * 2, to_sun).lit(depth, pose, 0)[0]
    x = rays()[..., 0] * 2.0
    end_m, pixel_m = 0.5 * np.tan(np.arcsin(np.cos(np.deg2rad(30.0)) / SEA_WATER_INDEX)), 2.0 / RIG.focal_px
    dark = (x > 0.06) & (x < end_m - pixel_m)
    assert dark.sum() > 500 and not lit[dark].any() and lit[(x > end_m + pixel_m) | (x < -0.06)].all()


@pytest.mark.parametrize("shadows", [True, False])
def test_only_the_light_of_the_sky_reaches_a_shadow(shadows):
    sections = {
        "rig": {"image_width_px": 96, "image_height_px": 64},
        "water": {"jerlov": "clear"},
        "sun": {"illuminance_lx": 900.0, "elevation_deg": 30.0, "azimuth_deg": 180.0, "sky_share": 0.25},
        "imaging": {"shadows": shadows},
    }
    scenario = Scenario.model_validate(sections)
    rig = scenario.believed_rig()
    water = medium(scenario.water)
    lighting = Illumination(water, daylight_at(scenario.sun, water, 0.0))
    formation = ImageFormation(scenario, lighting, wall(0.5), np.random.default_rng(0))
    pose = looking_down(2.0)
    shape = rig.height_px, rig.width_px
    white, depth = np.full((*shape, 3), 255, np.uint8), np.full(shape, 2.0, np.float32)
    light = formation.radiance(RenderedView(white, depth, 0, StampedPose(pose, 0.0)))[32, :, 1] * np.pi
    x = (np.arange(rig.width_px) - rig.cx_px) / rig.focal_px * 2.0
    behind = (x > 0.1) & (x < 0.3)
    np.testing.assert_allclose(light[behind], 225.0 if shadows else 900.0, rtol=1e-3)
    np.testing.assert_allclose(light[x < -0.1], 900.0, rtol=1e-3)


def test_the_light_field_keeps_energy():
    """Without absorption the net flux is the same at all depths; with it, Gershun: dE/dz = -a times scalar light."""
    source = SunSky(direction_to_sun(45.0, 0.0), 0.3)

    def flux(field, depth_m):
        down, up = field.scattered(depth_m, 1.5)
        net = sum(field.illuminance(depth_m, 1.5)) - 2 * np.pi * (up[0] * field._weight * field._cosine).sum()
        beam = source.beam_lx * np.exp(-field.beam_per_m * depth_m)
        return net, beam + 2 * np.pi * ((up[0] + down[0]) * field._weight).sum()

    for phase in (HG._replace(parameters=(0.8,)), Scatterer()):
        kept = [flux(LightField(BandWater(0.0, 1.0, phase), source, 1), z)[0] for z in (0.0, 0.7, 1.5)]
        np.testing.assert_allclose(kept, kept[0], rtol=1e-5)
        field, step = LightField(BandWater(0.2, 1.0, phase), source, 1), 1e-3
        slope = (flux(field, 0.7 + step)[0] - flux(field, 0.7 - step)[0]) / (2 * step)
        assert -slope == pytest.approx(0.2 * flux(field, 0.7)[1], rel=1e-3)


def test_the_light_field_of_isotropic_scattering_is_that_of_chandrasekhar():
    """Light that rises from a half space: w E0 / (4 pi) mu0 / (mu + mu0) H(mu) H(mu0), H by Chandrasekhar (1960)."""
    albedo, mu0, cosine = 0.9, 0.8, np.array([1.0, 0.5])
    x, w = np.polynomial.legendre.leggauss(64)
    mu, w = (x + 1) / 2, w / 2
    h = np.ones(64)
    for _ in range(200):
        h = np.sqrt(h / (np.sqrt(1 - albedo) + albedo / 2 * ((w * mu * h) / (mu[:, None] + mu)).sum(1)))
    even = HG._replace(parameters=(0.0,))
    source = SunSky((np.sqrt(1 - mu0**2), 0.0, mu0), 0.0)
    found = LightField(BandWater(1 - albedo, albedo, even), source, 4).veil(0.0, cosine, np.array([np.inf]))
    product = np.interp(cosine, mu, h) * np.interp(mu0, mu, h)
    expected = albedo / (4 * np.pi) / mu0 * mu0 / (cosine + mu0) * product
    np.testing.assert_allclose(found.sum(0)[:, 0], expected, rtol=3e-3)


@pytest.mark.parametrize("mu0", [1.0, 0.85])
@pytest.mark.parametrize("b_over_a", [2.0, 6.0])
def test_illuminance_decreases_as_kirk_computed(mu0, b_over_a):
    """Kirk (1984): mean Kd from the surface to the depth of 1 %, for Petzold's harbour water, within 4 %."""
    source = SunSky((np.sqrt(1 - mu0**2), 0.0, mu0), 0.0)
    field = LightField(BandWater(1.0, b_over_a, Scatterer()), source, 1)
    depths = np.linspace(0.2, 5.0, 97)
    light = np.array([sum(field.illuminance(z, np.inf)) for z in depths])
    depth_m = np.interp(np.log(100), -np.log(light), depths)
    water = medium(WaterConfig(absorption_per_m=(1.0,) * 3, scattering_per_m=(b_over_a,) * 3))
    assert np.log(100) / depth_m == pytest.approx(downwelling_per_m(water, mu0)[1], rel=0.04)


def water_of(jerlov):
    """Returns the water with a phase function whose Monte Carlo converges soon."""
    return WaterConfig(jerlov=jerlov, phase_function="henyey_greenstein")


def reference_scene(water, elevation_deg, surface_m, sky_share=0.2, albedo=0.0):
    """Returns the scene and the green water of a Jerlov type, with the floor at z = 0."""
    properties = medium(water_of(water))
    band = properties.bands[GREEN]
    source = SunSky(direction_to_sun(elevation_deg, 0.0), sky_share)
    sky = sky_share * sky_radiance(np.linspace(0.0, 1.0, 4001))
    sun = Sunlight(source.to_sun, source.beam_lx, surface_m, 0.004, sky)
    return ReferenceScene(band, np.zeros((0, 7)), (), albedo, sun=sun), source, band


@pytest.mark.long
def test_the_reference_in_absorbing_water_is_exact():
    """Sun: mu0 E exp(-a z / mu0); sky: 2 pi integral L mu exp(-a z / mu); on a floor and on a plane above it."""
    _, source, _ = reference_scene("clear", 45.0, 5.0)
    sky = 0.2 * sky_radiance(np.linspace(0.0, 1.0, 4001))
    a, mu = 0.3, np.linspace(CRITICAL_COSINE, 1, 20001)
    sun = Sunlight(source.to_sun, source.beam_lx, 5.0, 0.004, sky)
    scene = ReferenceScene(BandWater(a, 0.0, HG), np.zeros((0, 7)), (), 0.5, sun=sun)
    for height_m in (0.0, 2.0):
        z = 5.0 - height_m
        found = plane_light(scene, height_m * UP + 1e-9 * UP, UP, Effort(4000, 20))
        from_sky = 2 * np.pi * np.trapezoid(0.2 * sky_radiance(mu) * mu * np.exp(-a * z / mu), mu)
        of_sun, of_sky = (batch_mean(found.sums[:, part]) for part in (0, 1))
        assert of_sun.value == pytest.approx(0.8 * np.exp(-a * z / source.sun_cosine), rel=1e-6)
        # the floor returns nothing that reaches the plane from above
        assert abs(found.total.value - of_sun.value - from_sky) < 4 * of_sky.standard_error + 1e-4
    pose = looking_down(2.0)
    seen = pixel_light(scene, PixelRay(pose, RIG, (RIG.cx_px, RIG.cy_px)), Effort(4000, 20)).direct
    on_floor = 0.8 * np.exp(-a * 5.0 / source.sun_cosine)
    on_floor += 2 * np.pi * np.trapezoid(0.2 * sky_radiance(mu) * mu * np.exp(-a * 5.0 / mu), mu)
    assert abs(seen.value - 0.5 / np.pi * on_floor * np.exp(-a * 2.0)) < 4 * seen.standard_error + 1e-5


def test_the_reference_keeps_the_net_flux_of_water_that_absorbs_nothing():
    scene, _, _ = reference_scene("clear", 45.0, 1.5)
    scene = ReferenceScene(BandWater(0.0, 1.0, HG._replace(parameters=(0.8,))), scene.lamps, (), 0.0, sun=scene.sun)
    net, variance = [], 0.0
    for height_m in (0.2, 1.4):
        down, up = (plane_light(scene, height_m * UP, side * UP, Effort(6000, 20)).total for side in (1, -1))
        net.append(down.value - up.value)
        variance += down.standard_error**2 + up.standard_error**2
    assert abs(net[0] - net[1]) < 4 * np.sqrt(variance) < 0.1


def test_a_disc_of_the_sun_gives_the_light_of_its_centre():
    """The connection to the disc and the walks that meet it are weighted; a narrow disc changes nothing."""
    scene, _, band = reference_scene("II", 60.0, 4.0)
    pose = looking_down(2.0)
    ray = PixelRay(pose, RIG, (RIG.cx_px, RIG.cy_px))
    water = BandWater(band.absorption_per_m, band.scattering_per_m, HG._replace(parameters=(0.6,)))
    lights = []
    for radius in (0.0, 0.1):
        sun = Sunlight(scene.sun.to_sun, scene.sun.normal_lx, 4.0, radius)
        lights.append(pixel_light(ReferenceScene(water, scene.lamps, (), 0.0, sun=sun), ray, Effort(10000, 20)).veil)
    one, other = lights
    assert abs(one.value - other.value) < 4 * np.hypot(one.standard_error, other.standard_error) < 0.2 * one.value


@pytest.mark.parametrize(("water", "elevation_deg", "depth_m", "range_m"), CELLS)
def test_daylight_agrees_with_the_reference(water, elevation_deg, depth_m, range_m):
    """Illuminance within 5 %, veil within 10 %, and 3 standard errors, which are below 15 %."""
    scene, _, _ = reference_scene(water, elevation_deg, depth_m + range_m)
    pose = looking_down(range_m)
    veil = pixel_light(scene, PixelRay(pose, RIG, (RIG.cx_px, RIG.cy_px)), Effort(10_000)).veil
    lux = plane_light(scene, range_m * UP, UP, Effort(2500, 25)).total
    sun = SunConfig(illuminance_lx=1.0, depth_m=depth_m + range_m, elevation_deg=elevation_deg)
    optics = optics_under(sun, water_of(water), range_m)
    at_camera = optics_under(sun, water_of(water), range_m + 1e-3)
    model_lx = float(at_camera.floor_lx(level(1e-3)[1], 0)[CENTRE][1])
    model = float(optics.radiance(*level(range_m, 0), 0)[CENTRE][1])
    assert abs(model_lx - lux.value) < 3 * lux.standard_error + 0.05 * lux.value
    assert veil.standard_error < 0.15 * veil.value
    assert abs(model - veil.value) < 3 * veil.standard_error + 0.1 * veil.value


@pytest.mark.parametrize("lamps", [("lamps=[]",), ("lamps.0.intensity_cd=1.0", "lamps.1.intensity_cd=1.0")])
@pytest.mark.parametrize(("depth_m", "elevation_deg"), [(0.0, 90.0), (6.0, 90.0), (6.0, 40.0)])
def test_each_path_of_daylight_has_its_own_absorption(lamps, depth_m, elevation_deg):
    """A sunlit floor in water that only absorbs: the integral over the spectrum and the path sun, floor, camera.

    Lamps of 1 cd, whose light is below 1e-4 of daylight, change the spectrum for which the lamps' absorption holds.
    """
    sun = f"sun.depth_m={depth_m}", f"sun.elevation_deg={elevation_deg}", "sun.illuminance_lx=1e5", "sun.sky_share=0"
    rig = f"rig.image_width_px={RIG.width_px}", f"rig.image_height_px={RIG.height_px}"
    water = "water.jerlov=II", "water.turbidity=0", "plan.altitude_m=1.5"
    scenario = load_scenario("reef", [*lamps, *sun, *rig, *water])
    optics = Optics(scenario.believed_rig(), illumination_of(scenario), scenario.lamps)
    path_m = depth_m / direction_to_sun(elevation_deg, 0.0)[2] + 1.5
    left = band_weights(spectrum_of("daylight")) @ np.exp(-water_spectrum("II")[0] * path_m)
    light = optics.radiance(*level(1.5), 0)[CENTRE]
    np.testing.assert_allclose(light, 1e5 / np.pi * left, rtol=1e-3)


@pytest.mark.parametrize("off_axis_deg", [-30.0, 30.0])
def test_the_veil_off_the_axis_agrees_with_the_reference(off_axis_deg):
    """Lines of sight that lean towards a low sun in the north and away from it; 5 % and 3 standard errors."""
    water, sun = medium(water_of("IB")), SunConfig(
        illuminance_lx=1.0, depth_m=6.0, elevation_deg=20.0, azimuth_deg=90.0, sky_share=0.0
    )  # fmt: skip
    source = SunSky(direction_to_sun(20.0, 90.0), 0.0)
    band = water.bands[GREEN]
    scene = ReferenceScene(band, np.zeros((0, 7)), (), 0.0, sun=Sunlight(source.to_sun, source.beam_lx, 6.0, 0.004))
    lean = np.deg2rad(off_axis_deg)
    axis = np.array([0.0, np.sin(lean), -np.cos(lean)])
    pose = np.eye(4)
    pose[:3, :3] = np.column_stack([[1.0, 0, 0], np.cross(axis, [1.0, 0, 0]), axis])
    pose[2, 3] = 2.0
    truth = pixel_light(scene, PixelRay(pose, RIG, (RIG.cx_px, RIG.cy_px)), Effort(12000, 20)).veil
    range_m = 2.0 / np.cos(lean)
    veil = DaylightVeil(daylight_at(sun, water, 2.0), np.array([0.0, range_m])).radiance(axis, 4.0)[1, 1]
    assert abs(veil - truth.value) < 3 * truth.standard_error + 0.05 * truth.value < 0.2 * truth.value


def test_the_veil_of_daylight_follows_the_sun_when_the_camera_turns():
    """A camera that is turned by 180 deg shows the same veil upside down; its depth and the range count too."""
    sun = SunConfig(illuminance_lx=1000.0, depth_m=6.0, elevation_deg=40.0, azimuth_deg=25.0)
    optics = optics_under(sun, WaterConfig(jerlov="II"), 2.0)
    view = np.array([[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, 1, 4.0]])
    turned = view * np.array([-1.0, -1, 1, 1])
    black, depth = level(2.0, 0)
    one, other = (optics.radiance(black, depth, 0, SceneView(surface=WaterSurface(None, v))) for v in (view, turned))
    np.testing.assert_allclose(one, other[::-1, ::-1], rtol=1e-4)
    assert one.max() > 1.3 * one.min()
    deeper = view + np.array([[0.0] * 4, [0.0] * 4, [0, 0, 0, 1.0]])
    assert (optics.radiance(black, depth, 0, SceneView(surface=WaterSurface(None, deeper))) < one).all()
    assert (optics.radiance(black, 2 * depth, 0, SceneView(surface=WaterSurface(None, view))) > one).all()


def test_the_light_on_the_floor_is_that_of_the_light_field_at_all_depths():
    sun = SunConfig(illuminance_lx=1.0, depth_m=8.0, elevation_deg=45.0)
    water = medium(WaterConfig(jerlov="III"))
    optics = optics_under(sun, WaterConfig(jerlov="III"), 3.0)
    source = SunSky(direction_to_sun(45.0, 0.0), 0.2)
    for depth_m in (0.5, 2.0, 3.0):
        for band in range(3):
            a, b = water.absorption_per_m[band], water.scattering_per_m[band]
            field = LightField(BandWater(a, b, water.scatterers[band]), source, 1)
            expected = sum(field.illuminance(5.0 + depth_m, 5.0 + depth_m))
            assert optics.floor_lx(level(depth_m)[1], 0)[CENTRE][band] == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize(("jerlov", "turbidity", "depth_m"), [("9C", 100.0, 300.0), ("9C", 20.0, 500.0)])
def test_deep_dark_water_has_no_daylight_and_no_error(jerlov, turbidity, depth_m):
    sun = SunConfig(illuminance_lx=5e4, elevation_deg=40.0, depth_m=depth_m)
    optics = optics_under(sun, WaterConfig(jerlov=jerlov, turbidity=turbidity))
    light = optics.radiance(*level(2.0), 0, SceneView(surface=WaterSurface(None, looking_down(0.0))))
    assert np.isfinite(light).all() and light.max() < 1e-6
