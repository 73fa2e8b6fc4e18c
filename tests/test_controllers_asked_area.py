"""The asked area of a plan: closed forms of its size, and its relation to legs, loops and the grid of the map."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from twin.controllers import lawnmower, loops
from twin.controllers.detours import Task, with_tasks
from twin.controllers.survey_plan import SurveyRequest
from twin.scenario.file import load_scenario
from twin.world.mission import prepare

REQUEST = SurveyRequest((4.0, 3.0), 2.0, 0.25, 0.9, 0.6, 0, 320, 240, 277.0, 30.0)
ROUND = REQUEST._replace(area_m=(6.0, 6.0))


def share_inside(plan, half_m: float, n: int = 801) -> float:
    """Returns the area inside the asked area [m2], by counting the cells of a grid of side 2 `half_m`."""
    centres = (np.arange(n) + 0.5) / n * 2 * half_m - half_m
    return float(plan.inside_area(*np.meshgrid(centres, centres)).mean() * (2 * half_m) ** 2)


def test_all_tracks_of_a_lawnmower_cover_the_rectangle():
    plan = lawnmower.plan(REQUEST)
    assert plan.n_tracks > 1
    assert share_inside(plan, 3.0) == pytest.approx(12.0, rel=0.01)
    x, y = np.array([-2.0, 2.0, 2.0001, 0.0, 0.0]), np.array([-1.5, 1.5, 0.0, 1.5001, -1.5001])
    assert plan.inside_area(x, y).tolist() == [True, True, False, False, False]


@given(st.integers(1, 3), st.floats(2.5, 9.0))
def test_the_first_tracks_cover_a_strip_per_leg(n_tracks, width_m):
    plan = lawnmower.plan(REQUEST._replace(area_m=(4.0, width_m)))
    n_tracks = min(n_tracks, plan.n_tracks)
    part = lawnmower.plan(REQUEST._replace(area_m=(4.0, width_m), tracks=n_tracks))
    y = np.linspace(-width_m, width_m, 4001)
    inside = part.inside_area(np.zeros_like(y), y)
    assert np.mean(inside) * 2 == pytest.approx(n_tracks / plan.n_tracks, abs=2e-3)
    assert inside.argmax() == np.flatnonzero(y >= -width_m / 2 - 1e-9)[0]  # from the southern edge
    legs = part.outline()[:, 1]
    assert np.abs(y[inside][:, None] - legs).min(axis=1).max() <= part.swath_spacing_m / 2 + 1e-6


def test_all_loops_cover_the_disc():
    plan = loops.plan(ROUND)
    assert share_inside(plan, 3.5) == pytest.approx(np.pi * 9, rel=0.01)


@pytest.mark.parametrize("tracks", [1, 3])
def test_the_first_loops_cover_a_ring_along_each_loop(tracks):
    plan = loops.plan(ROUND._replace(tracks=tracks))
    path = np.concatenate([plan.references(k, np.arange(0, plan.track_duration_s(k), 0.04)).position[:, :2]
                           for k in range(1, tracks + 1)])  # fmt: skip
    rng = np.random.default_rng(tracks)
    points = rng.uniform(-3.2, 3.2, (600, 2))
    distance_m = np.linalg.norm(points[:, None] - path, axis=2).min(axis=1)
    expected = (distance_m <= plan.swath_spacing_m / 2) & (np.linalg.norm(points, axis=1) <= 3.0)
    differs = expected != plan.inside_area(*points.T)
    assert (np.abs(distance_m[differs] - plan.swath_spacing_m / 2) < 0.01).all()  # spacing of the path's points
    assert expected.sum() > 20


def test_a_part_of_the_loops_remains_a_part_with_many_tasks():
    part = loops.plan(ROUND._replace(tracks=2))
    task = Task("coral", (0.5, -0.3), (0.8, 0.6), 1.0, 0.0, 0.1, 0.9, 0.8, after_track=1)
    tasks = [task._replace(name=str(k)) for k in range(part.n_tracks_to_fill)]
    assert share_inside(with_tasks(part, tasks, 2.0), 3.5) == share_inside(part, 3.5) < np.pi * 8


def test_points_of_any_shape_are_accepted():
    plan = lawnmower.plan(REQUEST)
    assert plan.inside_area(np.array(0.0), np.array(0.0)).shape == ()
    assert plan.inside_area(np.zeros((3, 1)), np.zeros(4)).shape == (3, 4)


@pytest.mark.parametrize(
    "sets",
    [
        ["plan.area_m=[3.0, 1.0]"],
        ["plan.area_m=[3.0, 2.0]", "plan.tracks=1"],
        ['plan.pattern="loops"', "plan.area_m=[3.0, 3.0]"],
        ['plan.pattern="loops"', "plan.area_m=[3.0, 3.0]", "plan.overlap_across=0.3"],
        ['plan.pattern="loops"', "plan.area_m=[1.5, 1.5]", "plan.overlap_across=0.2"],
    ],
)
def test_the_grid_of_the_map_contains_the_asked_area(sets):
    mission = prepare(load_scenario("reef", [*sets, "terrain.size_m=[8.0, 8.0]"]))
    x, y = np.meshgrid(*mission.grid.centres())
    cells = mission.plan.inside_area(x, y)
    assert share_inside(mission.plan, 2.0) == pytest.approx(cells.sum() * mission.grid.cell_m**2, rel=0.02)
    edge = np.concatenate([cells[0], cells[-1], cells[:, 0], cells[:, -1]])
    assert not edge.any()
