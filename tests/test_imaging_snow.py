"""Marine snow: the same particles in both cameras and from frame to frame, as bright as their size and light say."""

import numpy as np
import pytest

from twin.core import geometry
from twin.imaging import snow as module
from twin.imaging.lamps import Daylight, lights_of_eye
from twin.imaging.snow import BOX_M, PUPIL_M
from twin.imaging.water import medium
from twin.scenario.model import LampConfig, Scenario, SnowConfig, WaterConfig

RIG = Scenario.model_validate({"rig": {"image_width_px": 320, "image_height_px": 240}}).believed_rig()
SHAPE = (RIG.height_px, RIG.width_px)
LAMPS = (LampConfig(position_m=(0.2, 0.3, 0.0), intensity_cd=1000.0),)
POSE = geometry.pose(
    geometry.rotation_from_rpy(0.05, -0.1, 0.6) @ geometry.BODY_FROM_DOWN_CAMERA, np.array([1, -2, 2.0])
)


def falling(density=40.0, diameter_m=0.002, current=(0.0, 0.0, 0.0), water="II", seed=0):
    sea = WaterConfig(jerlov=water)
    lights = [lights_of_eye(RIG, LAMPS, Daylight(np.zeros(3), np.zeros(3)), eye) for eye in (0, 1)]
    keys = SnowConfig(density_per_m3=density, diameter_m=diameter_m)
    return module.Snow(keys, np.array(current), RIG, medium(sea), lights, np.random.default_rng(seed))


def drawn(snow, eye=0, pose=POSE, time_s=0.0, depth_m=np.inf):
    light = np.zeros((*SHAPE, 3), np.float32)
    snow.draw(light, np.full(SHAPE, depth_m, np.float32), pose, eye, time_s)
    return light


def test_left_and_right_see_the_same_particle_at_the_disparity_of_its_range():
    """In the images, not only in the list: one particle at a time, its centre of light in both cameras."""
    snow, found = falling(density=20.0), 0
    everything = snow._start_m.copy()
    for k in range(len(everything)):
        snow._start_m = everything[k : k + 1]
        left, right = (snow.flakes(POSE, eye, 0.0) for eye in (0, 1))
        if len(left.depth_m) + len(right.depth_m) < 2 or left.depth_m[0] > 2:
            continue
        margin = 0.5 * (RIG.focal_px * PUPIL_M / left.depth_m[0]) + 3
        inside = [np.all((f.pixel[0] > margin) & (f.pixel[0] < np.array(SHAPE[::-1]) - margin)) for f in (left, right)]
        if not all(inside):
            continue
        centres = [centre(drawn(snow, eye)[..., 1]) for eye in (0, 1)]
        disparity = RIG.focal_px * RIG.baseline_m / left.depth_m[0]
        # a disc of a soft rim on whole pixels is centred to a tenth of a pixel
        np.testing.assert_allclose(centres[0] - centres[1], [disparity, 0], atol=0.2)
        found += 1
    assert found >= 20


def centre(image):
    v, u = np.mgrid[: image.shape[0], : image.shape[1]]
    return np.array([(image * u).sum(), (image * v).sum()]) / image.sum()


def test_particles_stay_where_they_are_while_the_vehicle_moves_and_drift_with_the_current():
    still, carried = falling(), falling(current=(0.2, -0.1, 0.05))
    moved = np.array([0.3, 0.2, -0.1])
    a, b = still.positions(POSE[:3, 3], 0.0), still.positions(POSE[:3, 3] + moved, 7.0)
    same = np.linalg.norm(a - b, axis=1) < 1e-9
    # those that left the box came back on its other side: a share of about the sum of the moves by the side
    assert same.mean() == pytest.approx(np.prod(1 - np.abs(moved) / BOX_M), abs=0.02)
    np.testing.assert_allclose(np.abs(b - a)[~same].max(axis=1), BOX_M)
    c = carried.positions(POSE[:3, 3], 2.0) - carried.positions(POSE[:3, 3], 0.0)
    np.testing.assert_allclose((c + BOX_M / 2) % BOX_M - BOX_M / 2, np.tile([0.4, -0.2, 0.1], (len(c), 1)), atol=1e-9)


def test_there_are_as_many_as_asked_around_the_vehicle_wherever_it_is():
    for place in (np.zeros(3), np.array([40.0, -17.0, 3.0])):
        points = falling(density=100.0).positions(place, 5.0) - place
        assert len(points) == 100 * BOX_M**3 and np.abs(points).max() <= BOX_M / 2 + 1e-9
        octants = np.bincount((points > 0) @ [1, 2, 4], minlength=8)
        assert np.abs(octants - len(points) / 8).max() < 5 * np.sqrt(len(points) / 8)


def single(depth_m, **kwargs):
    """A snow of one particle on the axis of the left camera."""
    snow = falling(**kwargs)
    snow._start_m = geometry.transform(POSE, np.array([[0.0, 0.0, depth_m]]))
    return snow


@pytest.mark.parametrize("eye", [0, 1])
def test_light_obeys_the_inverse_square_law_and_both_ways_of_water(eye):
    lights = lights_of_eye(RIG, LAMPS, Daylight(np.zeros(3), np.zeros(3)), eye)
    water = medium(WaterConfig(jerlov="II"))
    point = np.array([-eye * RIG.baseline_m, 0.0, 1.2])
    way = point - lights.position_m[0]
    distance = np.linalg.norm(way)
    share = np.interp(np.rad2deg(np.arccos(way @ lights.axis[0] / distance)), [10, 20, 30], [0.96, 0.87, 0.75])
    both_ways_m = distance + np.linalg.norm(point)
    expected = 0.5 / np.pi * 1000 * share / distance**2 * np.exp(-water.attenuation_per_m * both_ways_m)
    np.testing.assert_allclose(single(1.2).flakes(POSE, eye, 0.0).radiance[0], expected, rtol=1e-9)


@pytest.mark.parametrize("depth_m", [0.3, 0.8, 2.0])
def test_a_particle_sends_the_light_of_its_area_whatever_it_is_blurred_to(depth_m):
    snow = single(depth_m, diameter_m=0.001, water="clear")
    flake = snow.flakes(POSE, 0, 0.0)
    cover_px2 = np.pi / 4 * (RIG.focal_px * 0.001 / depth_m) ** 2
    np.testing.assert_allclose(drawn(snow).sum((0, 1)), cover_px2 * flake.radiance[0], rtol=1e-4)


def test_the_nearer_the_more_out_of_focus():
    widths = []
    for depth_m in (0.2, 0.5, 2.0):
        seen = drawn(single(depth_m, diameter_m=0.0005))[..., 1]
        widths.append(2 * np.sqrt((seen > 0).sum() / np.pi))
    # the pupil's image, f A / z = 5.5 px at 0.2 m, and a soft rim of half a pixel on both sides
    assert widths[0] > widths[1] > widths[2]
    assert widths[0] == pytest.approx(np.hypot(RIG.focal_px * PUPIL_M / 0.2, 1.0) + 1, rel=0.1)


def test_a_large_particle_hides_the_floor_and_the_floor_hides_what_lies_below_it():
    snow = single(0.5, diameter_m=0.02, water="clear")
    light = np.full((*SHAPE, 3), 1e4, np.float32)
    snow.draw(light, np.full(SHAPE, 2.0, np.float32), POSE, 0, 0.0)
    middle = light[SHAPE[0] // 2, SHAPE[1] // 2]
    flake = snow.flakes(POSE, 0, 0.0).radiance[0]
    assert (middle < 0.2e4).all() and (middle >= flake * 0.8).all()
    assert not drawn(snow, depth_m=0.4).any()


def test_streams_place_it_and_nothing_else_does():
    a, b, c = falling(seed=1), falling(seed=1), falling(seed=2)
    np.testing.assert_array_equal(drawn(a, 1), drawn(b, 1))
    assert (drawn(a) != drawn(c)).any()


def test_its_stream_is_the_last_so_that_earlier_draws_are_as_they_were():
    from twin.world.world import _STREAMS

    assert _STREAMS[:7] == ("left_camera", "right_camera", "navigation", "dvl", "usbl", "beacons", "snow")
    seven, six = (np.random.SeedSequence(1).spawn(n) for n in (7, 6))
    assert all((a.generate_state(4) == b.generate_state(4)).all() for a, b in zip(six, seven, strict=False))
