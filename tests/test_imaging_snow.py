"""Marine snow: consistent in both cameras and over time, with radiance by size and illumination."""

import numpy as np
import pytest
from scipy.optimize import brentq

from twin.core import geometry
from twin.errors import TwinError
from twin.imaging.camera.lens_psf import Defocus
from twin.imaging.camera.ray_sampling import RowMotion, sample_rays
from twin.imaging.camera.shutter import ExposureMotion
from twin.imaging.image_formation import ImageFormation, RenderedView, StampedPose
from twin.imaging.light.illumination import daylight_at, illumination_of
from twin.imaging.light.lamp_light import LampLight
from twin.imaging.light.lamps import light_sources_in_camera
from twin.imaging.light.water import medium
from twin.imaging.snow import APERTURE_M, BOX_M, MarineSnow, _into_camera, diameters
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
    properties = medium(WaterConfig(jerlov=water), "single")
    sources = [LampLight(light_sources(camera), properties) for camera in (0, 1)]
    keys = SnowConfig(density_per_m3=density, diameter_m=diameter_m)
    return MarineSnow(keys, np.array(current), RIG, sources, np.random.default_rng(seed))


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


def positions(snow, centre_m, time_s):
    """Returns the particle positions (n, 3) in the world [m], in the box around a centre (3,)."""
    low, points = centre_m - BOX_M / 2, np.empty((3, len(snow._start_m)))
    _into_camera(snow._start_m, snow._current_mps * time_s - low, low, snow._box_m, np.eye(4), points)
    return points.T


def test_particles_are_fixed_in_the_world_and_drift_with_the_current():
    still, carried = marine_snow(), marine_snow(current=(0.2, -0.1, 0.05))
    moved = np.array([0.3, 0.2, -0.1])
    a, b = positions(still, POSE[:3, 3], 0.0), positions(still, POSE[:3, 3] + moved, 7.0)
    same = np.linalg.norm(a - b, axis=1) < 1e-9
    # the other particles left the box and re-entered on its other side
    assert same.mean() == pytest.approx(np.prod(1 - np.abs(moved) / BOX_M), abs=0.02)
    np.testing.assert_allclose(np.abs(b - a)[~same].max(axis=1), BOX_M)
    c = positions(carried, POSE[:3, 3], 2.0) - positions(carried, POSE[:3, 3], 0.0)
    np.testing.assert_allclose((c + BOX_M / 2) % BOX_M - BOX_M / 2, np.tile([0.4, -0.2, 0.1], (len(c), 1)), atol=1e-9)


def test_the_density_around_the_vehicle_is_constant():
    for position in (np.zeros(3), np.array([40.0, -17.0, 3.0])):
        points = positions(marine_snow(density=100.0), position, 5.0) - position
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


def distribution(exponent, low_m=0.0005, high_m=0.01, n=40000):
    keys = SnowConfig(density_per_m3=1.0, junge_exponent=exponent, diameter_min_m=low_m, diameter_max_m=high_m)
    return diameters(keys, n, np.random.default_rng(3))


@pytest.mark.parametrize("exponent", [2.5, 4.0, 5.5])
def test_the_maximum_likelihood_exponent_of_the_sizes_is_that_of_the_distribution(exponent):
    sizes, (low, high) = distribution(exponent), (0.0005, 0.01)
    assert sizes.min() >= low and sizes.max() <= high

    def mean_log(j):
        """Returns the mean of log(D / low) of a power law of exponent j between the limits, by quadrature."""
        x = np.linspace(0, np.log(high / low), 20001)
        weight = np.exp((1 - j) * x)
        return (x * weight).sum() / weight.sum()

    # the likelihood is largest where the mean logarithm equals that of the sizes
    found = brentq(lambda j: mean_log(j) - np.log(sizes / low).mean(), 1.01, 9)
    assert found == pytest.approx(exponent, abs=4 * (exponent - 1) / np.sqrt(len(sizes)))


def test_equal_particles_draw_no_random_numbers():
    rng = np.random.default_rng(3)
    assert diameters(SnowConfig(diameter_m=0.002), 10, rng).tolist() == [0.002]
    assert rng.uniform() == np.random.default_rng(3).uniform()


def test_large_particles_of_a_distribution_give_more_light():
    properties = medium(WaterConfig(jerlov="clear"))
    sources = [LampLight(light_sources(camera), properties) for camera in (0, 1)]
    keys = SnowConfig(density_per_m3=40, junge_exponent=3, diameter_min_m=0.0005, diameter_max_m=0.01)
    snow = MarineSnow(keys, np.zeros(3), RIG, sources, np.random.default_rng(1))
    seen = snow.visible_particles(POSE, 0, 0.0)
    inside = np.all((seen.pixel > 30) & (seen.pixel < np.array(SHAPE[::-1]) - 30), axis=1)
    cover_px2 = np.pi / 4 * (RIG.focal_px * seen.diameter_m / seen.depth_m) ** 2
    assert np.ptp(seen.diameter_m) > 0.002 and inside.sum() > 20
    for k in np.flatnonzero(inside)[:10]:
        index = np.argmin(np.linalg.norm(snow.visible_particles(POSE, 0, 0.0).points_m - seen.points_m[k], axis=1))
        alone = MarineSnow(keys, np.zeros(3), RIG, sources, np.random.default_rng(1))
        starts, sizes = alone._start_m, alone._diameter_m
        which = np.argmin(np.abs(sizes - seen.diameter_m[index]))
        alone._start_m, alone._diameter_m = starts[which : which + 1], sizes[which : which + 1]
        if cover_px2[k] < 3:
            np.testing.assert_allclose(draw(alone).sum((0, 1)), cover_px2[k] * seen.radiance[k], rtol=1e-3)


def streak(depth_m, twist, exposure_s, readout_s=0.0, current=(0.0, 0.0, 0.0), offset_px=(0.0, 0.0)):
    """Returns the green image of one particle near the axis of a moving camera."""
    snow, light = single(depth_m, diameter_m=0.0005, current=current), np.zeros((*SHAPE, 3), np.float32)
    aside_m = np.array(offset_px) * depth_m / RIG.focal_px
    snow._start_m = geometry.transform(POSE, np.array([[*aside_m, depth_m]]))
    motion = ExposureMotion(np.array(twist), exposure_s, readout_s)
    snow.draw(light, np.full(SHAPE, np.inf, np.float32), POSE, 0, 0.0, motion)
    return light[..., 1].astype(float)


@pytest.mark.parametrize("depth_m", [0.4, 1.0, 2.0])
@pytest.mark.parametrize("velocity_mps", [(0.8, 0.0), (0.0, 0.8), (-0.6, 0.9)])
def test_the_length_of_a_streak_is_speed_times_exposure(velocity_mps, depth_m):
    """By the variance of the light along the path, to which a path of even speed adds length^2 / 12."""
    exposure_s, direction = 0.02, np.array(velocity_mps) / np.linalg.norm(velocity_mps)
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]

    def spread(image):
        along, share = u * direction[0] + v * direction[1], image / image.sum()
        return (share * along**2).sum() - (share * along).sum() ** 2

    length_px = RIG.focal_px * np.linalg.norm(velocity_mps) * exposure_s / depth_m
    grown = []
    for offset_px in np.random.default_rng(2).uniform(-0.5, 0.5, (40, 2)):  # pixels sample small discs coarsely
        rest, moved = (
            streak(depth_m, (0, 0, 0, *w, 0), exposure_s, offset_px=offset_px) for w in ((0.0, 0.0), velocity_mps)
        )
        grown.append(spread(moved) - spread(rest))
        assert moved.sum() == pytest.approx(rest.sum(), rel=1e-4) and moved.max() < rest.max()
    assert np.sqrt(12 * np.mean(grown)) == pytest.approx(length_px, rel=0.02)


def test_particles_that_drift_with_the_camera_are_not_streaked():
    velocity_mps = POSE[:3, :3] @ [0.5, -0.3, 0.0]
    moved = streak(1.0, (0, 0, 0, 0.5, -0.3, 0.0), 0.02, 0.01, current=tuple(velocity_mps))
    np.testing.assert_allclose(moved, streak(1.0, np.zeros(6), 0.02), atol=1e-6)


def test_a_rolling_shutter_moves_particles_as_it_moves_the_floor():
    """A particle near the top of the image of a camera that moves to the right is read early: it is displaced right."""
    snow, light = single(1.0, diameter_m=0.002), np.zeros((*SHAPE, 3), np.float32)
    snow._start_m = geometry.transform(POSE, np.array([[0.0, -0.3, 1.0]]))
    at_rest = snow.visible_particles(POSE, 0, 0.0).pixel[0]
    readout_s, speed_mps = 0.02, 1.0
    twist = np.array([0, 0, 0, speed_mps, 0, 0])
    snow.draw(light, np.full(SHAPE, np.inf, np.float32), POSE, 0, 0.0, ExposureMotion(twist, 0.0, readout_s))
    delay_s = readout_s * (at_rest[1] / (SHAPE[0] - 1) - 0.5)
    assert delay_s < -0.005
    moved_px = centroid(light[..., 1]) - at_rest
    np.testing.assert_allclose(moved_px, [-RIG.focal_px * speed_mps * delay_s, 0], atol=0.2)


@pytest.mark.parametrize("axis", range(6))
def test_a_rolling_shutter_that_is_applied_later_images_particles_at_the_same_place(axis):
    """The floor lies behind the particle, so it moves less in the image, by which the drawn image is shifted later."""
    twist, readout_s = 0.8 * np.eye(6)[axis], 0.02
    depth = np.full(SHAPE, 2.0, np.float32)
    images = []
    for rolls_later in (False, True):
        snow, light = single(0.8, diameter_m=0.002), np.zeros((*SHAPE, 3), np.float32)
        snow._start_m = geometry.transform(POSE, np.array([[0.1, -0.25, 0.8]]))
        snow.draw(light, depth, POSE, 0, 0.0, ExposureMotion(twist, 0.0, readout_s, rolls_later))
        images.append(light)
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    positions = np.stack([u, v], -1).astype(np.float32)
    motion = RowMotion(twist, readout_s, RIG.focal_px, (RIG.cx_px, RIG.cy_px))
    rolled = sample_rays(images[1], depth, positions, None, motion)
    # paths of 0.5 to 2.5 px; pixels sample small discs coarsely
    np.testing.assert_allclose(centroid(rolled[..., 1]), centroid(images[0][..., 1]), atol=0.1)


def test_particles_in_focus_are_smaller_than_those_out_of_focus():
    widths = []
    for focus_m in (0.5, 3.0):
        snow = single(0.5, diameter_m=0.0005)
        snow._defocus = Defocus(0.01, 1 / focus_m)
        widths.append((draw(snow)[..., 1] > 0).sum())
    assert widths[0] < widths[1] / 4


def test_drawing_does_not_depend_on_the_number_of_bands(monkeypatch):
    snow, motion = marine_snow(density=200.0), ExposureMotion(np.array([0, 0.2, 0, 0.5, 0.3, 0]), 0.02, 0.01)
    images = []
    for threads in (1, 2):
        monkeypatch.setattr("twin.core.threads._n_processors", lambda n=threads: n)
        light = np.zeros((*SHAPE, 3), np.float32)
        snow.draw(light, np.full(SHAPE, 2.0, np.float32), POSE, 0, 0.0, motion)
        images.append(light)
    np.testing.assert_array_equal(*images)


def test_particles_get_the_daylight_of_the_actual_depth_of_the_camera():
    """The reference plane is 20 m deep and the camera 2 m above it; the planned altitude does not matter."""
    water, sun = medium(WaterConfig(jerlov="III"), "single"), SunConfig(illuminance_lx=1e4, depth_m=20.0)
    keys, lit = SnowConfig(density_per_m3=20.0), []
    for planned_m in (2.0, 4.0):
        sources = light_sources_in_camera(RIG, (), daylight_at(sun, water, planned_m), 0)
        snow = MarineSnow(keys, np.zeros(3), RIG, [LampLight(sources, water)] * 2, np.random.default_rng(0))
        lit.append(snow.visible_particles(POSE, 0, 0.0).radiance)
    assert len(lit[0]) > 10 and lit[0].max() > 0
    np.testing.assert_allclose(lit[1], lit[0], rtol=1e-9)


@pytest.mark.parametrize(("albedo", "scattering"), [(0.9, "full"), (0.9, "single"), (0.1, "full")])
def test_a_particle_on_the_floor_shows_the_difference_of_their_albedos(albedo, scattering):
    """The change is (albedo / that of the floor - 1) times its direct light, within 30 % of it."""
    scenario = Scenario.model_validate({
        "rig": {"image_width_px": 320, "image_height_px": 240}, "water": {"jerlov": "III"},
        "lamps": [{"position_m": (0.0, 0.05, 0.0), "intensity_cd": 1000.0}], "imaging": {"scattering": scattering},
        "snow": {"density_per_m3": 20.0, "albedo": albedo},
    })  # fmt: skip
    formation = ImageFormation(scenario, illumination_of(scenario), None, np.random.default_rng(0))
    down = geometry.pose(geometry.BODY_FROM_DOWN_CAMERA, np.array([0.0, 0.0, 1.5]))
    assert formation._snow is not None
    formation._snow._start_m = geometry.transform(down, np.array([[0.0, 0.0, 1.499]]))
    formation._snow._diameter_m = np.array([0.1])  # wider than its blur
    grey, depth = np.full((*SHAPE, 3), 128, np.uint8), np.full(SHAPE, 1.5, np.float32)
    found = formation.components(RenderedView(grey, depth, 0, StampedPose(down, 0.0)))
    assert found.snow is not None
    middle = np.s_[SHAPE[0] // 2, SHAPE[1] // 2]
    expected = (albedo / (128 / 255) - 1) * found.direct[middle]
    np.testing.assert_allclose(found.snow[middle], expected, atol=0.3 * found.direct[middle].max())


def test_snow_reaches_the_floor_of_a_high_flight():
    snow = MarineSnow(
        SnowConfig(density_per_m3=20.0), np.zeros(3), RIG,
        [LampLight(light_sources(camera), medium(WaterConfig(jerlov="clear"))) for camera in (0, 1)],
        np.random.default_rng(0), None, 4.0,
    )  # fmt: skip
    level = geometry.pose(geometry.BODY_FROM_DOWN_CAMERA, np.array([3.0, 1.0, 4.0]))
    z = snow.visible_particles(level, 0, 0.0).depth_m
    volume_m3 = lambda a, b: (b**3 - a**3) / 3 * RIG.width_px * RIG.height_px / RIG.focal_px**2  # noqa: E731
    for low, high in ((1.5, 2.5), (3.0, 4.0)):
        expected = 20 * volume_m3(low, high)
        assert ((z > low) & (z < high)).sum() == pytest.approx(expected, abs=5 * np.sqrt(expected))


def test_more_particles_than_memory_holds_are_refused():
    properties = medium(WaterConfig(jerlov="II"), "single")
    sources = [LampLight(light_sources(camera), properties) for camera in (0, 1)]
    with pytest.raises(TwinError, match="snow.density_per_m3: .* particles around .*allowed: up to .* at this altit"):
        MarineSnow(SnowConfig(density_per_m3=5000), np.zeros(3), RIG, sources, np.random.default_rng(0), None, 40.0)
