"""Marine snow: consistent in both cameras and over time, with radiance by size and illumination."""

import numpy as np
import pytest

from twin.core import geometry
from twin.imaging.illumination import daylight_at
from twin.imaging.lamps import light_sources_in_camera
from twin.imaging.snow import APERTURE_M, BOX_M, MarineSnow
from twin.imaging.water import medium
from twin.scenario.model import LampConfig, Scenario, SnowConfig, SunConfig, WaterConfig

RIG = Scenario.model_validate({"rig": {"image_width_px": 320, "image_height_px": 240}}).believed_rig()
SHAPE = (RIG.height_px, RIG.width_px)
LAMPS = (LampConfig(position_m=(0.2, 0.3, 0.0), intensity_cd=1000.0),)
POSE = geometry.pose(
    geometry.rotation_from_rpy(0.05, -0.1, 0.6) @ geometry.BODY_FROM_DOWN_CAMERA, np.array([1, -2, 2.0])
)


def light_sources(camera):
    """Returns the lamps in a camera, without daylight."""
    no_daylight = daylight_at(SunConfig(illuminance_lx=0.0), medium(WaterConfig(jerlov="II")), 0.0)
    return light_sources_in_camera(RIG, LAMPS, no_daylight, camera)


def marine_snow(density=40.0, diameter_m=0.002, current=(0.0, 0.0, 0.0), water="II", seed=0):
    properties, sources = medium(WaterConfig(jerlov=water)), [light_sources(camera) for camera in (0, 1)]
    keys = SnowConfig(density_per_m3=density, diameter_m=diameter_m)
    return MarineSnow(keys, np.array(current), RIG, properties, sources, np.random.default_rng(seed))


def draw(snow, camera=0, pose=POSE, time_s=0.0, depth_m=np.inf):
    light = np.zeros((*SHAPE, 3), np.float32)
    snow.draw(light, np.full(SHAPE, depth_m, np.float32), pose, camera, time_s)
    return light


def test_a_particle_has_the_disparity_of_its_depth():
    """In the images of both cameras, for one particle at a time, by the centroid of its light."""
    snow, n_tested = marine_snow(density=20.0), 0
    all_starts_m = snow._start_m.copy()
    for k in range(len(all_starts_m)):
        snow._start_m = all_starts_m[k : k + 1]
        left, right = (snow.visible_particles(POSE, camera, 0.0) for camera in (0, 1))
        if len(left.depth_m) + len(right.depth_m) < 2 or left.depth_m[0] > 2:
            continue
        margin = 0.5 * (RIG.focal_px * APERTURE_M / left.depth_m[0]) + 3
        inside = [np.all((f.pixel[0] > margin) & (f.pixel[0] < np.array(SHAPE[::-1]) - margin)) for f in (left, right)]
        if not all(inside):
            continue
        centres = [centroid(draw(snow, camera)[..., 1]) for camera in (0, 1)]
        disparity = RIG.focal_px * RIG.baseline_m / left.depth_m[0]
        # the centroid of a disc with a soft rim has an error of 0.1 px
        np.testing.assert_allclose(centres[0] - centres[1], [disparity, 0], atol=0.2)
        n_tested += 1
    assert n_tested >= 20


def centroid(image):
    v, u = np.mgrid[: image.shape[0], : image.shape[1]]
    return np.array([(image * u).sum(), (image * v).sum()]) / image.sum()


def test_particles_are_fixed_in_the_world_and_drift_with_the_current():
    still, carried = marine_snow(), marine_snow(current=(0.2, -0.1, 0.05))
    moved = np.array([0.3, 0.2, -0.1])
    a, b = still.positions(POSE[:3, 3], 0.0), still.positions(POSE[:3, 3] + moved, 7.0)
    same = np.linalg.norm(a - b, axis=1) < 1e-9
    # the other particles left the box and re-entered on its other side
    assert same.mean() == pytest.approx(np.prod(1 - np.abs(moved) / BOX_M), abs=0.02)
    np.testing.assert_allclose(np.abs(b - a)[~same].max(axis=1), BOX_M)
    c = carried.positions(POSE[:3, 3], 2.0) - carried.positions(POSE[:3, 3], 0.0)
    np.testing.assert_allclose((c + BOX_M / 2) % BOX_M - BOX_M / 2, np.tile([0.4, -0.2, 0.1], (len(c), 1)), atol=1e-9)


def test_the_density_around_the_vehicle_is_constant():
    for position in (np.zeros(3), np.array([40.0, -17.0, 3.0])):
        points = marine_snow(density=100.0).positions(position, 5.0) - position
        assert len(points) == 100 * BOX_M**3 and np.abs(points).max() <= BOX_M / 2 + 1e-9
        octants = np.bincount((points > 0) @ [1, 2, 4], minlength=8)
        assert np.abs(octants - len(points) / 8).max() < 5 * np.sqrt(len(points) / 8)


def single(depth_m, **kwargs):
    """Returns marine snow of one particle on the axis of the left camera."""
    snow = marine_snow(**kwargs)
    snow._start_m = geometry.transform(POSE, np.array([[0.0, 0.0, depth_m]]))
    return snow


@pytest.mark.parametrize("camera", [0, 1])
def test_radiance_follows_the_inverse_square_law_and_attenuation_on_both_paths(camera):
    sources = light_sources(camera)
    water = medium(WaterConfig(jerlov="II"))
    point = np.array([-camera * RIG.baseline_m, 0.0, 1.2])
    from_lamp = point - sources.position_m[0]
    distance = np.linalg.norm(from_lamp)
    share = np.interp(np.rad2deg(np.arccos(from_lamp @ sources.axis[0] / distance)), [10, 20, 30], [0.96, 0.87, 0.75])
    path_m = distance + np.linalg.norm(point)
    expected = 0.5 / np.pi * 1000 * share / distance**2 * np.exp(-water.attenuation_per_m * path_m)
    np.testing.assert_allclose(single(1.2).visible_particles(POSE, camera, 0.0).radiance[0], expected, rtol=1e-9)


@pytest.mark.parametrize("depth_m", [0.3, 0.8, 2.0])
def test_blur_does_not_change_the_total_light_of_a_particle(depth_m):
    snow = single(depth_m, diameter_m=0.001, water="clear")
    particle = snow.visible_particles(POSE, 0, 0.0)
    cover_px2 = np.pi / 4 * (RIG.focal_px * 0.001 / depth_m) ** 2
    np.testing.assert_allclose(draw(snow).sum((0, 1)), cover_px2 * particle.radiance[0], rtol=1e-4)


def test_nearer_particles_are_more_out_of_focus():
    widths = []
    for depth_m in (0.2, 0.5, 2.0):
        light = draw(single(depth_m, diameter_m=0.0005))[..., 1]
        widths.append(2 * np.sqrt((light > 0).sum() / np.pi))
    # defocus by the aperture, f A / z = 5.5 px at 0.2 m, plus a soft rim of half a pixel on both sides
    assert widths[0] > widths[1] > widths[2]
    assert widths[0] == pytest.approx(np.hypot(RIG.focal_px * APERTURE_M / 0.2, 1.0) + 1, rel=0.1)


def test_particles_occlude_the_floor_and_are_occluded_by_it():
    snow = single(0.5, diameter_m=0.02, water="clear")
    light = np.full((*SHAPE, 3), 1e4, np.float32)
    snow.draw(light, np.full(SHAPE, 2.0, np.float32), POSE, 0, 0.0)
    middle = light[SHAPE[0] // 2, SHAPE[1] // 2]
    particle = snow.visible_particles(POSE, 0, 0.0).radiance[0]
    assert (middle < 0.2e4).all() and (middle >= particle * 0.8).all()
    assert not draw(snow, depth_m=0.4).any()


def test_particles_depend_on_the_random_stream_only():
    a, b, c = marine_snow(seed=1), marine_snow(seed=1), marine_snow(seed=2)
    np.testing.assert_array_equal(draw(a, 1), draw(b, 1))
    assert (draw(a) != draw(c)).any()


def test_the_snow_stream_is_last_so_that_other_streams_are_unchanged():
    from twin.world.world import _STREAMS

    assert _STREAMS[:7] == ("left_camera", "right_camera", "navigation", "dvl", "usbl", "beacons", "snow")
    seven, six = (np.random.SeedSequence(1).spawn(n) for n in (7, 6))
    assert all((a.generate_state(4) == b.generate_state(4)).all() for a, b in zip(six, seven, strict=False))
