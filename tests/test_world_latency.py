"""Latency of the computer: commands arrive late, the pilot predicts pose and reference, and surveys keep their path."""

import numpy as np
import pytest

from twin.controllers.segments import Reference
from twin.core import geometry
from twin.core.records import Estimate
from twin.core.timing import Stopwatch
from twin.errors import ScenarioError
from twin.scenario.file import load_scenario
from twin.session.assembly import make_navigator, open_world
from twin.simulate.kinematic_vehicle import KinematicVehicle
from twin.simulate.thrusters import thruster_wrench
from twin.survey import fly
from twin.world.computer import frames_of_latency, latency_s
from twin.world.mission import prepare
from twin.world.pilot import RovPilot, make_pilot

SHORT = ["imaging.fidelity=surrogate", "plan.area_m=[3.0,1.0]", "plan.tracks=1", "plan.speed_mps=0.4", "seed=1"]


def mission(*overrides):
    return prepare(load_scenario("reef", [*SHORT, *overrides]))


def deviations_m(flown, tmp_path):
    """Returns the distance (n,) of the true camera from its reference, at cruise and while holding."""
    stopwatch = Stopwatch()
    with open_world(flown, stopwatch) as world, make_navigator(flown, world, tmp_path, stopwatch) as navigator:
        fly(flown, world, navigator, lambda *_: None)
        truth = world.truth()
    return np.linalg.norm(truth.trajectory.positions - truth.reference, axis=1)


@pytest.mark.parametrize(("dynamics", "n"), [("rigid", 8), ("kinematic", 3)])
def test_a_command_arrives_after_the_latency(dynamics, n):
    prompt = mission(f"vehicle.dynamics={dynamics}")
    late = mission(f"vehicle.dynamics={dynamics}", "control.latency=0.2")
    k = round(0.2 * late.rig.frame_rate_hz)
    start, still = late.start, np.zeros(6)
    there = Reference(start[:3, 3] + [0.1, 0.0, 0.0], np.zeros(3), late.plan.reference(1, 0.0).yaw, np.zeros(3))
    here = Estimate(0.0, start, start, still, 0.0, "ok")
    pilot = make_pilot(late)
    commands = [pilot(here, there) for _ in range(k + 1)]
    assert not np.any(commands[:k])
    assert np.abs(commands[k]).max() > 0.01
    assert np.shape(commands) == (k + 1, n)
    assert np.abs(make_pilot(prompt)(here, there)).max() > 0.01


def test_the_thrust_of_a_world_is_the_one_that_moves_its_vehicle():
    with open_world(mission(), Stopwatch()) as world:
        vehicle = world.vehicle
        assert not isinstance(vehicle, KinematicVehicle)
        for _ in range(30):  # the lag settles
            world.act(np.linspace(-0.6, 0.8, 8))
        wrench = vehicle.thrusters.configuration @ world.thrust_n
        np.testing.assert_allclose(wrench, thruster_wrench(vehicle.thrusters), atol=1e-9)
        np.testing.assert_allclose(world.thrust_n, vehicle.thrusters.steady_n, rtol=1e-3, atol=1e-2)
        assert np.abs(world.thrust_n).max() > 1


def test_pose_and_reference_are_predicted_to_the_time_of_the_command():
    """A vehicle on its moving reference needs the same command, late or not, but for the gains."""
    late = mission("control.latency=0.2")
    velocity = 0.3 * late.start_of_body[:3, 0]
    body_twist = np.concatenate([np.zeros(3), late.start_of_body[:3, :3].T @ velocity])
    twist = geometry.adjoint(geometry.inverse(late.rig.body_from_camera)) @ body_twist
    on_course = Reference(late.start[:3, 3], velocity, late.plan.reference(1, 0.0).yaw, np.zeros(3))
    pilot = RovPilot(late)
    for _ in range(200):  # the smoothed velocity settles
        pilot(Estimate(0.0, late.start, late.start, twist, 0.0, "ok"), on_course)
    error = pilot.state.controller.integral[3:]
    assert np.abs(error).max() < 0.02


@pytest.mark.parametrize(("latency_s", "most_m"), [(0.1, 0.06), (0.2, 0.1), (0.3, 0.15)])
def test_surveys_keep_their_path_with_a_latency(tmp_path, latency_s, most_m):
    assert deviations_m(mission(f"control.latency={latency_s}"), tmp_path).max() < most_m


@pytest.mark.parametrize(("keys", "seconds"), [
    ((), 0.084), (("control.computer_speed=2.1",), 0.04), (("rig.image_width_px=640",), 0.168),
])  # fmt: skip
def test_a_stated_latency_is_the_time_of_a_keyframe_by_pixels_and_speed_rounded_up_to_frames(keys, seconds):
    stated = load_scenario("reef", [*SHORT, "control.latency=stated", *keys])
    assert latency_s(stated) == pytest.approx(seconds)
    assert frames_of_latency(stated) == np.ceil(seconds * stated.rig.frame_rate_hz)


@pytest.mark.parametrize(("keys", "problem"), [
    (("control.latency=stated", "control.computer_speed=0.1"), "control.computer_speed: 0.1: the estimators take"),
    (("control.computer_speed=2",), "control.computer_speed: has no effect without a stated latency"),
    (("control.latency=fast",), "control.latency"),
])  # fmt: skip
def test_a_computer_that_cannot_be_is_refused(keys, problem):
    with pytest.raises(ScenarioError) as raised:
        mission(*keys)
    assert any(problem in line for line in raised.value.lines), raised.value.lines


def test_the_slowest_computer_that_keeps_up_is_the_one_that_the_message_allows():
    with pytest.raises(ScenarioError) as raised:
        mission("control.latency=stated", "control.computer_speed=0.1")
    speed = raised.value.lines[0].rpartition("at least ")[2].rstrip(")")
    assert mission("control.latency=stated", f"control.computer_speed={speed}").scenario.control.latency == "stated"


def test_without_latency_no_command_waits():
    assert RovPilot(mission()).state.waiting.shape == (0, 8)
