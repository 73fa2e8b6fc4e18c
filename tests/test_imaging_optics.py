"""Light: the limits in which it has a closed form, and the veil against quadrature."""

from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad, quad_vec

from twin.config import Lamp, Scenario, Sun, Water
from twin.imaging.optics import Optics, beam_share, lights_of_eye, scattered_per_m
from twin.imaging.water import FORWARDNESS, JERLOV_PER_M, medium, phase_function

RIG = Scenario.model_validate({"rig": {"image_width_px": 96, "image_height_px": 64}}).believed_rig()
CLEAR, DARK = Water(jerlov="clear"), Sun(illuminance_lx=0)
#: A lamp at the very place of the left eye, looking along its axis.
AT_EYE = Lamp(position_m=tuple(RIG.body_from_camera[:3, 3]), intensity_cd=1000.0)
TWO_LAMPS = (
    Lamp(position_m=(0.25, 0.35, -0.05), pan_deg=-8.0, intensity_cd=1500.0),
    Lamp(position_m=(0.25, -0.35, -0.05), tilt_deg=10.0, intensity_cd=900.0),
)
CENTRE = (RIG.height_px // 2, RIG.width_px // 2)


def floor(depth_m, albedo=255):
    shape = (RIG.height_px, RIG.width_px)
    return np.full((*shape, 3), albedo, np.uint8), np.full(shape, depth_m, np.float32)


def veil_per_m(lights, water, ray, range_m):
    return scattered_per_m(lights, water, ray, np.array([range_m]))[0]


def rays():
    v, u = np.mgrid[: RIG.height_px, : RIG.width_px]
    ray = np.stack([(u - RIG.cx_px) / RIG.focal_px, (v - RIG.cy_px) / RIG.focal_px, np.ones_like(u, float)], -1)
    return ray / np.linalg.norm(ray, axis=-1, keepdims=True)


def test_daylight_in_clear_water_shows_albedo_over_pi():
    rng = np.random.default_rng(0)
    albedo = rng.integers(0, 256, (RIG.height_px, RIG.width_px, 3), dtype=np.uint8)
    light = Optics(RIG, CLEAR, (), Sun(illuminance_lx=1000)).radiance(albedo, floor(3.0)[1], 0)
    np.testing.assert_allclose(light, 1000 / np.pi * albedo / 255, rtol=1e-5)


def test_a_lamp_in_clear_water_obeys_the_inverse_square_law_and_lamberts_cosine():
    optics = Optics(RIG, CLEAR, (AT_EYE,), DARK)
    light = optics.radiance(*floor(2.0), 0)
    cos = rays()[..., 2]
    # The angle of the beam and of incidence is that of view; the beam falls to 0.96 at 10 deg, straight between.
    share = np.interp(np.rad2deg(np.arccos(cos)), [0, 10, 20, 30, 35, 40], [1, 0.96, 0.87, 0.75, 0.63, 0.5])
    expected = 1000 / np.pi * share * cos * (cos / 2.0) ** 2
    np.testing.assert_allclose(light[..., 1], expected, rtol=2e-3)  # the beam's table is coarse on its axis
    np.testing.assert_allclose(optics.radiance(*floor(4.0), 0), light / 4, rtol=1e-4)


def test_doubling_the_way_squares_the_transmission():
    water = medium(Water(jerlov="II"))
    ratio = []
    for depth_m in (1.5, 3.0):
        veil = Optics(RIG, Water(jerlov="II"), (AT_EYE,), DARK).radiance(*floor(depth_m, 0), 0)[CENTRE]
        wet = Optics(RIG, Water(jerlov="II"), (AT_EYE,), DARK).radiance(*floor(depth_m), 0)[CENTRE] - veil
        ratio.append(wet / Optics(RIG, CLEAR, (AT_EYE,), DARK).radiance(*floor(depth_m), 0)[CENTRE])
    np.testing.assert_allclose(ratio[1], ratio[0] ** 2, rtol=1e-3)
    # to the floor and back; half a pixel off the axis
    np.testing.assert_allclose(ratio[0], np.exp(-water.attenuation_per_m * 3.0), rtol=1e-3)


def test_without_floor_there_is_the_veil_alone_and_it_grows_with_range():
    optics = Optics(RIG, Water(jerlov="1C"), TWO_LAMPS, DARK)
    near, far, open_water = (optics.radiance(*floor(d, 0), 0) for d in (1.0, 3.0, np.inf))
    assert (near < far).all() and (far <= open_water).all()
    np.testing.assert_array_equal(open_water, optics.radiance(*floor(np.inf, 255), 0))
    np.testing.assert_allclose(optics.radiance(*floor(1e4), 0), open_water, rtol=1e-3)


@pytest.mark.parametrize("lamps", [(), (TWO_LAMPS[0].model_copy(update={"intensity_cd": 0.0}),)])
def test_a_lamp_that_is_off_makes_no_light_and_no_veil(lamps):
    assert not Optics(RIG, Water(jerlov="9C"), lamps, DARK).radiance(*floor(2.0), 0).any()


@pytest.mark.parametrize("jerlov", ["IB", "1C", "5C"])
@pytest.mark.parametrize("eye", [0, 1])
def test_the_veil_is_the_integral_of_scattered_light(jerlov, eye):
    optics = Optics(RIG, Water(jerlov=jerlov), TWO_LAMPS, Sun(illuminance_lx=20.0))
    lights, water = lights_of_eye(RIG, TWO_LAMPS, Sun(illuminance_lx=20.0), eye), medium(Water(jerlov=jerlov))
    for depth_m in (0.7, 2.0, 6.0):
        veil = optics.radiance(*floor(depth_m, 0), eye)
        for v, u in [(0, 0), (20, 70), CENTRE, (63, 95), (63, 3)]:
            ray = rays()[v, u]
            reach = depth_m / ray[2]
            exact, _ = quad_vec(partial(veil_per_m, lights, water, ray), 0, reach, epsrel=1e-3)
            np.testing.assert_allclose(veil[v, u], exact, rtol=0.03)


def test_the_veil_of_one_lamp_agrees_with_the_formula_written_out():
    lights, water = lights_of_eye(RIG, (AT_EYE,), DARK, 0), medium(Water(jerlov="II", turbidity=2.0))
    range_m = 1.7
    got = scattered_per_m(lights, water, np.array([0.0, 0.0, 1.0]), np.array([range_m]))[0]
    b = 2.0 * np.array([0.2498, 0.3580, 0.5236])
    c = b + [0.4622, 0.0622, 0.0247]
    straight_back = (1 - FORWARDNESS**2) / (4 * np.pi * (1 + FORWARDNESS) ** 3)
    np.testing.assert_allclose(got, b * straight_back * 1000 / range_m**2 * np.exp(-2 * c * range_m), rtol=1e-12)


def test_scattered_light_goes_somewhere():
    total, _ = quad(lambda mu: 2 * np.pi * phase_function(np.array(mu)), -1, 1)
    mean_cosine, _ = quad(lambda mu: 2 * np.pi * mu * phase_function(np.array(mu)), -1, 1)
    assert total == pytest.approx(1.0, abs=1e-9) and mean_cosine == pytest.approx(FORWARDNESS, abs=1e-9)


def test_beams_tilt_to_the_bow_and_pan_to_port():
    straight = lights_of_eye(RIG, (AT_EYE,), DARK, 0)
    np.testing.assert_allclose(straight.axis, [[0, 0, 1]], atol=1e-12)
    bow = lights_of_eye(RIG, (AT_EYE.model_copy(update={"tilt_deg": 90.0}),), DARK, 0)
    np.testing.assert_allclose(bow.axis, [[0, -1, 0]], atol=1e-12)  # up in the image
    port = lights_of_eye(RIG, (AT_EYE.model_copy(update={"pan_deg": 90.0}),), DARK, 0)
    np.testing.assert_allclose(port.axis, [[-1, 0, 0]], atol=1e-12)  # left in the image
    right = lights_of_eye(RIG, (AT_EYE,), DARK, 1)
    np.testing.assert_allclose(right.position_m, [[-RIG.baseline_m, 0, 0]], atol=1e-12)


@given(slope_x=st.floats(-0.5, 0.5), slope_y=st.floats(-0.5, 0.5))
def test_a_slanted_floor_is_lit_by_the_cosine_to_its_normal(slope_x, slope_y):
    # A plane z = 2 + slope_x x + slope_y y seen along ray (x', y', 1): depth = 2 / (1 - slope_x x' - slope_y y').
    ray = rays() / rays()[..., 2:]
    depth = 2.0 / (1 - slope_x * ray[..., 0] - slope_y * ray[..., 1])
    albedo, _ = floor(2.0)
    light = Optics(RIG, CLEAR, (AT_EYE,), DARK).radiance(albedo, depth.astype(np.float32), 0)
    normal = np.array([slope_x, slope_y, -1.0]) / np.sqrt(1 + slope_x**2 + slope_y**2)
    cos = np.maximum(-rays() @ normal, 0)
    expected = 1000 / np.pi * beam_share(rays()[..., 2]) * cos / (depth**2 * (ray**2).sum(-1))
    # The smaller one-sided slope is off by half a pixel's bend of depth: about slope / focal, under 1 % of the cosine.
    np.testing.assert_allclose(light[..., 1], expected, rtol=2e-2, atol=0.2)


def test_the_floor_beside_an_edge_keeps_its_light():
    albedo, depth = floor(2.0)
    whole = Optics(RIG, CLEAR, TWO_LAMPS, DARK).radiance(albedo, depth, 0)
    depth[:, 50:] = np.inf
    cut = Optics(RIG, CLEAR, TWO_LAMPS, DARK).radiance(albedo, depth, 0)
    np.testing.assert_array_equal(cut[:, :50], whole[:, :50])
    assert not cut[:, 50:].any()


def test_jerlov_types_grow_murkier_in_order():
    green = [sum(JERLOV_PER_M[name][k][1] for k in (0, 1)) for name in ("clear", "I", "IA", "IB", "II", "III")]
    coast = [sum(JERLOV_PER_M[name][k][1] for k in (0, 1)) for name in ("1C", "3C", "5C", "7C", "9C")]
    assert green == sorted(green) and coast == sorted(coast)
