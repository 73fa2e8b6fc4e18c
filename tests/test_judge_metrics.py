"""Map, consistency, control, overlap, requirements: closed forms, statistics, aborted surveys."""

import copy
import dataclasses
import json

import numpy as np
import pytest
from judge_synthetic import SCENARIO, evaluated, survey

from twin.core import geometry
from twin.core.height_field import image_overlap
from twin.core.links import Links
from twin.core.records import ElevationMap, MapGrid, Trajectory, Truth
from twin.errors import TwinError
from twin.judge import swaths
from twin.judge.consistency import consistency_metrics, nees, nees_interval
from twin.judge.map_error import map_metrics
from twin.judge.metrics import EvaluationInput, check_require, empty_metrics, evaluate
from twin.judge.swaths import control_metrics, leg_numbers, overlap_metrics, travel_direction
from twin.judge.verdict import meets_limit, more_is_better, numbers_of

RESULT, ELEVATION, TRUTH, RIG = survey()
PLANNED = {"overlap_along": 0.9, "overlap_across": 0.8, "along_median": 0.86, "across_median": 0.79}


def map_of(error: np.ndarray, sigma: float = 1.0) -> tuple[ElevationMap, Truth]:
    """Returns a map with the given errors, and a flat true floor that is observed everywhere."""
    grid = MapGrid(0, 0, 0.1, *error.shape)
    flat = np.full(error.shape, 2.0, np.float32)
    height = (flat + error).astype(np.float32)
    mosaic = np.zeros((*error.shape, 3), np.uint8)
    everywhere = np.ones(error.shape, bool)
    truth = dataclasses.replace(TRUTH, height_m=flat, seen=everywhere.copy(), asked=everywhere.copy())
    return ElevationMap(grid, height, np.full(error.shape, sigma, np.float32), mosaic), truth


def test_percentiles_of_uniform_errors_have_their_closed_form():
    error = np.linspace(-1, 1, 100_001).reshape(1, -1)  # |e| is uniform on 0 to 1
    metrics = map_metrics(*map_of(error))
    expected = dict(p85_m=0.85, le90_m=0.90, le95_m=0.95, max_m=1, rmse_m=1 / np.sqrt(3), nmad_m=1.4826 / 2, bias_m=0)
    for key, value in expected.items():
        assert metrics[key] == pytest.approx(value, abs=2e-5), key


def test_nmad_is_not_affected_by_a_bias_but_rmse_is():
    error = np.random.default_rng(0).normal(0, 0.02, (300, 300))
    plain, shifted = map_metrics(*map_of(error)), map_metrics(*map_of(error + 0.5))
    assert shifted["nmad_m"] == pytest.approx(plain["nmad_m"], rel=1e-4)
    assert plain["nmad_m"] == pytest.approx(0.02, rel=0.02)  # 90,000 draws: 0.4 % standard error
    assert shifted["rmse_m"] == pytest.approx(np.hypot(0.5, 0.02), rel=1e-3)
    assert shifted["bias_m"] == pytest.approx(0.5, abs=1e-3)


def test_sigma_ratio_is_one_for_the_right_sigma_and_inversely_proportional_to_it():
    error = np.random.default_rng(1).normal(0, 0.02, (300, 300))
    assert map_metrics(*map_of(error, sigma=0.02))["sigma_ratio"] == pytest.approx(1, rel=0.02)
    assert map_metrics(*map_of(error, sigma=0.01))["sigma_ratio"] == pytest.approx(2, rel=0.02)


def test_completeness_is_the_share_of_seen_cells_with_an_estimate():
    error = np.zeros((10, 10))
    error[0, :7] = np.nan
    elevation, truth = map_of(error)
    truth.seen[5:] = False
    elevation.height_m[9] = 99.0  # an estimate in a cell that was not seen is not evaluated
    metrics = map_metrics(elevation, truth)
    assert metrics["completeness"] == pytest.approx((50 - 7) / 50)
    assert metrics["max_m"] == 0


def test_nees_of_errors_drawn_from_their_covariance_is_three():
    rng = np.random.default_rng(2)
    root = rng.normal(0, 1, (20_000, 3, 3))
    error = np.einsum("nij,nj->ni", root, rng.normal(0, 1, (20_000, 3)))
    values = nees(error, root @ root.transpose(0, 2, 1))
    assert values.mean() == pytest.approx(3, abs=5 * np.sqrt(6 / 20_000))  # chi2 with 3 degrees: variance 6


def gaussian_final(seed: int, sigma_m: np.ndarray):
    """Returns the survey with normal errors of the final keyframes in camera axes and their true covariance."""
    rng = np.random.default_rng(seed)
    poses = TRUTH.trajectory.world_from_camera.copy()
    for frame in RESULT.keyframe_rows[1:]:
        poses[frame] = poses[frame] @ geometry.pose(np.eye(3), rng.normal(0, sigma_m))
    result = copy.copy(RESULT)
    result.final = Trajectory(TRUTH.trajectory.times_s, poses)
    cov = np.diag(np.concatenate([[1e-6] * 3, sigma_m**2]))
    result.node_cov = np.tile(cov, (len(RESULT.keyframe_rows), 1, 1))
    return result


def test_keyframe_consistency_uses_camera_axes_and_leaves_out_the_anchored_keyframe():
    sigma_m = np.array([0.001, 0.03, 0.2])  # unequal, to detect wrong axes
    metrics = [consistency_metrics(gaussian_final(k, sigma_m), None, TRUTH) for k in range(8)]
    n = 8 * (len(RESULT.keyframe_rows) - 1)
    assert np.mean([f["nees_position_mean"] for f in metrics]) == pytest.approx(3, abs=4 * np.sqrt(6 / n))
    share = np.mean([f["within_2sigma_position"] for f in metrics])
    assert share == pytest.approx(0.9545, abs=4 * np.sqrt(0.9545 * 0.0455 / (3 * n)))
    assert metrics[0]["within_2sigma_map"] is None


def test_the_interval_of_the_mean_nees_holds_99_percent_of_consistent_surveys():
    rng = np.random.default_rng(0)
    for k in (1, 7):
        low, high = nees_interval(k) or (0.0, 0.0)
        drawn = (rng.normal(size=(40_000, 3 * k)) ** 2).sum(axis=1) / k
        assert [np.mean(drawn < low), np.mean(drawn > high)] == pytest.approx([0.005] * 2, abs=0.0015)
    assert nees_interval(1e6) == pytest.approx([3, 3], abs=0.01)
    assert nees_interval(None) is None
    result = copy.copy(RESULT)
    for k, expected in ((7, nees_interval(7)), (None, (None, None))):
        result.quality = RESULT.quality._replace(independent_errors=k)
        metrics = consistency_metrics(result, None, TRUTH)
        assert (metrics["nees_position_low"], metrics["nees_position_high"]) == expected


def test_keyframes_without_a_covariance_are_left_out_of_consistency():
    result = gaussian_final(0, np.array([0.01, 0.01, 0.01]))
    result.node_cov = result.node_cov.copy()
    result.node_cov[2::2] = np.nan
    assert consistency_metrics(result, None, TRUTH)["nees_position_mean"] == pytest.approx(3, abs=1.6)
    result.node_cov[:] = 0
    assert consistency_metrics(result, None, TRUTH)["nees_position_mean"] is None


def test_cross_track_error_is_perpendicular_to_the_direction_of_travel():
    diagonal = np.array([1.0, 1.0]) / np.sqrt(2)
    n = 100
    reference = np.column_stack([np.outer(np.arange(n) * 0.1, diagonal), np.full(n, 2.0)])
    holding = np.arange(n) >= 80
    reference[80:] = reference[80]
    poses = np.tile(np.eye(4), (n, 1, 1))
    ahead, port = np.array([*diagonal, 0]), np.array([-diagonal[1], diagonal[0], 0])
    poses[:, :3, 3] = reference + 5 * ahead + 0.03 * port + [0, 0, 0.04]
    poses[80:, :3, 3] = reference[80:] + [0.3, 0, 0.4]
    truth = dataclasses.replace(
        TRUTH, trajectory=Trajectory(np.arange(n) * 1.0, poses), reference=reference, holding=holding
    )
    metrics = control_metrics(truth)
    assert metrics["cross_track_rmse_m"] == pytest.approx(0.03)
    assert metrics["station_keeping_rmse_m"] == pytest.approx(0.5)
    assert metrics["altitude_rmse_m"] == pytest.approx(np.sqrt((80 * 0.04**2 + 20 * 0.4**2) / 100))


def test_leg_numbers_exclude_short_segments_and_station_keeping():
    legs = leg_numbers(TRUTH.reference)
    assert legs.max() == 3
    on_leg = TRUTH.reference[legs == 1]
    assert np.ptp(on_leg[:, 0]) == pytest.approx(4, abs=0.1) and np.ptp(on_leg[:, 1]) == pytest.approx(0, abs=0.03)
    np.testing.assert_allclose(np.linalg.norm(travel_direction(TRUTH.reference), axis=1), 1)


def test_overlap_over_a_flat_floor_follows_from_the_planned_geometry():
    times, reference = TRUTH.trajectory.times_s, TRUTH.reference
    poses = np.tile(geometry.pose(geometry.BODY_FROM_DOWN_CAMERA, np.zeros(3)), (len(times), 1, 1))
    poses[:, :3, 3] = reference
    flat = dataclasses.replace(TRUTH, trajectory=Trajectory(times, poses), height_m=np.full_like(TRUTH.height_m, 0.2))
    metrics = overlap_metrics(RESULT, flat, RIG, ELEVATION.grid, PLANNED)
    depth = 2.0
    step = np.median(np.linalg.norm(np.diff(reference[RESULT.keyframe_rows], axis=0), axis=1))
    assert metrics["along_median"] == pytest.approx(1 - step / (RIG.height_px * depth / RIG.focal_px), abs=1e-6)
    # the reference reaches the line of the next leg with an accuracy of one step (2.5 cm)
    assert metrics["across_median"] == pytest.approx(1 - 0.5 / (RIG.width_px * depth / RIG.focal_px), abs=0.012)
    assert (metrics["along_asked"], metrics["across_asked"]) == (0.9, 0.8)
    assert (metrics["along_planned"], metrics["across_planned"]) == (0.86, 0.79)


def test_overlap_decreases_where_the_floor_rises():
    high = dataclasses.replace(TRUTH, height_m=TRUTH.height_m + 1.0)
    low, raised = (overlap_metrics(RESULT, t, RIG, ELEVATION.grid, {}) for t in (TRUTH, high))
    assert raised["across_median"] < low["across_median"] - 0.1
    assert raised["along_median"] < low["along_median"] - 0.05


def test_overlap_of_a_long_survey_is_measured_from_a_sample_of_pairs_over_the_whole_path(monkeypatch):
    whole, numbers = overlap_metrics(RESULT, TRUTH, RIG, ELEVATION.grid, {}), []
    monkeypatch.setattr(swaths, "MOST_PAIRS", 20)
    monkeypatch.setattr(swaths, "image_overlap", lambda f, *p: numbers.append(len(p[0])) or image_overlap(f, *p))
    sample = overlap_metrics(RESULT, TRUTH, RIG, ELEVATION.grid, {})
    assert numbers == [20, 20]
    for key in ("along_median", "across_median"):
        assert sample[key] == pytest.approx(whole[key], abs=0.02)


def diagonal_swaths(spacing_m):
    """Returns truth and result of a survey of two parallel straight swaths to the north-east over a flat floor."""
    n, ahead, port = 21, np.array([1.0, 1.0, 0.0]) / np.sqrt(2), np.array([-1.0, 1.0, 0.0]) / np.sqrt(2)
    first = np.outer(np.arange(n) * 0.1, ahead) + [0, 0, 2.2]
    reference = np.concatenate([first, first + spacing_m * port])
    poses = np.tile(geometry.pose(geometry.BODY_FROM_DOWN_CAMERA, np.zeros(3)), (2 * n, 1, 1))
    poses[:, :3, 3] = reference
    truth = dataclasses.replace(
        TRUTH, trajectory=Trajectory(np.arange(2 * n) * 1.0, poses), reference=reference,
        track=np.repeat([1, 2], n), height_m=np.full_like(TRUTH.height_m, 0.2),
    )  # fmt: skip
    return truth, dataclasses.replace(RESULT, keyframe_rows=np.arange(2 * n), track_of_keyframe=truth.track)


def test_sidelap_of_loops_is_perpendicular_to_the_direction_of_travel():
    truth, result = diagonal_swaths(0.3)
    metrics = overlap_metrics(result, truth, RIG, None, {"pattern": "loops"})
    length, width = RIG.height_px * 2.0 / RIG.focal_px, RIG.width_px * 2.0 / RIG.focal_px

    def shared_area(step):
        return (1 - step / np.sqrt(2) / length) * (1 - step / np.sqrt(2) / width)

    assert metrics["across_median"] == pytest.approx(shared_area(0.3), abs=1e-6)
    assert metrics["along_median"] == pytest.approx(shared_area(0.1), abs=1e-6)


def test_the_far_end_of_a_track_is_farthest_from_the_start_as_planned():
    poses = TRUTH.trajectory.world_from_camera.copy()
    away = np.linalg.norm(TRUTH.reference - TRUTH.reference[0], axis=1)
    for track, error in ((1, 0.03), (2, 0.07)):
        here = TRUTH.track == track
        far = here & (away >= 0.9 * away[here].max())
        poses[far, 1, 3] += error
        poses[here & ~far, 1, 3] += 1.0
    poses[0] = TRUTH.trajectory.world_from_camera[0]  # the anchor
    result = dataclasses.replace(RESULT, final=Trajectory(TRUTH.trajectory.times_s, poses))
    rows = evaluated(result, ELEVATION, TRUTH, RIG)["tracks"]
    assert [row["farthest_error_m"] for row in rows] == pytest.approx([0.03, 0.07])


@pytest.mark.parametrize(("name", "worse"), [("map.le90_m", 0.1), ("map.completeness", -0.1)])
def test_a_value_at_its_limit_meets_it(name, worse):
    assert [meets_limit(name, value, 0.5) for value in (0.5 - worse, 0.5, 0.5 + worse, None)] == [
        True,
        True,
        False,
        False,
    ]


def test_requirements_bound_errors_from_above_and_quality_from_below():
    require = {"map.le90_m": 0.05, "map.completeness": 1.0, "map.max_m": 1e-9}
    metrics = evaluate(EvaluationInput(RESULT, ELEVATION, TRUTH, RIG, require=require))
    verdicts = {name: row["passed"] for name, row in metrics["require"].items()}
    assert verdicts == {"map.le90_m": True, "map.completeness": False, "map.max_m": False}
    assert more_is_better("overlap.across_p05") and not more_is_better("timing.wall_s")
    assert more_is_better("orthomosaic.coverage_area") and more_is_better("orthomosaic.matched")
    assert not more_is_better("orthomosaic.ce90_m") and not more_is_better("orthomosaic.edge_width_m")


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("map.le9_m", "did you mean .*map.le90_m"),
        ("flags", "no such metric"),
        ("seed", "no such metric"),
        ("trajectory.final.ate", "did you mean trajectory.final.ate_"),
        ("tracks.0.ga_ms", "no such metric"),
    ],
)
def test_an_unknown_requirement_is_rejected_by_name(name, message):
    with pytest.raises(TwinError, match=message) as caught:
        check_require({name: 1.0})
    assert caught.value.field == f"require.{name}"


def test_an_aborted_survey_has_every_key_and_no_nan():
    whole = evaluated(RESULT, ELEVATION, TRUTH, RIG)
    for n_frames, n_keyframes in [(0, 0), (1, 0), (1, 1), (2, 1), (9, 2), (8, 2)]:
        part = evaluate(aborted(n_frames, n_keyframes))
        json.dumps(part, allow_nan=False)
        assert set(numbers_of(part)) >= {p for p in numbers_of(whole) if not p.startswith("timing.stages")}
        assert part["map"]["rmse_m"] is None and part["require"]["map.le90_m"]["passed"] is False
    assert set(numbers_of(empty_metrics())) == {p for p in numbers_of(whole) if not p.startswith("require.")}


def aborted(n_frames: int, n_keyframes: int) -> EvaluationInput:
    """Returns the survey aborted after some frames, without a map and before any alignment."""
    cut = {k: Trajectory(t.times_s[:n_frames], t.world_from_camera[:n_frames]) for k, t in vars(RESULT).items()
           if isinstance(t, Trajectory)}  # fmt: skip
    result = dataclasses.replace(
        RESULT, **cut,
        keyframe_rows=RESULT.keyframe_rows[:n_keyframes], track_of_keyframe=RESULT.track_of_keyframe[:n_keyframes],
        node_cov=np.zeros((0, 6, 6)), links=Links(), alignments=[], before_ga=[], after_ga=[],
    )  # fmt: skip
    flown = TRUTH.trajectory
    truth = dataclasses.replace(
        TRUTH, trajectory=Trajectory(flown.times_s[:n_frames], flown.world_from_camera[:n_frames]),
        reference=TRUTH.reference[:n_frames], holding=TRUTH.holding[:n_frames], track=TRUTH.track[:n_frames],
        seen=np.zeros_like(TRUTH.seen),
    )  # fmt: skip
    return EvaluationInput(result, None, truth, RIG, identity={"status": "aborted"}, require=SCENARIO.require)


def test_inputs_that_are_not_finite_become_none():
    timing = {
        "wall_s": np.nan,
        "simulated_s": np.float32(3),
        "stages": {"ga": {"mean_ms": np.inf, "count": np.int64(2)}},
    }
    identity = {"seed": np.int64(7)}
    metrics = evaluate(EvaluationInput(RESULT, ELEVATION, TRUTH, RIG, timing=timing, identity=identity))
    json.dumps(metrics, allow_nan=False)
    assert metrics["seed"] == 7 and metrics["timing"]["stages"]["ga"] == {"mean_ms": None, "count": 2}
    assert metrics["timing"]["wall_s"] is None and metrics["timing"]["simulated_s"] == 3


def test_a_map_without_estimates_has_completeness_zero_and_no_nan():
    empty = dataclasses.replace(ELEVATION, height_m=np.full_like(ELEVATION.height_m, np.nan))
    metrics = evaluate(EvaluationInput(RESULT, empty, TRUTH, RIG))["map"]
    assert metrics["completeness"] == 0 and metrics["rmse_m"] is None and metrics["max_m"] is None


def test_a_least_height_is_a_lower_limit_and_a_bias_is_limited_to_both_sides():
    assert [meets_limit("control.least_height_m", height, 0.5) for height in (0.01, 1.0)] == [False, True]
    assert [meets_limit("map.bias_m", bias, 0.02) for bias in (-5.0, -0.01, 0.01, 5.0)] == [False, True, True, False]
