"""Forward scatter: no light is lost or doubled, and it spreads as far as the theory of small angles says."""

import numpy as np
import pytest
from scipy.integrate import quad

from twin.imaging.forward_scatter import FORWARD_DEG, ForwardScatter, forward_lobe
from twin.imaging.water import medium, phase_function
from twin.scenario.model import Scenario, WaterConfig

RIG = Scenario.model_validate({"rig": {"image_width_px": 320, "image_height_px": 240}}).believed_rig()
SHAPE = (RIG.height_px, RIG.width_px)


def b_f(water):
    return forward_lobe().share * medium(water).scattering_per_m


def ranges(depth):
    v, u = np.mgrid[: depth.shape[0], : depth.shape[1]]
    return depth * np.sqrt(1 + ((u - RIG.cx_px) ** 2 + (v - RIG.cy_px) ** 2) / RIG.focal_px**2)


@pytest.mark.parametrize("jerlov", ["I", "II", "3C"])
def test_energy_is_that_of_the_light_before_it_was_scattered(jerlov):
    """Textured, over a stepped floor: after = direct exp(b_f r), which is L exp(-(c - b_f) r), to 0.1 %."""
    rng, water = np.random.default_rng(0), WaterConfig(jerlov=jerlov)
    direct = rng.uniform(0, 50, (*SHAPE, 3)).astype(np.float32)
    direct[:, 200:] *= 0.1
    depth = np.full(SHAPE, 2.0, np.float32)
    depth[:100, :150] = 0.8
    depth[200:] = np.inf  # open water has no floor to scatter from
    direct[200:] = 0
    after = (direct + ForwardScatter(RIG, medium(water)).spread(direct, depth)).sum((0, 1), dtype=np.float64)
    with np.errstate(over="ignore", invalid="ignore"):
        growth = np.where(np.isfinite(depth)[..., None], np.exp(b_f(water) * ranges(depth)[..., None]), 0)
    np.testing.assert_allclose(after, (direct * growth).sum((0, 1)), rtol=1e-3)


def test_light_is_not_doubled():
    """An even floor arrives as if attenuated by c - b_f: never as bright as without scattering."""
    water = WaterConfig(jerlov="III")
    scattering = medium(water).scattering_per_m
    depth, direct = np.full(SHAPE, 2.0, np.float32), np.ones((*SHAPE, 3), np.float32)
    direct *= np.exp(-scattering * ranges(depth)[..., None])
    whole = direct + ForwardScatter(RIG, medium(water)).spread(direct, depth)
    assert (whole > direct).all() and (whole < 1).all()
    centre = whole[SHAPE[0] // 2, SHAPE[1] // 2]
    # the blur mixes ranges of up to 3 % more than that of the centre
    np.testing.assert_allclose(centre, np.exp(-(scattering - b_f(water)) * 2.0), rtol=0.03)


@pytest.mark.parametrize(("jerlov", "depth_m"), [("II", 1.0), ("II", 3.0), ("3C", 2.0)])
def test_a_spot_spreads_by_the_variance_of_small_angles(jerlov, depth_m):
    direct, depth = np.zeros((*SHAPE, 3), np.float32), np.full(SHAPE, depth_m, np.float32)
    direct[113:127, 151:169] = 10.0  # wider than a bin, whose light moves to its middle
    spread = ForwardScatter(RIG, medium(WaterConfig(jerlov=jerlov))).spread(direct, depth)
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    thick = b_f(WaterConfig(jerlov=jerlov)) * depth_m
    for band in range(3):
        weight = spread[..., band] / spread[..., band].sum()
        mean_u = (weight * u).sum()
        assert abs(mean_u - 159.5) < 1 and abs((weight * v).sum() - 119.5) < 1
        scatterings = thick[band] / (1 - np.exp(-thick[band]))
        expected = RIG.focal_px**2 * forward_lobe().variance_rad2 / 3 * scatterings
        # the spot's own variance besides; its parts of bins move by up to half of one
        assert (weight * (u - mean_u) ** 2).sum() - (18**2 - 1) / 12 == pytest.approx(expected, rel=0.05)


def test_the_forward_lobe_is_that_part_of_the_phase_function():
    limit = np.deg2rad(FORWARD_DEG)
    share, _ = quad(lambda a: 2 * np.pi * np.sin(a) * phase_function(np.cos(a)), 0, limit)
    moment, _ = quad(lambda a: 2 * np.pi * np.sin(a) * phase_function(np.cos(a)) * a**2 / 2, 0, limit)
    assert forward_lobe().share == pytest.approx(share, rel=1e-5) and 0.7 < share < 0.78
    assert forward_lobe().variance_rad2 == pytest.approx(moment / share, rel=1e-5)


def test_water_that_does_not_scatter_leaves_the_image_as_it_is():
    direct = np.random.default_rng(0).uniform(0, 1, (*SHAPE, 3)).astype(np.float32)
    assert (
        not ForwardScatter(RIG, medium(WaterConfig(jerlov="clear")))
        .spread(direct, np.full(SHAPE, 2.0, np.float32))
        .any()
    )


@pytest.mark.parametrize(("width", "height"), [(321, 243), (64, 48), (330, 250)])
def test_images_of_any_size_keep_their_energy(width, height):
    rig = Scenario.model_validate({"rig": {"image_width_px": width, "image_height_px": height}}).believed_rig()
    direct = np.random.default_rng(0).uniform(0, 9, (height, width, 3)).astype(np.float32)
    depth = np.full((height, width), 1.5, np.float32)
    water = medium(WaterConfig(jerlov="II"))
    v, u = np.mgrid[:height, :width]
    range_m = 1.5 * np.sqrt(1 + ((u - rig.cx_px) ** 2 + (v - rig.cy_px) ** 2) / rig.focal_px**2)
    expected = (direct * np.expm1(b_f(WaterConfig(jerlov="II")) * range_m[..., None])).sum((0, 1))
    got = ForwardScatter(rig, water).spread(direct, depth).sum((0, 1), dtype=np.float64)
    # of the scattered part alone, so that 1 % of it is 0.3 % of all: ranges are told to 1 cm of 1.5 m at worst
    np.testing.assert_allclose(got, expected, rtol=5e-3)
