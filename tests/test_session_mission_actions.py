"""The vehicle slows down where frames are lost and stops where vision is lost; otherwise it flies as planned."""

import functools

import numpy as np
import pytest

from twin import survey
from twin.controllers.segments import Reference
from twin.core import geometry
from twin.core.quality import ActionTimes
from twin.core.records import NO_STEREO, Estimate, Readings
from twin.core.settings import BLIND_S, BRAKING_S
from twin.core.timing import Stopwatch
from twin.estimate.vision.f2f import constant_velocity_motion
from twin.estimate.vision.motion_filter import MotionFilter
from twin.scenario.file import load_scenario
from twin.session.assembly import navigator_with, open_world
from twin.session.mission_actions import RATES, RECOVERED_S, MissionActions
from twin.surrogate.surrogate_world import SurrogateWorld
from twin.world.mission import prepare
from twin.world.pace import FULL, Pace
from twin.world.pilot import make_pilot, without_feedback

RATE_HZ = 30.0


@functools.cache
def mission():
    short = ["plan.tracks=1", "plan.area_m=[2.0,1.0]", "control.hold_s=0.4", "imaging.fidelity=surrogate"]
    return prepare(load_scenario("reef", short))


def estimate(status, position=(0.0, 0.0, 2.0)):
    pose = geometry.pose(geometry.BODY_FROM_DOWN_CAMERA, np.array(position))
    return Estimate(0.0, pose, pose, np.zeros(6), 0.0, status)


def paces(actions, statuses):
    return [actions(estimate(status)) for status in statuses]


def frames(seconds, status):
    return [status] * round(seconds * RATE_HZ)


def test_measured_frames_and_a_few_lost_ones_are_flown_at_full_pace():
    actions = MissionActions(mission())
    statuses = frames(5, "ok") + ["lost"] * 5 + frames(5, "ok") + ["lost", "ok"] * 2
    assert set(paces(actions, statuses)) == {FULL} and actions.times == ActionTimes() and not actions.times.sentence


def test_the_vehicle_stops_where_vision_is_lost_and_flies_on_slowly_at_first():
    log = []
    actions = MissionActions(mission(), lambda _, action, **__: log.append(action))
    blind = paces(actions, frames(5, "lost"))
    assert blind[round(BLIND_S * RATE_HZ) - 1] == FULL
    assert blind[-1].rate == pytest.approx(0.0, abs=0.02) and sum(pace.keyframe for pace in blind) >= 1
    after = paces(actions, frames(RECOVERED_S + 0.5, "ok"))
    assert max(pace.rate for pace in after) <= RATES["slow"]
    assert paces(actions, frames(6, "ok"))[-1] == FULL
    assert log == ["hold", "slow", "fly"]
    assert actions.times.held_s == pytest.approx(5 - BLIND_S, abs=0.1)
    assert "held station for" in actions.times.sentence and "slowed for" in actions.times.sentence


def test_the_pace_changes_only_where_motion_is_measured():
    actions = MissionActions(mission())
    rates = [pace.rate for pace in paces(actions, ["lost", "lost", "lost", "ok"] * 20)]
    changed = np.flatnonzero(np.diff(rates)) + 1
    assert actions.action == "slow" and len(changed) and set(changed % 4) == {3}


def test_frames_of_the_compiled_loop_count_as_measured():
    """Otherwise one lost frame per keyframe would count as a lost second."""
    actions = MissionActions(mission())
    for _ in range(40):
        assert actions(estimate("lost")) == FULL
        actions.add_measured_frames(14)
        assert actions(estimate("ok")) == FULL


def test_the_vehicle_stops_when_keyframes_have_no_stereo_until_one_has():
    """Its motion is still measured, by the points of the last keyframe; between keyframes nothing changes."""
    actions, seen = MissionActions(mission()), []
    for failed in (True, False, True, True, True, False):
        actions(estimate(NO_STEREO if failed else "ok"), is_keyframe=True)
        seen.append(actions.action)
        for _ in range(20):
            actions(estimate("ok"), is_keyframe=False)
    assert seen == ["fly", "fly", "fly", "hold", "hold", "slow"]


def test_prediction_and_reference_brake_equally():
    """While nothing is measured, the filter predicts the path of the reference: both differ by the lag
    of one frame, at most 0.35 m/s / 30 Hz each."""
    actions, predicted = MissionActions(mission()), MotionFilter()
    predicted.velocity[3] = speed = 0.35
    path_m = 0.0
    for pace in paces(actions, frames(5, "lost")):
        predicted.predict(1 / RATE_HZ)
        path_m += speed * pace.rate / RATE_HZ
    assert path_m == pytest.approx(speed * (BLIND_S + BRAKING_S), abs=0.02)
    assert predicted.pose[0, 3] == pytest.approx(path_m, abs=2 * speed / RATE_HZ)


def test_a_slowed_course_flies_the_same_path_with_the_same_keyframes():
    whole, interval_s = mission().planned_frames(1), 1 / RATE_HZ
    time_s, sequences = 0.0, []
    while len(sequence := mission().next_frames(1, time_s, Pace(0.7))):
        sequences.append(sequence)
        time_s = sequence.path_times_s[-1]
    positions = np.concatenate([sequence.reference.position for sequence in sequences])
    velocities = np.concatenate([sequence.reference.velocity for sequence in sequences])
    assert len(sequences) == np.ceil((len(whole) - 1) / 0.7)
    assert (
        sum(sequence.keyframe.sum() for sequence in sequences) == whole.keyframe[1:].sum()
        and sequences[-1].keyframe[-1]
    )
    np.testing.assert_allclose(positions[-1], whole.reference.position[-1])
    times = [sequence.path_times_s[0] for sequence in sequences]
    for axis in range(3):
        np.testing.assert_allclose(
            positions[:, axis], np.interp(times, whole.path_times_s, whole.reference.position[:, axis]), atol=1e-3
        )
    # central differences of a path with accelerations up to 0.2 m/s2 that jump between segments
    np.testing.assert_allclose(
        (positions[2:-1] - positions[:-3]) / (2 * interval_s), velocities[1:-2], atol=0.2 * interval_s
    )


def test_a_changing_rate_accelerates_the_reference():
    """d2x/dt2 by finite differences of x(s(t)) with s = t + t^2 / 2 and x = s^2."""
    position, velocity, acceleration = np.array([[1.0]]), np.array([[2.0]]), np.array([[2.0]])  # at s = 1
    t = np.sqrt(3.0) - 1  # s(t) = 1, ds/dt = 1 + t, d2s/dt2 = 1
    scaled = Pace(1 + t, 1.0).scaled(Reference(position, velocity, 0.0, acceleration))

    def x(t):
        return (t + t**2 / 2) ** 2

    h = 1e-4
    assert scaled.velocity.item() == pytest.approx((x(t + h) - x(t - h)) / (2 * h), rel=1e-6)
    assert scaled.acceleration.item() == pytest.approx((x(t + h) - 2 * x(t) + x(t - h)) / h**2, rel=1e-5)


def test_at_full_pace_all_remaining_frames_follow():
    whole = mission().planned_frames(1)
    rest = mission().next_frames(1, whole.path_times_s[99], FULL)
    np.testing.assert_allclose(rest.path_times_s, whole.path_times_s[100:])
    np.testing.assert_allclose(rest.reference.position, whole.reference.position[100:])
    np.testing.assert_array_equal(rest.keyframe, whole.keyframe[100:])
    assert len(mission().next_frames(1, whole.path_times_s[-1], FULL)) == 0


def test_the_pilot_does_not_act_on_predicted_positions():
    reference = mission().planned_frames(1)[100].reference
    near, far = (estimate("lost", reference.position + [dx, 0.1, 0.0]) for dx in (0.0, 0.5))
    pressure, dvl = Readings(pressure_z_m=2.0), Readings(pressure_z_m=2.0, dvl_mps=np.zeros(3))

    def command(one, readings):
        return make_pilot(mission())(without_feedback(one, reference, readings), reference)

    np.testing.assert_array_equal(command(near, pressure), command(far, pressure))
    assert np.abs(command(near, dvl) - command(far, dvl)).max() > 0.1
    low = estimate("lost", reference.position - [0, 0, 0.3])
    assert np.abs(command(near, pressure) - command(low, pressure)).max() > 0.1


def test_a_survey_without_lost_frames_is_the_same_with_and_without_actions():
    def fly(actions):
        with open_world(mission(), Stopwatch()) as world:
            navigator = navigator_with(mission(), world.vision, Stopwatch())
            survey.fly(mission(), world, navigator, lambda *_: None, actions)
            return world.truth(), navigator.log.online.array

    (plain, online), (watched, watched_online) = fly(None), fly(MissionActions(mission()))
    np.testing.assert_array_equal(plain.trajectory.world_from_camera, watched.trajectory.world_from_camera)
    np.testing.assert_array_equal(online, watched_online)
    np.testing.assert_array_equal(plain.reference, watched.reference)


def fly_blind(first, end, monkeypatch, actions):
    """Returns the true survey and the online path of a surrogate survey without F2F in the frames from first to end."""
    monkeypatch.setattr(SurrogateWorld, "fast_forward", lambda *_: lambda sequence, k: k)
    with open_world(mission(), Stopwatch()) as world:
        navigator = navigator_with(mission(), world.vision, Stopwatch())
        track, observe = world.vision.track_frame, world.vision.observe_stereo
        predicted = MotionFilter()

        def track_frame(frame):
            motion, status = track(frame)
            if not first <= frame.index < end:
                predicted.velocity = geometry.log(motion.a_from_b) * RATE_HZ
                predicted.correct(predicted.pose, np.eye(6) * 1e-12)
                return motion, status
            predicted.restart()
            predicted.predict(1 / RATE_HZ)
            return constant_velocity_motion(predicted.pose), "too few points matched"

        monkeypatch.setattr(world.vision, "track_frame", track_frame)
        monkeypatch.setattr(
            world.vision, "observe_stereo", lambda f, row: None if first <= f.index < end else observe(f, row)
        )
        survey.fly(mission(), world, navigator, lambda *_: None, actions)
        return world.truth(), navigator.log.online.array


def test_a_survey_blind_for_three_seconds_is_flown_to_the_end(monkeypatch):
    actions = MissionActions(mission())
    truth, online = fly_blind(round(4 * RATE_HZ), round(7 * RATE_HZ), monkeypatch, actions)
    n = len(truth.trajectory)
    assert n == len(online) == len(truth.reference) == len(truth.track) > mission().n_frames
    keyframe_s = mission().plan.n_frames_per_keyframe / RATE_HZ  # it waits for stereo too
    assert 2.9 - BLIND_S < actions.times.held_s < 3.1 - BLIND_S + keyframe_s
    off_m = np.linalg.norm(truth.trajectory.positions - truth.reference, axis=1)
    assert off_m.max() < 0.15
    step_m = np.linalg.norm(np.diff(truth.reference, axis=0), axis=1)
    assert step_m.max() < 1.05 * mission().plan.speed_mps / RATE_HZ


def test_an_additional_keyframe_at_the_planned_speed_changes_no_frame():
    times_s = mission().planned_frames(1).path_times_s
    rest = mission().next_frames(1, float(times_s[9]), Pace(1.0, 0.0, True))
    np.testing.assert_allclose(rest.path_times_s, times_s[10:])
    planned = mission().planned_frames(1).keyframe[10:]
    assert rest.keyframe[0] and np.array_equal(rest.keyframe[1:], planned[1:]) and not planned[0]
