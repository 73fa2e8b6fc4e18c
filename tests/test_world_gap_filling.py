"""Gaps of a survey: found from the stereo points of the keyframes, and flown over after the last track."""

import numpy as np
import pytest

from twin import survey
from twin.errors import ScenarioError
from twin.scenario.file import load_scenario
from twin.world.gap_filling import GapFiller
from twin.world.mission import prepare

SMALL = ["plan.area_m=[5.0,3.0]", "plan.altitude_m=2.0", "imaging.fidelity=surrogate", "plan.fill_gaps=true"]


def scenario(*overrides):
    return load_scenario("reef", [*SMALL, *overrides])


def shown(filler, low, high, times=2):
    """Adds keyframes whose points fill a rectangle from `low` to `high` [m]."""
    x, y = np.meshgrid(np.arange(low[0], high[0], 0.05), np.arange(low[1], high[1], 0.05))
    points = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    for _ in range(times):
        filler.add(points)


def test_legs_are_planned_over_what_fewer_than_two_keyframes_show():
    mission = prepare(scenario())
    filler, last = GapFiller(mission), mission.plan.reference(1, 0.0)
    shown(filler, (-3, -2), (3, 2), times=1)
    shown(filler, (-3, -2), (0.4, 2), times=1)
    shown(filler, (1.6, -2), (3, 2), times=1)
    path = filler.path(last, (0.0, 0.0, 2.0))
    assert filler.gaps.found_m2 == pytest.approx(1.2 * 3.0, rel=0.4)
    x, y = np.concatenate([segment.points() for segment in path[1:]])[:, :2].T
    assert x.min() > -0.4 and x.max() < 2.4 and np.ptp(y) > 1.0
    shown(filler, (0.0, -2), (2.0, 2))
    assert filler.path(last, (0.0, 0.0, 2.0)) == () and filler.gaps.left_m2 == 0


def test_a_gap_that_stays_is_not_flown_over_for_ever():
    filler, mission = GapFiller(prepare(scenario())), prepare(scenario())
    last = mission.plan.reference(1, 0.0)
    assert filler.path(last, (0.0, 0.0, 2.0))
    assert filler.path(last, (0.0, 0.0, 2.0)) == ()
    assert filler.gaps.left_m2 == filler.gaps.found_m2 and "could not be covered" in filler.gaps.sentence


@pytest.mark.long
def test_a_survey_without_gaps_flies_no_further_track(tmp_path):
    whole = survey.run(scenario(), tmp_path / "whole", outputs=None).metrics
    plain = survey.run(scenario("plan.fill_gaps=false"), tmp_path / "plain", outputs=None).metrics
    assert whole["gaps"] == {"found_m2": 0.0, "left_m2": 0.0} and plain["gaps"]["found_m2"] is None
    assert whole["timing"]["frames"] == plain["timing"]["frames"] and whole["trajectory"] == plain["trajectory"]


@pytest.mark.parametrize(("task", "line"), [
    ("position_m=[9.0,9.0]", "lies outside the area"),
    ("position_m=[0.0,0.0],after_track=99", "no such track"),
    ("position_m=[0.0,0.0],after_track=1,start_s=3.0", "contradicts after_track"),
    ("position_m=[0.0,0.0],altitude_m=0.2", "come within"),
    ("position_m=[0.0,0.0],speed_mps=1.9", "too fast"),
])  # fmt: skip
def test_a_task_that_cannot_be_flown_is_refused(task, line):
    with pytest.raises(ScenarioError, match=f"tasks.0.*{line}"):
        prepare(scenario(f"tasks=[{{{task}}}]"))


@pytest.mark.long
def test_tasks_have_their_own_maps_in_the_order_of_flight(tmp_path):
    later, first = 'name="b",position_m=[0.5,0.3],altitude_m=1.0', 'name="a",position_m=[-0.5,0.0],altitude_m=1.0'
    tasks = "tasks=[{" + later + "},{" + first + ",after_track=1}]"
    given = scenario("plan.fill_gaps=false", tasks)
    found = survey.run(given, tmp_path / "run", outputs=()).metrics
    names = [task["name"] for task in found["tasks"]]
    assert names == [detail.name for detail in prepare(given).details] and names[0] == "a"
    for number, task in enumerate(found["tasks"], 1):
        assert task["completeness_area"] > 0.95 and task["cell_m"] == 0.01 and task["le90_m"] < 0.01
        assert (tmp_path / "run" / f"task_{number}" / "dem.tif").is_file()
    plain = survey.run(scenario("plan.fill_gaps=false"), tmp_path / "plain", outputs=()).metrics
    assert found["overlap"]["across_asked"] == plain["overlap"]["across_asked"]
    assert found["overlap"]["across_median"] == pytest.approx(plain["overlap"]["across_median"], abs=0.02)
    assert found["map"]["cell_m"] == plain["map"]["cell_m"] and plain["tasks"] == []


@pytest.mark.parametrize("across_m", [0.15, 0.6, 1.3])
def test_without_a_keyframe_the_whole_area_is_a_gap(across_m):
    mission = prepare(scenario(f"plan.area_m=[4.0,{across_m}]"))
    filler = GapFiller(mission)
    assert filler.path(mission.plan.reference(1, 0.0), (0.0, 0.0, 2.0))
    assert filler.gaps.found_m2 == pytest.approx(4.0 * across_m)
