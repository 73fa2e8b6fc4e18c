"""Detours of a plan: tracks for tasks between its tracks, and legs over gaps after them."""

import math
from itertools import pairwise

import numpy as np
import pytest

from twin.controllers.detours import Task, legs_at, with_tasks
from twin.controllers.lawnmower import plan
from twin.controllers.survey_area import SurveyArea
from twin.controllers.survey_plan import SurveyRequest
from twin.judge.swaths import swath_numbers
from twin.world.planning import planned_keyframes

HOLD_S = 2.0
REQUEST = SurveyRequest(
    (6.0, 4.0), 2.0, 0.3, 0.8, 0.6, 0, 320, 240, 277.0, 30.0, area=SurveyArea("rectangle", (6.0, 4.0))
)


def task(**changes):
    found = Task("coral", (0.5, -0.3), (0.8, 0.6), 1.0, 0.0, 0.1, 0.9, 0.8)
    return found._replace(**changes)


def positions(survey):
    return [survey.references(k, survey.frames_of_track(k)[0]).position for k in range(1, survey.n_tracks + 1)]


@pytest.mark.parametrize(
    "where", [{"after_track": 1}, {"start_s": 10.0}, {}, {"within_leg": True}, {"within_leg": True, "start_s": 10.0}]
)
def test_a_task_is_a_track_that_starts_and_ends_where_the_survey_was_left(where):
    level = plan(REQUEST)
    survey = with_tasks(level, [task(**where)], HOLD_S)
    (detour,) = survey.detours
    tracks = positions(survey)
    own, before = tracks[detour.track - 1], tracks[detour.track - 2]
    np.testing.assert_allclose(own[0], before[-1], atol=1e-3)
    np.testing.assert_allclose(own[-1], own[0], atol=1e-3)
    assert own[:, 2].min() == pytest.approx(1.0) and own[:, 2].max() == pytest.approx(2.0)
    low = own[own[:, 2] < 1.0 + 1e-6]
    assert (np.abs(low[:, :2] - [0.5, -0.3]) <= [0.4 + 1e-6, 0.3 + 1e-6]).all()
    rest = np.concatenate([part for k, part in enumerate(tracks, 1) if k != detour.track])
    known = np.concatenate(positions(level))
    assert np.linalg.norm(np.diff(rest, axis=0), axis=1).sum() == pytest.approx(
        np.linalg.norm(np.diff(known, axis=0), axis=1).sum(), rel=1e-3
    )


def test_a_task_leaves_at_the_end_of_the_leg_that_is_nearest_to_it():
    survey = with_tasks(plan(REQUEST), [task(centre_m=(2.4, 0.9))], HOLD_S)
    left = positions(survey)[survey.detours[0].track - 1][0]
    ends = np.concatenate([[s.points()[-1] for s in path] for path in plan(REQUEST).paths])
    assert math.dist(left[:2], (2.4, 0.9)) == pytest.approx(np.linalg.norm(ends[:, :2] - [2.4, 0.9], axis=1).min())


def test_a_task_within_a_leg_leaves_at_the_foot_of_the_perpendicular_and_the_survey_continues_there():
    survey = with_tasks(plan(REQUEST), [task(centre_m=(1.3, -0.9), within_leg=True)], HOLD_S)
    track = survey.detours[0].track
    before, own, after = positions(survey)[track - 2 : track + 1]
    assert before[-1][0] == pytest.approx(1.3) and abs(before[-1][1] + 0.9) < 0.5 * plan(REQUEST).swath_spacing_m + 1e-9
    np.testing.assert_allclose([own[0], after[0]], [before[-1]] * 2, atol=1e-9)
    assert np.sign(after[20][0] - after[0][0]) == np.sign(before[-1][0] - before[-20][0])


def test_a_task_at_a_time_within_a_leg_leaves_then():
    level = plan(REQUEST)
    survey = with_tasks(level, [task(start_s=7.3, within_leg=True)], HOLD_S)
    np.testing.assert_allclose(positions(survey)[0][-1], level.reference(1, 7.3).position, atol=1e-3)


def test_two_tasks_within_one_leg_are_flown_in_its_direction():
    tasks = [task(name="far", centre_m=(2.0, -1.0), within_leg=True), task(centre_m=(-1.0, -1.0), within_leg=True)]
    level, survey = plan(REQUEST), with_tasks(plan(REQUEST), tasks, HOLD_S)
    starts = [positions(survey)[d.track - 1][0][0] for d in sorted(survey.detours, key=lambda d: d.track)]
    assert sorted(np.round(starts, 6)) == [-1.0, 2.0]
    before, after = (planned_keyframes(one, "lawnmower") for one in (level, survey))
    assert set(before.swath) == set(after.swath)


def test_two_tasks_that_leave_a_leg_at_the_same_place_are_flown_one_after_the_other():
    tasks = [task(name=name, centre_m=(1.3, -0.9), within_leg=True) for name in "ab"]
    survey = with_tasks(plan(REQUEST), tasks, HOLD_S)
    starts = [positions(survey)[detour.track - 1][0] for detour in survey.detours]
    np.testing.assert_allclose(starts[0], starts[1], atol=0.2)
    assert len(survey.detours) == 2 and np.isfinite(survey.all_references().position).all()


def test_several_tasks_keep_their_tracks_and_every_leg_keeps_its_number():
    tasks = [task(name="b", after_track=2), task(name="a", after_track=1), task(name="c", start_s=1e5)]
    level = plan(REQUEST)
    survey = with_tasks(level, tasks, HOLD_S)
    assert [d.name for d in sorted(survey.detours, key=lambda d: d.track)] == ["a", "b", "c"]
    assert survey.n_tracks == level.n_tracks + 3 and survey.n_leg_tracks == level.n_tracks
    before, after = (planned_keyframes(one, "lawnmower") for one in (level, survey))
    assert set(before.swath) == set(after.swath)
    detours = [d.track for d in survey.detours]
    reference = survey.all_references()
    track = np.concatenate([np.full(len(p), k) for k, p in enumerate(positions(survey), 1)])
    swath = swath_numbers(
        reference.position, np.asarray(reference.yaw), track, {"pattern": "lawnmower"} | survey.swath_notes
    )
    assert (swath[np.isin(track, detours)] == -1).all()


def test_keyframes_of_a_task_keep_its_overlap_and_bring_the_camera_down_in_small_steps():
    survey = with_tasks(plan(REQUEST), [task()], HOLD_S)
    number = survey.detours[0].track
    times_s, keyframe = survey.frames_of_track(number)
    at = survey.references(number, times_s).position[keyframe]
    step = np.diff(at, axis=0)
    low = at[:-1, 2] < 1.0 + 1e-6
    assert np.linalg.norm(step[low], axis=1).max() <= 0.11 * 320 / 277.0
    descending = np.abs(step[:, 2]) > 1e-6
    assert (np.abs(step[descending, 2]) / at[1:][descending, 2]).max() < 0.15


def test_a_level_survey_raises_a_task_to_the_height_above_its_floor():
    survey = with_tasks(plan(REQUEST), [task(floor_m=0.4)], HOLD_S)
    assert positions(survey)[survey.detours[0].track - 1][:, 2].min() == pytest.approx(1.4)


def test_legs_over_gaps_are_flown_to_the_nearest_next():
    legs = [((4.0, 0.0, 2.0), (5.0, 0.0, 2.0)), ((2.0, 1.0, 2.0), (1.0, 1.0, 2.0))]
    path = legs_at(plan(REQUEST), (0.0, 0.0, 2.0), 0.0, legs)
    ends = [segment.points()[-1].tolist() for segment in path]
    np.testing.assert_allclose(ends, [legs[1][1], legs[1][0], legs[0][0], legs[0][1]])
    for a, b in pairwise(path):
        np.testing.assert_allclose(a.points()[-1], b.points()[0])


@pytest.mark.parametrize("within_leg", [False, True])
@pytest.mark.parametrize("by_time", [False, True])
def test_a_task_does_not_interrupt_the_cross_lines(within_leg, by_time):
    """It is nearest to a corner between them, or begins while they are flown."""
    level = plan(REQUEST._replace(cross_lines=3))
    corner = level.paths[level.cross_track - 1][1].points()[0][:2]
    begins_s = sum(level.track_duration_s(k) + HOLD_S for k in range(1, level.cross_track)) + 1.0
    near = task(centre_m=tuple(corner - 0.1 * np.sign(corner)), within_leg=within_leg)
    survey = with_tasks(level, [near._replace(start_s=begins_s) if by_time else near], HOLD_S)
    lines = positions(survey)[survey.cross_track - 1]
    np.testing.assert_allclose(lines, positions(level)[level.cross_track - 1])
    assert not by_time or survey.detours[0].track == survey.n_tracks
