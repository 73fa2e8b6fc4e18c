"""Tank experiments: sizes in a map, closure of loops, path of the rig, bad cells among the uncertain ones."""

from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np
import pytest

from twin.core import geometry
from twin.core.records import StereoRig, SurveyResult, Trajectory
from twin.reproduce import tank_survey
from twin.reproduce.experiment_floors import OBJECTS, tank_floor
from twin.reproduce.tank import TABLES, TITLES, flagged_share, sizes_table
from twin.reproduce.tank_sizes import hidden_cells, measure, true_size
from twin.reproduce.tank_survey import N_LOOP, STEP_M, closures, lawnmower_path, map_grid, two_loops_path

GRID = map_grid(0.003)
X, Y = np.meshgrid(*GRID.centres())
NAMES = [item.name for item in OBJECTS]


@pytest.mark.parametrize("item", OBJECTS, ids=NAMES)
@pytest.mark.parametrize("floor_m", [0.0, -0.3])
def test_the_true_surface_has_the_true_size_whatever_the_height_of_the_floor(item, floor_m):
    row = measure(item, item.height_at(X, Y) + floor_m, GRID)
    # the sides of a box lie in the middle between cells of 3 mm; a curved edge falls up to half a cell from its place
    np.testing.assert_allclose(row.measured[:2], row.true[:2], atol=1e-9 if item.shape == "box" else 0.003)
    assert row.measured.height_m == pytest.approx(row.true.height_m, abs=0.001)


def test_a_linear_ramp_at_the_edges_does_not_change_the_size_of_a_box():
    """The height of a box blurred by a box filter is half of its top at the true edge."""
    item = OBJECTS[0]._replace(centre_m=(0.0, 0.0), size_m=(0.144, 0.096, 0.06))
    ramp = [
        np.clip(0.5 - (np.abs(axis) - side / 2) / 0.02, 0, 1) for axis, side in zip((X, Y), item.size_m, strict=False)
    ]
    row = measure(item, 0.06 * ramp[0] * ramp[1], GRID)
    np.testing.assert_allclose(row.measured, item.size_m, atol=1e-9)


def test_holes_are_passed_over_and_an_object_without_heights_has_no_size():
    item = OBJECTS[0]
    height = item.height_at(X, Y)
    holes = np.where(np.random.default_rng(1).random(height.shape) < 0.2, np.nan, height)
    np.testing.assert_allclose(measure(item, holes, GRID).errors_m, 0, atol=0.008)
    strip = np.where(np.abs(np.abs(X - item.centre_m[0]) - 0.075) < 0.003, np.nan, height)  # no heights at two sides
    assert abs(measure(item, strip, GRID).errors_m.x_m) < 0.003
    assert np.isnan(measure(item, np.full_like(height, np.nan), GRID).measured).all()


def test_mismatches_on_top_of_an_object_do_not_change_its_extents():
    pipe = next(item for item in OBJECTS if item.shape == "pipe")
    height = pipe.height_at(X, Y)
    top = (height > 0.9 * pipe.size_m[2]) & (np.abs(X - pipe.centre_m[0]) < 0.2)
    true, wrong = measure(pipe, height, GRID).measured, measure(pipe, np.where(top, -0.36, height), GRID).measured
    np.testing.assert_allclose(wrong[:2], true[:2], atol=1e-3)


def test_a_pipe_without_heights_on_its_crest_has_extents_but_no_height():
    pipe = next(item for item in OBJECTS if item.shape == "pipe")
    crest = np.abs(Y - pipe.centre_m[1]) < 0.01
    row = measure(pipe, np.where(crest, np.nan, pipe.height_at(X, Y)), GRID)
    assert np.isnan(row.measured.height_m) and np.abs(row.errors_m[:2]).max() < 0.003


def box_map(side_m, hidden_m):
    """Returns heights of a box at the origin with a strip of unknown floor beyond its side towards +x."""
    beyond = X - side_m / 2
    height = np.where(np.maximum(np.abs(X), np.abs(Y)) < side_m / 2, 0.09, 0.0)
    return np.where((beyond > 0) & (beyond < hidden_m) & (np.abs(Y) < side_m / 2), np.nan, height)


def one_view(x_m):
    """Returns the pose (1, 4, 4) of a camera 1.5 m above the floor that looks down."""
    return geometry.pose(geometry.rotations_of_down_camera(np.zeros(1))[0], np.array([x_m, 0.0, 1.5]))[None]


def test_floor_behind_a_box_is_hidden_as_far_as_similar_triangles_say():
    """Cameras at x = -0.4 m, 1.5 m above the floor, see it from 0.0894 m on beyond an edge at 0.06 m, 0.09 m high."""
    rig = StereoRig(640, 480, 686.0, 0.3)
    edge = 0.06 + 0.09 * (0.06 + 0.4) / (1.5 - 0.09)
    hidden = hidden_cells(box_map(0.12, 0.1), GRID, one_view(-0.4), rig)
    here = (np.abs(Y) < 0.03) & (X < 0.15)
    found = X[here & hidden].max()
    assert 0 < edge - found < 2 * GRID.cell_m  # the side of the box falls over one cell
    assert not hidden[X < 0.06].any()
    np.testing.assert_array_equal(hidden[here], (np.isnan(box_map(0.12, 0.1)) & (X <= found + 1e-9))[here])
    seen = np.concatenate([one_view(-0.4), one_view(0.4)])
    for order in (seen, seen[::-1]):
        assert not hidden_cells(box_map(0.12, 0.1), GRID, order, rig).any()


def test_an_object_beside_hidden_floor_ends_at_its_last_cell_and_not_in_the_middle_of_the_gap():
    box = OBJECTS[0]._replace(centre_m=(0.0, 0.0), size_m=(0.12, 0.12, 0.09))
    height = box_map(0.12, 0.033)
    assert measure(box, height, GRID).errors_m.x_m > 0.012
    hidden = np.isnan(height)
    np.testing.assert_allclose(measure(box, height, GRID, hidden).errors_m, 0, atol=0.0031)


def test_a_dome_is_narrower_at_half_of_its_height():
    stone = next(item for item in OBJECTS if item.shape == "dome")
    assert true_size(stone).x_m == pytest.approx(0.866 * stone.size_m[0], rel=1e-3)


def poses(positions):
    found = np.tile(np.eye(4), (len(positions), 1, 1))
    found[:, :3, 3] = positions
    return Trajectory(np.arange(len(positions)) / 30, found)


def test_the_closure_error_is_the_distance_between_a_repeated_frame_and_the_first():
    drift = np.outer(np.arange(61), [3e-4, 0, -4e-4])  # 0.5 mm a frame
    none = np.zeros(0, np.int64)
    result = SurveyResult(poses(drift), poses(drift / 5), poses(0 * drift), none, none, np.zeros((0, 6, 6)))
    found = closures(result, (30, 60))
    np.testing.assert_allclose(found, [[0.015, 0.003, 0], [0.030, 0.006, 0]], atol=1e-12)


def test_the_two_loops_touch_at_the_start_without_crossing():
    """They lie on either side of the line through the start, along which both begin."""
    first, second = two_loops_path(1).planned_m[: N_LOOP + 1], two_loops_path(1).planned_m[N_LOOP:]
    assert first[1:-1, 0].min() > 1e-3 and second[1:-1, 0].max() < -1e-3
    np.testing.assert_allclose(first[[0, -1], 0], 0, atol=1e-12)
    assert "touch at the start" in TITLES["tank2"]


@pytest.mark.parametrize("path", [lawnmower_path(130, 1), two_loops_path(1)], ids=["legs", "loops"])
def test_frames_are_5_cm_apart_on_a_track_that_bends_at_one_place(path):
    steps = np.abs(np.diff(path.planned_m, axis=0)).sum(axis=1)
    chord = np.linalg.norm(np.diff(path.planned_m, axis=0), axis=1)
    assert steps.max() < 1.42 * STEP_M and chord.min() > 0.68 * STEP_M  # corners and arcs cut less than this
    off = path.world_from_camera[:, 1, 3] - path.planned_m[:, 1]
    at_bend = np.abs(path.planned_m[:, 0] - 0.2) < 0.05
    away = path.planned_m[:, 0] < -0.2
    assert off[at_bend].mean() > 0.009 and np.abs(off[away].mean()) < 0.001


def test_the_second_path_has_61_pairs_and_returns_to_its_first_pose_at_frames_31_and_61():
    path = two_loops_path(1)
    assert len(path.planned_m) == 61 and path.repeats == (N_LOOP, 2 * N_LOOP)
    for k in path.repeats:
        np.testing.assert_array_equal(path.world_from_camera[k], path.world_from_camera[0])
    assert len(lawnmower_path(130, 1).planned_m) == 130


class StartedError(Exception):
    """Raised instead of starting the estimators."""


@pytest.mark.parametrize("name", ["tank1", "tank2"])
def test_the_estimators_start_at_the_planned_pose_and_not_at_the_true_one(name, tmp_path, monkeypatch):
    starts = []

    def navigator(rig, settings, start, **_):
        starts.append(start)
        raise StartedError

    monkeypatch.setattr(tank_survey, "Navigator", navigator)
    monkeypatch.setattr(tank_survey, "tank_floor", lambda _: None)
    monkeypatch.setattr(tank_survey, "image_vision", lambda *_: nullcontext())
    monkeypatch.setattr(tank_survey, "RenderedWorld", lambda *_: nullcontext())
    with pytest.raises(StartedError):
        tank_survey.survey_tank(name, tmp_path, tank_survey.QUICK)
    path = two_loops_path(tank_survey.SEED) if name == "tank2" else lawnmower_path(130, tank_survey.SEED)
    np.testing.assert_allclose(starts[0], geometry.pose(geometry.BODY_FROM_DOWN_CAMERA, path.planned_m[0]), atol=1e-12)
    assert np.abs(starts[0] - path.world_from_camera[0]).max() > 5e-4


def test_heights_are_compared_as_if_the_first_pose_were_true():
    """A map of a level floor in axes that are off by a rigid motion: it is tilted, but has no error."""
    motion, first = geometry.exp(np.array([0.003, -0.002, 0.001, 0.002, 0.001, 0.004])), np.eye(4)
    first[2, 3] = 1.5
    x, y = np.meshgrid(*GRID.centres())
    a, b, c, d = motion[2]
    height = (-(a * x + b * y + d) / c).astype(np.float32)  # where the moved point has z = 0
    assert np.abs(height).max() > 0.005
    survey = SimpleNamespace(
        result=SimpleNamespace(final=SimpleNamespace(world_from_camera=geometry.inverse(motion)[None] @ first)),
        truth=SimpleNamespace(trajectory=SimpleNamespace(world_from_camera=first[None]), seen=np.isfinite(height)),
        elevation=SimpleNamespace(height_m=height),
        mission=SimpleNamespace(grid=GRID, terrain=SimpleNamespace(height_at=lambda x, _: 0 * x)),
    )
    np.testing.assert_allclose(tank_survey.height_errors(survey), 0, atol=1e-8)
    survey.truth.seen[3, 4] = False
    assert np.isnan(tank_survey.height_errors(survey)[3, 4])


def test_the_floor_has_the_objects_at_their_heights_with_a_saturated_pipe_and_a_shade():
    floor = tank_floor(1)
    for item in OBJECTS:
        assert float(floor.height_at(*item.centre_m)) == pytest.approx(item.size_m[2], rel=0.01)
    rows, cols = floor.texture.shape[:2]

    def level(x, y):
        row, col = int((floor.north_m - y) / floor.texture_px_m), int((x - floor.west_m) / floor.texture_px_m)
        assert 0 <= row < rows and 0 <= col < cols
        return floor.texture[row - 20 : row + 20, col - 20 : col + 20].mean()

    assert level(0.3, 0.3) > 3 * level(-0.9, 0.3)
    assert floor.texture[..., 0].max() > 200


def test_the_share_of_flagged_cells_counts_bad_cells_in_the_worst_fifth_by_sigma():
    sigma = np.arange(100.0).reshape(10, 10)
    error = np.zeros((10, 10))
    error[9, 5:] = 0.03  # among the twenty largest
    error[0, :1] = -0.03
    error[0, 1] = 0.019
    assert flagged_share(error, sigma) == pytest.approx(5 / 6)
    assert flagged_share(0 * error, sigma) is None


def test_the_table_of_sizes_has_every_object_and_the_closure_is_reported_for_the_loops_only():
    rows = sizes_table([measure(item, item.height_at(X, Y), GRID) for item in OBJECTS]).rows
    assert [row[0] for row in rows] == ["object", *NAMES]
    assert [float(row[-1]) for row in rows[1:]] == pytest.approx([0] * len(NAMES), abs=3)
    assert "closure" in TABLES["tank2"] and "closure" not in TABLES["tank1"]
