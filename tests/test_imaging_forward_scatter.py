"""Multiple scattering: energy, the kernels against closed forms and a random walk, and the image that is blurred."""

import cv2
import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import ndtr

from twin.imaging.light.forward_scatter import ForwardScatter, _add_upsampled, level_sigma_px, place_of
from twin.imaging.light.illumination import Illumination, daylight_at
from twin.imaging.light.lamp_light import LampLight
from twin.imaging.light.lamps import light_sources_in_camera
from twin.imaging.light.optics import Optics, SceneView
from twin.imaging.light.phase_function import BandWater, Scatterer, phase_of, table_of
from twin.imaging.light.spread import LAMP_SIGMA_RAD, camera_mixture, lamp_mixture
from twin.imaging.light.water import Medium, medium
from twin.scenario.model import LampConfig, Scenario, SunConfig, WaterConfig

RIG = Scenario.model_validate({"rig": {"image_width_px": 160, "image_height_px": 120}}).believed_rig()
SHAPE = (RIG.height_px, RIG.width_px)
HG, PETZOLD = Scatterer("henyey_greenstein", 0.0, (0.924,)), Scatterer("petzold")
LAMP = LampConfig(position_m=(0.2, 0.4, 0.0), pan_deg=-10.0, intensity_cd=1000.0)


def sea(absorption, scattering, scatterer=PETZOLD):
    return Medium(np.full(3, absorption), np.full(3, scattering), (scatterer,) * 3)


def backscatter_fraction(scatterer):
    """Returns the fraction of the scattered light that is scattered by more than 90 deg."""
    cumulative = table_of(scatterer).cumulative
    return 1 - np.interp(0.5**0.25, np.linspace(0.0, 1.0, len(cumulative)), cumulative)


@pytest.mark.parametrize("scatterer", [HG, PETZOLD])
def test_light_of_an_even_floor_is_lost_only_by_scattering_backwards(scatterer):
    """Without absorption, light scattered by less than 90 deg reaches the camera: exp(-b_b r) of it arrives."""
    sigmas = tuple(level_sigma_px(level) / 277 for level in range(9))
    ranges_m = (0.3, 1.0, 3.0)
    backwards = backscatter_fraction(scatterer)
    for b in (0.05, 1.0):
        thickness = b * np.array(ranges_m)
        arrives = np.exp(-thickness) + camera_mixture(BandWater(0.0, b, scatterer), ranges_m, sigmas).sum(1)
        np.testing.assert_allclose(arrives, np.exp(-backwards * thickness), rtol=3e-3)


@pytest.mark.filterwarnings("ignore::scipy.integrate.IntegrationWarning")  # Petzold's table has kinks
@pytest.mark.parametrize("scatterer", [HG, PETZOLD])
def test_light_scattered_once_from_an_even_lamp_agrees_with_quadrature(scatterer):
    """On a floor, light scattered by t adds the integral of cos(alpha) for alpha below t and 90 deg: sin(t), then 1."""
    thickness = 1e-3
    cuts = np.deg2rad([1e-6, 1e-4, 1e-2, 1, 10, 90, 180])
    density = lambda t: 2 * np.pi * float(phase_of(scatterer, np.array(t)))  # noqa: E731
    pieces = [(low, high) for low, high in zip(cuts, cuts[1:], strict=False)]
    floor = sum(quad(lambda t: density(t) * np.sin(min(t, np.pi / 2)), *piece)[0] for piece in pieces)
    # on a particle: the integral of 1 over alpha below t
    particle = sum(quad(lambda t: density(t) * t, *piece)[0] for piece in pieces)
    water = BandWater(0.0, thickness, scatterer)
    for receiver, expected in (("floor", floor), ("particle", particle)):
        found = lamp_mixture(water, (1.0,), receiver).sum() / thickness
        assert found == pytest.approx(expected, rel=5e-3)


def walk_px(scatterer, thickness, focal_px, n=60_000):
    """Returns displacements [px] of rays that are scattered at least once between floor and camera, by small angles."""
    rng = np.random.default_rng(1)
    counts = rng.poisson(thickness, n)
    table, place, ahead = table_of(scatterer), np.zeros((n, 2)), np.ones(n, bool)
    edges = 2 * np.arcsin(np.linspace(0, 1, len(table.cumulative)) ** 2)
    for k in range(counts.max()):
        on = np.flatnonzero(counts > k)
        angle, turn = np.interp(rng.random(len(on)), table.cumulative, edges), 2 * np.pi * rng.random(len(on))
        place[on] += (np.tan(np.minimum(angle, 1.55)) * rng.random(len(on)))[:, None] * np.stack(
            [np.cos(turn), np.sin(turn)], 1
        )
        ahead[on[angle > np.pi / 2]] = False
    return np.hypot(*place[(counts > 0) & ahead].T) * focal_px


@pytest.mark.parametrize(("scatterer", "thickness"), [(HG, 0.5), (PETZOLD, 0.5), (PETZOLD, 3.0)])
def test_the_kernel_has_the_core_and_the_tail_of_a_random_walk(scatterer, thickness):
    """Shares within 2, 8 and 40 px; the standard error of the walk is 0.003, the Gaussians fit within 0.02."""
    away = walk_px(scatterer, thickness, 277.0)
    levels = range(9)
    weights = camera_mixture(
        BandWater(0.0, thickness, scatterer), (1.0,), tuple(level_sigma_px(k) / 277 for k in levels)
    )
    for radius in (2.0, 8.0, 40.0):
        within = [1 - np.exp(-(radius**2) / (2 * level_sigma_px(k) ** 2)) if k else 1.0 for k in levels]
        assert weights[0] @ within / weights.sum() == pytest.approx((away < radius).mean(), abs=0.02)


def spread_of(floor, depth_m, water):
    blur = ForwardScatter(RIG, water)
    around = np.zeros((*blur.surroundings.shape, 3), np.float32), np.full(blur.surroundings.shape, 0.0, np.float32)
    range_m = np.full(SHAPE, depth_m)
    around[1][:] = place_of(np.float64(depth_m))
    return blur.spread(floor, range_m, around), blur


def test_the_image_of_a_point_has_the_kernel_and_its_energy():
    floor, water = np.zeros((*SHAPE, 3), np.float32), sea(0.0, 0.4)
    floor[60, 80] = 1000.0
    image = spread_of(floor, 2.0, water)[0][..., 1].astype(float)
    v, u = np.indices(SHAPE)
    away = np.hypot(v - 60, u - 80)
    radii = np.array([3.5, 7.5, 15.5, 30.5])
    levels = 6  # of the image of this test and its surroundings
    sigmas = [level_sigma_px(k) for k in range(levels + 2)]
    weights = camera_mixture(water.bands[1], (2.0,), tuple(s / RIG.focal_px for s in sigmas))[0]
    for radius in radii:
        within = [1 - np.exp(-(radius**2) / (2 * s**2)) if s else 1.0 for s in sigmas]
        assert image[away < radius].sum() / 1000 == pytest.approx(weights @ within, rel=0.06)
    # an even floor, also around the image: nothing is lost but what scatters backwards
    blur = ForwardScatter(RIG, water)
    ones = np.ones((*blur.surroundings.shape, 3), np.float32)
    place = np.full(blur.surroundings.shape, place_of(np.float64(2.0)), np.float32)
    even = blur.spread(np.ones((*SHAPE, 3), np.float32), np.full(SHAPE, 2.0), (ones, place)) + np.exp(-0.8)
    np.testing.assert_allclose(even, np.exp(-0.8 * backscatter_fraction(PETZOLD)), rtol=0.01)


def test_off_the_axis_the_kernel_covers_more_pixels_and_keeps_its_light():
    """Pixels per angle grow by 1 / cos(theta)^1.5. Compared without the core (level 0), which is below a pixel."""
    floor, water, place = np.zeros((*SHAPE, 3), np.float32), sea(0.0, 0.4), (105, 145)
    floor[place] = 1000.0
    blur = ForwardScatter(RIG, water)
    around = np.zeros((*blur.surroundings.shape, 3), np.float32), np.full(blur.surroundings.shape, 0.0, np.float32)
    image = np.zeros_like(floor)
    around[1][:] = at = place_of(np.float64(2.0))
    blur.add(floor, np.full((SHAPE[0] // 2, SHAPE[1] // 2), at, np.float32), around, image)
    v, u = np.indices(SHAPE)
    away, image = np.hypot(v - place[0], u - place[1]), image[..., 1].astype(float) / 1000
    off = np.hypot(place[0] - (SHAPE[0] - 1) / 2, place[1] - (SHAPE[1] - 1) / 2) / RIG.focal_px
    wider = (1 + off**2) ** 0.75
    sigmas = np.array([level_sigma_px(k) for k in range(1, 8)])
    weights = camera_mixture(water.bands[1], (2.0,), (0.0, *(sigmas / RIG.focal_px).tolist()))[0][1:]
    for radius in (3.5, 7.5):
        within = [weights @ (1 - np.exp(-((radius / scale) ** 2) / (2 * sigmas**2))) for scale in (1.0, wider)]
        assert image[away < radius].sum() == pytest.approx(within[1], rel=0.06)
        assert image[away < radius].sum() < 0.93 * within[0]
    np.testing.assert_allclose(blur._tables[..., 4:7].sum(0), 0.0, atol=1e-6)


def test_a_ray_that_ends_near_collects_less_scattered_light_than_one_that_ends_far():
    blur = ForwardScatter(RIG, sea(0.0, 0.4))
    range_m = np.full(SHAPE, 4.0)
    range_m[:, :80] = 1.0
    around = np.ones((*blur.surroundings.shape, 3), np.float32), np.full(blur.surroundings.shape, 300.0, np.float32)
    light = blur.spread(np.ones((*SHAPE, 3), np.float32), range_m, around)[60, :, 1]
    near, far = -np.expm1(-0.4 * np.array([1.0, 4.0])) - 0.02
    # the widest levels take the weights of the mean range within their width, so the near part is up to 30 % too bright
    assert near < light[10] < 1.3 * near and light[150] == pytest.approx(far, rel=0.1)
    assert (np.diff(light[20:140]) > -2e-3).all()


def test_light_of_a_near_edge_is_blurred_by_its_own_range():
    """A white floor at 1 m beside a black one at 4 m: 30 px beyond the edge, the kernel of 1 m cut by a half plane."""
    water, edge, away = sea(0.0, 0.4), 80, 30
    blur = ForwardScatter(RIG, water)
    range_m, floor = np.full(SHAPE, 4.0), np.zeros((*SHAPE, 3), np.float32)
    range_m[:, :edge], floor[:, :edge] = 1.0, 1.0
    grid = blur.surroundings
    left = np.arange(grid.shape[1]) < grid.pad + edge / 2**grid.level
    place = np.where(left, place_of(np.float64(1.0)), place_of(np.float64(4.0))) * np.ones((grid.shape[0], 1))
    around = np.repeat(np.where(left, 1.0, 0.0)[None, :, None], grid.shape[0], 0).repeat(3, 2)
    inner = place.copy()
    inner[grid.pad : -grid.pad, grid.pad : -grid.pad] = place_of(np.float64(2.0))  # of the plane that fits the image
    light = blur.spread(floor, range_m, (around.astype(np.float32), inner.astype(np.float32)))[60, edge + away, 1]
    sigmas = [level_sigma_px(k) for k in range(8)]
    weights = camera_mixture(water.bands[1], (1.0,), tuple(s / RIG.focal_px for s in sigmas))[0]
    beyond = [w * ndtr(-away / s) for w, s in zip(weights[1:], sigmas[1:], strict=True)]
    assert light == pytest.approx(sum(beyond), rel=0.15)


def optics(water):
    return Optics(RIG, Illumination(water, daylight_at(SunConfig(illuminance_lx=0), water, 0.0)), (LAMP,))


@pytest.mark.parametrize("scattering", ["full", "none"])
def test_water_that_does_not_scatter_gives_the_image_of_single_scattering(scattering):
    albedo = np.random.default_rng(0).integers(0, 256, (*SHAPE, 3), dtype=np.uint8)
    depth, settings = np.full(SHAPE, 1.5, np.float32), WaterConfig(jerlov="II", turbidity=0.0)
    single, other = (optics(medium(settings, model)).radiance(albedo, depth, 0) for model in ("single", scattering))
    np.testing.assert_array_equal(other, single)
    if scattering == "none":  # whatever the turbidity
        murky = WaterConfig(jerlov="II", turbidity=3.0)
        np.testing.assert_array_equal(optics(medium(murky, "none")).radiance(albedo, depth, 0), single)


def test_radiance_is_the_sum_of_its_parts_also_without_floor_and_in_shadow():
    albedo = np.random.default_rng(0).integers(0, 256, (*SHAPE, 3), dtype=np.uint8)
    depth = np.random.default_rng(1).uniform(1.4, 1.5, SHAPE).astype(np.float32)
    depth[80:, 100:] = np.inf
    lit = np.ones((1, *SHAPE), np.uint8)
    lit[0, 20:60, 20:60] = 0
    model = optics(medium(WaterConfig(jerlov="III")))
    for shadow in (SceneView(), SceneView(lit=lit)):
        direct, forward, backscatter = model.parts(albedo, depth, 0, shadow)
        np.testing.assert_allclose(model.radiance(albedo, depth, 0, shadow), direct + forward + backscatter, rtol=2e-3)
        assert not direct[80:, 100:].any() and (forward[80:, 100:] > 0).all()
    open_sky, shaded = (
        model.parts(albedo, depth, 0, shadow).direct[20:60, 20:60] for shadow in (SceneView(), SceneView(lit=lit))
    )
    assert (shaded <= open_sky).all() and (shaded[open_sky > 0] > 0).all()  # scattered light reaches the shadow


def test_a_softened_beam_lights_beyond_its_edge_and_loses_on_its_axis():
    water, still = sea(0.05, 1.0), sea(0.05, 0.0)
    spot = LAMP.model_copy(update={"pan_deg": 0.0, "beam": ((0.0, 1.0), (9.0, 1.0), (10.0, 0.0))})
    sources = light_sources_in_camera(RIG, (spot,), daylight_at(SunConfig(illuminance_lx=0), still, 0.0), 0)
    angle = np.deg2rad([0.0, 5.0, 15.0, 30.0])
    points = sources.position_m[0] + 2.0 * np.stack([np.sin(angle), 0 * angle, np.cos(angle)], -1)
    clear, murky = (LampLight(sources, one).lux(0, points)[0][:, 1] for one in (still, water))
    assert (murky[:2] < clear[:2]).all() and (murky[:2] > np.exp(-2.0) * clear[:2]).all()
    assert (clear[2:] == 0).all() and (murky[2:] > 0).all() and (np.diff(murky) < 0).all()


def test_mixtures_are_narrow_and_wide_enough_for_the_kernels():
    """The light within the narrowest and beyond half of the widest Gaussian of a lamp is below 10 %."""
    weights = lamp_mixture(BandWater(0.06, 1.0, PETZOLD), (2.0,), "floor")[0]
    assert weights[0] < 0.1 * weights.sum() and weights[LAMP_SIGMA_RAD > 0.6].sum() < 0.2 * weights.sum()


@pytest.mark.parametrize("shape", [(48, 64), (7, 9), (8, 9), (7, 10), (3, 2), (2, 2)])
def test_the_finest_level_is_upsampled_as_by_opencv(shape):
    rng = np.random.default_rng(0)
    small = rng.random(((shape[0] + 1) // 2, (shape[1] + 1) // 2, 3), np.float32)
    light = rng.random((*shape, 3), np.float32)
    expected = light + cv2.pyrUp(small, dstsize=shape[::-1])
    flat = light.reshape(shape[0], -1)
    for first, end in ((0, 1), (1, shape[0])):
        _add_upsampled(small.reshape(len(small), -1), flat, first, end)
    np.testing.assert_allclose(light, expected, atol=5e-7)  # values up to 2, rounded in single precision
