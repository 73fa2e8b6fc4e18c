"""Map metrics over the asked area: closed forms of LE90 with holes, and what does not change them."""

import dataclasses

import numpy as np
import pytest
from judge_synthetic import survey

from twin.core.records import ElevationMap, MapGrid, Truth
from twin.judge.map_error import completeness_metric, map_metrics, percentile_with_holes
from twin.judge.metrics import EvaluationInput, evaluate
from twin.judge.verdict import more_is_better

RESULT, ELEVATION, TRUTH, RIG = survey()
N = 100  # rows and columns of the test maps


def map_with_holes(share: float, seed: int = 0) -> tuple[ElevationMap, Truth, np.ndarray]:
    """Returns a map of N x N cells with normal errors of 1 cm and a share of holes, its truth, and the errors."""
    rng = np.random.default_rng(seed)
    error = rng.normal(0, 0.01, (N, N))
    holes = rng.permutation(N * N) < round(share * N * N)
    error[holes.reshape(N, N)] = np.nan
    flat, everywhere = np.zeros((N, N), np.float32), np.ones((N, N), bool)
    truth = dataclasses.replace(TRUTH, height_m=flat, seen=everywhere.copy(), asked=everywhere.copy())
    error = error.astype(np.float32)
    built = dataclasses.replace(
        ELEVATION, grid=MapGrid(0, 0, 0.1, N, N), height_m=error.copy(), sigma_m=np.full((N, N), 0.01, np.float32)
    )
    return built, truth, error.astype(float)


@pytest.mark.parametrize("share", [0.0, 0.01, 0.08, 0.0999])
def test_with_less_than_ten_percent_of_holes_le90_is_the_percentile_with_infinite_errors(share):
    elevation, truth, error = map_with_holes(share)
    metrics = map_metrics(elevation, truth)
    with_infinity = np.where(np.isfinite(error), np.abs(error), np.inf)
    assert metrics["le90_area_m"] == np.percentile(with_infinity, 90)
    assert metrics["completeness_area"] == pytest.approx(1 - share, abs=0.5 / N**2)
    assert (metrics["le90_area_m"] > metrics["le90_m"]) == (share > 0)  # LE90 of the mapped cells ignores the holes


@pytest.mark.parametrize("share", [0.1001, 0.12, 0.5, 1.0])
def test_with_more_than_ten_percent_of_holes_le90_is_infinite_and_its_requirement_is_missed(share):
    elevation, truth, _ = map_with_holes(share)
    metrics = map_metrics(elevation, truth)
    assert metrics["le90_area_m"] is None
    assert metrics["completeness_area"] == pytest.approx(1 - share, abs=0.5 / N**2)
    assert share == 1 or metrics["le90_m"] < 0.02


def test_a_percentile_that_falls_on_the_last_finite_error_is_finite():
    errors = np.array([*range(10), np.nan])  # 11 values: the 90th percentile is the tenth
    assert percentile_with_holes(errors, 90) == 9
    assert percentile_with_holes(np.append(errors, np.nan), 90) is None  # between the tenth and infinity
    assert percentile_with_holes(np.array([]), 90) is None


def test_cells_outside_the_area_do_not_count():
    elevation, truth, _ = map_with_holes(0.05)
    truth.asked[:, N // 2 :] = False
    metrics = map_metrics(elevation, truth)
    elevation.height_m[:, N // 2 :] = np.nan
    truth.seen[:, N // 2 :] = False
    changed = map_metrics(elevation, truth)
    for key in ("le90_area_m", "completeness_area"):
        assert changed[key] == metrics[key]
    elevation.height_m[:, N // 2 :] = 50.0
    assert map_metrics(elevation, truth)["le90_area_m"] == metrics["le90_area_m"]


def test_asked_cells_that_no_keyframe_observed_count():
    elevation, truth, _ = map_with_holes(0.0)
    truth.seen[: N // 4] = False
    elevation.height_m[: N // 4] = np.nan
    metrics = map_metrics(elevation, truth)
    assert metrics["completeness"] == 1 and metrics["le90_m"] < 0.02
    assert metrics["completeness_area"] == 0.75 and metrics["le90_area_m"] is None


def test_the_order_of_the_cells_does_not_matter():
    elevation, truth, _ = map_with_holes(0.07)
    mirrored = dataclasses.replace(elevation, height_m=elevation.height_m[::-1, ::-1].copy())
    truth.asked[:10] = False
    turned = dataclasses.replace(truth, asked=truth.asked[::-1, ::-1].copy())
    assert map_metrics(mirrored, turned)["le90_area_m"] == map_metrics(elevation, truth)["le90_area_m"]


def test_a_survey_without_a_map_or_without_an_area_has_no_area_metrics():
    elevation, truth, _ = map_with_holes(0.0)
    truth.asked[:] = False
    for metrics in (map_metrics(None, truth), map_metrics(elevation, truth)):
        assert metrics["le90_area_m"] is None and metrics["completeness_area"] is None


def test_requirements_on_the_area_are_judged():
    require = {"map.le90_area_m": 0.05, "map.completeness_area": 0.9}
    passed = evaluate(EvaluationInput(RESULT, ELEVATION, TRUTH, RIG, require=require))["require"]
    assert [row["passed"] for row in passed.values()] == [True, True]
    holed = dataclasses.replace(ELEVATION, height_m=ELEVATION.height_m.copy())
    holed.height_m[:, ::4] = np.nan
    missed = evaluate(EvaluationInput(RESULT, holed, TRUTH, RIG, require=require))["require"]
    assert missed["map.le90_area_m"] == {"value": None, "limit": 0.05, "passed": False}
    assert missed["map.completeness_area"]["value"] == pytest.approx(0.75, abs=0.01)
    assert not missed["map.completeness_area"]["passed"]


def test_more_completeness_is_better_and_every_map_statistic_is_reported_with_one():
    assert more_is_better("map.completeness_area") and not more_is_better("map.le90_area_m")
    assert completeness_metric("map.le90_area_m") == "map.completeness_area"
    assert completeness_metric("map.rmse_m") == "map.completeness"
    for name in ("map.completeness", "map.completeness_area", "map.cell_m", "trajectory.final.ate_rmse_m", "risk"):
        assert completeness_metric(name) is None


def test_errors_over_objects_and_over_bare_floor_are_separate():
    """Errors of 1 cm over the floor, 3 cm over objects and 20 cm in a tenth of the cells of objects."""
    elevation, truth, _ = map_with_holes(0.0)
    objects = np.zeros((N, N), np.uint16)
    objects[:20] = 1
    error = np.where(objects > 0, 0.03, -0.01).astype(np.float32)
    error[:2] = -0.2
    elevation = dataclasses.replace(elevation, height_m=error)
    metrics = map_metrics(elevation, dataclasses.replace(truth, objects=objects))
    expected = {
        "median_m": 0.01, "gross_share": 0.02, "floor_median_m": 0.01, "floor_le90_m": 0.01, "floor_gross_share": 0.0,
        "objects_median_m": 0.03, "objects_gross_share": 0.1,
    }  # fmt: skip
    assert {key: metrics[key] for key in expected} == pytest.approx(expected)
    bare = map_metrics(elevation, truth)
    assert bare["floor_le90_m"] == bare["le90_m"] and bare["objects_le90_m"] is None
