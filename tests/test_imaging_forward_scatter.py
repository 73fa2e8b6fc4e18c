"""Forward scatter: energy is conserved, and the point spread function has the width of small-angle theory."""

import numpy as np
import pytest
from scipy.integrate import quad

from twin.imaging.forward_scatter import FORWARD_DEG, ForwardScatter, forward_scattering
from twin.imaging.water import medium, phase_function
from twin.scenario.model import Scenario, WaterConfig

RIG = Scenario.model_validate({"rig": {"image_width_px": 320, "image_height_px": 240}}).believed_rig()
SHAPE = (RIG.height_px, RIG.width_px)


def forward_scattering_per_m(water):
    return forward_scattering().share * medium(water).scattering_per_m


def ranges(depth):
    v, u = np.mgrid[: depth.shape[0], : depth.shape[1]]
    return depth * np.sqrt(1 + ((u - RIG.cx_px) ** 2 + (v - RIG.cy_px) ** 2) / RIG.focal_px**2)


@pytest.mark.parametrize("jerlov", ["I", "II", "3C"])
def test_forward_scatter_conserves_energy(jerlov):
    """For a textured, stepped floor: sum = direct exp(b_f r), which is L exp(-(c - b_f) r), within 0.1 %."""
    rng, water = np.random.default_rng(0), WaterConfig(jerlov=jerlov)
    direct = rng.uniform(0, 50, (*SHAPE, 3)).astype(np.float32)
    direct[:, 200:] *= 0.1
    depth = np.full(SHAPE, 2.0, np.float32)
    depth[:100, :150] = 0.8
    depth[200:] = np.inf  # no floor, hence no light to scatter
    direct[200:] = 0
    after = (direct + ForwardScatter(RIG, medium(water)).spread(direct, depth)).sum((0, 1), dtype=np.float64)
    with np.errstate(over="ignore", invalid="ignore"):
        thickness = forward_scattering_per_m(water) * ranges(depth)[..., None]
        growth = np.where(np.isfinite(depth)[..., None], np.exp(thickness), 0)
    np.testing.assert_allclose(after, (direct * growth).sum((0, 1)), rtol=1e-3)


def test_a_uniform_floor_is_attenuated_by_c_minus_b_f():
    """Forward scatter never makes the floor brighter than in water without scattering."""
    water = WaterConfig(jerlov="III")
    scattering = medium(water).scattering_per_m
    depth, direct = np.full(SHAPE, 2.0, np.float32), np.ones((*SHAPE, 3), np.float32)
    direct *= np.exp(-scattering * ranges(depth)[..., None])
    total = direct + ForwardScatter(RIG, medium(water)).spread(direct, depth)
    assert (total > direct).all() and (total < 1).all()
    centre = total[SHAPE[0] // 2, SHAPE[1] // 2]
    # the blur mixes in ranges up to 3 % longer than at the centre
    np.testing.assert_allclose(centre, np.exp(-(scattering - forward_scattering_per_m(water)) * 2.0), rtol=0.03)


@pytest.mark.parametrize(("jerlov", "depth_m"), [("II", 1.0), ("II", 3.0), ("3C", 2.0)])
def test_a_spot_spreads_by_the_variance_of_small_angle_theory(jerlov, depth_m):
    direct, depth = np.zeros((*SHAPE, 3), np.float32), np.full(SHAPE, depth_m, np.float32)
    direct[113:127, 151:169] = 10.0  # wider than a bin, to whose centre light is moved
    spread = ForwardScatter(RIG, medium(WaterConfig(jerlov=jerlov))).spread(direct, depth)
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    thickness = forward_scattering_per_m(WaterConfig(jerlov=jerlov)) * depth_m
    for band in range(3):
        weight = spread[..., band] / spread[..., band].sum()
        mean_u = (weight * u).sum()
        assert abs(mean_u - 159.5) < 1 and abs((weight * v).sum() - 119.5) < 1
        scatterings = thickness[band] / (1 - np.exp(-thickness[band]))
        expected = RIG.focal_px**2 * forward_scattering().variance_rad2 / 3 * scatterings
        # minus the variance of the spot itself, which is moved by up to half a bin
        assert (weight * (u - mean_u) ** 2).sum() - (18**2 - 1) / 12 == pytest.approx(expected, rel=0.05)


def test_the_forward_lobe_agrees_with_quadrature_of_the_phase_function():
    limit = np.deg2rad(FORWARD_DEG)
    share, _ = quad(lambda a: 2 * np.pi * np.sin(a) * phase_function(np.cos(a)), 0, limit)
    moment, _ = quad(lambda a: 2 * np.pi * np.sin(a) * phase_function(np.cos(a)) * a**2 / 2, 0, limit)
    assert forward_scattering().share == pytest.approx(share, rel=1e-5) and 0.7 < share < 0.78
    assert forward_scattering().variance_rad2 == pytest.approx(moment / share, rel=1e-5)


def test_water_without_scattering_adds_no_forward_scatter():
    direct = np.random.default_rng(0).uniform(0, 1, (*SHAPE, 3)).astype(np.float32)
    forward_scatter = ForwardScatter(RIG, medium(WaterConfig(jerlov="clear")))
    assert not forward_scatter.spread(direct, np.full(SHAPE, 2.0, np.float32)).any()


@pytest.mark.parametrize(("width", "height"), [(321, 243), (64, 48), (330, 250)])
def test_energy_is_conserved_for_any_image_size(width, height):
    rig = Scenario.model_validate({"rig": {"image_width_px": width, "image_height_px": height}}).believed_rig()
    direct = np.random.default_rng(0).uniform(0, 9, (height, width, 3)).astype(np.float32)
    depth = np.full((height, width), 1.5, np.float32)
    water = medium(WaterConfig(jerlov="II"))
    v, u = np.mgrid[:height, :width]
    range_m = 1.5 * np.sqrt(1 + ((u - rig.cx_px) ** 2 + (v - rig.cy_px) ** 2) / rig.focal_px**2)
    expected = (direct * np.expm1(forward_scattering_per_m(WaterConfig(jerlov="II")) * range_m[..., None])).sum((0, 1))
    got = ForwardScatter(rig, water).spread(direct, depth).sum((0, 1), dtype=np.float64)
    # scattered part only: 1 % of it is 0.3 % of the total; ranges are quantized to 1 cm of 1.5 m
    np.testing.assert_allclose(got, expected, rtol=5e-3)
