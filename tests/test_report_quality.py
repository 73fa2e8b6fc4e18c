"""Quality report of a survey: coverage, errors by class, standards, cross-sections, and the answer in words."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import twin.report
from twin.core import geometry
from twin.core.records import MapGrid, Trajectory
from twin.estimate.self_check import MIN_POINTS
from twin.exchange.geotiff import Raster
from twin.judge.height_classes import asprs_vertical_class_cm, error_classes, iho_orders
from twin.judge.map_error import cause_shares
from twin.report.headline import conditions
from twin.report.html import render_text
from twin.report.map_figures import round_below, sampled, section_lines
from twin.report.run_folder import Keyframes, Network, Run
from twin.report.run_writer import rings_around
from twin.report.survey_data import asked_area, errors_by_class, keyframe_coverage, survey_data

GRID = MapGrid(-2.0, 1.5, 0.02, 150, 200)
HEIGHT_M, BASELINE_M = 1.5, 0.2
RIG = {"hfov_deg": 60.0, "image_width_px": 320, "image_height_px": 240, "baseline_m": BASELINE_M}
RING = np.array([[-0.5, -0.25], [0.5, -0.25], [0.5, 0.25], [-0.5, 0.25], [-0.5, -0.25]])


def run_over_a_plane(positions, heading=0.0, rings=(RING,)) -> Run:
    """A run whose keyframes look down at a level surface; all errors are 1 mm, all standard deviations 2 mm."""
    poses = np.tile(np.eye(4), (len(positions), 1, 1))
    poses[:, :3, :3] = geometry.rotation_from_rpy(0.0, 0.0, heading) @ geometry.BODY_FROM_DOWN_CAMERA
    poses[:, :3, 3] = positions
    frames = np.arange(len(positions))
    keyframes = Keyframes(frames, frames + 1, 1, {}, np.zeros((0, 3)), np.eye(4), 0.5, tuple(rings))
    flat = np.zeros((GRID.rows, GRID.cols))
    values = {"dem": flat + 1e-3, "dem_truth": flat, "dem_error": flat + 1e-3, "dem_sigma": flat + 2e-3}
    rasters = {name: Raster(GRID, layer) for name, layer in values.items()}
    scenario = {"rig": RIG, "plan": {"pattern": "lawnmower", "area_m": [1.0, 0.5]}}
    path = {"final": Trajectory(frames.astype(float), poses)}
    return Run(Path(), scenario, {}, None, path, rasters, Network(np.zeros((0, 3)), np.zeros((0, 2), int)), keyframes)


def test_one_keyframe_covers_what_both_cameras_see_of_a_plane():
    coverage = keyframe_coverage(run_over_a_plane([[0.0, 0.0, HEIGHT_M]]))
    assert coverage is not None and coverage.step == 1 and set(np.unique(coverage.keyframes)) == {0, 1}
    width_m = 2 * HEIGHT_M * np.tan(np.deg2rad(30))
    expected_m2 = (width_m - BASELINE_M) * width_m * 240 / 320
    edge_m2 = 2 * (width_m + 0.75 * width_m) * GRID.cell_m / 2  # half a cell on each side
    assert coverage.keyframes.sum() * GRID.cell_m**2 == pytest.approx(expected_m2, abs=edge_m2)
    assert np.nanmax(np.abs(coverage.range_m - HEIGHT_M)) == pytest.approx(1e-3)
    # the camera's x points to starboard, so that the pair sees less on its port side, here the north
    rows, _ = np.nonzero(coverage.keyframes)
    north_m = GRID.north_m - (rows + 0.5) * GRID.cell_m
    assert north_m.max() == pytest.approx(width_m / 2 - BASELINE_M, abs=0.02)
    assert north_m.min() == pytest.approx(-width_m / 2, abs=0.02)


def test_keyframes_add_up_and_a_coarse_coverage_agrees():
    run = run_over_a_plane([[0.0, 0.0, HEIGHT_M], [0.4, 0.0, HEIGHT_M], [0.8, 0.0, HEIGHT_M + 0.3]])
    coverage = keyframe_coverage(run)
    assert coverage is not None and coverage.keyframes.max() == 3
    fine = MapGrid(-2.0, 1.5, 0.01, 300, 400)
    rasters = {name: Raster(fine, np.zeros((300, 400))) for name in run.rasters}
    coarse = keyframe_coverage(replace(run, rasters=rasters))
    assert coarse is not None and coarse.step == 2
    assert (coarse.keyframes == coverage.keyframes).mean() > 0.98


def test_figures_of_a_survey_over_its_asked_area():
    run = run_over_a_plane([[0.0, 0.0, HEIGHT_M]])
    data = survey_data(run, keyframe_coverage(run))
    assert data is not None and data.asked == "1 m x 0.5 m"
    assert data.height_m == pytest.approx(HEIGHT_M - 1e-3)
    assert data.pixel_m == pytest.approx(2 * data.height_m * np.tan(np.deg2rad(30)) / 320)
    assert data.covered == {1: 1.0, 2: 0.0, 5: 0.0, 10: 0.0}
    polygon = replace(run, scenario=run.scenario | {"plan": {"pattern": "lawnmower", "polygon": "area.kml"}})
    assert asked_area(polygon) == "0.5 square metres"
    a_part = replace(run, keyframes=run.keyframes._replace(asked_m2=0.1))  # of the area, as few tracks were flown
    assert asked_area(a_part) == "0.1 square metres"
    assert survey_data(replace(run, rasters={}), None) is None


def test_errors_by_class_of_a_run():
    run = run_over_a_plane([[0.0, 0.0, HEIGHT_M]])
    found = errors_by_class(run, keyframe_coverage(run))
    assert set(found) == {"slope", "height", "keyframes"}
    for classes in found.values():
        assert [(one.le90_m, one.sigma_ratio) for one in classes] == [(pytest.approx(1e-3), pytest.approx(0.5))]
    assert errors_by_class(replace(run, rasters={"dem": run.rasters["dem"]}), keyframe_coverage(run)) == {}


def test_errors_fall_into_the_class_of_their_value():
    values = np.array([[0.0, 9.9, 10.0, 30.0, np.nan]])
    error, sigma = np.array([[0.01, -0.03, 0.05, 0.07, 9.0]]), np.full((1, 5), 0.01)
    low, high = error_classes(error, sigma, values, (0.0, 10.0, 20.0, 30.0))
    assert (low.low, low.high, low.share) == (0.0, 10.0, 0.5)
    assert low.bias_m == pytest.approx(-0.01) and low.le90_m == pytest.approx(0.028)
    assert low.sigma_ratio == pytest.approx(np.sqrt((1 + 9) / 2))
    assert (high.low, high.share, high.bias_m) == (10.0, 0.25, pytest.approx(0.05))


def test_orders_of_s44_at_10_m_of_water():
    """TVU of table 1 at 10 m: 0.168, 0.261, 0.517 and 1.026 m; THU 1 m, 2 m, 5 m + 5 %, 20 m + 10 %."""
    orders = iho_orders(10.0, 0.3)
    assert [round(one.tvu_m, 3) for one in orders] == [0.168, 0.261, 0.517, 1.026]
    assert [one.thu_m for one in orders] == [1.0, 2.0, 5.5, 21.0]
    assert [one.reached for one in orders] == [False, False, True, True]
    assert {one.reached for one in iho_orders(10.0, None)} == {None}


@pytest.mark.parametrize(
    ("rmse_m", "points", "expected"),
    [(0.0104, 30, 1.1), (0.011, 500, 1.1), (0.0104, 29, None), (None, 500, None)],
)
def test_a_vertical_class_needs_30_check_points(rmse_m, points, expected):
    assert asprs_vertical_class_cm(rmse_m, points) == expected


def test_rings_go_around_the_asked_cells():
    x, y = np.meshgrid(*GRID.centres())
    (ring,) = rings_around((np.abs(x) <= 1.0) & (np.abs(y) <= 0.5), GRID)
    np.testing.assert_allclose(ring[0], ring[-1])
    np.testing.assert_allclose([ring.min(axis=0), ring.max(axis=0)], [[-1.0, -0.5], [1.0, 0.5]], atol=GRID.cell_m)
    hollow = (np.hypot(x, y) < 1.0) & (np.hypot(x, y) > 0.5)
    assert len(rings_around(hollow, GRID)) == 2


@pytest.mark.parametrize("heading", [0.0, 0.4, 1.2])
def test_cross_sections_run_along_the_legs_and_across_them(heading):
    legs = np.array([[s * 0.6, y, HEIGHT_M] for y in (-0.1, 0.1) for s in ((-1, 1) if y < 0 else (1, -1))])
    turned = legs @ geometry.rotation_from_rpy(0.0, 0.0, heading).T
    ring = RING @ geometry.rotation_from_rpy(0.0, 0.0, heading)[:2, :2].T
    along, across = section_lines(run_over_a_plane(turned, heading, [ring]))
    direction = (along[-1] - along[0]) / np.linalg.norm(along[-1] - along[0])
    assert abs(direction @ [np.cos(heading), np.sin(heading)]) > 0.98  # the turns are across the legs
    assert abs(direction @ (across[-1] - across[0])) < 1e-9
    np.testing.assert_allclose((along[0] + along[-1]) / 2, 0.0, atol=GRID.cell_m)
    assert np.linalg.norm(along[-1] - along[0]) == pytest.approx(1.0, abs=2 * GRID.cell_m)


def test_a_map_is_sampled_in_its_cells():
    raster = Raster(MapGrid(0.0, 1.0, 0.5, 2, 2), np.array([[1.0, 2.0], [3.0, 4.0]]))
    points = np.array([[0.1, 0.9], [0.9, 0.9], [0.1, 0.1], [0.6, 0.4], [1.1, 0.5]])
    np.testing.assert_array_equal(sampled(raster, points), [1.0, 2.0, 3.0, 4.0, np.nan])


@pytest.mark.parametrize(("value", "expected"), [(1.0, 1.0), (0.19, 0.1), (4.99, 2.0), (70.0, 50.0), (0.05, 0.05)])
def test_scale_bars_and_contours_have_round_numbers(value, expected):
    assert round_below(value) == pytest.approx(expected)


def test_shares_of_the_causes_are_those_of_the_variance():
    stated_m = {"pose_error_m": 0.003, "stereo_error_m": 0.004, "relief_error_m": None, "calibration_error_m": 0.0}
    shares = cause_shares(stated_m)
    assert list(shares) == ["stereo", "pose"]
    assert shares["stereo"] == (0.004, pytest.approx(0.64)) and shares["pose"][1] == pytest.approx(0.36)
    assert cause_shares({}) == {}


def answer(**elevation: Any) -> str:
    heights = {"completeness_area": 1.0, "le90_area_m": 0.0051, "le90_m": 0.006} | elevation
    metrics = {"map": heights, "trajectory": {"final": {"ate_rmse_m": 0.0032, "path_m": 17.2}}}
    metrics |= {"timing": {"simulated_s": 66.0}, "water": {"visibility_m": 6.0}}
    data = SimpleNamespace(height_m=1.75)
    known = {"metrics": metrics, "data": data, "asked": "4 m x 1.6 m"}
    return " ".join(render_text("survey_answer.txt.j2", known).split())


def test_the_answer_has_the_words_and_units_of_its_user():
    assert answer() == (
        "The survey mapped 100 % of the asked 4 m x 1.6 m in 1.1 min. On 90 % of this area the height error is below "
        "5.1 mm (LE90). Positions are right to 3.2 mm (root mean square) over a path of 17.20 m. The cameras were "
        "1.75 m above the sea floor on average, in water with a visibility of 6 m."
    )


def test_the_answer_states_no_error_for_an_area_with_too_many_holes():
    text = answer(completeness_area=0.7, le90_area_m=None)
    assert "mapped 70 %" in text and "No height error can be stated for 90 % of this area" in text
    assert "90 % of the mapped cells have a height error below 6.0 mm" in text


def test_the_page_names_the_least_number_of_matched_points():
    text = (Path(twin.report.__file__).parent / "survey_answers.html.j2").read_text()
    assert f"below {MIN_POINTS} the survey counts as degraded" in text


def test_conditions_name_the_water():
    water = {"jerlov": "II", "turbidity": 2.0, "source": "solonenko2015"}
    text = conditions({"plan": {"altitude_m": 1.5}, "water": water, "rig": {"title": "pair"}}, 6.04)
    assert text.startswith('1.5 m above the reference plane with the rig "pair" in water of Jerlov type II (')
    assert text.endswith(") with 2 times its scattering, visibility 6 m")
    assert (
        conditions({"water": {"jerlov": "clear", "turbidity": 3.0}}) == "0 m above the reference plane in clear water"
    )
    assert conditions({"water": {"absorption_per_m": [0.1]}}).endswith("in water with custom optical properties")
