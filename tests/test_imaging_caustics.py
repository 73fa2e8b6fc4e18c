"""Caustics: light is conserved, contrast as measured at sea, waves as measured, the same pattern in both cameras."""

import types

import jerlov
import numpy as np
import pytest

from twin.core import geometry
from twin.errors import TwinError
from twin.imaging.image_formation import ImageFormation, RenderedView, StampedPose
from twin.imaging.light import caustics as caustics_module
from twin.imaging.light.caustics import (
    CELLS,
    GRAVITY_MPS2,
    TILE_DEPTHS,
    Caustics,
    curvature_spectrum,
    directionality,
    displacement,
    scattering_blur,
    slope_variance,
)
from twin.imaging.light.illumination import Daylight, Illumination, daylight_at, illumination_of
from twin.imaging.light.phase_function import BandWater, Scatterer, table_of
from twin.imaging.light.sun_sky import SunSky, direction_to_sun
from twin.imaging.light.water import Medium, medium
from twin.scenario.model import SEA_WATER_INDEX, Scenario, SunConfig, WaterConfig

CLEAR = medium(WaterConfig(jerlov="clear"))
FLAT = types.SimpleNamespace(height_m=np.zeros((9, 9), np.float32), spacing_m=1.0, west_m=-4.0, south_m=-4.0)
WIND_MPS = 5.0
# Santa Barbara Channel, Darecki et al. (2011): c = 0.68 /m at 555 nm is given; a at 532 nm is an estimate
CHANNEL_PER_M = 0.1, 0.58


def scenario(**sun):
    keys = {"illuminance_lx": 1000.0, "depth_m": 4.0, "caustics": 1.0} | sun
    rig = {"image_width_px": 160, "image_height_px": 120}
    return Scenario.model_validate({"rig": rig, "sun": keys, "water": {"jerlov": "clear"}})


def pattern(caustics, time_s):
    """Returns the illuminance (CELLS, CELLS) divided by its mean."""
    return caustics.closed_pattern(time_s)[:-1, :-1]


def caustics_at(depth_m, focused_share, water, seed):
    sun = SunConfig(illuminance_lx=1000.0, depth_m=depth_m, caustics=focused_share)
    return Caustics(Illumination(water, daylight_at(sun, water, 0.0)), WIND_MPS, seed)


def contrast_in_channel(depth_m, wind_mps, direct_share):
    """Coefficient of variation of the irradiance in the Santa Barbara Channel, over the tile and two instants."""
    absorption, scattering = (np.full(3, value) for value in CHANNEL_PER_M)
    dark = np.zeros(3)
    water = Medium(absorption, scattering)
    daylight = Daylight(dark, dark, dark, depth_m, depth_m, direct_share, SunSky(), water, absorption)
    here = Caustics(Illumination(water, daylight), wind_mps, 1)
    return np.mean([pattern(here, time_s).std() for time_s in (0.0, 5.0)])


def image_formation(here):
    return ImageFormation(here, illumination_of(here), FLAT, np.random.default_rng(0))


@pytest.mark.parametrize(("depth_m", "jerlov"), [(0.3, "clear"), (1.0, "clear"), (4.0, "IB"), (20.0, "II")])
def test_waves_conserve_light(depth_m, jerlov):
    caustics = caustics_at(depth_m, 1.0, medium(WaterConfig(jerlov=jerlov)), 3)
    for time_s in (0.0, 1.7):
        light = pattern(caustics, time_s)
        assert light.mean(dtype=np.float64) == pytest.approx(1.0, abs=1e-5)
        assert light.min() > -1e-3


def test_contrast_against_depth_as_measured_at_sea():
    """Within 1.5 times of Darecki et al. (2011, fig. 13a) at 532 nm, 0.86 to 9.58 m below a wind of 4.1 to 6.4 m/s.

    The sun was 30 to 33 deg from the zenith; of such daylight 23 % is diffuse (Gernez & Antoine 2009).
    """
    measured, share = jerlov.darecki2011_irradiance_cv(), jerlov.gernez2009_diffuse_share()
    direct = 1 - share.diffuse_fraction[list(share.sun_zenith_deg).index(30.0)]
    of_green = measured.cv[:, list(measured.wavelengths_nm).index(532.0)]
    ratio = [contrast_in_channel(d, 5.25, direct) / cv for d, cv in zip(measured.depth_m, of_green, strict=True)]
    assert min(ratio) > 1 / 1.5 and max(ratio) < 1.5


def test_contrast_against_wind_as_measured_at_sea():
    """Within 1.5 times of Darecki et al. (2011, fig. 13b) at 0.91 to 1.25 m, for winds of 3.9 to 10.3 m/s.

    The sun was 42 to 46 deg from the zenith; of such daylight 26 % is diffuse.
    """
    measured = jerlov.darecki2011_spectral_cv()
    of_green = measured.cv[:, list(measured.wavelengths_nm).index(532.0)]
    ratio = [contrast_in_channel(1.08, w, 0.74) / cv for w, cv in zip(measured.wind_m_s, of_green, strict=True)]
    assert min(ratio) > 1 / 1.5 and max(ratio) < 1.5


@pytest.mark.parametrize("wind_mps", [3.0, 5.0, 8.0, 11.0, 15.0])
def test_mean_square_slope_agrees_with_sun_glitter(wind_mps):
    """Cox & Munk (1954), clean surface: 0.003 + 0.00512 U in total, of which 0.00316 U is along the wind."""
    along, across = slope_variance(wind_mps)
    assert along + across == pytest.approx(0.003 + 0.00512 * wind_mps, rel=0.3)
    assert along / across == pytest.approx(0.00316 * wind_mps / (0.003 + 0.00192 * wind_mps), rel=0.5)


@pytest.mark.parametrize(
    ("wind_mps", "level"), [(6.0, 0.01 * (1 + np.log(0.20698 / 0.23))), (12.0, 0.01 * (1 + 3 * np.log(0.47699 / 0.23)))]
)
def test_the_slowest_waves_have_the_published_curvature_and_directionality(wind_mps, level):
    """Elfouhaily et al. (1997), eq. 40, 41, 44 and 57, where the long waves have died out: at 370 and 740 rad/m."""
    friction_mps = wind_mps * np.sqrt(1e-3 * (0.8 + 0.065 * wind_mps))
    slowest, shorter = curvature_spectrum(np.array([370.0, 740.0]), wind_mps)
    assert slowest == pytest.approx(level / 2, rel=0.01)
    shorter_mps = np.sqrt(9.81 / 740 * (1 + 2**2))
    assert shorter / slowest == pytest.approx(0.23 / shorter_mps * np.exp(-0.25), rel=0.01)
    delta = np.arctanh(directionality(np.array([370.0]), wind_mps))[0]
    assert delta - np.log(2) / 4 - 4 * (0.23 * 0.84 / wind_mps) ** 2.5 == pytest.approx(
        0.13 * friction_mps / 0.23, rel=0.01
    )


def test_the_waves_of_the_tile_and_the_unresolved_ones_have_the_slopes_of_the_spectrum():
    """The sum over the wave numbers of the tile is the integral of the spectrum, within the steps of the longest."""
    here = caustics_at(4.0, 1.0, CLEAR, 1)
    east, north = here.slopes(0.7)
    longest, shortest = 2 * np.pi / (4.0 * TILE_DEPTHS), 0.95 * np.pi * CELLS / (4.0 * TILE_DEPTHS)
    shorter_than_tile, unresolved = slope_variance(WIND_MPS, longest / 2), slope_variance(WIND_MPS, shortest)
    for slope, all_waves, rest in zip((east, north), shorter_than_tile, unresolved, strict=True):
        assert (slope.astype(np.float64) ** 2).mean() == pytest.approx(all_waves - rest, rel=0.15)


def test_waves_that_the_cells_do_not_resolve_act_as_a_blur(monkeypatch):
    """With cells of half the size, which resolve shorter waves, the contrast is the same."""
    coarse = pattern(caustics_at(3.0, 1.0, medium(WaterConfig(jerlov="IB")), 1), 0.0).std()
    monkeypatch.setattr(caustics_module, "CELLS", 2 * CELLS)
    fine = pattern(caustics_at(3.0, 1.0, medium(WaterConfig(jerlov="IB")), 1), 0.0).std()
    assert coarse == pytest.approx(fine, rel=0.08)


def test_fluctuations_are_as_fast_as_at_sea():
    """The strongest fluctuations at 1 to 3 m have 1 to 3 Hz (1.1 s at 3 m: Gernez & Antoine 2009, fig. 8a)."""
    here, rate_hz, n = caustics_at(2.0, 1.0, medium(WaterConfig(jerlov="IB")), 1), 16.0, 160
    at_points = np.array([pattern(here, i / rate_hz)[::8, ::8].ravel() for i in range(n)])
    power = (np.abs(np.fft.rfft((at_points - 1) * np.hanning(n)[:, None], axis=0)) ** 2).mean(1)
    assert 1.0 <= np.fft.rfftfreq(n, 1 / rate_hz)[power.argmax()] <= 3.0


def test_in_shallow_water_caustics_follow_the_curvature_of_the_surface():
    """Before rays cross, I = 1 / det(1 - displacement per slope * slope gradient): the ratio of areas."""
    depth_m = 0.01
    caustics = caustics_at(depth_m, 1.0, CLEAR, 1)
    east, north = (s.astype(np.float64) for s in caustics.slopes(0.4))
    k = 2 * np.pi * np.fft.fftfreq(CELLS, 1 / caustics.cells_per_m)

    def gradient(values, axis):
        along = k[None] if axis == 1 else k[:, None]
        return np.fft.ifft2(1j * along * np.fft.fft2(values)).real

    per_slope_m = (1 - 1 / SEA_WATER_INDEX) * depth_m
    det = (1 - per_slope_m * gradient(east, 1)) * (1 - per_slope_m * gradient(north, 0))
    det -= per_slope_m**2 * gradient(east, 0) * gradient(north, 1)
    assert det.min() > 0.5
    light = pattern(caustics, 0.4)
    # the formula holds at the surface, a few cells away from the floor point; that and the cell size reduce contrast
    assert np.corrcoef(light.ravel(), (1 / det).ravel())[0, 1] > 0.97
    assert light.std() == pytest.approx((1 / det).std(), rel=0.1)


@pytest.mark.parametrize("column", [3, 100])
def test_waves_have_the_dispersion_of_gravity_and_capillary_waves(column):
    """The phase of each wave changes by omega t with omega^2 = g k (1 + (k / 370 rad/m)^2), downwind."""
    here = caustics_at(1.0, 1.0, CLEAR, 1)
    step_s = 0.02 if column == 3 else 0.002
    before, after = (np.fft.fft2(here.slopes(t)[0]) for t in (0.0, step_s))
    k = 2 * np.pi * column / here.tile_m
    phase = np.angle(after[0, column] / before[0, column])
    assert phase == pytest.approx(-step_s * np.sqrt(GRAVITY_MPS2 * k * (1 + (k / 370) ** 2)), rel=1e-3)


def test_blur_by_the_water_agrees_with_a_monte_carlo_simulation():
    """Walks of photons from a vertical pencil of light, with any order of scattering.

    20000 walks give a standard error of the transform of 0.006; the small-angle theory differs by up to 5 %.
    """
    rng, depth_m, (absorption, scattering) = np.random.default_rng(1), 3.78, CHANNEL_PER_M
    phase, n = table_of(Scatterer()), 20000
    at, to = np.zeros((n, 3)), np.tile([0.0, 0.0, 1.0], (n, 1))
    weight, east, light = np.ones(n), [], []
    for _ in range(40):
        step = rng.exponential(1 / scattering, len(at))
        after = at + step[:, None] * to
        crosses = (at[:, 2] < depth_m) & (after[:, 2] >= depth_m)
        down = ((depth_m - at[:, 2]) / np.where(to[:, 2] == 0, 1, to[:, 2]))[crosses]
        east.append(at[crosses, 0] + down * to[crosses, 0])
        light.append(weight[crosses] * np.exp(-absorption * down))
        weight = weight * np.exp(-absorption * step)
        alive = (after[:, 2] > 0) & (weight > 1e-3)
        at, weight, to = after[alive], weight[alive], _scattered(to[alive], phase, rng)
    k, east, light = np.array([0.3, 1.0, 3.0, 10.0, 100.0]), np.concatenate(east), np.concatenate(light)
    simulated = (light * np.cos(k[:, None] * east)).sum(1) / light.sum()
    np.testing.assert_allclose(scattering_blur(k, depth_m, BandWater(*CHANNEL_PER_M)), simulated, rtol=0.05, atol=0.018)


def _scattered(to, phase, rng):
    """Returns directions (n, 3) after one scattering."""
    cell = np.interp(rng.random(len(to)), phase.cumulative, np.arange(len(phase.cumulative)))
    cosine, turn = 1 - 2 * (cell / (len(phase.cumulative) - 1)) ** 4, rng.uniform(0, 2 * np.pi, len(to))
    side = np.cross(to, np.where(np.abs(to[:, :1]) < 0.9, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]))
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    across = np.cos(turn)[:, None] * side + np.sin(turn)[:, None] * np.cross(to, side)
    return cosine[:, None] * to + np.sqrt(np.maximum(1 - cosine**2, 0))[:, None] * across


def test_blur_by_the_water_has_its_limits():
    k = np.array([0.0, 1e-3, 2e3])
    np.testing.assert_array_equal(scattering_blur(k, 5.0, BandWater(0.1, 0.0)), 1.0)
    fine = scattering_blur(k, 5.0, BandWater(0.0, 0.3))
    assert fine[0] == 1.0 and fine[1] == pytest.approx(1.0, abs=1e-3)
    # the finest pattern is that of the light that is not scattered; 1.9 % of the light is scattered upwards
    assert fine[2] == pytest.approx(np.exp(-0.3 * 5.0 * 0.981), rel=0.06)


def test_contrast_decreases_with_depth_turbidity_and_diffuse_light():
    contrast = [pattern(caustics_at(d, 1.0, medium(WaterConfig(jerlov="IB")), 1), 0.0).std() for d in (5.0, 20.0, 60.0)]
    assert contrast[0] > 1.5 * contrast[1] > 3 * contrast[2] > 0
    murky = pattern(caustics_at(5.0, 1.0, medium(WaterConfig(jerlov="II")), 1), 0.0).std()
    assert murky < 0.6 * contrast[0]
    half = pattern(caustics_at(5.0, 0.5, medium(WaterConfig(jerlov="IB")), 1), 0.0)
    np.testing.assert_allclose(half.std(), contrast[0] / 2, rtol=1e-4)


def test_the_pattern_depends_on_the_seed_and_changes_with_time():
    one, same, other = (caustics_at(4.0, 1.0, CLEAR, seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(pattern(one, 0.3), pattern(same, 0.3))
    assert np.corrcoef(pattern(one, 0.0).ravel(), pattern(other, 0.0).ravel())[0, 1] < 0.3
    moved = [np.corrcoef(pattern(one, 0.0).ravel(), pattern(one, t).ravel())[0, 1] for t in (1 / 30, 2.0)]
    assert moved[0] > 0.6 and moved[1] < 0.3


def test_both_cameras_see_the_same_caustics_on_the_floor():
    """On a level floor at 2 m the right image is the left one shifted by the disparity, and matches the pattern."""
    here = scenario()
    light, rig = image_formation(here), here.believed_rig()
    pose = geometry.pose(geometry.BODY_FROM_DOWN_CAMERA, np.array([0.37, -1.2, 2.0]))
    white, depth = np.full((120, 160, 3), 255, np.uint8), np.full((120, 160), 2.0, np.float32)
    left, right = (
        light.radiance(RenderedView(white, depth, camera, StampedPose(pose, 0.5)))[..., 1] for camera in (0, 1)
    )
    pixel_m = 2.0 / rig.focal_px
    shift = rig.baseline_m / pixel_m
    column = np.arange(30, 150)
    moved = np.array([np.interp(column, np.arange(160), row) for row in left])
    shifted = np.array([np.interp(column - shift, np.arange(160), row) for row in right])
    assert np.abs(shifted - moved).mean() < 0.02 * left.mean() and left.std() > 0.2 * left.mean()
    # each pixel shows the pattern at the intersection of its ray with the floor
    caustics = caustics_at(4.0, 1.0, CLEAR, here.seed)
    lines = pattern(caustics, 0.5)
    for v, u in [(0, 0), (60, 80), (101, 17)]:
        east = 0.37 + (u - rig.cx_px) * pixel_m * pose[0, 0] + (v - rig.cy_px) * pixel_m * pose[0, 1]
        north = -1.2 + (u - rig.cx_px) * pixel_m * pose[1, 0] + (v - rig.cy_px) * pixel_m * pose[1, 1]
        col, row = east * caustics.cells_per_m, north * caustics.cells_per_m
        j, i = int(np.floor(col)), int(np.floor(row))
        w, h = col - j, row - i
        at = lambda r, c: lines[r % CELLS, c % CELLS]  # noqa: E731
        expected = (1 - h) * ((1 - w) * at(i, j) + w * at(i, j + 1)) + h * (
            (1 - w) * at(i + 1, j) + w * at(i + 1, j + 1)
        )
        assert left[v, u] == pytest.approx(1000 / np.pi * expected, rel=2e-3)


def test_without_caustics_daylight_is_uniform():
    light = image_formation(scenario(caustics=0.0))
    pose = geometry.pose(geometry.BODY_FROM_DOWN_CAMERA, np.array([0.0, 0.0, 2.0]))
    white, depth = np.full((120, 160, 3), 255, np.uint8), np.full((120, 160), 2.0, np.float32)
    np.testing.assert_allclose(
        light.radiance(RenderedView(white, depth, 0, StampedPose(pose, 0.0))), 1000 / np.pi, rtol=1e-5
    )


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


def landing(to_sun, slope):
    """Returns where a ray of the sun meets the depth 1 m, east and north of where it meets a surface of this slope."""
    sun = np.array(to_sun)
    in_air = np.array([*(SEA_WATER_INDEX * -sun[:2]), 0.0])
    in_air[2] = -np.sqrt(1 - in_air @ in_air)
    down = np.array([*slope, -1.0]) / np.sqrt(1 + np.dot(slope, slope))  # normal of the surface into the water
    along = in_air @ down
    cosine = np.sqrt(1 - (1 - along**2) / SEA_WATER_INDEX**2)
    ray = in_air / SEA_WATER_INDEX + (cosine - along / SEA_WATER_INDEX) * down
    return ray[:2] / -ray[2]


@pytest.mark.parametrize(("elevation_deg", "azimuth_deg"), [(90.0, 0.0), (50.0, 30.0), (15.0, 200.0)])
def test_a_ray_of_a_slanted_sun_is_displaced_as_by_snells_law(elevation_deg, azimuth_deg):
    to_sun, step = direction_to_sun(elevation_deg, azimuth_deg), 1e-5
    found = [(landing(to_sun, step * axis) - landing(to_sun, -step * axis)) / (2 * step) for axis in np.eye(2)]
    np.testing.assert_allclose(displacement(to_sun), np.transpose(found), atol=1e-6)


def test_a_low_sun_stretches_its_caustics_along_its_azimuth():
    """The pattern of the same waves: its variance of slopes towards the sun falls more than across."""
    steep = {}
    for elevation_deg in (90.0, 20.0):
        sun = SunConfig(illuminance_lx=1.0, depth_m=3.0, caustics=1.0, elevation_deg=elevation_deg, azimuth_deg=90.0)
        light = pattern(Caustics(Illumination(CLEAR, daylight_at(sun, CLEAR, 0.0)), WIND_MPS, 1), 0.0)
        to_north, to_east = np.gradient(light)
        steep[elevation_deg] = to_north.std() / to_east.std()
    assert steep[20.0] < 0.9 * steep[90.0]
