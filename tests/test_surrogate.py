"""Surrogate: ray casting, matchability, sampled measurements, and the fit of the error model."""

import functools
import subprocess
import sys
import time
from collections import defaultdict
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from pydantic import BaseModel

from twin import scenes, survey
from twin.core import geometry
from twin.core.height_field import cast_pixels, height_field
from twin.core.records import MapGrid
from twin.core.timing import Stopwatch
from twin.errors import ScenarioError, SurveyAborted, TwinError
from twin.estimate.vision import matching
from twin.imaging.camera.photo_sensor import sensor_of
from twin.imaging.image_formation import ImageFormation, StampedPose
from twin.scenario.file import load_scenario
from twin.session.assembly import navigator_with, open_world
from twin.surrogate import error_model_file
from twin.surrogate.error_model import (
    BinnedDepthLaw,
    BorderErrorLaw,
    BorderLaw,
    DepthLaw,
    ErrorModel,
    FractionLaw,
    ScatterLaw,
    SigmaLaw,
)
from twin.surrogate.map_model import (
    CellErrors,
    MapModel,
    edge_border_factor,
    edge_strength,
    heavy_tailed,
    relief_error_px,
    roughness,
    step_slope,
    window_noise,
)
from twin.surrogate.matchability import (
    NO_DEPENDENCE,
    FloorImages,
    Matchability,
    floor_albedos,
    lamp_share,
    position_dependence,
    precision,
    unevenness_px,
)
from twin.surrogate.snow_noise import snow_effect
from twin.surrogate.surrogate_world import SurrogateWorld, surrogate_vision
from twin.surrogate.vision import corner_count, match_sigma_px, overlap_inflation
from twin.surrogate.window_texture import EVEN_TEXTURE, window_texture
from twin.surrogate_fit import fit, rendered_surveys
from twin.surrogate_fit.comparison import UNIT_PX, ComparisonVision, single_error_models
from twin.surrogate_fit.rendered_surveys import all_statistics, comparison_model, fit_to_surveys
from twin.terrains import Terrain
from twin.world.mission import prepare
from twin.world.pilot import make_pilot

SCENES = sorted(file.stem for file in Path(scenes.__file__).parent.glob("*.toml"))
SHORT = ['imaging.fidelity="surrogate"', "plan.tracks=2", "plan.area_m=[2.4,1.2]", "control.hold_s=1.0"]


@functools.cache
def mission(*sets):
    return prepare(load_scenario("reef", [*SHORT, *sets]))


def tilted(x, y, z):
    return geometry.pose(geometry.rotation_from_rpy(np.pi - 0.15, 0.1, 0.7), np.array([x, y, z]))


@pytest.fixture(scope="module")
def reef():
    return mission()


@pytest.fixture(scope="module")
def vision(reef):
    return surrogate_vision(reef, ErrorModel(), lambda: reef.start, Stopwatch())


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


def raster_fraction(vision):
    """Returns the number of raster points of the last keyframe per matched point."""
    return len(vision.latest.points) / vision.latest.n_points


def bounds_px(m, depths_m):
    images = FloorImages(m.scenario, m.illumination)
    return precision(images, floor_albedos(images, m.terrain, depths_m), depths_m).bounds_px


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
    for turbidity in (1.0, 2.0, 2.6):
        m = mission('water.jerlov="III"', f"water.turbidity={turbidity}", "sun.illuminance_lx=0")
        matchability = Matchability(m.scenario, m.illumination, m.terrain)
        found.append((matchability.binning, matchability.medium_bound_px))
        depths = matchability.depths_m
        unbinned.append(np.interp(np.sqrt(depths[0] * depths[-1]), depths, bounds_px(m, depths)))
    assert [binning for binning, _ in found] == [1, 2, 4]
    assert found[0][1] == pytest.approx(unbinned[0])
    assert all(px * binning < 0.9 * full for (binning, px), full in zip(found[1:], unbinned[1:], strict=True))


@pytest.mark.long
def test_a_survey_in_snow_that_prevents_all_matches_is_refused_even_with_extrapolate():
    """All bounds are infinite, so no binning is better than another and the matches have no error to sample."""
    size = "rig.image_width_px=128", "rig.image_height_px=96"
    m = mission("snow.density_per_m3=5000", "snow.diameter_m=0.02", "imaging.extrapolate=true", *size)
    with pytest.raises(ScenarioError, match=r"imaging.fidelity: .*marine snow prevents all matches .*less \[snow\]"):
        surrogate_vision(m, ErrorModel(), lambda: m.start, Stopwatch())


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
    for half_px, tracked in ((0.05, True), (0.005, False)):
        model = ErrorModel(match_fraction=FractionLaw(0.9, half_px, 4.0))
        vision = surrogate_vision(reef, model, lambda: reef.start, Stopwatch())
        observe_keyframes(vision, [reef.start], [reef.start])
        vision.restart_tracking()
        assert (vision.frame_errors is not None) == tracked
        assert vision.latest.bound_px == pytest.approx(0.01, rel=0.3)


def test_the_lamp_share_decreases_with_sunlight():
    def share(lux, *sets):
        m = mission(f"sun.illuminance_lx={lux}", *sets)
        return lamp_share(FloorImages(m.scenario, m.illumination))

    lamps = "lamps=[{position_m=[0.3, 0.3, 0.0], intensity_cd=500.0}]"
    shares = [share(lux, lamps) for lux in (0, 100, 1000, 10_000)]
    assert shares[0] == 1
    assert all(np.diff(shares) < 0) and 0 < shares[-1] < 0.5
    # the radiances of two light sources add up
    assert shares[1] / (1 - shares[1]) == pytest.approx(10 * shares[2] / (1 - shares[2]), rel=0.01)
    assert share(1000, "lamps=[]") == 0
    dark = mission("sun.illuminance_lx=1000", lamps, "water.turbidity=100")
    plan = BaseModel.model_copy(dark.scenario.plan, update={"altitude_m": 1000.0})  # beyond the limits of the key
    high = BaseModel.model_copy(dark.scenario, update={"plan": plan})
    assert lamp_share(FloorImages(high, dark.illumination)) == 1  # no light returns


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


COMPARED = ErrorModel(distance_growth=3.0, relief_gain=0.3)


def reseeded(vision, seed):
    """Returns the same vision with other random numbers."""
    vision._rng, vision._link_key, vision._normals = np.random.default_rng(seed), seed, np.zeros((0, 6))
    vision._n_used = 0
    vision._relief_noise = np.random.default_rng([seed, 1]).standard_normal(vision._relief_noise.shape)
    return vision


@pytest.mark.parametrize("bias_fraction", [0.0, 0.9])
def test_link_errors_are_consistent_with_their_covariance(reef, bias_fraction):
    """With error ratio 1 and no inflation the NEES per degree of freedom is 1."""
    model = ErrorModel(
        match_error_ratio=1.0,
        match_covariance_inflation=1.0,
        match_bias_fraction=bias_fraction,
        match_sigma_px=SigmaLaw(0.05, 0.0),
    )
    poses = [tilted(0, 0, 2.0), tilted(0.2, 0.1, 2.05)]
    assert nees_of_links(reef, model, poses) == pytest.approx(1.0, abs=0.12)


def nees_of_links(reef, model, poses):
    """Returns the NEES per degree of freedom of the link between two poses, the mean over 150 seeds."""
    at, true, nees = [0], geometry.inverse(poses[0]) @ poses[1], []
    vision = surrogate_vision(reef, model, lambda: poses[at[0]], Stopwatch())
    for seed in range(150):
        observe_keyframes(reseeded(vision, seed), poses, at)
        link = link_of(vision, 0, 1)
        error = geometry.log(geometry.inverse(true) @ link.a_from_b)
        nees.append(error @ np.linalg.solve(link.cov, error) / 6)
    return np.mean(nees)


def test_the_errors_of_links_grow_with_distance_as_their_covariance(reef):
    """The growth multiplies the variance of one of two stereo pairs by 10 here; without it the NEES would be 0.2."""
    model = ErrorModel(
        match_error_ratio=1.0, match_covariance_inflation=1.0, match_bias_fraction=0.0, distance_growth=30.0,
        match_sigma_px=SigmaLaw(0.05, 0.0),
    )  # fmt: skip
    assert nees_of_links(reef, model, [tilted(0, 0, 2.0), tilted(0.2, 0.1, 2.05)]) == pytest.approx(1.0, abs=0.15)


def test_lamps_scale_errors_and_covariances_of_links_and_daylight_does_not(reef):
    """Growths of 2 multiply the variances by 1 + 2^2 under lamps alone. The random numbers are the same."""
    plain = ErrorModel(match_sigma_px=SigmaLaw(0.05, 0.0), common_bias_px=0.0)
    grown = plain._replace(lamp_error_growth=2.0, lamp_sigma_growth=2.0)
    poses, at = [tilted(0, 0, 2.0), tilted(0.2, 0.1, 2.05)], [0]
    for flown, factor in ((reef, 5.0), (mission("lamps=[]", "sun.illuminance_lx=2000"), 1.0)):
        vision, covs, errors = surrogate_vision(flown, plain, lambda: poses[at[0]], Stopwatch()), [], []
        observe_keyframes(vision, poses, at)
        for vision.model in (plain, grown):
            covs.append(link_of(vision, 0, 1).cov)
            errors.append(error_of_link(vision, 0, 1))
        # the least squares are linearised at the measured points, hence the tolerances
        assert np.trace(covs[1]) == pytest.approx(factor * np.trace(covs[0]), rel=0.1)
        np.testing.assert_allclose(errors[1], np.sqrt(factor) * errors[0], atol=0.1 * np.abs(errors[1]).max())


def test_relief_makes_the_matches_of_a_stereo_pair_less_precise():
    """A floor with an unevenness of u px per unit of baseline / depth has the parallax u baseline / depth in a pair."""
    rough, at = mission('terrain.kind="fractal"', "terrain.relief_m=1.0"), tilted(0, 0, 2.5)
    sigmas = []
    for gain in (0.0, 3.0):
        model = ErrorModel(match_sigma_px=SigmaLaw(0.02, 0.0), stereo_relief_gain=gain)
        vision = surrogate_vision(rough, model, lambda: at, Stopwatch())
        cov = vision.observe_stereo(None, 0).cov
        sigmas.append(np.sqrt(np.median(np.trace(cov, axis1=1, axis2=2)) * raster_fraction(vision)))
    baseline_in_depths = np.mean(vision.latest.points[:, 2])
    parallax_px = vision.latest.unevenness_px * baseline_in_depths
    assert parallax_px > 0.01
    assert sigmas[1] / sigmas[0] == pytest.approx(np.hypot(0.02, 3.0 * parallax_px) / 0.02, rel=1e-6)


def test_the_fit_recovers_the_match_sigma_over_relief_and_the_growth_under_lamps():
    rng = np.random.default_rng(0)
    bounds, parallax, lamps = rng.uniform(0.005, 0.1, 40), rng.uniform(0, 0.1, 40), rng.uniform(0, 1, 40)
    true = ErrorModel(match_sigma_px=SigmaLaw(0.015, 1.3), stereo_relief_gain=0.4)
    sigmas = np.array([match_sigma_px(true, b, p) for b, p in zip(bounds, parallax, strict=True)])
    law, gain = fit._fit_match_sigma(bounds, parallax, sigmas * np.exp(0.05 * rng.standard_normal(40)))
    assert (*law, gain) == pytest.approx((0.015, 1.3, 0.4), rel=0.15)
    ratios = 0.9 * np.hypot(1, 1.2 * lamps) * np.exp(0.05 * rng.standard_normal(40))
    ratios[::13] *= 5  # surveys near the loss of vision
    assert fit._fit_lamp_growth(ratios, lamps) == pytest.approx((0.9, 1.2), rel=0.15)


def test_the_error_due_to_relief_is_quadratic_for_small_roughness_and_limited_for_large():
    """With q = gain r / limit, the error is limit q^2 for q << 1 and the limit for q >> 1; at q = 1 limit / sqrt(2)."""
    gain, limit_px = 1.5, 0.03
    for q, expected in ((0.1, 0.01 * limit_px), (1.0, limit_px / np.sqrt(2)), (10.0, limit_px)):
        assert relief_error_px(q * limit_px / gain, gain, limit_px) == pytest.approx(expected, rel=1e-3)


def test_the_noise_near_walls_has_unit_variance_most_of_which_is_in_few_cells_that_form_patches():
    """|n| > 1.5 in 13.4 % of the cells; the integral of n^4 over them is 80 % of 3, its mean."""
    noise = heavy_tailed(window_noise((1500, 1500), 4, np.random.default_rng(0)))
    assert (noise.mean(), noise.std()) == (pytest.approx(0.0, abs=0.02), pytest.approx(1.0, abs=0.04))
    large = np.abs(noise) > 1.5**2 / np.sqrt(3)
    assert large.mean() == pytest.approx(0.134, abs=0.005)
    assert np.sum(noise[large] ** 2) / np.sum(noise**2) == pytest.approx(0.81, abs=0.02)
    assert np.mean(large[:, 1:][large[:, :-1]]) > 0.4  # gross errors come in patches; 0.134 if independent


def test_only_windows_with_a_wall_have_edges_and_their_strength_grows_with_the_slope():
    """An undulating floor has roughness but no walls; the columns 19 and 20 of a step are steep."""
    height = np.tile(0.002 * np.cos(np.arange(40)), (30, 1)).astype(np.float32)
    height[:, 20:] += 0.4
    rough, slope = roughness(height, 5), step_slope(height, 0.02)
    edge = edge_strength(rough, slope, 5)
    assert rough[15, 3:15].min() > 4e-4
    assert np.flatnonzero(edge[15]).tolist() == list(range(17, 23))  # windows of five with one of the columns 19 and 20
    largest = np.array([rough[15, j - 2 : j + 3].max() for j in range(17, 23)])
    least = np.maximum(slope[15, 17:23], 0.1)
    np.testing.assert_allclose(edge[15, 17:23] ** 4, rough[15, 17:23] * largest * least**2, rtol=1e-4)


def test_the_slope_of_a_step_between_two_cells_is_not_halved_and_that_of_a_plane_is_exact():
    y, x = np.mgrid[:20, :30] * 0.02
    plane = step_slope((0.3 * x - 0.4 * y).astype(np.float32), 0.02)
    np.testing.assert_allclose(plane, 0.5, rtol=1e-3)
    step = step_slope(np.where(x > 0.29, 0.1, 0.0).astype(np.float32), 0.02)
    np.testing.assert_allclose(step[:, 14:16], 5.0, rtol=1e-5)
    assert step[:, :14].max() == step[:, 16:].max() == 0


def observe_keyframes(vision, poses, at):
    """Observes keyframes at these poses; `at[0]` is set to the index of the present one."""
    for k, pose in enumerate(poses):
        at[0] = k
        assert vision.observe_stereo(None, k) is not None
        vision.add_to_mosaic(k, pose)


def link_of(vision, i, j):
    """Returns the motion i_from_j between an earlier keyframe i and a later one j."""
    return vision._sample_link(vision._keyframes[j], vision._keyframes[i], j, i, vision.model)


def error_of_link(vision, i, j):
    earlier, later = vision._keyframes[i].pose, vision._keyframes[j].pose
    return geometry.log(geometry.inverse(geometry.inverse(earlier) @ later) @ link_of(vision, i, j).a_from_b)


def test_stereo_points_lie_in_both_images(reef):
    pose = tilted(0, 0, 2.0)
    vision = surrogate_vision(reef, ErrorModel(), lambda: pose, Stopwatch())
    points = vision.observe_stereo(None, 0)
    right_px = points.pixels[:, 0] - reef.rig.focal_px * vision.latest.points[:, 2]
    assert right_px.min() >= reef.scenario.estimate.patch_px // 2
    excluded = vision._pixels[~np.isin(np.arange(len(vision._pixels)), vision.latest.raster_indices)]
    assert len(excluded) and excluded[:, 0].max() < points.pixels[:, 0].max() / 2  # at the left border


def test_a_fifth_of_the_image_suffices_for_a_link_with_larger_covariance(reef):
    """As with images: the common points have to be consistent, not numerous."""
    poses, at = [tilted(0.1 * k, 0.0, 2.0) for k in range(30)], [0]
    vision = surrogate_vision(reef, ErrorModel(), lambda: poses[at[0]], Stopwatch())
    observe_keyframes(vision, poses, at)
    links = [link_of(vision, 0, k) for k in range(1, 30)]
    measured = [link for link in links if link is not None]
    assert None in links and links.index(None) == len(measured)
    assert measured[-1].n_points < 0.25 * vision._keyframes[0].n_points
    assert measured[-1].cov[3, 3] > 9 * measured[0].cov[3, 3]


def test_a_link_does_not_depend_on_earlier_measurements(reef):
    poses, at = [tilted(0, 0, 2.0), tilted(0.2, 0.1, 2.05)], [0]
    vision = surrogate_vision(reef, ErrorModel(), lambda: poses[at[0]], Stopwatch())
    observe_keyframes(vision, poses, at)
    first = link_of(vision, 0, 1)
    vision.draw_normals(1)
    np.testing.assert_array_equal(link_of(vision, 0, 1).a_from_b, first.a_from_b)


def test_the_bias_of_a_keyframe_reduces_the_loop_closure_error_of_three_keyframes(reef):
    poses, at = [tilted(0, 0, 2.0), tilted(0.05, 0, 2.0), tilted(0.1, 0, 2.0)], [0]

    def closure(bias_fraction):
        model = ErrorModel(match_bias_fraction=bias_fraction, common_bias_px=0.0)
        vision, squares = surrogate_vision(reef, model, lambda: poses[at[0]], Stopwatch()), []
        for seed in range(60):
            observe_keyframes(reseeded(vision, seed), poses, at)
            a, b, c = (link_of(vision, i, j).a_from_b for i, j in ((0, 1), (1, 2), (0, 2)))
            squares.append(np.sum(geometry.log(geometry.inverse(c) @ a @ b)[3:] ** 2))
        return np.mean(squares)

    assert closure(0.95) < 0.5 * closure(0.0)


def test_errors_due_to_relief_accumulate_along_a_path_and_cancel_around_a_loop(reef):
    """Ten equal steps; independent errors would accumulate to ten times the variance of one step."""
    poses, at = [tilted(0.02 * k, 0, 2.0) for k in range(11)], [0]
    model = ErrorModel(match_bias_fraction=0.0, common_bias_px=0.0, match_error_ratio=0.0, relief_gain=1.0)
    vision = surrogate_vision(reef, model, lambda: poses[at[0]], Stopwatch())
    steps, sums, closures = [], [], []
    for seed in range(30):
        observe_keyframes(reseeded(vision, seed), poses, at)
        steps.append([error_of_link(vision, k, k + 1) for k in range(10)])
        sums.append(np.sum(steps[-1], axis=0))
        closures.append(steps[-1][0] + steps[-1][1] - error_of_link(vision, 0, 2))
    step, path, closure = (np.mean(np.square(x)[..., 3:]) for x in (steps, sums, closures))
    assert path > 5 * 10 * step
    assert closure < 0.3 * step


@pytest.mark.parametrize(
    ("error_ratio", "bias_fraction", "relief_gain"), [(1.2, 0.0, 0.0), (0.9, 0.8, 0.0), (1.0, 0.6, 10.0)]
)
def test_the_fit_separates_keyframe_bias_from_relief(reef, error_ratio, bias_fraction, relief_gain):
    """60 paths of eleven keyframes: the correlation has a standard error of 0.03. This reef is smooth."""
    poses, at = [tilted(0.04 * k, 0.02 * k, 2.0) for k in range(11)], [0]
    model = ErrorModel(
        match_error_ratio=error_ratio, match_bias_fraction=bias_fraction, relief_gain=relief_gain, common_bias_px=0.0
    )
    models = {"images": model, **single_error_models(model)}
    vision, statistics = surrogate_vision(reef, model, lambda: poses[at[0]], Stopwatch()), defaultdict(list)
    for seed in range(60):
        observe_keyframes(reseeded(vision, seed), poses, at)
        cov = link_of(vision, 0, 1).cov
        for name, vision.model in models.items():
            errors = [error_of_link(vision, k, k + 1) for k in range(10)]
            far = [error_of_link(vision, k, k + 3) for k in range(8)]
            statistics[f"link_nees_{name}"] += [e @ np.linalg.solve(cov, e) for e in errors + far]
            statistics[f"consecutive_product_{name}"] += [e @ np.linalg.solve(cov, f) for e, f in pairwise(errors)]
        statistics["link_distance"] += [1.0] * len(errors) + [3.0] * len(far)
    found = fit._fit_link_errors([statistics], np.ones(1), np.zeros(1), ErrorModel(relief_gain=10.0))
    assert found.match_error_ratio == pytest.approx(error_ratio, rel=0.05)
    assert found.relief_gain == pytest.approx(relief_gain, abs=2.5)
    assert found.match_bias_fraction == pytest.approx(bias_fraction, abs=0.15)


@pytest.fixture
def no_errors(vision):
    zeros = np.zeros(vision.scene.map_model.seen.shape, np.float32)
    return CellErrors(
        *[zeros] * 5, 0.0, np.array([1.0, 3.0]), np.zeros(2), np.full(2, 0.01), np.zeros(2), np.ones(2)
    )  # fmt: skip


def patch_of(model, errors, pose, next_pose=None, estimated=None, seed=0):
    """Returns the height patch of a keyframe; `estimated` is its estimated pose, by default the true one."""
    observed = model.observe(pose, pose if estimated is None else estimated)
    following = None if next_pose is None else model.observe(next_pose, next_pose)
    return model.sample_patch(observed, following, np.zeros((6, 6)), errors, np.random.default_rng(seed))


def test_without_errors_the_patch_of_a_keyframe_is_the_true_floor(vision, no_errors):
    pose = tilted(0.1, 0.2, 2.0)
    patch = patch_of(vision.scene.map_model, no_errors, pose)
    known = np.isfinite(patch.height_m)
    rows, cols = patch.height_m.shape
    true = vision.scene.map_model.height_m[patch.row : patch.row + rows, patch.col : patch.col + cols]
    assert known.sum() > 5000
    np.testing.assert_allclose(patch.height_m[known], true[known], atol=1e-6)


def test_a_height_error_of_the_pose_shifts_the_patch_without_the_cells_of_the_next_keyframe(vision, no_errors):
    pose, next_pose = tilted(0.1, 0.2, 2.0), tilted(0.3, 0.2, 2.0)
    raised = pose.copy()
    raised[2, 3] += 0.01
    whole, strip = (patch_of(vision.scene.map_model, no_errors, pose, n, raised) for n in (None, next_pose))
    rows, cols = whole.height_m.shape
    true = vision.scene.map_model.height_m[whole.row : whole.row + rows, whole.col : whole.col + cols]
    assert np.nanmean(whole.height_m - true) == pytest.approx(0.01, abs=1e-5)
    known = np.isfinite(strip.height_m)
    assert 0.05 < known.sum() / np.isfinite(whole.height_m).sum() < 0.4


def map_model_over(height_m, relative_bounds=NO_DEPENDENCE.bounds):
    """Returns the map model of a floor with heights (ny, nx) at nodes 2 cm apart around the origin, and the rig."""
    n = len(height_m)
    west = -(n - 1) * 0.02 / 2
    grid = MapGrid(west - 0.01, -west + 0.01, 0.02, n, n)
    rig = mission().rig
    floor = height_field(height_m, 0.02, west, west)
    model = MapModel(grid, height_m[::-1].astype(np.float32), rig, floor, 2.0, relative_bounds=relative_bounds)
    return model, rig


def test_a_wall_hides_the_floor_behind_it_from_the_map():
    """Cameras 1.5 m above the upper terrace, 0.8 m from its edge: a strip of 0.8 m / 1.5 at the foot is hidden."""
    x = np.arange(-100, 101) * 0.02
    model, rig = map_model_over(np.broadcast_to(np.where(x > 0, 1.0, 0.0), (201, 201)))
    model.mark_seen(geometry.pose(geometry.BODY_FROM_DOWN_CAMERA, np.array([0.8, 0.0, 2.5])))
    row = model.seen[100]
    assert row[(x > 0.2) & (x < 1.4)].all()
    assert not row[(x > -0.8 / 1.5 + 0.02) & (x < -0.02)].any()
    low = geometry.pose(geometry.BODY_FROM_DOWN_CAMERA, np.array([-0.8, 0.0, 2.5]))
    model.mark_seen(low)
    assert model.seen[100][(x > -1.5) & (x < -0.02)].all()


def test_the_roughness_is_that_of_a_curved_floor_and_zero_on_a_plane():
    """For z = a x^2 it is the standard deviation of a x^2 over the window; for a plane it is zero."""
    y, x = np.meshgrid(np.arange(-50, 51) * 0.02, np.arange(-50, 51) * 0.02, indexing="ij")
    (curved, rig), (plane, _) = map_model_over(0.5 * x**2), map_model_over(0.3 * x + 0.2 * y)
    cells = 2 * max(round((11 * 2.0 / rig.focal_px / 0.02 - 1) / 2), 1) + 1
    across_m = (np.arange(cells) - cells // 2) * 0.02
    inner = np.s_[10:-10, 10:-10]
    np.testing.assert_allclose(curved.roughness_m[inner], np.std(0.5 * across_m**2), rtol=1e-3)
    assert plane.roughness_m[inner].max() < 1e-6


def test_an_edge_does_not_change_the_unevenness_of_the_floor_around_it():
    flown = mission("plan.altitude_m=2.0")
    y, x = np.mgrid[-5:5.01:0.01, -5:5.01:0.01]
    rough = 0.01 * np.sin(40 * x) * np.sin(40 * y)
    smooth, wall = (
        Terrain(h.astype(np.float32), 0.01, -5.0, -5.0, flown.terrain.texture, 0.005) for h in (rough, rough + (x > 0))
    )
    without, with_wall = (unevenness_px(flown.scenario, floor, np.array([2.0]))[0] for floor in (smooth, wall))
    assert with_wall == pytest.approx(without, rel=0.1)


def test_the_variance_of_a_cell_decreases_with_the_number_of_keyframes_and_their_distance(vision, no_errors):
    """By the law c + (1 - c) / (1 + g (n - 1)), g = gain B^2 / (B^2 + half^2) + noise_gain s, for steps B of 0 to 2.

    The steps are in baselines, and the share s of image noise is 0.64 / (0.36 + 0.64).
    """
    law, baseline_m = DepthLaw(0.06, 2.0, 0.0, 0.2, 2.0, 1.5, 0.5), vision.rig.baseline_m
    errors, model = no_errors._replace(sigma_law=law, depth_sigma_px=np.full(2, 0.1)), vision.scene.map_model
    errors = errors._replace(sigma_noise_share=law.noise_share(np.full(2, 0.04)))
    for part in model._runs:
        part[:] = 0
    for step in (1e-6, 1, 2):
        poses = [tilted(0.1 + step * baseline_m * k, 0.2, 2.0) for k in range(4)]
        variances = {}
        for n in (1, 4):
            for pose, next_pose in pairwise([*poses[4 - n :], None]):
                patch = patch_of(model, errors, pose, next_pose)
            window = np.s_[
                patch.row : patch.row + patch.height_m.shape[0], patch.col : patch.col + patch.height_m.shape[1]
            ]
            variances[n] = np.where(model.views[window] == n, patch.variance_m2, np.nan)
        gain = 2.0 * step**2 / (step**2 + 1.5**2) + 0.5 * 0.64
        ratio = (variances[4] / variances[1])[np.isfinite(variances[4] / variances[1])]
        assert len(ratio) > 1000
        np.testing.assert_allclose(ratio, 0.2 + 0.8 / (1 + 3 * gain), rtol=1e-4)
        assert law.relative_variance(4, step, 0.04) == pytest.approx(0.2 + 0.8 / (1 + 3 * gain))


def test_the_errors_of_a_map_are_normal_with_the_standard_deviation_of_their_cell(vision, no_errors):
    """A scale mixture: the kurtosis of the errors is 3 exp(4 s^2) for a scatter s, that of error / sigma is 3.

    The precision of a cell is the same for all keyframes that show it.
    """
    rng, model, scatter = np.random.default_rng(0), vision.scene.map_model, 0.4
    errors = no_errors._replace(
        cell_noise=rng.standard_normal(model.seen.shape, np.float32), cell_scatter=np.full(2, scatter),
        depth_error_px=np.full(2, 0.1), depth_sigma_px=np.full(2, 0.1),
    )  # fmt: skip
    patches = [patch_of(model, errors, tilted(0.1, 0.2, 2.0), seed=seed) for seed in range(8)]
    known = np.isfinite(patches[0].height_m)
    np.testing.assert_allclose(patches[0].variance_m2[known], patches[7].variance_m2[known])
    window = np.s_[patches[0].row : patches[0].row + known.shape[0], patches[0].col : patches[0].col + known.shape[1]]
    error = np.array([(patch.height_m - model.height_m[window])[known] for patch in patches]).astype(float)
    sigma = np.sqrt(patches[0].variance_m2[known])
    per_px = (
        vision.rig.focal_px
        * vision.rig.baseline_m
        / 0.1
        / np.square(model.observe(*2 * [tilted(0.1, 0.2, 2.0)]).depth_m[known])
    )
    assert np.log(sigma * per_px).std() == pytest.approx(scatter, rel=0.03)

    def kurtosis(x):
        return float(np.mean(x**4) / np.mean(x**2) ** 2)

    assert kurtosis(error / sigma) == pytest.approx(3, rel=0.05)
    assert kurtosis(error * per_px) == pytest.approx(3 * np.exp(4 * scatter**2), rel=0.2)


def test_the_errors_of_neighbouring_cells_have_the_correlation_of_overlapping_squares(vision, no_errors):
    model = vision.scene.map_model
    patch = patch_of(model, no_errors._replace(depth_error_px=np.full(2, 0.1)), tilted(0.1, 0.2, 2.0))
    rows, cols = patch.height_m.shape
    error = patch.height_m - model.height_m[patch.row : patch.row + rows, patch.col : patch.col + cols]
    known = np.isfinite(error)
    both = known[:, 1:] & known[:, :-1]
    correlation = np.corrcoef(error[:, 1:][both], error[:, :-1][both])[0, 1]
    assert model.correlated_cells > model.window_cells > 1
    assert correlation == pytest.approx(1 - 1 / model.correlated_cells, abs=0.05)


def test_cells_without_a_height_lie_along_the_border_of_the_images(vision, no_errors):
    """Of the cells at a distance b from the border, the fraction 0.5 exp(-b / 10) has no height."""
    model, pose = vision.scene.map_model, tilted(0.1, 0.2, 2.0)
    uniform = np.random.default_rng(0).random(model.seen.shape, np.float32)
    errors = no_errors._replace(dropout=uniform, border_share=0.5, border_width_px=np.full(2, 10.0))
    observed, patch = model.observe(pose, pose), patch_of(model, errors, pose)
    for low, high in ((0, 10), (10, 20), (40, 60)):
        cells = (observed.depth_m > 0) & (observed.border_px >= low) & (observed.border_px < high)
        expected = 0.5 * np.exp(-observed.border_px[cells] / 10).mean()
        holes = np.isnan(patch.height_m[cells]).mean()
        assert holes == pytest.approx(expected, abs=4 * np.sqrt(expected / cells.sum()) + 1e-3)


def test_the_noise_of_edges_has_unit_variance_and_the_correlation_of_a_window():
    """Means over windows of four cells share three quarters of their cells with those of the neighbours."""
    noise = window_noise((400, 400), 4, np.random.default_rng(0))
    assert noise.std() == pytest.approx(1.0, rel=0.03)
    assert np.mean(noise[:, 1:] * noise[:, :-1]) == pytest.approx(0.75, abs=0.05)


def vision_roughness_px(vision):
    rig, model = vision.rig, vision.scene.map_model
    return model.roughness_m * rig.focal_px * rig.baseline_m / model.depth_m**2


def test_cells_near_a_wall_have_larger_errors_and_standard_deviations():
    x = np.arange(-60, 61) * 0.02
    model, _ = map_model_over(np.broadcast_to(np.where(x > 0, 0.1, 0.0), (121, 121)))
    zeros = np.zeros((121, 121), np.float32)
    errors = CellErrors(
        *[zeros] * 5, 0.0, np.array([1.0, 3.0]), np.zeros(2), np.full(2, 1e-3), np.zeros(2), np.ones(2)
    )._replace(edge_noise=zeros + 1, edge_error=np.full(2, 2.0), edge_sigma_gain=0.5)  # fmt: skip
    pose, beside = (geometry.pose(geometry.BODY_FROM_DOWN_CAMERA, np.array([x, 0.0, 2.0])) for x in (0.0, 0.02))
    patch, plain = (patch_of(model, e, pose) for e in (errors, errors._replace(edge_sigma_gain=0.0)))
    window = np.s_[patch.row : patch.row + patch.height_m.shape[0], patch.col : patch.col + patch.height_m.shape[1]]
    known = np.isfinite(patch.height_m)
    edge_m = model.edge_m[window][known]
    difference = (patch.height_m - model.height_m[window])[known]
    np.testing.assert_allclose(difference, 2 * edge_m, atol=1e-5)
    assert difference.max() > 0.04 and difference.min() < 1e-5
    added = (patch.systematic_m2 - plain.systematic_m2)[known]
    np.testing.assert_allclose(added, (0.5 * edge_m) ** 2, rtol=1e-3, atol=1e-9)
    at_border = patch_of(model, errors._replace(border_edge=np.full(2, 3.0)), pose)
    np.testing.assert_allclose((at_border.height_m - model.height_m[window])[known], 6 * edge_m, atol=2e-5)
    patch_of(model, errors, pose, beside)
    twice = patch_of(model, errors, beside)
    window = np.s_[twice.row : twice.row + twice.height_m.shape[0], twice.col : twice.col + twice.height_m.shape[1]]
    seen_twice = np.isfinite(twice.height_m) & (model.views[window] == 2)
    expected = 2 * model.edge_m[window][seen_twice] / 2**0.2
    np.testing.assert_allclose((twice.height_m - model.height_m[window])[seen_twice], expected, atol=1e-5)


def test_errors_near_walls_decrease_from_the_border_of_the_image_to_its_centre():
    """1 + 1.2 exp(-6 b / height)."""
    factor = edge_border_factor(np.array([0.0, 40.0, 120.0]), 240)
    np.testing.assert_allclose(factor, [2.2, 1 + 1.2 / np.e, 1 + 1.2 / np.e**3])


def cells_of(patch):
    """Returns the window of the grid that a patch covers."""
    return np.s_[patch.row : patch.row + patch.height_m.shape[0], patch.col : patch.col + patch.height_m.shape[1]]


def test_errors_of_depth_follow_the_table_of_the_distance_from_the_border(vision, no_errors):
    """Only the keyframe itself observes the cells, so their distance is that in its images."""
    model, pose = vision.scene.map_model, tilted(0.1, 0.2, 2.0)
    plain = no_errors._replace(depth_error_px=np.full(2, 0.1), depth_sigma_px=np.full(2, 0.2))
    ramp = plain._replace(border_distances_px=np.array([0.0, 50.0]), border_depth=np.array([3.0, 1.0]))
    observed = model.observe(pose, pose)
    first, second = patch_of(model, plain, pose), patch_of(model, ramp, pose)
    known, near = np.isfinite(first.height_m), np.clip(1 - observed.border_px / 50, 0, 1)
    errors = [(patch.height_m - model.height_m[cells_of(first)])[known] for patch in (first, second)]
    np.testing.assert_allclose(errors[1], errors[0] * (1 + 2 * near[known]), atol=1e-6)
    sigmas = [np.sqrt(patch.variance_m2[known]) for patch in (first, second)]
    np.testing.assert_allclose(sigmas[1], sigmas[0] * (1 + 2 * near[known]), rtol=1e-4)


def test_errors_of_depth_follow_the_bound_at_the_position_in_the_image(no_errors):
    """The bound is 1 at the left and 2 at the right border, so its square is a ramp of information between them."""
    grid_m = np.zeros((121, 121))
    even, rig = map_model_over(grid_m)
    model, _ = map_model_over(grid_m, np.array([[1.0, 2.0]]))
    zeros = np.zeros((121, 121), np.float32)
    ratios = np.linspace(1.0, 2.0, 100)
    errors = CellErrors(
        *[zeros] * 5, 0.0, np.array([1.0, 3.0]), np.full(2, 0.1), np.full(2, 0.2), np.zeros(2), np.ones(2),
        bound_ratios=ratios, bound_error=ratios**2, bound_sigma=ratios,
    )  # fmt: skip
    pose, beside = (geometry.pose(geometry.BODY_FROM_DOWN_CAMERA, np.array([x, 0.0, 2.0])) for x in (0.0, 0.02))
    observed = model.observe(pose, pose)
    plain, patch = (patch_of(m, errors, pose) for m in (even, model))
    known = np.isfinite(patch.height_m)
    rows, cols = (k[cells_of(patch)][known] for k in np.indices((121, 121)))
    floor = [model.grid.west_m + (cols + 0.5) * 0.02, model.grid.north_m - (rows + 0.5) * 0.02, 0 * cols, 0 * cols + 1]
    column = (rig.focal_px * (geometry.inverse(pose) @ floor)[0] / 2.0 + rig.cx_px + 0.5) / rig.width_px * 2 - 0.5
    information = 1 - 0.75 * np.clip(column, 0, 1)
    np.testing.assert_allclose(observed.information[known], information, rtol=1e-3)
    ratio = 1 / np.sqrt(information)
    np.testing.assert_allclose(model.bound_ratio[cells_of(patch)][known], ratio, rtol=1e-3)
    np.testing.assert_allclose((patch.height_m / plain.height_m)[known], ratio**2, rtol=5e-3)
    np.testing.assert_allclose((patch.variance_m2 / plain.variance_m2)[known], ratio**2, rtol=5e-3)
    second = model.observe(beside, beside)
    patch_of(model, errors, pose, beside)
    twice = patch_of(model, errors, beside)
    both = np.isfinite(twice.height_m) & (model.views[cells_of(twice)] == 2)
    rows, cols = (np.nonzero(both)[k] + offset for k, offset in enumerate((twice.row, twice.col)))
    summed = observed.information[rows - observed.row, cols - observed.col] + second.information[both]
    np.testing.assert_allclose(model.bound_ratio[rows, cols], np.sqrt(2 / summed), rtol=1e-5)


LAMPS = "lamps=[{position_m=[0.25, 0.35, -0.05], pan_deg=-8.0}, {position_m=[0.25, -0.35, -0.05], pan_deg=8.0}]"


def test_lamps_make_the_centre_of_the_image_more_precise_than_its_sides_and_daylight_does_not():
    lit, sunlit = (
        position_dependence(FloorImages(m.scenario, m.illumination), 2.0).bounds
        for m in (mission(LAMPS, "sun.illuminance_lx=0"), mission("lamps=[]", "sun.illuminance_lx=1000"))
    )
    assert lit[:, [0, -1]].min() > 1.1 > 0.9 > lit[2:4, 3:5].max()
    np.testing.assert_allclose(sunlit, 1.0, atol=0.08)


def test_the_relative_bound_is_that_of_random_textures_in_crops_of_the_image():
    """Oracle: bounds from gradients and noise of other textures (white noise) in each quarter of the image."""
    m = mission(LAMPS, "sun.illuminance_lx=0", "water.jerlov=III")
    table = position_dependence(FloorImages(m.scenario, m.illumination), 2.0).bounds
    rng, rig = np.random.default_rng(7), m.scenario.believed_rig()
    formation = ImageFormation(m.scenario, m.illumination, None, rng)
    shape = rig.height_px, rig.width_px
    depth, camera = np.full(shape, 2.0, np.float32), StampedPose(tilted(0.0, 0.0, 2.0), 0.0)
    albedo = np.repeat(rng.integers(40, 140, (*shape, 1), np.uint8), 3, axis=2)
    lights = [formation.radiance(image, depth, 0, camera) for image in (albedo, np.full_like(albedo, 90))]
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
    assert position_dependence(FloorImages(m.scenario, m.illumination), 1000.0) is NO_DEPENDENCE


def test_rough_cells_have_more_holes(vision, no_errors):
    shape = vision.scene.map_model.seen.shape
    rng, pose, model = np.random.default_rng(0), tilted(0.1, 0.2, 2.0), vision.scene.map_model
    uniform = rng.random(shape, np.float32)
    patch = patch_of(model, no_errors._replace(dropout=uniform, edge_half_px=0.2), pose)
    window = np.s_[patch.row : patch.row + patch.height_m.shape[0], patch.col : patch.col + patch.height_m.shape[1]]
    known = np.isfinite(patch.height_m)
    rough = model.roughness_m[window] > np.quantile(model.roughness_m[window], 0.9)
    inside = np.s_[20:-20, 20:-20]
    assert known[inside][rough[inside]].mean() < 0.9 * known[inside][~rough[inside]].mean()


TRUE_DEPTH = DepthLaw(0.05, 1.5, 1.2, 0.05, 3.0, 1.4, 0.8)
TRUE_EDGE = SigmaLaw(0.7, 12.0)
TRUE_BINNED = BinnedDepthLaw(1.2, 2.5, 0.2, 2.0, 0.3)


def map_statistics(rng, scatter=0.02, binning=1):
    """Returns statistics of surveys whose variances follow `TRUE_DEPTH`, with known lateral, relief and edge errors.

    In binned images, they follow the law that `TRUE_BINNED` makes of it.

    The variances of sampled maps are the sums of those of their errors, with the parameters of `ErrorModel()`.
    """
    model, true = ErrorModel(), TRUE_BINNED.changed(TRUE_DEPTH, binning)
    law, _ = model.depth_laws(binning)
    conditions = (
        (0.02, 0, 0.5),
        (0.02, 1, 1.5),
        (0.04, 0, 3),
        (0.04, 1, 0.7),
        (0.1, 1, 2),
        (0.1, 0, 1),
        (0.1, 0, 0.1),
        (0.02, 0, 0.1),
    )
    for bound_px, lamp, step in conditions:
        survey = {"bound_px": [bound_px], "lamp_share": [lamp], "binning": 2 * [binning], "metres_per_px": [8e-3**0.5]}
        survey |= {"window_ratio": [1.0]}
        classes = ("smooth1", 1, 0.0), ("smooth4", 5, 0.0), ("smooth15", 20, 0.0), ("rough9", 11, 0.05)
        for name, views, rough_px in (*classes, ("rougher9", 11, 0.2), ("steep", 5, 0.0), ("edge", 4, 1.0)):
            pose, per_px2 = 1e-7, 8e-3
            lateral, edge = (1e-5 if name == "steep" else 0.0), (1e-3 if name == "edge" else 0.0)
            depth_px = true.sigma_px(bound_px, lamp) ** 2 * true.relative_variance(views, step, bound_px)
            relief = relief_error_px(rough_px, 0.4, 0.05) ** 2
            images = pose + per_px2 * (depth_px + relief) + 1.5**2 * lateral + TRUE_EDGE(bound_px) ** 2 * edge
            images *= float(np.exp(scatter * rng.standard_normal()))
            sampled_px = law.sigma_px(bound_px, lamp) ** 2 * law.relative_variance(views, step, bound_px)
            sampled_px += relief_error_px(rough_px, model.relief_error_gain, model.relief_error_limit_px) ** 2
            sampled = (
                pose
                + per_px2 * sampled_px
                + model.lateral_sigma_px**2 * lateral
                + model.edge_error(bound_px) ** 2 * edge
            )
            survey[f"map_error_{name}"] = [
                images, pose, pose + per_px2 * UNIT_PX**2, pose + lateral, pose + edge, sampled, views, step, rough_px
            ]  # fmt: skip
        yield survey


def test_the_fit_recovers_the_variances_of_maps():
    found = fit._fit_map_variances(list(map_statistics(np.random.default_rng(0))), "error", ErrorModel())
    for bound_px, lamp, views, step in (
        (0.02, 0, 1, 1),
        (0.1, 1, 5, 1),
        (0.04, 0.5, 10, 0.6),
        (0.03, 1, 4, 3),
        (0.1, 0, 9, 0),
    ):
        fitted, true = (
            law.sigma_px(bound_px, lamp) * np.sqrt(law.relative_variance(views, step, bound_px))
            for law in (found.depth, TRUE_DEPTH)
        )
        assert fitted == pytest.approx(true, rel=0.05)
    assert found.depth.noise_gain == pytest.approx(0.8, rel=0.2)
    assert found.lateral_sigma_px == pytest.approx(1.5, rel=0.05)
    assert found.relief_gain == pytest.approx(0.4, rel=0.15)
    assert found.relief_limit_px == pytest.approx(0.05, rel=0.1)
    for bound_px in (0.02, 0.1):
        assert found.edge(bound_px) == pytest.approx(TRUE_EDGE(bound_px), rel=0.05)
    assert fit._robust_scatter(found.departures) < 0.02


def test_parameters_that_no_survey_determines_keep_the_values_of_the_compared_model():
    """A unit error at edges has a thousandth of the effect of the pose, and the noise of the statistics is 2 %."""
    surveys = list(map_statistics(np.random.default_rng(0)))
    for statistics in surveys:
        for name in [name for name in statistics if name.startswith("map")]:
            if "edge" in name:
                del statistics[name]
            else:
                statistics[name][4] = statistics[name][1] * 1.001
    found = fit._fit_map_variances(surveys, "error", ErrorModel(edge_error=SigmaLaw(1.7, 20.0)))
    assert found.edge == pytest.approx((1.7, 20.0), rel=0.05)


def test_the_fit_takes_into_account_that_errors_raise_the_variance_of_a_sampled_map_more_than_they_add():
    """If sampled maps have 1.44 times the variance of the sum of their errors, depth errors are 1.2 times smaller."""
    surveys = list(map_statistics(np.random.default_rng(0)))
    larger = [{k: [*v[:5], 1.44 * v[5], *v[6:]] if k.startswith("map") else v for k, v in s.items()} for s in surveys]
    laws = [fit._fit_map_variances(s, "error", ErrorModel()).depth for s in (surveys, larger)]
    first, second = (law.sigma_px(0.05, 0.5) * np.sqrt(law.relative_variance(3, 1.5, 0.05)) for law in laws)
    assert first / second == pytest.approx(1.2, rel=0.03)


def test_the_fit_finds_the_scatter_of_depth_errors_between_surveys():
    """36 surveys: the scatter from median absolute values has a relative standard error of about 0.2."""
    rng, surveys = np.random.default_rng(1), []
    for simulated in [s for _ in range(6) for s in map_statistics(rng)]:
        factor = float(np.exp(0.4 * rng.standard_normal()))  # of the variance: 0.2 of the standard deviation
        surveys.append({k: [v[0] * factor, *v[1:]] if k.startswith("map") else v for k, v in simulated.items()})
    departures = fit._fit_map_variances(surveys, "error", ErrorModel()).departures
    assert fit._robust_scatter(departures) == pytest.approx(0.2, rel=0.4)


def test_surveys_with_binned_images_determine_their_law_and_not_the_laws_of_full_images():
    surveys, by_2, by_4 = (list(map_statistics(np.random.default_rng(k), binning=k)) for k in (1, 2, 4))
    fine = fit._fit_map_variances(surveys, "error", ErrorModel())
    both = fit._fit_map_variances([*surveys, *by_2, *by_4], "error", ErrorModel())
    assert fine.binned == ErrorModel().depth_binned_error
    assert both.binned == pytest.approx(TRUE_BINNED, rel=0.15)
    np.testing.assert_allclose(both.depth, fine.depth, rtol=1e-3)
    assert fit._robust_scatter(both.departures) < 0.03


def test_the_fit_recovers_the_scatter_of_depth_over_the_cells_of_a_map():
    """The scatter of a survey is proportional to that of its texture, with and without binning."""
    true, surveys = ScatterLaw(2.4, 0.05), []
    for binning, texture, bound_px in ((1, 0.2, 0.02), (1, 0.5, 0.06), (2, 0.3, 0.2), (4, 0.6, 0.1)):
        scatter = {"map_scatter_smooth4": [float(true(bound_px, texture))], "map_scatter_edge": [3.0]}
        surveys.append({"bound_px": [bound_px], "texture_scatter": [texture], "binning": [binning, binning], **scatter})
    np.testing.assert_allclose(fit._fit_texture_scatter(surveys, ErrorModel().depth_texture_scatter), true, rtol=1e-3)
    assert fit._fit_texture_scatter([{"bound_px": [0.1]}], true) == true


def test_an_evenly_textured_image_has_the_same_bound_in_all_windows():
    """Columns alternate between two grey levels, so each window has the gradient of the whole image."""
    even = np.tile([0.0, 3.0], (40, 20))
    assert window_texture(even) == pytest.approx(EVEN_TEXTURE, abs=1e-9)
    assert window_texture(np.full((40, 40), 7.0)) == EVEN_TEXTURE


def test_the_bound_of_a_window_is_inversely_proportional_to_its_gradient():
    """Three quarters of the image have the contrast 1, one quarter 4; windows across the border are few."""
    contrast = np.repeat([1.0, 4.0], [1500, 500])[None]
    texture = window_texture(contrast * np.tile([0.0, 1.0], (60, 1000)))
    assert texture.median_ratio == pytest.approx(np.sqrt((3 * 1 + 16) / 4), rel=0.01)
    assert texture.scatter == pytest.approx(np.log(4) * np.sqrt(3) / 4, rel=0.01)
    assert window_texture(5 * contrast * np.tile([0.0, 1.0], (60, 1000))) == pytest.approx(texture)


def test_windows_without_texture_have_the_largest_bound_that_is_counted():
    """The running sums of the blur leave values just below zero after the end of a texture."""
    signal = np.zeros((60, 400))
    signal[:24] = np.random.default_rng(0).normal(0, 5, (24, 400))
    texture = window_texture(signal)
    assert texture.median_ratio == pytest.approx(20)  # 1 / 0.05, in 32 of 56 rows of windows
    assert texture.scatter == pytest.approx(np.log(20 * np.sqrt(60 / 24)) * np.sqrt(24 * 32) / 56, rel=0.1)


def test_at_an_infinite_bound_noise_causes_all_errors_and_no_cell_has_a_height(vision, no_errors):
    law, bounds = DepthLaw(0.05, 2.0, 1.0, 0.01, 4.0, 1.5), np.array([0.1, 1e9, np.inf])
    assert law.noise_share(bounds)[2] == 1 == law.noise_share(bounds)[1]
    assert ScatterLaw(2.0, 0.03)(bounds, 0.5)[2] == 1.0
    errors = no_errors._replace(depth_error_px=np.array([0.0, np.inf]))
    assert np.isnan(patch_of(vision.scene.map_model, errors, tilted(0.1, 0.2, 2.0)).height_m).all()


def test_a_height_that_is_not_a_number_is_an_error_and_not_a_hole(vision, no_errors):
    for unknown in ({"cell_scatter": np.full(2, np.nan)}, {"completeness": np.full(2, np.nan)}):
        with pytest.raises(FloatingPointError, match="height"):
            patch_of(vision.scene.map_model, no_errors._replace(**unknown), tilted(0.1, 0.2, 2.0))
    broken = vision.model._replace(depth_error=DepthLaw(0.0, 0.0, np.inf, 0.01, 3.0, 1.0))
    with pytest.raises(FloatingPointError):
        vision._cell_errors(broken, (4, 4))


def test_below_the_floor_nothing_is_matched(reef):
    vision = surrogate_vision(reef, ErrorModel(), lambda: tilted(0, 0, -1.0), Stopwatch())
    with np.errstate(divide="raise"):
        assert vision.observe_stereo(None, 0) is None


def test_without_image_noise_snow_between_the_patches_leaves_exact_matches():
    clean = [np.random.default_rng(0).normal(100, 10, (80, 80)).astype(np.float32)] * 3
    snowy = [image.copy() for image in clean]
    for k, image in enumerate(snowy):
        image[30 + k : 33 + k, 40] += 5
    effect = snow_effect(clean, snowy, 0.0, 9)
    assert effect.matched_share == 1.0
    assert 0 <= effect.variance_px2 < 1e-9


def test_dense_matching_has_the_bound_of_the_median_window_and_the_scatter_of_the_windows(vision):
    matching, law = vision.scene.matchability, ScatterLaw(2.0, 0.03)
    model = vision.model._replace(depth_error=DepthLaw(0.0, 1.0, 0.0, 0.01, 3.0, 1.0), depth_texture_scatter=law)
    errors = vision._cell_errors(model, (4, 4))
    assert matching.texture.median_ratio > 1 and matching.texture.scatter > 0.1
    np.testing.assert_allclose(errors.depth_error_px, matching.bounds_px * matching.texture.median_ratio)
    np.testing.assert_allclose(errors.cell_scatter, law(matching.bounds_px, matching.texture.scatter))


def test_the_share_of_noise_in_the_variance_of_depth_grows_with_the_bound_of_the_median_window(vision):
    """It is c^2 / (c0^2 + c^2) at the bound c, if the error without noise is that of noise at the bound c0."""
    window_px = vision.scene.matchability.window_bounds_px
    laws = [DepthLaw(slope * window_px[0], slope, 1.0, 0.01, 3.0, 1.0, 0.8) for slope in (1.5, 3.0)]
    errors = vision._cell_errors(vision.model._replace(depth_error=laws[0], depth_sigma=laws[1]), (4, 4))
    share = window_px**2 / (window_px[0] ** 2 + window_px**2)
    assert share[0] == 0.5 and share[-1] > 0.505
    np.testing.assert_allclose(errors.error_noise_share, share)
    np.testing.assert_allclose(errors.sigma_noise_share, share)


def test_the_fit_finds_the_share_of_the_scatter_of_cells_that_their_true_errors_have():
    """Rendered errors scatter by exp(0.45 n), those sampled with the compared share of 0.9 by exp(0.6 n)."""
    rng, surveys = np.random.default_rng(0), []
    for _ in range(20):
        sizes = [np.abs(rng.standard_normal(20_000) * np.exp(s * rng.standard_normal(20_000))) for s in (0.45, 0.6)]
        tails = [float(np.divide(*np.percentile(size, (90, 50)))) for size in sizes]
        surveys.append({"map_tail_smooth4": tails, "map_tail_edge0.1": [10.0, 1.0]})
    assert fit._fit_error_scatter(surveys, 0.9) == pytest.approx(0.9 * 0.45 / 0.6, rel=0.06)
    assert fit._fit_error_scatter([{"map_tail_smooth4": [3.0, 2.4]}], 0.9) == 0.9  # sampled errors without tails


def test_the_true_error_of_a_cell_has_a_share_of_the_scatter_of_its_standard_deviation(vision, no_errors):
    """Cells one standard deviation above the median: exp(0.5 0.4) for errors and exp(0.4) for standard deviations."""
    ones = np.ones(vision.scene.map_model.seen.shape, np.float32)
    errors = no_errors._replace(depth_error_px=np.full(2, 0.1), depth_sigma_px=np.full(2, 0.1))
    scattered = errors._replace(cell_noise=ones, cell_scatter=np.full(2, 0.4), error_scatter_share=0.5)
    pose, truth = tilted(0.0, 0.0, 2.0), vision.scene.map_model
    level, changed, exact = (patch_of(truth, e, pose) for e in (errors, scattered, no_errors))
    ratio = (changed.height_m - exact.height_m) / (level.height_m - exact.height_m)
    assert np.nanmedian(ratio) == pytest.approx(np.exp(0.2), rel=1e-3)
    assert np.nanmedian(changed.variance_m2 / level.variance_m2) == pytest.approx(np.exp(0.8), rel=1e-3)


def test_the_fit_recovers_the_holes_at_image_borders():
    true, surveys = BorderLaw(0.45, 1.5, 90.0, 1.2), []
    for bound_px, lamp in ((0.01, 0.0), (0.04, 0.0), (0.02, 1.0), (0.06, 1.0)):
        distance = np.array([0.25, 0.75, 1.5, 3.0, 6.0, 12.0])
        known = 0.99 * (1 - true.share * np.exp(-distance / true.width_px(bound_px, lamp)))
        surveys.append({
            "bound_px": [bound_px], "lamp_share": [lamp], "hole_known": [0.99], "hole_px": [0.1],
            "border_px": distance, "border_known": known, "border_cells": [500.0] * 6,
        })  # fmt: skip
    np.testing.assert_allclose(fit._fit_border_holes(surveys, BorderLaw(1, 1, 1, 1)), true, rtol=0.02)


def test_the_fit_recovers_the_errors_at_image_borders():
    """The compared model already has a part of the increase."""
    true, compared, rng = BorderErrorLaw(1.4, 4.0), BorderErrorLaw(0.5, 2.0), np.random.default_rng(0)
    distance = np.array([1.0, 3.0, 6.0, 9.0, 16.0, 30.0, 80.0])
    surveys = []
    for level in (0.7, 1.0, 1.5):  # of all errors of a survey, relative to the compared model
        ratios = level * true(distance) / compared(distance) * np.exp(0.02 * rng.standard_normal((2, 7)))
        surveys.append(
            {"border_distance_px": distance, "border_error_ratio": ratios[0], "border_sigma_ratio": ratios[1]}
        )
    np.testing.assert_allclose(fit._fit_border_errors(surveys, compared), true, rtol=0.1)
    assert fit._fit_border_errors([{}], compared) == compared


def test_surveys_without_smooth_cells_do_not_determine_the_holes_of_smooth_floors():
    """The first bin of roughness of a survey over a rough floor alone begins at 0.7 px."""
    rough = {
        "bound_px": [0.02], "lamp_share": [1.0], "hole_known": [0.5, 0.2], "hole_px": [0.7, 1.4],
        "hole_cells": [900.0, 100.0], "border_px": [3.0], "border_known": [0.5], "border_cells": [100.0],
    }  # fmt: skip
    law, holes = FractionLaw(0.98, 0.5, 4.0), BorderLaw(0.4, 1.0, 50.0, 1.0)
    assert fit._fit_completeness([rough], law) == law
    assert fit._fit_border_holes([rough], holes) == holes
    assert fit._fit_edge_holes([rough], 7.0) == 7.0
    smooth = rough | {"hole_px": [0.1, 1.4], "hole_known": [0.97, 0.9], "border_known": [0.7]}
    assert fit._fit_completeness([smooth, rough], law)(0.02) == pytest.approx(0.97, abs=1e-3)
    assert fit._fit_edge_holes([smooth, rough], 7.0) != 7.0


def test_the_fit_recovers_the_roughness_that_halves_the_map():
    roughness = np.array([0.1, 0.3, 0.7, 1.5, 3.0, 6.0])
    known = 0.99 / (1 + (roughness / 4.0) ** 2) * (1 + (0.1 / 4.0) ** 2)
    survey = {"hole_known": known, "hole_px": roughness, "hole_cells": [1000.0] * 6}
    assert fit._fit_edge_holes([survey], 10.0) == pytest.approx(4.0, rel=0.1)


@pytest.mark.parametrize("jobs", [1, 3])
def test_the_statistics_of_surveys_come_in_their_order(jobs, monkeypatch):
    """With threads in place of processes; the first surveys take longest."""
    monkeypatch.setattr(rendered_surveys, "ProcessPoolExecutor", lambda n, mp_context: ThreadPoolExecutor(n))
    monkeypatch.setattr(rendered_surveys, "get_context", lambda method: None)

    def statistics(scenario, folder, compared):
        time.sleep(0.05 / (1 + scenario))
        return {"value": [scenario], "folder": [folder], "compared": [compared]}

    monkeypatch.setattr(rendered_surveys, "survey_statistics", statistics)
    found = list(all_statistics([(k, f"run{k}") for k in range(6)], "model", jobs))
    assert found == [{"value": [k], "folder": [f"run{k}"], "compared": ["model"]} for k in range(6)]


@pytest.mark.parametrize("scene", SCENES)
def test_the_surrogate_maps_every_shipped_scene(scene, tmp_path, outside_data, monkeypatch):
    if scene.startswith("horseshoe"):
        monkeypatch.setenv("TWIN_DATA", str(outside_data("horseshoe_reef_dem.tif").parent))
    short = ["seed=41", "plan.tracks=1", "plan.area_m=[1.5,1.5]"]
    sets = [*short, 'imaging.fidelity="surrogate"', "imaging.extrapolate=true"]
    metrics = survey.run(load_scenario(scene, sets), tmp_path / "run", outputs=None).metrics
    assert metrics["status"] == "complete"
    assert metrics["map"]["completeness"] > 0.95


def test_a_survey_in_water_without_matches_is_not_flown(tmp_path):
    scenario = load_scenario("reef", ['water.jerlov="9C"', "water.turbidity=4", "plan.tracks=1"])
    assert rendered_surveys.survey_statistics(scenario, tmp_path / "run", ErrorModel()) == {}
    assert not (tmp_path / "run").exists()


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


def test_an_error_model_is_loaded_as_it_was_saved(tmp_path):
    model = ErrorModel(match_sigma_px=SigmaLaw(0.031, 0.7), f2f_anticorrelation=0.123)
    fitted = error_model_file.FittedErrorModel(model, 7, {"match_sigma_px": 0.1})
    error_model_file.save(fitted, tmp_path / "model.toml")
    assert error_model_file.load(tmp_path / "model.toml") == fitted
    unlimited = error_model_file.FittedErrorModel(model, 7, {"match_sigma_px": 0.1}, {"bound_px": (0.01, np.inf)})
    error_model_file.save(unlimited, tmp_path / "unlimited.toml")
    loaded = error_model_file.load(tmp_path / "unlimited.toml")
    assert loaded == unlimited
    assert not loaded.quantities_outside_fit({"bound_px": (1e5, 1e5)})


@pytest.mark.parametrize(("lost_px", "limit_px"), [(0.3, np.inf), (0.05, 0.1)])
def test_the_bound_is_unlimited_if_the_most_turbid_survey_of_the_fit_was_lost(lost_px, limit_px):
    complete, lost = ({"condition_bound_px": [px, px]} for px in (0.1, lost_px))
    assert rendered_surveys._fitted_range([complete], [lost])["bound_px"] == (0.1, limit_px)


def test_a_few_gross_links_do_not_determine_the_bias_of_keyframes():
    """Three products of a survey whose links failed outweighed 1300 of 47 others, and gave a bias fraction of 0.98."""
    rng = np.random.default_rng(0)

    def links(n, product):
        values = {"link_nees_images": np.ones(n), "link_nees_patches": np.ones(n), "link_nees_relief": np.full(n, 1e-6)}
        return values | {
            "link_distance": rng.random(n), "consecutive_product_images": np.full(n, product),
            "consecutive_product_patches": np.full(n, -0.2), "consecutive_product_relief": np.zeros(n),
        }  # fmt: skip

    usual = [links(30, -0.1) for _ in range(20)]
    without, bias = (
        fit._fit_link_errors(surveys, np.ones(len(surveys)), np.zeros(len(surveys)), ErrorModel()).match_bias_fraction
        for surveys in (usual, [*usual, links(3, -5.0)])
    )
    assert without == pytest.approx(0.4, rel=0.01)  # BIAS_FRACTION / 2
    assert bias == pytest.approx(without, rel=0.3)


@pytest.mark.parametrize(("frames", "links", "is_lost"), [(0.1, 0.1, False), (0.3, 0.0, True), (0.0, 0.3, True)])
def test_a_survey_is_lost_if_many_frames_or_links_fail(frames, links, is_lost):
    flags = {name: [1.0] * round(10 * share) + [0.0] * round(10 - 10 * share) for name, share in
             (("frame_lost", frames), ("link_failed_images", links))}  # fmt: skip
    assert rendered_surveys._is_lost(flags) == is_lost


def test_every_point_is_matched_in_the_model_with_which_images_are_compared():
    """Otherwise there are no statistics where the surrogate loses vision and the images do not."""
    model = ErrorModel(point_fraction=FractionLaw(0.8, 0.1, 4.0), match_fraction=FractionLaw(0.9, 0.1, 4.0))
    compared = comparison_model(model)
    assert compared.point_fraction(1.0) == pytest.approx(0.8)
    assert compared.match_fraction(1.0) == pytest.approx(0.9)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("n_surveys = 3\n", "imaging.error_model.*twin fit-surrogate"),
    ],
)
def test_a_file_that_is_not_an_error_model_is_rejected(content, message, tmp_path):
    (tmp_path / "other.toml").write_text(content)
    with pytest.raises(TwinError, match=message):
        error_model_file.load(tmp_path / "other.toml")


@pytest.mark.long
def test_the_fit_recovers_the_error_model_of_simulated_surveys():
    """A surrogate with other errors than the compared one takes the place of the images.

    Bias fraction and relief gain need longer paths than these of 15 keyframes.
    """
    true = ErrorModel(
        match_sigma_px=SigmaLaw(0.03, 1.5), match_error_ratio=1.4, match_bias_fraction=0.4, lamp_error_growth=1.5,
        f2f_sigma_px=SigmaLaw(0.04, 2.0), f2f_error_ratio=1.0, f2f_anticorrelation=0.4, distance_growth=4.0,
        relief_gain=0.3, mosaic_sigma_px=SigmaLaw(0.3, 1.0), lateral_sigma_px=0.5,
        depth_sigma=DepthLaw(0.1, 2.0, 0.0, 0.01, 3.0, 1.0), depth_error=DepthLaw(0.08, 2.0, 0.0, 0.01, 3.0, 1.0),
        depth_texture_scatter=ScatterLaw(2.0, 0.03),
    )  # fmt: skip
    waters = [['water.jerlov="I"'], ['water.jerlov="III"'], ["lamps=[]", "sun.illuminance_lx=2000"]]
    statistics = [compare_survey(mission(*water), true, seed) for seed, water in enumerate(waters)]
    fitted = fit_to_surveys(statistics, COMPARED).model
    bound_px = fitted.bound_range_px[1]
    for name in ("match_sigma_px", "f2f_sigma_px", "mosaic_sigma_px"):
        assert getattr(fitted, name)(bound_px) == pytest.approx(getattr(true, name)(bound_px), rel=0.05), name
    assert fitted.match_error_ratio == pytest.approx(true.match_error_ratio, rel=0.2)
    under_lamps, true_under_lamps = (m.match_error_ratio * np.hypot(1, m.lamp_error_growth) for m in (fitted, true))
    assert under_lamps == pytest.approx(true_under_lamps, rel=0.2)
    assert fitted.f2f_error_ratio == pytest.approx(true.f2f_error_ratio, rel=0.1)
    assert fitted.f2f_anticorrelation == pytest.approx(true.f2f_anticorrelation, abs=0.1)
    assert fitted.distance_growth == pytest.approx(true.distance_growth, rel=0.25)
    sigmas = [
        m.depth_sigma.sigma_px(bound_px, 1.0) * np.sqrt(m.depth_sigma.relative_variance(6, 1, bound_px))
        for m in (fitted, true)
    ]
    assert sigmas[0] == pytest.approx(sigmas[1], rel=0.15)
    scatters = [m.depth_texture_scatter(bound_px, 1.0) for m in (fitted, true)]
    assert scatters[0] == pytest.approx(scatters[1], rel=0.15)
    assert fitted.depth_ratio_scatter < 0.1
    # the lateral error does not vary with the sigma of its cell, to which the fit relates all errors
    assert fitted.lateral_sigma_px == pytest.approx(true.lateral_sigma_px, rel=0.3)


class SimulatedImages:
    """Surrogate in place of vision by images: each stereo point has the covariance of a single match."""

    def __init__(self, vision):
        self._vision = vision

    def __getattr__(self, name):
        return getattr(self._vision, name)

    def observe_stereo(self, frame, row):
        points = self._vision.observe_stereo(frame, row)
        return points._replace(cov=points.cov / raster_fraction(self._vision))


def compare_survey(flown, true, seed):
    """Returns the statistics of a survey whose measurements are sampled from the error model `true`."""
    world = SurrogateWorld(flown, Stopwatch(), error_model_file.FittedErrorModel(true, 2, {}))

    def true_pose():
        return world.world_from_camera

    compared = surrogate_vision(flown, COMPARED, true_pose, Stopwatch())
    vision = ComparisonVision(SimulatedImages(reseeded(world.vision, 100 + seed)), compared, true_pose)
    navigator = navigator_with(flown, vision, Stopwatch())
    survey.fly(flown, world, navigator, lambda *_: None)
    result = navigator.finish()
    vision.build_map(result, flown.grid, np.zeros((len(result.keyframe_rows), 6, 6)), lambda _: None)
    return vision.statistics


@pytest.mark.parametrize("aiding", ['["pressure", "ahrs", "dvl"]', "[]"])
def test_the_compiled_loop_equals_the_loop_over_single_frames(aiding, monkeypatch):
    """Both use the same steps and the same random numbers."""
    flown = mission(f"navigation.aiding={aiding}", "plan.tracks=1")

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
from twin import survey
from twin.scenario.file import load_scenario
result = survey.run(load_scenario("reef", {SHORT!r}), Path({str(tmp_path / "run")!r}), outputs=None)
assert result.status == "complete"
print(*(name for name in ("mujoco", "OpenGL", "matplotlib", "rerun", "rasterio", "trimesh") if name in sys.modules))
"""
    done = subprocess.run([sys.executable, "-c", line], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []
