"""The surrogate: rays, what keyframes show, drawn measurements, and a calibration that finds where they came from."""

import subprocess
import sys
from collections import defaultdict
from itertools import pairwise

import numpy as np
import pytest

from terrains import Terrain
from twin import survey
from twin.core import geometry
from twin.core.timing import Stopwatch
from twin.errors import ScenarioError, SurveyAborted, TwinError
from twin.scenario.file import load_scenario
from twin.surrogate import error_model_file
from twin.surrogate.error_model import ErrorModel, Law
from twin.surrogate.floor_rays import Floor
from twin.surrogate.map_model import CellErrors
from twin.surrogate.matchability import bounds_px, lamp_share, unevenness_px
from twin.surrogate.surrogate_world import SurrogateWorld, vision_beside
from twin.surrogate_fit import fit, witness
from twin.surrogate_fit.rendered_surveys import fit_to
from twin.world.mission import prepare

SHORT = ['imaging.fidelity="surrogate"', "plan.tracks=2", "plan.area_m=[2.4,1.2]", "control.hold_s=1.0"]


def mission(*sets):
    return prepare(load_scenario("quickstart", [*SHORT, *sets]))


def tilted(x, y, z):
    return geometry.pose(geometry.rotation_from_rpy(np.pi - 0.15, 0.1, 0.7), np.array([x, y, z]))


@pytest.fixture(scope="module")
def reef():
    return mission()


@pytest.fixture(scope="module")
def told(reef):
    return vision_beside(reef, ErrorModel(), lambda: reef.start, Stopwatch())


def test_a_ray_meets_the_floor_first_where_a_march_in_small_steps_first_dips_below_it(reef):
    floor, pose = Floor(reef.terrain), tilted(0.3, -0.2, 1.5)
    pixels = np.random.default_rng(0).uniform([0, 0], [319, 239], (40, 2))
    depth = floor.depth_at(pixels, pose, reef.rig)
    steps = np.arange(0.2, 4.0, 5e-4)
    rays = np.column_stack([(pixels - [reef.rig.cx_px, reef.rig.cy_px]) / reef.rig.focal_px, np.ones(40)])
    for ray, found in zip(rays, depth, strict=True):
        points = geometry.transform(pose, ray * steps[:, None])
        below = points[:, 2] < reef.terrain.height_at(points[:, 0], points[:, 1])
        assert found == pytest.approx(steps[np.argmax(below)], abs=1e-3)


def test_a_ray_that_leaves_the_floor_meets_nothing(reef):
    up = geometry.pose(np.eye(3), np.array([0, 0, 2.0]))
    beside = geometry.pose(geometry.BODY_FROM_DOWN_CAMERA, np.array([50.0, 0, 2.0]))
    for pose in (up, beside):
        assert np.isinf(Floor(reef.terrain).depth_at(np.array([[160.0, 120.0]]), pose, reef.rig)).all()


def test_patches_are_placed_worse_in_murkier_water_from_farther_and_with_more_noise():
    def bound(depth_m, *sets):
        m = mission(*sets)
        return bounds_px(m.scenario, m.terrain, np.array([depth_m]))[0]

    base = bound(2.0)
    assert bound(2.0, 'water.jerlov="3C"') > 2 * base
    assert bound(3.0, 'water.jerlov="3C"') > 2 * bound(2.0, 'water.jerlov="3C"')
    noisier = bound(2.0, "imaging.noise_sd=0.032", "imaging.shot_noise=0.024")
    assert noisier == pytest.approx(4 * base, rel=0.05)


def test_the_lamps_share_of_the_light_falls_as_the_sun_rises():
    def share(lux, *sets):
        m = mission(f"sun.illuminance_lx={lux}", *sets)
        return lamp_share(m.scenario, m.terrain)

    lamps = "lamps=[{position_m=[0.3, 0.3, 0.0], intensity_cd=500.0}]"
    shares = [share(lux, lamps) for lux in (0, 100, 1000, 10_000)]
    assert shares[0] == 1
    assert all(np.diff(shares) < 0) and 0 < shares[-1] < 0.5
    # of two lights the radiances add up
    assert shares[1] / (1 - shares[1]) == pytest.approx(10 * shares[2] / (1 - shares[2]), rel=0.01)
    assert share(1000, "lamps=[]") == 0
    dark = mission("sun.illuminance_lx=1000", lamps, "water.turbidity=100")
    plan = dark.scenario.plan.model_copy(update={"altitude_m": 1000.0})
    assert lamp_share(dark.scenario.model_copy(update={"plan": plan}), dark.terrain) == 1  # nothing comes back


def test_the_floor_under_a_patch_lies_out_of_its_plane_as_its_curvature_tells():
    """z = a x^2 lies off its plane by the deviation of a x^2 from its mean; a plane by nothing."""
    flown = mission("plan.altitude_m=2.0")
    y, x = np.mgrid[-5:5.01:0.01, -5:5.01:0.01]
    curved, slanted = (
        Terrain(h.astype(np.float32), 0.01, -5.0, -5.0, flown.terrain.texture, 0.005) for h in (0.5 * x**2, 0.3 * x + y)
    )
    across_m = np.linspace(-0.5, 0.5, 9) * 11 * 2.0 / flown.rig.focal_px
    expected = flown.rig.focal_px / 2.0 * np.std(0.5 * across_m**2)
    found = unevenness_px(flown.scenario, curved, np.array([2.0]))[0]
    assert found == pytest.approx(expected, rel=0.03)
    assert unevenness_px(flown.scenario, slanted, np.array([2.0]))[0] < 0.01 * expected


COMPARED = ErrorModel(apart=3.0, relief=0.3)


def redrawn(vision, seed):
    """The same vision with other numbers."""
    vision._rng, vision._key, vision._drawn = np.random.default_rng(seed), seed, np.zeros((0, 6))
    vision._used, lasting = 0, np.random.default_rng([seed, 1])
    vision._relief = lasting.standard_normal(vision._relief.shape)
    return vision


@pytest.mark.parametrize("steady", [0.0, 0.9])
def test_links_err_as_their_covariance_says(reef, steady):
    """With excess 1 and no correlation each of six degrees of freedom counts 1."""
    model = ErrorModel(place_excess=1.0, correlation=1.0, steady=steady, place_px=Law(0.05, 0.0))
    poses, at = [tilted(0, 0, 2.0), tilted(0.2, 0.1, 2.05)], [0]
    vision = vision_beside(reef, model, lambda: poses[at[0]], Stopwatch())
    true, squares = geometry.inverse(poses[0]) @ poses[1], []
    for seed in range(150):
        looked(redrawn(vision, seed), poses, at)
        link = link_of(vision, 0, 1)
        error = geometry.log(geometry.inverse(true) @ link.a_from_b)
        squares.append(error @ np.linalg.solve(link.cov, error) / 6)
    assert np.mean(squares) == pytest.approx(1.0, abs=0.12)


def looked(vision, poses, at):
    """What was seen at keyframes with these poses, `at` being where the vehicle is."""
    for k, pose in enumerate(poses):
        at[0] = k
        assert vision.observe_stereo(None, k) is not None
        vision.add_to_mosaic(k, pose)


def link_of(vision, i, j):
    """The link from the later of two keyframes to the earlier."""
    return vision._link(vision._seen[j], vision._seen[i], j, i, vision.model)


def error_of_link(vision, i, j):
    there, here = vision._seen[i].pose, vision._seen[j].pose
    return geometry.log(geometry.inverse(geometry.inverse(there) @ here) @ link_of(vision, i, j).a_from_b)


def test_points_lie_where_both_eyes_see_them(reef):
    pose = tilted(0, 0, 2.0)
    vision = vision_beside(reef, ErrorModel(), lambda: pose, Stopwatch())
    points = vision.observe_stereo(None, 0)
    right_px = points.pixels[:, 0] - reef.rig.focal_px * vision._now.points[:, 2]
    assert right_px.min() >= reef.scenario.estimate.patch_px // 2
    left = vision._pixels[~np.isin(np.arange(len(vision._pixels)), vision._now.met)]
    assert len(left) and left[:, 0].max() < points.pixels[:, 0].max() / 2  # what is left out is at the left border


def test_a_fifth_of_the_image_is_enough_for_a_link_and_it_errs_more(reef):
    """As with images: what both see has to agree, not to be much."""
    poses, at = [tilted(0.1 * k, 0.0, 2.0) for k in range(30)], [0]
    vision = vision_beside(reef, ErrorModel(), lambda: poses[at[0]], Stopwatch())
    looked(vision, poses, at)
    links = [link_of(vision, 0, k) for k in range(1, 30)]
    seen = [link for link in links if link is not None]
    assert None in links and links.index(None) == len(seen)
    assert seen[-1].n_points < 0.25 * vision._seen[0].n_points
    assert seen[-1].cov[3, 3] > 9 * seen[0].cov[3, 3]


def test_a_link_is_the_same_whatever_was_measured_before_it(reef):
    poses, at = [tilted(0, 0, 2.0), tilted(0.2, 0.1, 2.05)], [0]
    vision = vision_beside(reef, ErrorModel(), lambda: poses[at[0]], Stopwatch())
    looked(vision, poses, at)
    first = link_of(vision, 0, 1)
    vision.draw(1)
    np.testing.assert_array_equal(link_of(vision, 0, 1).a_from_b, first.a_from_b)


def test_what_stays_the_same_cancels_around_a_triangle(reef):
    poses, at = [tilted(0, 0, 2.0), tilted(0.05, 0, 2.0), tilted(0.1, 0, 2.0)], [0]

    def closure(steady):
        model = ErrorModel(steady=steady, common_px=0.0)
        vision, left = vision_beside(reef, model, lambda: poses[at[0]], Stopwatch()), []
        for seed in range(60):
            looked(redrawn(vision, seed), poses, at)
            a, b, c = (link_of(vision, i, j).a_from_b for i, j in ((0, 1), (1, 2), (0, 2)))
            left.append(np.sum(geometry.log(geometry.inverse(c) @ a @ b)[3:] ** 2))
        return np.mean(left)

    assert closure(0.95) < 0.5 * closure(0.0)


def test_what_the_floor_makes_links_err_by_adds_up_along_the_path_and_cancels_around_a_triangle(reef):
    """Over ten steps of one way; what each match errs by alone adds up to the root of ten of a step."""
    poses, at = [tilted(0.02 * k, 0, 2.0) for k in range(11)], [0]
    model = ErrorModel(steady=0.0, common_px=0.0, place_excess=0.0, relief=1.0)
    vision, steps, ways, closures = vision_beside(reef, model, lambda: poses[at[0]], Stopwatch()), [], [], []
    for seed in range(30):
        looked(redrawn(vision, seed), poses, at)
        steps.append([error_of_link(vision, k, k + 1) for k in range(10)])
        ways.append(np.sum(steps[-1], axis=0))
        closures.append(steps[-1][0] + steps[-1][1] - error_of_link(vision, 0, 2))
    alone, together, closure = (np.mean(np.square(x)[..., 3:]) for x in (steps, ways, closures))
    assert together > 5 * 10 * alone
    assert closure < 0.3 * alone


@pytest.mark.parametrize(("place_excess", "steady", "relief"), [(1.2, 0.0, 0.0), (0.9, 0.8, 0.0), (1.0, 0.6, 5.0)])
def test_what_is_steady_and_what_relief_does_are_told_apart_by_the_path(reef, place_excess, steady, relief):
    """60 ways over eleven keyframes: the correlation has a standard error of 0.03. This reef is smooth."""
    poses, at = [tilted(0.04 * k, 0.02 * k, 2.0) for k in range(11)], [0]
    model = ErrorModel(place_excess=place_excess, steady=steady, relief=relief, common_px=0.0)
    parts = {
        "images": model,
        "patches": model._replace(place_excess=1.0, steady=witness.STEADY, relief=0.0),
        "relief": model._replace(place_excess=0.0, relief=witness.RELIEF),
    }
    vision, notes = vision_beside(reef, model, lambda: poses[at[0]], Stopwatch()), defaultdict(list)
    for seed in range(60):
        looked(redrawn(vision, seed), poses, at)
        cov = link_of(vision, 0, 1).cov
        for name, vision.model in parts.items():
            errors = [error_of_link(vision, k, k + 1) for k in range(10)]
            far = [error_of_link(vision, k, k + 3) for k in range(8)]
            notes[f"link_{name}"] += [e @ np.linalg.solve(cov, e) for e in errors + far]
            notes[f"chain_{name}"] += [e @ np.linalg.solve(cov, f) for e, f in pairwise(errors)]
        notes["link_apart"] += [1.0] * len(errors) + [3.0] * len(far)
    found = fit._link_parts([notes], own_relief=5.0)
    assert found[0][0] == pytest.approx(place_excess, rel=0.05)
    assert found[1] == pytest.approx(relief, abs=1.2)
    assert found[2] == pytest.approx(steady, abs=0.15)


@pytest.fixture
def errors(told):
    shape = told.chart.seen.shape
    nothing = np.zeros(shape, np.float32)
    return CellErrors(nothing, nothing, 0.0, np.array([1.0, 3.0]), np.zeros(2), np.full(2, 0.01), np.ones(2))


def test_without_errors_a_keyframe_hands_over_the_true_floor(told, errors):
    pose = tilted(0.1, 0.2, 2.0)
    patch = told.chart.hand_over(pose, None, pose, np.zeros((6, 6)), errors, np.random.default_rng(0))
    known = np.isfinite(patch.height_m)
    rows, cols = patch.height_m.shape
    true = told.chart.height_m[patch.row : patch.row + rows, patch.col : patch.col + cols]
    assert known.sum() > 5000
    np.testing.assert_allclose(patch.height_m[known], true[known], atol=1e-6)


def test_a_pose_believed_too_high_lifts_the_map_and_only_what_the_next_does_not_see_is_handed_over(told, errors):
    pose, following = tilted(0.1, 0.2, 2.0), tilted(0.3, 0.2, 2.0)
    lifted = pose.copy()
    lifted[2, 3] += 0.01
    whole, strip = (
        told.chart.hand_over(pose, n, lifted, np.zeros((6, 6)), errors, np.random.default_rng(0))
        for n in (None, following)
    )
    rows, cols = whole.height_m.shape
    true = told.chart.height_m[whole.row : whole.row + rows, whole.col : whole.col + cols]
    assert np.nanmean(whole.height_m - true) == pytest.approx(0.01, abs=1e-5)
    handed = np.isfinite(strip.height_m)
    assert 0.05 < handed.sum() / np.isfinite(whole.height_m).sum() < 0.4


def test_a_surrogate_survey_ends_complete_and_is_the_same_again(tmp_path):
    scenario = load_scenario("quickstart", SHORT)
    results = [survey.run(scenario, tmp_path / name, shows=()) for name in "ab"]
    metrics = results[0].metrics
    assert metrics["status"] == "complete"
    assert 1e-4 < metrics["trajectory"]["final"]["ate_rmse_m"] < 0.02
    assert metrics["map"]["completeness"] > 0.95
    final = [(r.folder / "trajectory_final.tum").read_bytes() for r in results]
    assert final[0] == final[1]


def test_water_in_which_nothing_can_be_matched_ends_the_survey_and_is_named(tmp_path):
    scenario = load_scenario("quickstart", [*SHORT, 'water.jerlov="9C"', "water.turbidity=4"])
    metrics = survey.run(scenario, tmp_path, shows=()).metrics
    assert metrics["status"] == "aborted"
    assert "9C" in metrics["reason"] and "too few points" in metrics["reason"]


def test_what_the_surrogate_knows_nothing_of_is_refused():
    for sets in (["snow.density_per_m3=100"], ["calibration_error.focal_error=0.01"], ['port.kind="flat"']):
        with pytest.raises(ScenarioError, match="imaging.fidelity.*rendered"):
            mission(*sets)


def test_water_outside_the_calibration_is_warned_of():
    kept = error_model_file.load()
    murky = mission('water.jerlov="9C"', "plan.altitude_m=3", "plan.tracks=1")
    warnings = SurrogateWorld(murky, Stopwatch(), kept).warnings
    assert len(warnings) == 1 and "calibrated from" in warnings[0]
    assert SurrogateWorld(mission(), Stopwatch(), kept).warnings == ()


def test_a_calibration_comes_back_from_disk_and_a_file_that_is_none_is_told(tmp_path):
    model = ErrorModel(place_px=Law(0.031, 0.7), f2f_undone=0.123)
    kept = error_model_file.FittedErrorModel(model, 7, {"place_px": 0.1})
    error_model_file.save(kept, tmp_path / "model.toml")
    assert error_model_file.load(tmp_path / "model.toml") == kept
    (tmp_path / "other.toml").write_text("surveys = 3\n")
    with pytest.raises(TwinError, match="imaging.error_model.*twin fit-surrogate"):
        error_model_file.load(tmp_path / "other.toml")


def test_calibrating_on_surveys_that_obey_a_model_finds_that_model():
    """The images are played by a surrogate with other errors than the one that it is compared with.

    What is steady, and relief, take longer paths than these of 15 keyframes.
    """
    true = ErrorModel(
        place_px=Law(0.03, 1.5), place_excess=1.4, f2f_px=Law(0.04, 2.0), f2f_excess=1.0, f2f_undone=0.4, steady=0.4,
        mosaic_px=Law(0.3, 1.0), depth_px=Law(0.02, 1.0), lateral_px=0.5, apart=4.0, relief=0.3, lamps=1.5,
    )  # fmt: skip
    waters = [['water.jerlov="I"'], ['water.jerlov="III"'], ["lamps=[]", "sun.illuminance_lx=2000"]]
    notes = [witnessed(mission(*water), true, seed) for seed, water in enumerate(waters)]
    found = fit_to(notes, COMPARED).model
    bound_px = found.bound_px[1]
    for name in ("place_px", "f2f_px", "mosaic_px"):
        assert getattr(found, name)(bound_px) == pytest.approx(getattr(true, name)(bound_px), rel=0.05), name
    assert found.place_excess == pytest.approx(true.place_excess, rel=0.2)
    under_lamps = found.place_excess * np.hypot(1, found.lamps)
    assert under_lamps == pytest.approx(true.place_excess * np.hypot(1, true.lamps), rel=0.2)
    assert found.f2f_excess == pytest.approx(true.f2f_excess, rel=0.1)
    assert found.f2f_undone == pytest.approx(true.f2f_undone, abs=0.1)
    assert found.apart == pytest.approx(true.apart, rel=0.25)
    assert found.depth_px(bound_px) == pytest.approx(true.depth_px(bound_px), rel=0.15)
    assert found.lateral_px == pytest.approx(true.lateral_px, rel=0.2)


class Played:
    """A surrogate in the part of the images: each point errs as one, not for those it stands for."""

    def __init__(self, vision):
        self._vision = vision

    def __getattr__(self, name):
        return getattr(self._vision, name)

    def observe_stereo(self, frame, row):
        points = self._vision.observe_stereo(frame, row)
        return points._replace(cov=points.cov / self._vision.stand_for)


def witnessed(flown, true, seed):
    """What a witness notes on a survey whose vision obeys a model."""
    world = SurrogateWorld(flown, Stopwatch(), error_model_file.FittedErrorModel(true, 2, {}))

    def truth():
        return world.world_from_camera

    redrawn(world.vision, 100 + seed)
    beside = witness.Witness(Played(world.vision), vision_beside(flown, COMPARED, truth, Stopwatch()), truth)
    navigator = survey.make_navigator(flown, beside, Stopwatch())
    survey.fly(flown, world, navigator, lambda *_: None)
    result = navigator.finish()
    beside.map(result, flown.grid, np.zeros((len(result.keyframe_rows), 6, 6)), lambda _: None)
    return beside.notes


@pytest.mark.parametrize("aiding", ['["pressure", "ahrs", "dvl"]', "[]"])
def test_frames_at_once_are_what_they_are_one_by_one(aiding, monkeypatch, tmp_path):
    """The compiled loop takes every step that a single frame takes, and draws the same numbers for it."""
    flown = mission(f"navigation.aiding={aiding}", "plan.tracks=1")

    def fly():
        with survey.open_world(flown, Stopwatch()) as world:
            navigator = survey.make_navigator(flown, survey.vision_in(world, tmp_path), Stopwatch())
            survey.fly(flown, world, navigator, lambda *_: None)
            return world.truth().trajectory, navigator.finish()

    true, at_once = fly()
    monkeypatch.setattr(SurrogateWorld, "glide", lambda *_: None)
    true_single, single = fly()
    np.testing.assert_array_equal(true.world_from_camera, true_single.world_from_camera)
    for name in ("f2f", "online", "final"):
        ours, theirs = getattr(at_once, name), getattr(single, name)
        np.testing.assert_array_equal(ours.times_s, theirs.times_s)
        np.testing.assert_array_equal(ours.world_from_camera, theirs.world_from_camera)


def test_the_truth_knows_of_every_frame_its_track_its_plan_and_whether_it_keeps_station():
    flown = mission("plan.tracks=2", "plan.area_m=[1.2, 1.2]")
    with survey.open_world(flown, Stopwatch()) as world:
        navigator = survey.make_navigator(flown, world.vision, Stopwatch())
        survey.fly(flown, world, navigator, lambda *_: None)
        truth, first, hold = world.truth(), flown.fly(1), len(flown.hold(1))
    n = len(first)
    assert len(truth.reference) == len(truth.holding) == len(truth.track) == len(world) == flown.n_frames
    np.testing.assert_array_equal(truth.reference[:n], first.reference.position)
    np.testing.assert_array_equal(truth.holding[: n + 2 * hold + 1], [False] * n + [True] * 2 * hold + [False])
    np.testing.assert_array_equal(np.flatnonzero(np.diff(truth.track)), [n + 2 * hold - 1])
    np.testing.assert_allclose(truth.reference[n : n + 2 * hold], first.reference.position[-1:].repeat(2 * hold, 0))


def test_what_is_kept_of_keyframes_does_not_grow_with_the_survey():
    flown = mission("plan.tracks=6", "plan.area_m=[1.2, 1.2]", "plan.overlap_across=0.95", "estimate.window_tracks=1")
    with survey.open_world(flown, Stopwatch()) as world:
        navigator = survey.make_navigator(flown, world.vision, Stopwatch())
        survey.fly(flown, world, navigator, lambda *_: None)
        last_two = [key.number for key in navigator.keys if key.track >= 5]
        assert sorted(world.vision._seen) == [0, 1, 2, 3, *last_two]


def test_where_the_physics_diverges_frames_at_once_end_and_say_so():
    flown = mission()
    with survey.open_world(flown, Stopwatch()) as world:
        navigator, pilot = survey.make_navigator(flown, world.vision, Stopwatch()), survey.make_pilot(flown)
        course, glide = flown.fly(1), world.glide(navigator, pilot)
        navigator.update(world.observe(course[0]), 1)
        world.vehicle.body.velocity[0] = np.nan
        with pytest.raises(SurveyAborted, match="the physics diverged at"):
            glide(course, 1)
        assert len(world) == len(navigator.times_s) == 2  # the frame that showed it is kept


def test_a_survey_for_its_figures_loads_nothing_that_draws(tmp_path):
    """A worker of a study holds what it needs: MuJoCo, OpenGL and what draws pictures are 100 MB."""
    line = f"""
import sys
from pathlib import Path
from twin import survey
from twin.scenario_file import load_scenario
result = survey.run(load_scenario("quickstart", {SHORT!r}), Path({str(tmp_path / "run")!r}), shows=None)
assert result.status == "complete"
print(*(name for name in ("mujoco", "OpenGL", "matplotlib", "rerun", "rasterio", "trimesh") if name in sys.modules))
"""
    done = subprocess.run([sys.executable, "-c", line], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []
