"""Surrogate: ray casting, matchability, and sampled measurements of motions."""

import functools
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.ndimage import uniform_filter

from twin import scenes, survey
from twin.app.look import render_view
from twin.core import geometry
from twin.core.height_field import cast_pixels, height_field
from twin.core.records import NO_STEREO
from twin.core.timing import Stopwatch
from twin.errors import ScenarioError, SurveyAborted
from twin.estimate.vision import matching
from twin.imaging.camera.photo_sensor import sensor_of
from twin.imaging.image_formation import ImageFormation, RenderedView, StampedPose
from twin.scenario.file import load_scenario
from twin.session.assembly import navigator_with, open_world
from twin.session.stepped_world import SteppedWorld
from twin.surrogate import error_model_file
from twin.surrogate.matchability import (
    EVEN_TEXTURE,
    NO_DEPENDENCE,
    FloorImages,
    Matchability,
    floor_albedos,
    lamp_share,
    position_dependence,
    unevenness_px,
    window_texture,
)
from twin.surrogate.sampling import sample_f2f_motion
from twin.surrogate.surrogate_world import SurrogateWorld
from twin.surrogate.vision import FrameErrors, SurrogateVision, corner_count, overlap_inflation
from twin.terrains import Terrain
from twin.world.mission import prepare
from twin.world.pilot import make_pilot

SCENES = sorted(file.stem for file in Path(scenes.__file__).parent.glob("*.toml"))
SHORT = [
    "rig.model=ideal",
    'imaging.fidelity="surrogate"',
    "plan.tracks=2",
    "plan.area_m=[2.4,1.2]",
    "control.hold_s=1.0",
]
MODEL = error_model_file.load().model
LAMPS = "lamps=[{position_m=[0.25, 0.35, -0.05], pan_deg=-8.0}, {position_m=[0.25, -0.35, -0.05], pan_deg=8.0}]"


@functools.cache
def mission(*sets):
    return prepare(load_scenario("reef", [*SHORT, *sets]))


def tilted(x, y, z):
    return geometry.pose(geometry.rotation_from_rpy(np.pi - 0.15, 0.1, 0.7), np.array([x, y, z]))


@pytest.fixture(scope="module")
def reef():
    return mission()


def field_of(terrain):
    return height_field(terrain.height_m, terrain.spacing_m, terrain.west_m, terrain.south_m)


def test_ray_depth_equals_the_first_crossing_of_a_fine_ray_march(reef):
    pose = tilted(0.3, -0.2, 1.5)
    pixels = np.random.default_rng(0).uniform([0, 0], [319, 239], (40, 2))
    depth = cast_pixels(field_of(reef.terrain), pose[None], reef.rig, pixels)[0]
    steps = np.arange(0.2, 4.0, 5e-4)
    rays = np.column_stack([(pixels - [reef.rig.cx_px, reef.rig.cy_px]) / reef.rig.focal_px, np.ones(40)])
    for ray, ray_depth in zip(rays, depth, strict=True):
        points = geometry.transform(pose, ray * steps[:, None])
        below = points[:, 2] < reef.terrain.height_at(points[:, 0], points[:, 1])
        assert ray_depth == pytest.approx(steps[np.argmax(below)], abs=1e-3)


def test_a_ray_that_misses_the_terrain_has_infinite_depth(reef):
    up = geometry.pose(np.eye(3), np.array([0, 0, 2.0]))
    outside = geometry.pose(geometry.BODY_FROM_DOWN_CAMERA, np.array([50.0, 0, 2.0]))
    for pose in (up, outside):
        assert np.isinf(cast_pixels(field_of(reef.terrain), pose[None], reef.rig, np.array([[160.0, 120.0]]))).all()


@functools.cache
def rendered_over_expected(*sets):
    """Returns noise and gradients of rendered images of a level floor, relative to those of `FloorImages`.

    Gradients are those of means of 3 x 3 pixels: the rounding of rectified images is noise from pixel to pixel.
    """
    m = mission("terrain.kind=flat", "water.jerlov=IB", "plan.speed_mps=0.7", *sets)
    floor, moving = FloorImages(m.scenario, m.illumination), np.array([0, 0, 0, 0.7, 0, 0])
    (albedo,) = floor_albedos(floor, m.terrain, np.array([2.0]))
    expected = floor.matched(albedo, 2.0, np.random.default_rng(0))
    views = [render_view(m, (x, 0.0, 2.0), moving if m.scenario.sensor is not None else None) for x in (-0.4, 0.0, 0.4)]
    noise = np.mean([matching.gray(view.noise.astype(np.float32)).std() for view in views])
    found = [noise / (matching.gray(expected.noise).std() / np.sqrt(2))]
    for axis in (0, 1):
        rendered, signal = (
            np.mean([np.diff(uniform_filter(matching.gray(image), 3), axis=axis).std() for image in images])
            for images in ([view.decomposed.noise_free for view in views], [expected.signal])
        )
        found.append(rendered / signal)
    return found


@pytest.mark.parametrize("sensor", ["sensor.bits=12", 'sensor.tone_curve="srgb"', 'sensor.white_balance="grey_world"'])
def test_noise_and_texture_of_the_images_are_those_of_rendered_images(sensor):
    """Oracle: sensor, lens, port and shutter of the rendered stereo camera; both textures are filtered differently."""
    ideal = rendered_over_expected("rig.model=ideal")
    assert ideal[0] == pytest.approx(1.0, abs=0.05)
    real = rendered_over_expected("rig.model=machine_vision_dome", sensor)
    np.testing.assert_allclose(real, ideal, rtol=0.15)


def test_motion_and_aberrations_blur_the_images_of_which_the_bound_is_computed():
    long = ["sensor.exposure_max_ms=30", "sun.illuminance_lx=5", "lamps=[]"]
    still, fast, soft = (
        bounds_px(mission(*long, *sets), np.array([2.0]))[0]
        for sets in (["plan.speed_mps=0.05"], ["plan.speed_mps=0.7"], ["plan.speed_mps=0.05", "lens.blur_px=[1,1,1]"])
    )
    assert fast > 1.2 * still and soft > 1.5 * still


def raster_fraction(vision):
    """Returns the number of raster points of the last keyframe per matched point."""
    return len(vision.latest.points) / vision.latest.n_points


def bounds_px(m, depths_m):
    """Returns the bounds (n,) of the full images of a mission's floor at depths (n,)."""
    images, rng = FloorImages(m.scenario, m.illumination), np.random.default_rng(0)
    albedos = floor_albedos(images, m.terrain, depths_m)
    return [images.matched(a, z, rng).bound_px(11, 1) for a, z in zip(albedos, depths_m, strict=True)]


def test_the_matching_bound_grows_with_turbidity_depth_and_noise():
    def bound(depth_m, *sets):
        m = mission(*sets)
        return bounds_px(m, np.array([depth_m]))[0]

    base = bound(2.0)
    assert bound(2.0, 'water.jerlov="3C"') > 2 * base
    assert bound(3.0, 'water.jerlov="3C"') > 2 * bound(2.0, 'water.jerlov="3C"')
    noisier = bound(2.0, "imaging.noise_sd=0.032", "imaging.shot_noise=0.024")
    assert noisier == pytest.approx(4 * base, rel=0.05)


def test_the_matching_bound_grows_without_limit_as_the_floor_disappears():
    """The gradient of the veil does not move with the floor: counted as texture, it kept the bound below 4 px."""

    def bound(turbidity):
        m = mission('water.jerlov="III"', f"water.turbidity={turbidity}")
        return bounds_px(m, np.array([2.0]))[0]

    assert bound(15.0) > 100 > 1 > bound(2.0) > 2 * bound(1.2)


@pytest.mark.long
def test_images_are_binned_in_turbid_water_and_the_bound_is_that_of_their_pixels():
    """Binned pixels show coarse texture better than the full images do."""
    found, unbinned = [], []
    for turbidity in (1.0, 2.0, 3.0):
        m = mission('water.jerlov="III"', f"water.turbidity={turbidity}", "sun.illuminance_lx=0")
        matchability = Matchability(m.scenario, m.illumination, m.terrain)
        found.append((matchability.binning, matchability.medium_bound_px))
        unbinned.append(bounds_px(m, matchability.depths_m)[1])
    assert [binning for binning, _ in found] == [1, 2, 4]
    assert found[0][1] == pytest.approx(unbinned[0], rel=1e-3)
    assert all(px * binning < 0.9 * full for (binning, px), full in zip(found[1:], unbinned[1:], strict=True))


def test_the_bound_between_three_depths_is_that_of_images_at_this_depth():
    """Its logarithm is a parabola in the logarithm of the depth, from 0.03 to 0.3 px here."""
    m = mission('water.jerlov="III"', "water.turbidity=1.5")
    matchability = Matchability(m.scenario, m.illumination, m.terrain)
    between = np.sqrt(matchability.depths_m[1:] * matchability.depths_m[:-1])
    expected = np.array(bounds_px(m, between))
    assert matchability.binning == 1
    # other parts of the texture have another contrast
    np.testing.assert_allclose(matchability.bound_at(between), expected, rtol=0.2)


@pytest.mark.long
def test_a_survey_in_snow_that_prevents_all_matches_is_refused_even_with_extrapolate():
    """All bounds are infinite, so no binning is better than another and the matches have no error to sample."""
    size = "rig.image_width_px=128", "rig.image_height_px=96"
    m = mission("snow.density_per_m3=5000", "snow.diameter_m=0.02", "imaging.extrapolate=true", *size)
    with pytest.raises(ScenarioError, match=r"imaging.fidelity: .*marine snow prevents all matches .*less \[snow\]"):
        SurrogateVision(m, MODEL, lambda: m.start, Stopwatch())


def test_small_images_have_fewer_corners_but_as_many_points_on_a_grid(reef):
    """As in rendered surveys with 500 requested points: 500, about 256 and 500 at a binning of 1, 2 and 4."""
    settings = reef.scenario.estimator_settings()
    assert [corner_count(reef.rig.binned(k), settings) for k in (1, 2, 4)] == [500, 256, 500]


@pytest.mark.parametrize("binning", [1, 2, 4])
def test_the_inflation_by_common_pixels_is_that_of_patches_spread_at_random(reef, binning):
    """Patches at the border overlap fewer others, so the centres are spread over the whole image periodically."""
    rig, rng = reef.rig.binned(binning), np.random.default_rng(0)
    size = np.array([rig.width_px, rig.height_px])
    points = [rng.uniform(0, size, (150, 2)) for _ in range(20)]
    expected = np.mean([matching.variance_inflation(p, 11) for p in points])
    assert overlap_inflation(150, rig, 11) == pytest.approx(expected, rel=0.1)


def test_tracking_is_lost_where_too_few_points_would_be_matched_between_frames(reef):
    """The estimators need a quarter of the points; the bound of this water is 0.01 px."""
    for half_px, tracked in ((0.05, True), (0.007, False)):
        vision = SurrogateVision(reef, MODEL._replace(match_half_px=half_px), lambda: reef.start, Stopwatch())
        observe_keyframes(vision, [reef.start], [reef.start])
        vision.restart_tracking()
        assert (vision.frame_errors is not None) == tracked
        assert vision.latest.bound_px == pytest.approx(0.01, rel=0.3)


def test_frames_are_tracked_with_the_yaw_that_was_known_when_their_points_were_measured():
    m = mission("rig.model=ideal", "calibration_error.right_yaw_deg=0.1", "calibration_error.rotation_sigma_deg=0.1")
    yaw_rad = np.deg2rad(m.scenario.true_calibration_error().right_yaw_deg)
    vision = SurrogateVision(m, MODEL, lambda: m.start, Stopwatch())

    def gain():
        vision.restart_tracking()
        return vision.frame_errors.gain - np.eye(6)

    observe_keyframes(vision, [m.start], [m.start])
    wrong = gain()
    assert np.abs(wrong).max() > 0.01
    vision.correct_yaw(yaw_rad, 1e-6)
    np.testing.assert_array_equal(gain(), wrong)
    assert vision.observe_stereo(None, 1) is not None
    assert np.abs(gain()).max() < 0.1 * np.abs(wrong).max()


def lamp_share_of(m, depth_m=2.0):
    return lamp_share(FloorImages(m.scenario, m.illumination), depth_m)


def test_the_lamp_share_decreases_with_sunlight():
    lamps = "lamps=[{position_m=[0.3, 0.3, 0.0], intensity_cd=500.0}]"
    shares = [lamp_share_of(mission(f"sun.illuminance_lx={lux}", lamps)) for lux in (0, 100, 1000, 10_000)]
    assert shares[0] == 1
    assert all(np.diff(shares) < 0) and 0 < shares[-1] < 0.5
    # the illuminances of two light sources add up
    assert shares[1] / (1 - shares[1]) == pytest.approx(10 * shares[2] / (1 - shares[2]), rel=0.01)
    assert lamp_share_of(mission("sun.illuminance_lx=1000", "lamps=[]")) == 0
    murky = mission("sun.illuminance_lx=1000", lamps, "water.turbidity=100")
    assert lamp_share_of(murky, 1000.0) < 1e-6  # out of the reach of the lamps
    assert lamp_share_of(murky, 1e5) == 1  # no light returns


def test_unevenness_equals_the_deviation_of_a_curved_floor_from_its_plane():
    """For z = a x^2 it is the standard deviation of a x^2 over the patch; for a plane it is zero."""
    flown = mission("plan.altitude_m=2.0")
    y, x = np.mgrid[-5:5.01:0.01, -5:5.01:0.01]
    curved, slanted = (
        Terrain(h.astype(np.float32), 0.01, -5.0, -5.0, flown.terrain.texture, 0.005) for h in (0.5 * x**2, 0.3 * x + y)
    )
    across_m = np.linspace(-0.5, 0.5, 9) * 11 * 2.0 / flown.rig.focal_px
    expected = flown.rig.focal_px / 2.0 * np.std(0.5 * across_m**2)
    computed = unevenness_px(flown.scenario, curved, np.array([2.0]))[0]
    assert computed == pytest.approx(expected, rel=0.03)
    assert unevenness_px(flown.scenario, slanted, np.array([2.0]))[0] < 0.01 * expected


def test_an_edge_does_not_change_the_unevenness_of_the_floor_around_it():
    flown = mission("plan.altitude_m=2.0")
    y, x = np.mgrid[-5:5.01:0.01, -5:5.01:0.01]
    rough = 0.01 * np.sin(40 * x) * np.sin(40 * y)
    smooth, wall = (
        Terrain(h.astype(np.float32), 0.01, -5.0, -5.0, flown.terrain.texture, 0.005) for h in (rough, rough + (x > 0))
    )
    without, with_wall = (unevenness_px(flown.scenario, floor, np.array([2.0]))[0] for floor in (smooth, wall))
    assert with_wall == pytest.approx(without, rel=0.1)


def reseeded(vision, seed):
    """Returns the same vision with other random numbers."""
    vision._rng, vision._normals, vision._n_used = np.random.default_rng(seed), np.zeros((0, 6)), 0
    vision._link_start["state"]["key"][0] = seed
    vision._relief_noise = np.random.default_rng([seed, 1]).standard_normal(vision._relief_noise.shape)
    return vision


def observe_keyframes(vision, poses, at):
    """Observes keyframes at these poses; `at[0]` is set to the index of the present one."""
    for k, pose in enumerate(poses):
        at[0] = k
        assert vision.observe_stereo(None, k) is not None
        vision.add_to_mosaic(k, pose)


def link_of(vision, i, j):
    """Returns the motion i_from_j between an earlier keyframe i and a later one j."""
    return vision.sample_links(SimpleNamespace(number=j, yaw_rad=0.0), [SimpleNamespace(number=i)], vision.model)[0]


def error_of_link(vision, i, j):
    earlier, later = vision._keyframes[i].pose, vision._keyframes[j].pose
    return geometry.log(geometry.inverse(geometry.inverse(earlier) @ later) @ link_of(vision, i, j).a_from_b)


@pytest.mark.parametrize(("bias_fraction", "growth"), [(0.0, 0.0), (0.9, 0.0), (0.0, 30.0)])
def test_link_errors_are_consistent_with_their_covariance(reef, bias_fraction, growth):
    """The NEES per degree of freedom is 1. The growth multiplies the variance of one of two stereo pairs by 10."""
    poses, at, nees = [tilted(0, 0, 2.0), tilted(0.2, 0.1, 2.05)], [0], []
    model = MODEL._replace(
        match_bias_fraction=bias_fraction, distance_growth=growth, match_floor_px=0.05, efficiency=0.0, relief_gain=0.0,
        lamp_growth=0.0,
    )  # fmt: skip
    vision = SurrogateVision(reef, model, lambda: poses[at[0]], Stopwatch())
    for seed in range(150):
        observe_keyframes(reseeded(vision, seed), poses, at)
        error = error_of_link(vision, 0, 1)
        nees.append(error @ np.linalg.solve(link_of(vision, 0, 1).cov, error) / 6)
    assert np.mean(nees) == pytest.approx(1.0, abs=0.15)


def test_links_sampled_together_are_those_sampled_one_by_one(reef):
    poses, at = [tilted(0.1 * k, 0.05 * k, 2.0) for k in range(4)], [0]
    vision = SurrogateVision(reef, MODEL, lambda: poses[at[0]], Stopwatch())
    observe_keyframes(vision, poses, at)
    nodes = [SimpleNamespace(number=k, yaw_rad=0.0) for k in range(4)]
    together = vision.sample_links(nodes[3], nodes[2::-1], MODEL)
    for motion, k in zip(together, (2, 1, 0), strict=True):
        alone = link_of(vision, k, 3)
        np.testing.assert_array_equal(motion.a_from_b, alone.a_from_b)
        np.testing.assert_array_equal(motion.cov, alone.cov)
        assert motion[2:4] == alone[2:4]
    assert not np.array_equal(together[0].cov, together[1].cov)


def test_lamps_scale_errors_of_links_and_daylight_does_not(reef):
    """A growth of 2 multiplies the variances by 1 + 2^2 under lamps alone. The random numbers are the same."""
    plain = MODEL._replace(match_floor_px=0.2, efficiency=0.0, lamp_growth=0.0)
    poses, at = [tilted(0, 0, 2.0), tilted(0.2, 0.1, 2.05)], [0]
    for flown, factor in ((reef, 5.0), (mission("lamps=[]", "sun.illuminance_lx=2000"), 1.0)):
        vision, errors = SurrogateVision(flown, plain, lambda: poses[at[0]], Stopwatch()), []
        observe_keyframes(vision, poses, at)
        for vision.model in (plain, plain._replace(lamp_growth=2.0)):
            errors.append(error_of_link(vision, 0, 1))
        # linearised at the measured points, and with a small common bias, hence the tolerance
        np.testing.assert_allclose(errors[1], np.sqrt(factor) * errors[0], atol=0.1 * np.abs(errors[1]).max())


def test_relief_makes_the_matches_of_a_stereo_pair_less_precise():
    """A floor with an unevenness of u px per unit of baseline / depth has the parallax u baseline / depth in a pair."""
    rough, at = mission('terrain.kind="fractal"', "terrain.relief_m=1.0"), tilted(0, 0, 2.5)
    sigmas = []
    for gain in (0.0, 3.0):
        model = MODEL._replace(match_floor_px=0.02, efficiency=0.0, stereo_relief_gain=gain)
        vision = SurrogateVision(rough, model, lambda: at, Stopwatch())
        cov = vision.observe_stereo(None, 0).cov
        sigmas.append(np.sqrt(np.median(np.trace(cov, axis1=1, axis2=2)) * raster_fraction(vision)))
    parallax_px = vision.latest.unevenness_px * np.mean(vision.latest.points[:, 2])
    assert parallax_px > 0.01
    assert sigmas[1] / sigmas[0] == pytest.approx(np.hypot(0.02, 3.0 * parallax_px) / 0.02, rel=1e-6)


def test_stereo_points_lie_in_both_images(reef):
    pose = tilted(0, 0, 2.0)
    vision = SurrogateVision(reef, MODEL, lambda: pose, Stopwatch())
    points = vision.observe_stereo(None, 0)
    right_px = points.pixels[:, 0] - reef.rig.focal_px * vision.latest.points[:, 2]
    assert right_px.min() >= reef.scenario.estimate.patch_px // 2
    excluded = vision._pixels[~np.isin(np.arange(len(vision._pixels)), vision.latest.raster_indices)]
    assert len(excluded) and excluded[:, 0].max() < points.pixels[:, 0].max() / 2  # at the left border


def test_a_fifth_of_the_image_suffices_for_a_link_with_larger_covariance(reef):
    """As with images: the common points have to be consistent, not numerous."""
    poses, at = [tilted(0.1 * k, 0.0, 2.0) for k in range(30)], [0]
    vision = SurrogateVision(reef, MODEL, lambda: poses[at[0]], Stopwatch())
    observe_keyframes(vision, poses, at)
    links = [link_of(vision, 0, k) for k in range(1, 30)]
    measured = [link for link in links if link is not None]
    assert None in links and links.index(None) == len(measured)
    assert measured[-1].n_points < 0.25 * vision._keyframes[0].n_points
    assert measured[-1].cov[3, 3] > 9 * measured[0].cov[3, 3]


def test_a_link_does_not_depend_on_earlier_measurements(reef):
    poses, at = [tilted(0, 0, 2.0), tilted(0.2, 0.1, 2.05)], [0]
    vision = SurrogateVision(reef, MODEL, lambda: poses[at[0]], Stopwatch())
    observe_keyframes(vision, poses, at)
    first = link_of(vision, 0, 1)
    vision.draw_normals(1)
    np.testing.assert_array_equal(link_of(vision, 0, 1).a_from_b, first.a_from_b)


def test_the_bias_of_a_keyframe_reduces_the_loop_closure_error_of_three_keyframes(reef):
    poses, at = [tilted(0, 0, 2.0), tilted(0.05, 0, 2.0), tilted(0.1, 0, 2.0)], [0]

    def closure(bias_fraction):
        model = MODEL._replace(match_bias_fraction=bias_fraction, match_floor_px=0.05, relief_gain=0.0)
        vision, squares = SurrogateVision(reef, model, lambda: poses[at[0]], Stopwatch()), []
        for seed in range(60):
            observe_keyframes(reseeded(vision, seed), poses, at)
            a, b, c = (link_of(vision, i, j).a_from_b for i, j in ((0, 1), (1, 2), (0, 2)))
            squares.append(np.sum(geometry.log(geometry.inverse(c) @ a @ b)[3:] ** 2))
        return np.mean(squares)

    assert closure(0.95) < 0.5 * closure(0.0)


def test_errors_due_to_relief_accumulate_along_a_path_and_cancel_around_a_loop(reef):
    """Ten equal steps; independent errors would accumulate to ten times the variance of one step."""
    poses, at = [tilted(0.02 * k, 0, 2.0) for k in range(11)], [0]
    model = MODEL._replace(match_floor_px=1e-4, efficiency=0.0, stereo_relief_gain=0.0, relief_gain=1e3)
    vision = SurrogateVision(reef, model, lambda: poses[at[0]], Stopwatch())
    steps, sums, closures = [], [], []
    for seed in range(30):
        observe_keyframes(reseeded(vision, seed), poses, at)
        steps.append([error_of_link(vision, k, k + 1) for k in range(10)])
        sums.append(np.sum(steps[-1], axis=0))
        closures.append(steps[-1][0] + steps[-1][1] - error_of_link(vision, 0, 2))
    step, path, closure = (np.mean(np.square(x)[..., 3:]) for x in (steps, sums, closures))
    assert path > 5 * 10 * step
    assert closure < 0.3 * step


def test_below_the_floor_nothing_is_matched(reef):
    vision = SurrogateVision(reef, MODEL, lambda: tilted(0, 0, -1.0), Stopwatch())
    with np.errstate(divide="raise"):
        assert vision.observe_stereo(None, 0) is None


def light_of(m, depth_m):
    """Returns the arguments of `position_dependence` for a level floor at a depth."""
    images = FloorImages(m.scenario, m.illumination)
    (albedo,) = floor_albedos(images, m.terrain, np.array([2.0]))
    matched = images.matched(albedo, depth_m, np.random.default_rng(0))
    return images.contrast(albedo, depth_m, matched.even), matched.noise


def test_lamps_make_the_centre_of_the_image_more_precise_than_its_sides_and_daylight_does_not():
    lit, sunlit = (
        position_dependence(*light_of(m, 2.0)).bounds
        for m in (mission(LAMPS, "sun.illuminance_lx=0"), mission("lamps=[]", "sun.illuminance_lx=1000"))
    )
    assert lit[:, [0, -1]].min() > 1.1 > 0.9 > lit[2:4, 3:5].max()
    np.testing.assert_allclose(sunlit, 1.0, atol=0.08)


def test_the_relative_bound_is_that_of_random_textures_in_crops_of_the_image():
    """Oracle: bounds from gradients and noise of other textures (white noise) in each quarter of the image."""
    m = mission(LAMPS, "sun.illuminance_lx=0", "water.jerlov=III")
    table = position_dependence(*light_of(m, 2.0)).bounds
    rng, rig = np.random.default_rng(7), m.scenario.believed_rig()
    formation = ImageFormation(m.scenario, m.illumination, None, rng)
    shape = rig.height_px, rig.width_px
    depth, camera = np.full(shape, 2.0, np.float32), StampedPose(tilted(0.0, 0.0, 2.0), 0.0)
    albedo = np.repeat(rng.integers(40, 140, (*shape, 1), np.uint8), 3, axis=2)
    lights = [formation.radiance(RenderedView(image, depth, 0, camera)) for image in (albedo, np.full_like(albedo, 90))]
    sensor = sensor_of(m.scenario, rig)
    setting = sensor.meter(lights[0])
    signal = matching.gray(((lights[0] - lights[1]) * 255 * setting.gain).astype(np.float32))
    first, second = (matching.gray(sensor.image(lights[0], setting, rng).astype(np.float32)) for _ in range(2))
    ratio2 = [block_means(x, 3, 4) for x in ((first - second)[:, 1:] ** 2, np.diff(signal, axis=1) ** 2)]
    expected = np.sqrt(ratio2[0] / ratio2[1] / (ratio2[0].mean() / ratio2[1].mean()))
    information = block_means(np.repeat(np.repeat(1 / table**2, 10, axis=0), 10, axis=1), 3, 4)
    np.testing.assert_allclose(1 / np.sqrt(information), expected, rtol=0.08)


def block_means(values, rows, cols):
    return np.array(
        [[part.mean() for part in np.array_split(row, cols, axis=1)] for row in np.array_split(values, rows)]
    )


def test_no_light_from_the_floor_gives_equal_bounds_over_the_image():
    m = mission("water.turbidity=100", "lamps=[]", "sun.illuminance_lx=1000")
    assert position_dependence(*light_of(m, 1000.0)) is NO_DEPENDENCE


def test_an_evenly_textured_image_has_the_same_bound_in_all_windows():
    """Columns alternate between two grey levels, so each window has the gradient of the whole image."""
    even = np.tile([0.0, 3.0], (40, 20))
    assert window_texture(even, np.ones((1, 1))) == pytest.approx(EVEN_TEXTURE, abs=1e-9)
    assert window_texture(np.full((40, 40), 7.0), np.ones((1, 1))) == EVEN_TEXTURE


def test_the_bound_of_a_window_is_inversely_proportional_to_its_gradient():
    """Three quarters of the image have the contrast 1, one quarter 4; windows across the border are few."""
    contrast = np.repeat([1.0, 4.0], [1500, 500])[None]
    image = contrast * np.tile([0.0, 1.0], (60, 1000))
    texture = window_texture(image, np.ones((1, 1)))
    assert texture.median_ratio == pytest.approx(np.sqrt((3 * 1 + 16) / 4), rel=0.01)
    assert texture.scatter == pytest.approx(np.log(4) * np.sqrt(3) / 4, rel=0.01)
    assert window_texture(5 * image, np.ones((1, 1))) == pytest.approx(texture)


def test_windows_without_texture_have_the_largest_bound_that_is_counted():
    """The running sums of the blur leave values just below zero after the end of a texture."""
    signal = np.zeros((60, 400))
    signal[:24] = np.random.default_rng(0).normal(0, 5, (24, 400))
    texture = window_texture(signal, np.ones((1, 1)))
    assert texture.median_ratio == pytest.approx(20)  # 1 / 0.05, in 32 of 56 rows of windows
    assert texture.scatter == pytest.approx(np.log(20 * np.sqrt(60 / 24)) * np.sqrt(24 * 32) / 56, rel=0.1)


def test_errors_of_consecutive_motions_between_frames_are_anticorrelated():
    """e_k = n_k - a n_(k-1): variance 1 + a^2, covariance of neighbours -a; standard error of 4000 motions 0.03."""
    a, n = 0.4, 4000
    errors = FrameErrors(1e-4 * np.eye(6), np.eye(6), a, np.zeros((0, 0)))
    normals = np.random.default_rng(5).standard_normal((n + 1, 6))
    poses = np.eye(4), np.eye(4)
    motions = [sample_f2f_motion(errors, *poses, normals[k + 1], normals[k]) for k in range(n)]
    found = np.array([geometry.log(motion) for motion in motions]) / 1e-4
    assert np.mean(found**2) == pytest.approx(1 + a**2, abs=0.03)
    assert np.mean(found[1:] * found[:-1]) == pytest.approx(-a, abs=0.03)


OF_SECONDS = ("auv", "tank", "coral_garden", "quickstart")


@pytest.mark.parametrize("scene", [pytest.param(s, marks=[pytest.mark.long] * (s in OF_SECONDS)) for s in SCENES])
def test_the_surrogate_maps_every_shipped_scene(scene, tmp_path, outside_data, monkeypatch):
    if scene.startswith("horseshoe"):
        monkeypatch.setenv("TWIN_DATA", str(outside_data("horseshoe_reef_dem.tif").parent))
    short = ["seed=41", "plan.tracks=1", "plan.area_m=[1.5,1.5]"]
    sets = [*short, 'imaging.fidelity="surrogate"', "imaging.extrapolate=true"]
    metrics = survey.run(load_scenario(scene, sets), tmp_path / "run", outputs=None).metrics
    assert metrics["status"] == "complete"
    assert metrics["map"]["completeness"] > 0.95


def test_a_surrogate_survey_is_complete_and_reproducible(tmp_path):
    scenario = load_scenario("reef", SHORT)
    results = [survey.run(scenario, tmp_path / name, outputs=()) for name in "ab"]
    metrics = results[0].metrics
    assert metrics["status"] == "complete"
    assert 1e-4 < metrics["trajectory"]["final"]["ate_rmse_m"] < 0.02
    assert metrics["map"]["completeness"] > 0.95
    final = [(r.folder / "trajectory_final.tum").read_bytes() for r in results]
    assert final[0] == final[1]


def test_water_without_matches_aborts_the_survey_with_a_reason(tmp_path):
    murky = ['water.jerlov="9C"', "water.turbidity=10", "imaging.extrapolate=true"]
    scenario = load_scenario("reef", [*SHORT, *murky])
    metrics = survey.run(scenario, tmp_path, outputs=()).metrics
    assert metrics["status"] == "aborted"
    assert "9C" in metrics["reason"] and "too few points" in metrics["reason"]


@pytest.mark.parametrize("settings", ['aiding=["pressure", "ahrs", "dvl"]', "aiding=[]", "dvl_rate_hz=8"])
def test_the_compiled_loop_equals_the_loop_over_single_frames(settings, monkeypatch):
    """Both use the same steps and the same random numbers."""
    flown = mission('navigation.aiding=["pressure", "ahrs", "dvl"]', f"navigation.{settings}", "plan.tracks=1")

    def fly():
        with open_world(flown, Stopwatch()) as world:
            navigator = navigator_with(flown, world.vision, Stopwatch())
            survey.fly(flown, world, navigator, lambda *_: None)
            return world.truth().trajectory, navigator.finish()

    true, compiled = fly()
    monkeypatch.delattr(SurrogateWorld, "fast_forward")
    true_single, single = fly()
    np.testing.assert_array_equal(true.world_from_camera, true_single.world_from_camera)
    for name in ("f2f", "online", "final"):
        ours, theirs = getattr(compiled, name), getattr(single, name)
        np.testing.assert_array_equal(ours.times_s, theirs.times_s)
        np.testing.assert_array_equal(ours.world_from_camera, theirs.world_from_camera)


def test_the_truth_records_track_reference_and_station_keeping_of_every_frame():
    flown = mission("plan.tracks=2", "plan.area_m=[1.2, 1.2]")
    with open_world(flown, Stopwatch()) as world:
        navigator = navigator_with(flown, world.vision, Stopwatch())
        survey.fly(flown, world, navigator, lambda *_: None)
        truth, first, hold = world.truth(), flown.planned_frames(1), len(flown.station_keeping_frames(1))
    n = len(first)
    assert len(truth.reference) == len(truth.holding) == len(truth.track) == len(world) == flown.n_frames
    np.testing.assert_array_equal(truth.reference[:n], first.reference.position)
    np.testing.assert_array_equal(truth.holding[: n + 2 * hold + 1], [False] * n + [True] * 2 * hold + [False])
    np.testing.assert_array_equal(np.flatnonzero(np.diff(truth.track)), [n + 2 * hold - 1])
    np.testing.assert_allclose(truth.reference[n : n + 2 * hold], first.reference.position[-1:].repeat(2 * hold, 0))


def test_the_number_of_stored_keyframes_does_not_grow_with_the_survey():
    flown = mission("plan.tracks=6", "plan.area_m=[1.2, 1.2]", "plan.overlap_across=0.95", "estimate.window_tracks=1")
    with open_world(flown, Stopwatch()) as world:
        navigator = navigator_with(flown, world.vision, Stopwatch())
        survey.fly(flown, world, navigator, lambda *_: None)
        last_two = [k.number for k in navigator.network.keyframes if k.track >= 5]
        assert sorted(world.vision._keyframes) == [0, 1, 2, 3, *last_two]


def test_diverged_physics_ends_the_compiled_loop_with_an_error():
    flown = mission()
    with open_world(flown, Stopwatch()) as world:
        navigator, pilot = navigator_with(flown, world.vision, Stopwatch()), make_pilot(flown)
        sequence, fast_forward = flown.planned_frames(1), world.fast_forward(navigator, pilot)
        navigator.update(world.observe(sequence[0]), 1)
        world.vehicle.state.velocity[0] = np.nan
        with pytest.raises(SurveyAborted, match="the physics diverged at"):
            fast_forward(sequence, 1)
        assert len(world) == len(navigator.log) == 2  # the frame at which it was detected is kept


@pytest.mark.long
def test_a_survey_without_optional_outputs_loads_no_graphics_library(tmp_path):
    """MuJoCo, OpenGL and the drawing libraries would take 100 MB in each worker of a study."""
    line = f"""
import sys
from pathlib import Path
from types import SimpleNamespace
from twin import survey
from twin.scenario.file import load_scenario
result = survey.run(load_scenario("reef", {SHORT!r}), Path({str(tmp_path / "run")!r}), outputs=None)
assert result.status == "complete"
print(*(name for name in ("mujoco", "OpenGL", "matplotlib", "rerun", "rasterio", "trimesh") if name in sys.modules))
"""
    done = subprocess.run([sys.executable, "-c", line], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


def test_a_view_of_one_row_of_floor_points_is_no_keyframe():
    """Beyond the edge of a level floor, points in one line leave the rotation about it undetermined."""
    sets = ["imaging.fidelity=surrogate", "imaging.extrapolate=true", "plan.area_m=[2.0,1.0]", "terrain.kind=flat"]
    with SteppedWorld(load_scenario("quickstart", [*sets, "vehicle.dynamics=kinematic"])) as world:
        frame, estimators, statuses = world.reset(), world.estimator(), []
        while frame is not None:
            statuses.append(estimators.update(frame, 1).status)
            frame = world.step(np.array([0.0, 1.0, 0.0]), keyframe=len(statuses) % 5 == 0)
    assert NO_STEREO in statuses[-10:]
