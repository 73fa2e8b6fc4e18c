"""The Monte Carlo of the light of a pixel: closed forms, tabulated slabs, conservation of energy, other estimators.

Deviations are compared with 4 standard errors of the Monte Carlo (probability 6e-5 each), plus what the oracle leaves
out.
"""

import numpy as np
import pytest
from scipy.integrate import quad

from twin.core.height_field import height_field
from twin.core.records import StereoRig
from twin.errors import TwinError
from twin.imaging.light.lamps import LED_BEAM, beam_share
from twin.imaging.light.phase_function import BandWater, Scatterer, phase_of
from twin.imaging.reference.floor_crossings import LEVEL
from twin.imaging.reference.pixel_light import (
    Effort,
    PixelRay,
    ReferenceScene,
    Sunlight,
    batch_mean,
    pixel_light,
    refined,
)
from twin.imaging.reference.walk import LAMP_SCATTERED

RIG = StereoRig(320, 240, 277.0, 0.1)
EVEN_BEAM, LED = np.array([[0.0, 1.0], [90.0, 1.0]]), np.array(LED_BEAM)
LAMPS = np.array([[0.2, 0.35, 1.95, 0.0, -0.14, -0.99, 1500.0], [0.2, -0.35, 1.95, 0.0, 0.14, -0.99, 900.0]])
LAMPS[:, 3:6] /= np.linalg.norm(LAMPS[:, 3:6], axis=1, keepdims=True)


def henyey_greenstein(mean_cosine):
    return Scatterer("henyey_greenstein", 0.0, (mean_cosine,))


ISOTROPIC = henyey_greenstein(0.0)


def looking_down(height_m, tilt_rad=0.0, azimuth_rad=0.0):
    """Returns world_from_camera for a camera whose axis is tilted from straight down towards an azimuth."""
    axis = np.array([np.sin(tilt_rad) * np.cos(azimuth_rad), np.sin(tilt_rad) * np.sin(azimuth_rad), -np.cos(tilt_rad)])
    right = np.cross(axis, [0, 0, 1.0]) if tilt_rad else np.array([1.0, 0, 0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.column_stack([right, np.cross(axis, right), axis])
    pose[:3, 3] = [0, 0, height_m]
    return pose


def central(pose, pixel=None):
    return PixelRay(pose, RIG, pixel or (RIG.cx_px, RIG.cy_px))


def lit(water, albedo=0.5, relief=LEVEL, lamps=LAMPS):
    return ReferenceScene(water, lamps, (LED, LED), albedo, relief)


def under_sun(water, mu0, albedo, surface_m):
    sun = Sunlight((np.sqrt(1 - mu0**2), 0.0, mu0), 1.0, surface_m)
    return ReferenceScene(water, np.zeros((0, 7)), (), albedo, sun=sun)


def assert_near(estimate, expected, rel=0.0):
    assert abs(estimate.value - expected) < 4 * estimate.standard_error + rel * abs(expected), (estimate, expected)


def test_light_in_absorbing_water_is_exact():
    """L = rho/pi sum I f cos/d^2 exp(-a (d + r)), at a pixel off the axis."""
    pose, pixel, a = looking_down(2.0), (40.0, 200.0), 0.3
    found = pixel_light(lit(BandWater(a, 0.0)), central(pose, pixel), Effort(64, 2))
    ray = np.array([(pixel[0] - RIG.cx_px) / RIG.focal_px, (pixel[1] - RIG.cy_px) / RIG.focal_px, 1.0])
    seen = pose[:3, 3] + pose[:3, :3] @ ray * 2.0
    expected = 0.0
    for lamp in LAMPS:
        to_lamp = lamp[:3] - seen
        d = np.linalg.norm(to_lamp)
        light = lamp[6] * beam_share(-(to_lamp / d) @ lamp[3:6], LED) * to_lamp[2] / d**3
        expected += 0.5 / np.pi * light * np.exp(-a * (d + 2.0 * np.linalg.norm(ray)))
    assert found.total.value == pytest.approx(expected, rel=1e-5)  # the path starts 1 um above the floor
    assert found.total == found.direct and found.total.standard_error == 0


@pytest.mark.parametrize("phase", [Scatterer(), Scatterer(molecular_share=1.0), henyey_greenstein(0.8)])
def test_light_scattered_once_into_a_pixel_is_that_of_quadrature(phase):
    """b integral p I f/d^2 exp(-c (d + s)) ds over the ray of the pixel."""
    a, b = 0.06, 0.4
    found = pixel_light(lit(BandWater(a, b, phase), 0.0), central(looking_down(2.0)), Effort(2000, 20))

    def integrand(s):
        point, total = np.array([0, 0, 2.0 - s]), 0.0
        for lamp in LAMPS:
            to_lamp = lamp[:3] - point
            d = np.linalg.norm(to_lamp)
            angle = np.arccos(-to_lamp[2] / d)
            strength = lamp[6] * beam_share(-(to_lamp / d) @ lamp[3:6], LED) / d**2
            total += b * float(phase_of(phase, np.array(angle))) * strength * np.exp(-(a + b) * (d + s))
        return total

    expected = quad(integrand, 0, 2.0, limit=60, epsrel=1e-4)[0]
    assert_near(found.veil_once, expected, rel=2e-3)


def test_floor_light_scattered_once_from_a_lamp_above_has_its_closed_form():
    """A lamp at height D above the floor point, even over the lower half space, in thin water that scatters evenly.

    The scattered part is pi b D / 4 of the direct part: integral of cos/(4 pi) over the half space, times
    integral dr/d^2 = (pi/2) / (D sin) up to the height of the lamp. What is scattered twice or comes back from the
    floor is smaller by b D or the albedo.
    """
    b, height = 1e-3, 2.0
    lamp = np.array([[0, 0, height, 0, 0, -1.0, 1000.0]])
    scene = ReferenceScene(BandWater(0.0, b, ISOTROPIC), lamp, (EVEN_BEAM,), 1e-3, lamp_radius_m=1e-6)
    found = pixel_light(scene, central(looking_down(height + 0.5)), Effort(8000, 20))
    expected = found.direct.value * np.pi * b * height / 4
    assert_near(batch_mean(found.sums[:, LAMP_SCATTERED]), expected, rel=3 * b * height)


def h_function(albedo, n=64):
    """Returns nodes mu and Chandrasekhar's H(mu) for isotropic scattering (1960, chapter V, eq. 1.42), by iteration."""
    x, w = np.polynomial.legendre.leggauss(n)
    mu, w = (x + 1) / 2, w / 2
    h = np.ones(n)
    for _ in range(200):
        new = 1 / (np.sqrt(1 - albedo) + albedo / 2 * ((w * mu * h) / (mu[:, None] + mu)).sum(1))
        h = np.sqrt(h * new)  # damped: the plain iteration oscillates
    return mu, h


def test_the_h_function_is_the_tabulated_one():
    """Chandrasekhar (1960), Table XI, conservative case: H(0.5) = 2.0128, H(1) = 2.9078."""
    mu, h = h_function(1.0)
    np.testing.assert_allclose(np.interp([0.5, 1.0], mu, h), [2.0128, 2.9078], rtol=2e-3)


@pytest.mark.parametrize("albedo", [0.5, 0.9])
def test_a_half_space_with_isotropic_scattering_reflects_as_chandrasekhar_computed(albedo):
    """I(mu) = w E0 / (4 pi) mu0 / (mu + mu0) H(mu) H(mu0)."""
    nodes, h = h_function(albedo)
    scene = under_sun(BandWater(1 - albedo, albedo, ISOTROPIC), 0.6, 0.0, 60.0)
    for mu in (1.0, 0.4):
        found = pixel_light(scene, central(looking_down(60 - 1e-9, np.arccos(mu))), Effort(10000, 20))
        product = np.prod(np.interp([mu, 0.6], nodes, h))
        assert_near(found.veil, albedo / (4 * np.pi) * 0.6 / (mu + 0.6) * product, rel=2e-3)


def test_a_conservative_slab_transmits_diffuse_light_as_tabulated():
    """Isotropic scattering, optical thickness 1, Lambertian light from above: 0.5532 is transmitted.

    Heaslet & Warming (1965, Int. J. Heat Mass Transf. 8, 979); the same number is the heat flux between black plates.
    """
    x, w = np.polynomial.legendre.leggauss(5)
    mu, w = (x + 1) / 2, w / 2
    reflected, variance = 0.0, 0.0
    for mu0, w0 in zip(mu, w, strict=True):
        scene = under_sun(BandWater(0.0, 1.0, ISOTROPIC), mu0, 0.0, 1.0)
        for k, (mu1, w1) in enumerate(zip(mu, w, strict=True)):
            ray = central(looking_down(1 - 1e-9, np.arccos(mu1)))
            light = pixel_light(scene, ray, Effort(2000, 10, seed=k)).veil
            factor = 4 * np.pi * w0 * w1 * mu1
            reflected += factor * light.value
            variance += (factor * light.standard_error) ** 2
    assert abs(1 - reflected - 0.5532) < 4 * np.sqrt(variance) + 2e-3  # 5 x 5 nodes: 0.001


def test_what_neither_water_nor_floor_absorbs_comes_back():
    """White floor, no absorption, forward scattering: the mean radiance over Lambert's cosine is E0 mu0 / pi."""
    scene = under_sun(BandWater(0.0, 1.0, henyey_greenstein(0.8)), 0.8, 1.0, 1.5)
    lights = []
    rng = np.random.default_rng(0)
    strata = (np.stack(np.meshgrid(np.arange(8), np.arange(8)), -1).reshape(-1, 2) + rng.random((64, 2))) / 8
    for k, (u, v) in enumerate(strata):
        ray = central(looking_down(1.5 - 1e-9, np.arcsin(np.sqrt(u)), 2 * np.pi * v))
        lights.append(pixel_light(scene, ray, Effort(400, 4, seed=k)).total.value)
    error = np.std(lights, ddof=1) / np.sqrt(len(lights))  # an upper limit: the directions are stratified
    assert np.mean(lights) == pytest.approx(0.8 / np.pi, abs=3 * error)
    assert error < 0.02 * 0.8 / np.pi


def components(light):
    """Returns means of components of the light; the third is blurred light that had reached the floor straight."""
    scattered, blurred = light.sums[:, LAMP_SCATTERED], light.blurred_by_bin.sum(2)
    means = [batch_mean(part) for part in (scattered, blurred.sum(1), blurred[:, 0])]
    return *means, light.veil, light.total


@pytest.mark.parametrize("phase", [ISOTROPIC, pytest.param(henyey_greenstein(0.7), marks=pytest.mark.long)])
def test_both_estimators_agree(phase):
    """The textbook estimator shares neither guided directions nor connections with the other."""
    scene, ray = lit(BandWater(0.1, 0.5, phase)), central(looking_down(2.0), (60.0, 60.0))
    fine = pixel_light(scene, ray, Effort(2000, 20))
    plain = pixel_light(scene, ray, Effort(12000, 20, seed=2, plain=True))
    for one, other in zip(components(fine), components(plain), strict=True):
        limit = 4 * np.hypot(one.standard_error, other.standard_error)
        assert abs(one.value - other.value) < limit < 0.6 * one.value


def grid_of(height_of, half_m=20.0, spacing_m=0.1):
    """Returns the floor with the heights of a function of (x, y), as a grid."""
    at = np.linspace(-half_m, half_m, round(2 * half_m / spacing_m) + 1)
    return height_field(height_of(*np.meshgrid(at, at)), spacing_m, -half_m, -half_m)


def test_a_level_grid_is_the_level_floor():
    """The same random numbers, so the same walks, but for rounding."""
    water, ray = BandWater(0.1, 0.3, henyey_greenstein(0.8)), central(looking_down(2.0), (250.0, 60.0))
    level, grid = (
        pixel_light(lit(water, relief=one), ray, Effort(640, 8))
        for one in (LEVEL, grid_of(lambda x, y: 0 * x, 1000.0, 5.0))
    )
    np.testing.assert_allclose(grid.sums, level.sums, rtol=1e-6)


def test_a_slope_is_a_level_floor_seen_by_a_turned_camera():
    """Camera and lamps are turned about the y axis by the angle of the slope, through a point of the floor."""
    tilt, water = np.deg2rad(35.0), BandWater(0.1, 0.4, henyey_greenstein(0.8))
    turn = np.array([[np.cos(tilt), 0, -np.sin(tilt)], [0, 1, 0], [np.sin(tilt), 0, np.cos(tilt)]])  # raises the x axis
    lamps = np.column_stack([LAMPS[:, :3] @ turn.T, LAMPS[:, 3:6] @ turn.T, LAMPS[:, 6]])
    pose = looking_down(2.0)
    turned = np.eye(4)
    turned[:3, :3], turned[:3, 3] = turn @ pose[:3, :3], turn @ pose[:3, 3]
    slope, effort = grid_of(lambda x, y: np.tan(tilt) * x), Effort(2000, 20)
    level = pixel_light(lit(water), central(pose, (60.0, 60.0)), effort)
    found = pixel_light(lit(water, relief=slope, lamps=lamps), central(turned, (60.0, 60.0)), effort)
    assert found.direct.value == pytest.approx(level.direct.value, rel=1e-4)
    for one, other in zip(components(found), components(level), strict=True):
        limit = 4 * np.hypot(one.standard_error, other.standard_error)
        assert abs(one.value - other.value) < limit < 0.5 * other.value


def test_the_shadow_of_a_wall_ends_where_similar_triangles_say_and_scattering_fills_it():
    """Lamp 2 m high and 1 m before a wall of 0.5 m: without scattering, 0.5 / 1.5 m behind the wall are dark."""
    wall = grid_of(lambda x, y: np.where(np.abs(x) < 0.005, 0.5, 0.0), 3.0, 0.01)
    lamp = np.array([[-1.0, 0, 2.0, 0, 0, -1.0, 1000.0]])
    light = {}
    for b, x in ((0.0, 0.32), (0.0, 0.345), (0.5, 0.32)):
        scene = ReferenceScene(BandWater(0.05, b, henyey_greenstein(0.8)), lamp, (EVEN_BEAM,), 0.5, wall)
        pose = looking_down(2.0)
        pose[0, 3] = x
        light[b, x] = pixel_light(scene, central(pose), Effort(2000, 10))
    assert light[0.0, 0.32].total.value == 0 and light[0.5, 0.32].direct.value == 0
    d = np.hypot(1.345, 2.0)
    expected = 0.5 / np.pi * 1000 * 2.0 / d**3 * np.exp(-0.05 * (d + 2.0))
    assert light[0.0, 0.345].total.value == pytest.approx(expected, rel=1e-5)
    filling = batch_mean(light[0.5, 0.32].sums[:, LAMP_SCATTERED])
    assert filling.value > 3 * filling.standard_error > 0


def test_the_blur_of_a_pixel_keeps_the_light_and_falls_off_with_distance():
    """Light within 0.5 px per area is far denser than beyond 40 px: the kernel has a cusp and a long tail."""
    found = pixel_light(lit(BandWater(0.06, 0.3)), central(looking_down(2.0)), Effort(4000, 20))
    inner, outer = found.blurred_share(0.0, 2.0), found.blurred_share(40.0)
    shares = [found.blurred_share(low, high).value for low, high in ((0.0, 2.0), (2.0, 40.0), (40.0, np.inf))]
    assert sum(shares) == pytest.approx(1)
    assert inner.value / (np.pi * 4) > 100 * (shares[1] / (np.pi * 1600))
    assert outer.value > 0.1
    scattered, blurred, _, veil, total = components(found)
    assert total.value == pytest.approx(found.direct.value + scattered.value + blurred.value + veil.value)
    with pytest.raises(ValueError, match="not among the edges"):
        found.blurred_share(3.0)


def test_equal_seeds_give_equal_light_and_the_error_is_that_of_repetition():
    scene, ray = lit(BandWater(0.1, 0.1, henyey_greenstein(0.8))), central(looking_down(2.0))
    results = [pixel_light(scene, ray, Effort(640, 16, seed)).total for seed in range(1, 17)]
    again = pixel_light(scene, ray, Effort(640, 16, 1)).total
    assert again == results[0]
    spread = np.std([result.value for result in results], ddof=1)
    claimed = np.mean([result.standard_error for result in results])
    assert 0.5 < spread / claimed < 1.8  # 16 repetitions: 1 +- 0.18, and the errors scatter


def test_rounds_are_added_until_the_standard_error_is_reached():
    """The first round is the plain computation, later ones have other random numbers, and their number is limited."""
    scene, ray, effort = lit(BandWater(0.1, 0.1, henyey_greenstein(0.8))), central(looking_down(2.0)), Effort(320, 16)
    light_of = lambda one: pixel_light(scene, ray, one)  # noqa: E731
    first = light_of(effort)
    target = 0.4 * first.total.standard_error
    light = refined(light_of, lambda found: found.total.standard_error < target, effort, 100_000)
    assert light.total.standard_error < target and len(light.sums) >= 16 * 4
    np.testing.assert_array_equal(light.sums[:16], first.sums)
    assert len(np.unique(light.sums[:, 2])) == len(light.sums)
    assert_near(light.total, pixel_light(scene, ray, Effort(3200, 16, 9)).total.value, rel=0.05)
    assert len(refined(light_of, lambda _: False, effort, 3 * 320).sums) == 3 * 16
    assert len(refined(light_of, lambda _: False, effort, 1).sums) == 16


def test_too_few_batches_are_refused():
    with pytest.raises(TwinError, match=r"effort\.batches"):
        pixel_light(lit(BandWater(0.1, 0.1)), central(looking_down(2.0)), Effort(10, 1))
