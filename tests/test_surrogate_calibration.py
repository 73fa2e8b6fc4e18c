"""Surrogate: calibration errors, ports and marine snow, and the refusal of surveys outside the range of the fit."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from twin import survey
from twin.app import study_command
from twin.core import geometry
from twin.core.records import StereoObservation
from twin.core.timing import Stopwatch
from twin.errors import ScenarioError, TwinError
from twin.imaging.camera.true_cameras import make_true_cameras
from twin.report.headline import headline
from twin.scenario.file import load_scenario
from twin.studies.flight import fly
from twin.studies.surveys import Survey, surveys
from twin.surrogate import error_model_file
from twin.surrogate.coverage import QUANTITIES, quantities_outside_fit
from twin.surrogate.matchability import FloorImages, floor_albedos, in_snow
from twin.surrogate.measured_view import IDEAL_VIEW, MeasuredRows, measured_view
from twin.surrogate.sampling import sample_link
from twin.surrogate.snow_noise import snow_effect
from twin.surrogate.surrogate_world import SurrogateWorld
from twin.world.mission import prepare

SHORT = [
    "rig.model=ideal",
    'imaging.fidelity="surrogate"',
    "plan.tracks=1",
    "plan.area_m=[1.6,1.0]",
    "control.hold_s=0.5",
]
DEPTHS_M = np.linspace(1.2, 2.4, 5)
#: Scenarios in which every kind of error is present.
ERRORS = {
    "baseline": ["calibration_error.baseline_error=0.02"],
    "focal": ["calibration_error.focal_error=0.01"],
    "distortion": ["calibration_error.k1_error=0.02", "calibration_error.k2_error=-0.01"],
    "rotation": ["calibration_error.right_yaw_deg=0.02", "calibration_error.right_roll_deg=0.1"],
    "flat port": ['port.kind="flat"', "port.calibrated_at_m=1.0"],
    "dome": ['port.kind="dome"', "port.offset_m=[0.002,0.0,0.003]"],
}


def scenario(*sets):
    return load_scenario("reef", [*SHORT, *sets])


def view_of(*sets):
    """Returns the measured view of a scenario, its true cameras and the believed rig."""
    given = scenario(*sets)
    rig, cameras = given.believed_rig(), make_true_cameras(given)
    return measured_view(cameras, rig, DEPTHS_M), cameras, rig


def floor_points(rig, n=200):
    """Returns true points (n, 3), normalised (x, y, disparity), spread over the image and the depths."""
    rng = np.random.default_rng(0)
    half = np.array([rig.width_px, rig.height_px]) / 2 / rig.focal_px
    return np.column_stack([rng.uniform(-0.9 * half, 0.9 * half, (n, 2)), rig.baseline_m / rng.uniform(1.2, 2.4, n)])


def test_without_errors_all_points_are_measured_where_they_are():
    view, _, rig = view_of()
    assert view is IDEAL_VIEW
    points = floor_points(rig)
    np.testing.assert_array_equal(view.measure(points), points)


@pytest.mark.parametrize(("sets", "scale"), [
    (ERRORS["baseline"], (1.0, 1.0, 1.02)),  # the right image is 2 % further away
    (ERRORS["focal"], (1.01, 1.01, 1.01)),  # both images are magnified
])  # fmt: skip
def test_errors_of_baseline_and_focal_length_scale_the_measured_positions(sets, scale):
    view, _, rig = view_of(*sets)
    points = floor_points(rig)
    np.testing.assert_allclose(view.measure(points), points * scale, atol=1e-9)


@pytest.mark.parametrize("name", ERRORS)
def test_the_measured_column_and_disparity_are_those_of_the_rectified_images(name):
    """Independent of the table: projection of each point by the true cameras; 0.01 px is far below the match noise.

    A roll of the right camera is removed from its image, so that only its columns are compared, to first order.
    """
    view, cameras, rig = view_of(*ERRORS[name])
    points = floor_points(rig)
    xyz = np.column_stack([points[:, :2], np.ones(len(points))]) * (rig.baseline_m / points[:, 2:])
    offset = np.array([cameras.rendered_rig.baseline_m, 0.0, 0.0])
    left, right = rig.without_refraction(cameras.project(xyz, 0), cameras.project(xyz - offset, 1))
    right_xy = rig.normalised(right)
    columns_px = right[:, 0] - rig.focal_px * view.removed[2] * right_xy[:, 1]  # cancels the roll
    columns_px += rig.focal_px * view.removed[0] * right_xy[:, 0] * right_xy[:, 1]  # and the pitch
    measured = view.measure(points) * rig.focal_px
    np.testing.assert_allclose(measured[:, 0], left[:, 0] - rig.cx_px, atol=0.01)
    np.testing.assert_allclose(measured[:, 2], left[:, 0] - columns_px, atol=0.015)


def test_pitch_roll_and_row_offset_are_removed_and_yaw_is_not():
    sets = [f"calibration_error.right_{name}" for name in ("pitch_deg=0.1", "roll_deg=0.2", "yaw_deg=0.05")]
    view, _, rig = view_of(*sets, "calibration_error.right_principal_point_error_px=[0.0,0.5]")
    given = [*np.deg2rad([0.1, 0.0, 0.2]), 0.5 / rig.focal_px]
    np.testing.assert_allclose(view.removed, given, atol=np.deg2rad(0.001))
    points = floor_points(rig)
    without_yaw, _, _ = view_of(*sets[:2], "calibration_error.right_principal_point_error_px=[0.0,0.5]")
    rows_px = [v.measure_with_rows(points)[:, 3] * rig.focal_px for v in (view, without_yaw)]
    yaw_rows_px = np.deg2rad(0.05) * points[:, 0] * points[:, 1] * rig.focal_px
    assert np.abs(rows_px[1]).max() < 0.01
    assert rows_px[0].std() == pytest.approx(yaw_rows_px.std(), rel=0.2)
    shift_px = (view.measure(points) - without_yaw.measure(points))[:, 2] * rig.focal_px
    assert np.abs(shift_px).mean() == pytest.approx(np.deg2rad(0.05) * rig.focal_px * 1.08, rel=0.03)  # 1 + x^2


@pytest.mark.parametrize("name", ["focal", "distortion", "flat port"])
def test_true_directions_are_measured_at_the_given_positions(name):
    view, _, rig = view_of(*ERRORS[name])
    wanted, disparity = floor_points(rig)[:, :2], rig.baseline_m / 1.8
    true = view.true_directions(wanted, disparity)
    measured = view.measure(np.column_stack([true, np.full(len(true), disparity)]))
    np.testing.assert_allclose(measured[:, :2], wanted, atol=1e-7)


def test_the_motion_gain_scales_translation_as_baseline_and_leaves_it_with_an_error_of_focal_length():
    """A baseline 2 % longer than believed makes depth and translation 2 % too small.

    With a focal length 1 % longer, depth is 1 % too small; image motion is 1 % too large, and so are rotations.
    """
    view, _, rig = view_of(*ERRORS["baseline"])
    np.testing.assert_allclose(
        view.motion_gain(floor_points(rig), rig.baseline_m), np.diag([1, 1, 1, 1 / 1.02, 1 / 1.02, 1 / 1.02]), atol=1e-6
    )
    view, _, rig = view_of(*ERRORS["focal"])
    gain = view.motion_gain(floor_points(rig), rig.baseline_m)
    assert gain[3, 3] == pytest.approx(1.0, abs=0.003)
    assert gain[5, 5] == pytest.approx(1 / 1.01, abs=0.003)
    assert gain[2, 2] == pytest.approx(1.0, abs=1e-6)  # rotation about the optical axis


def test_the_estimated_yaw_of_the_report_is_that_of_the_rows():
    view, _, rig = view_of("calibration_error.right_yaw_deg=0.1")
    rows = MeasuredRows(view, rig, 11, np.random.default_rng(0))
    pairs = [rows.observe(StereoObservation(0, 400, None), floor_points(rig, 100), 0.03) for _ in range(5)]
    observation, ratio = pairs[-1]
    report = rows.report()
    assert report.estimate[1] == pytest.approx(np.deg2rad(0.1), abs=4 * report.sigma[1])
    assert report.sigma[1] < np.deg2rad(0.02)
    assert observation.row_spread_ratio == pytest.approx(ratio) and ratio > 1.1


def test_the_view_is_corrected_for_a_yaw_that_the_estimators_find():
    view, _, rig = view_of("calibration_error.right_yaw_deg=0.1")
    rows, points = MeasuredRows(view, rig, 11, np.random.default_rng(0)), floor_points(rig, 100)
    corrected = rows.correct_yaw(np.deg2rad(0.1), 1e-5)
    offset, left = (np.abs(one.measure(points)[:, 2] - points[:, 2]).max() for one in (view, corrected))
    assert offset == pytest.approx(np.deg2rad(0.1), rel=0.6) and left < 0.02 * offset


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    """Metrics of short surveys, by name of the errors."""
    names, folder = ("ideal", "baseline", "focal"), tmp_path_factory.mktemp("runs")
    return {n: survey.run(scenario(*ERRORS.get(n, ())), folder / n, outputs=()).metrics for n in names}


def test_metrics_contain_the_visibility_of_the_water(flown):
    water = flown["ideal"]["water"]
    assert 0 < water["visibility_m"] < np.inf and 0 < water["secchi_m"] < np.inf
    assert f", visibility {water['visibility_m']:.2g} m" in headline(flown["ideal"], scenario().model_dump())


def test_a_survey_with_a_longer_baseline_maps_the_floor_two_percent_too_near(flown):
    """Heights are too great by 2 % of the depth of about 1.8 m, and the path is too short by 2 %."""
    errors = {name: metrics["map"]["bias_m"] for name, metrics in flown.items()}
    assert errors["baseline"] - errors["ideal"] == pytest.approx(0.0353, rel=0.1)
    assert errors["focal"] - errors["ideal"] == pytest.approx(0.0175, rel=0.1)
    path = {name: metrics["trajectory"]["final"]["ate_rmse_m"] for name, metrics in flown.items()}
    assert path["baseline"] > 5 * path["ideal"] and path["focal"] < 3 * path["ideal"]
    assert flown["baseline"]["status"] == "complete"  # no image shows an error of the baseline


def test_a_link_shows_the_yaw_and_is_right_after_its_correction():
    view, _, rig = view_of("calibration_error.right_yaw_deg=0.1")
    step = geometry.exp(np.array([0.01, -0.02, 0.05, 0.25, -0.1, 0.03]))
    points, cov = floor_points(rig, 48), np.diag([1e-8, 1e-8, 2e-8])

    def link(view):
        camera = (
            rig.focal_px, rig.cx_px, rig.cy_px, float(rig.width_px), float(rig.height_px), 5.0, rig.baseline_m,
            view.table,
        )  # fmt: skip
        zeros = np.zeros((48, 3)), np.zeros((1, 1, 3)), np.zeros((1, 1, 2)), np.zeros((49, 3))
        return sample_link(points, *zeros, np.eye(4), step, camera, cov, np.zeros((3, 3)), 0.0, 0.0, 0.0, 0.0, 1.0)

    true = np.deg2rad(0.1)
    n, turned, _, yaw = link(view)
    assert n > 20 and yaw[0] == pytest.approx(true, rel=0.02)
    _, corrected, _, remaining = link(view.without_yaw(true))
    assert remaining[0] == pytest.approx(0, abs=0.02 * true)
    error, left = (geometry.log(geometry.inverse(motion) @ step) for motion in (turned, corrected))
    assert np.linalg.norm(left) < 0.03 * np.linalg.norm(error)
    np.testing.assert_allclose(yaw[2:] * true, error - left, atol=0.1 * np.abs(error).max())


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_survey_calibrates_itself(seed, tmp_path):
    """It finds the yaw that its seed draws, to its standard deviation, and the sigmas of the map contain the rest."""
    given = scenario(
        f"seed={seed}", "calibration_error.rotation_sigma_deg=0.1", "calibration_error.baseline_sigma_mm=0.1"
    )
    metrics = survey.run(given, tmp_path / "run", outputs=()).metrics
    found, true_deg = metrics["self_check"]["calibration"], given.true_calibration_error().right_yaw_deg
    assert found["yaw_deg"] == pytest.approx(true_deg, abs=4 * found["yaw_sigma_deg"])
    assert 0.0005 < found["yaw_sigma_deg"] < 0.02
    assert metrics["map"]["sigma_ratio"] < 2


TEXTURE = np.random.default_rng(1).normal(120, 20, (120, 160)).astype(np.float32)


def test_snow_that_changes_nothing_leaves_the_bound_of_the_noise():
    variance_px2, matched_share = snow_effect([TEXTURE] * 3, [TEXTURE] * 3, 2.0, 11)
    gradient2 = float(np.mean(np.diff(TEXTURE, axis=1) ** 2))
    assert matched_share == 1.0
    # patches with more texture than the mean have a larger weight
    assert variance_px2 == pytest.approx(2 * 4 / (121 * gradient2), rel=0.1)


def test_the_share_of_matches_falls_with_the_part_of_the_image_that_flakes_cover():
    """A bright square in every view is in each of the two images of a match: (side + patch)^2 pixels are lost twice."""
    snowy = []
    for k in range(3):
        image = TEXTURE.copy()
        image[40:60, 30 + 40 * k : 50 + 40 * k] = 255 * (np.indices((20, 20)).sum(0) % 2)
        snowy.append(image)
    _, matched_share = snow_effect([TEXTURE] * 3, snowy, 2.0, 11)
    lost = 2 * (20 + 11) ** 2 / ((120 - 22) * (160 - 22))
    assert 1 - matched_share == pytest.approx(lost, rel=0.25)


def test_more_snow_gives_less_precise_and_fewer_matches():
    mission, found = prepare(scenario()), []
    for n in (0, 400, 1600):
        images = FloorImages(scenario(f"snow.density_per_m3={n}"), mission.illumination)
        (albedo,) = floor_albedos(images, mission.terrain, np.array([1.8]))
        matched = images.matched(albedo, 1.8, np.random.default_rng(0))
        found.append(in_snow(images, albedo, 1.8, matched, 1))
    bounds_px, clear = np.transpose(found)
    assert bounds_px[0] < bounds_px[1] < bounds_px[2]
    assert clear[0] == 1 > clear[1] > clear[2]


MURKY = ['water.jerlov="9C"', "plan.altitude_m=3"]
SPARSE = ["plan.overlap_along=0.3", 'plan.overlap_reference="plane"']


def world(*sets, fitted=None):
    return SurrogateWorld(prepare(scenario(*sets)), Stopwatch(), fitted or error_model_file.load())


@pytest.mark.parametrize("name", ["focal", "distortion", "flat port"])
def test_beacons_are_detected_where_the_true_cameras_image_them(name):
    """The noise of both surveys is the same, so that it cancels."""
    beacons = ['navigation.aiding=["beacons"]', "beacons=[{position_m=[-0.4,-0.7,0.3]},{position_m=[-1.2,-0.3,0.6]}]"]
    pixels = []
    for sets in ((), ERRORS[name]):
        made = world(*beacons, *sets)
        first = made.mission.planned_frames(1)
        made.start_sequence(first)
        detected = made.observe(first[0]).readings.beacons
        assert detected is not None and [beacon.beacon for beacon in detected] == [0, 1]
        pixels.append(np.array([beacon.pixel for beacon in detected]))
    cameras = made.mission.true_cameras
    surveyed = np.array([beacon.position_m for beacon in made.mission.scenario.beacons])
    points_m = geometry.transform(geometry.inverse(made.world_from_camera), surveyed)
    expected = cameras.project(points_m) - made.mission.rig.project(points_m)
    assert np.abs(expected).max() > 0.02
    np.testing.assert_allclose(pixels[1] - pixels[0], expected, atol=1e-9)


def test_a_survey_outside_the_fit_is_refused_with_quantity_value_and_range():
    with pytest.raises(ScenarioError, match=r"median overlap .* of 0\.\d+ .allowed: at least 0\.\d+.*--extrapolate"):
        world(*SPARSE)


def test_with_extrapolate_it_flies_with_a_warning():
    warnings = world(*SPARSE, "imaging.extrapolate=true").warnings
    assert len(warnings) == 1 and warnings[0].startswith(
        "The surrogate extrapolates outside the range of its error model: median overlap"
    )
    assert "at least" in warnings[0]
    assert world().warnings == ()


def test_no_water_is_too_turbid_for_the_built_in_error_model():
    """Its most turbid survey was lost, so the surrogate loses vision there as well; see `_fitted_range`."""
    assert world(*MURKY).warnings == ()


def test_a_survey_of_a_study_outside_the_fit_is_a_refused_row(tmp_path):
    given = scenario(*SPARSE)
    row = fly(Survey(0, 1, {}, given, given.fingerprint(), tmp_path / "runs" / "0", "none"))
    assert row["status"] == "refused" and "median overlap" in row["reason"]


def test_a_map_that_the_error_model_cannot_give_is_a_refused_row(tmp_path, monkeypatch):
    def sample_patch(*_):
        raise FloatingPointError("the error model gives a height that is not finite")

    monkeypatch.setattr("twin.surrogate.map_model.MapModel.sample_patch", sample_patch)
    given = scenario()
    row = fly(Survey(0, 1, {}, given, given.fingerprint(), tmp_path / "runs" / "0", "none"))
    assert row["status"] == "refused" and row["unmodelled"] and "not finite (allowed: imaging.fidelity" in row["reason"]


def test_extrapolate_of_the_command_line_sets_the_key_of_every_survey():
    for extrapolate in (True, False):
        study = study_command.load("turbidity", study_command.StudyOptions(extrapolate=extrapolate))
        assert next(surveys(study, Path("unused"))).scenario.imaging.extrapolate is extrapolate


def test_every_range_in_the_file_limits_the_surveys(tmp_path):
    fitted = replace(error_model_file.load(), fitted_range={"lamp_share": (0.0, 0.5)}, misfit={})
    error_model_file.save(fitted, tmp_path / "model.toml")
    assert error_model_file.load(tmp_path / "model.toml") == fitted
    with pytest.raises(ScenarioError, match="share of the light from the lamps of 1 .allowed: 0 to 0.5"):
        world(fitted=fitted)


def test_a_range_of_an_unknown_quantity_is_rejected(tmp_path):
    text = error_model_file.DEFAULT_FILE.read_text().replace(
        "[fitted_range]", "[fitted_range]\nsalinity = [1.0, 2.0]\n#"
    )
    (tmp_path / "model.toml").write_text(text)
    with pytest.raises(TwinError, match="fitted_range.salinity: unknown quantity"):
        error_model_file.load(tmp_path / "model.toml")


def test_a_quantity_may_leave_its_range_by_its_factor():
    factor = QUANTITIES["bound_px"].factor
    fitted = {"bound_px": (0.02, 0.1)}
    assert not quantities_outside_fit({"bound_px": (0.001, 0.1 * factor)}, fitted)  # more precise than in the fit
    (found,) = quantities_outside_fit({"bound_px": (0.05, 0.101 * factor)}, fitted)
    assert f"0.05 to {0.101 * factor:.3g} px" in found[0] and "px" in found[1]


def test_points_whose_disparity_would_be_negative_are_not_matched():
    """A yaw of 5 deg towards the left camera takes 0.087 off all disparities."""
    view, _, rig = view_of("calibration_error.right_yaw_deg=-5")
    points = floor_points(rig)
    matched = MeasuredRows(view, rig, 11, np.random.default_rng(0)).are_matched(points)
    assert not matched[points[:, 2] < 0.08].any()
