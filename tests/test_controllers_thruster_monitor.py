"""Thrusters that do not push as commanded: noticed by their feedback, and left out of the allocation."""

import json

import numpy as np
import pytest

from twin.controllers.thruster_monitor import ThrusterMonitor
from twin.core.records import Trajectory
from twin.scenario.file import load_scenario
from twin.scenario.model import VehicleConfig
from twin.simulate.autopilot import allocation_without
from twin.simulate.hydrodynamics import angular_first
from twin.simulate.parameters import moves_along_all_axes, parameters_of
from twin.simulate.thrusters import steady_thrust_n
from twin.survey import run

FULL_N, RATE_HZ = 30.0, 30.0
CONFIGURATION = angular_first(parameters_of(VehicleConfig()).thrust_configuration)


def noticed_s(reported, commanded=lambda time_s: 5.0, duration_s=10.0):
    """Returns the time at which a thruster is lost, None if never; thrusts are functions of the time and command."""
    monitor = ThrusterMonitor(FULL_N, RATE_HZ)
    for k in range(round(duration_s * RATE_HZ)):
        wanted_n = commanded(k / RATE_HZ)
        monitor.add(k / RATE_HZ, np.array([wanted_n]), np.array([reported(k / RATE_HZ, wanted_n)]))
    return monitor.lost[0].time_s if monitor.lost else None


def test_a_loss_is_noticed_when_a_quarter_of_the_mean_square_thrust_is_missing():
    """Of a step, 1 - exp(-t) of the mean square is missing after t seconds: a quarter after ln(4 / 3)."""
    found = noticed_s(lambda time_s, wanted_n: wanted_n * (time_s < 5.0))
    assert found - 5.0 == pytest.approx(np.log(4 / 3), abs=2 / RATE_HZ)


@pytest.mark.parametrize(("reported", "commanded", "lost"), [
    (lambda t, n: n, lambda t: 9 * np.sin(t), False),  # sound
    (lambda t, n: 0.6 * n, lambda t: 9 * np.sin(t), False),
    (lambda t, n: 0.4 * n, lambda t: 9 * np.sin(t), True),
    (lambda t, n: 9.0, lambda t: 9 * np.sin(t), True),  # stuck
    (lambda t, n: 0.0, lambda t: 0.2, False),  # hardly used: 0.7 % of full thrust
    (lambda t, n: n * (t % 0.2 < 0.1), lambda t: 9.0, True),  # half of the time
])  # fmt: skip
def test_a_thruster_is_lost_if_it_misses_half_of_its_commanded_thrust(reported, commanded, lost):
    assert (noticed_s(reported, commanded) is not None) == lost


@pytest.mark.parametrize("lost", [[0], [4], [2, 5]])
def test_the_others_give_the_wrench_with_the_least_thrust(lost):
    """The thrusts are the least-norm solution of NumPy for the remaining columns of the configuration matrix."""
    allocation, rov = allocation_without(VehicleConfig(), lost), parameters_of(VehicleConfig())
    wrench = np.array([0.1, -0.2, 0.5, 4.0, -3.0, 6.0])
    commands, factor = allocation.commands(wrench)
    thrusts = steady_thrust_n(commands, rov.thrust_coefficients, rov.thrust_table)
    left = np.delete(np.arange(8), lost)
    expected, *_ = np.linalg.lstsq(CONFIGURATION[:, left], wrench, rcond=None)
    assert factor == 1 and not commands[lost].any()
    np.testing.assert_allclose(thrusts[left], expected, atol=0.02)
    np.testing.assert_allclose(CONFIGURATION @ thrusts, wrench, atol=0.03)


@pytest.mark.parametrize(("lost", "moves"), [([0], True), ([4, 5, 6], True), ([0, 1], False), ([4, 5, 6, 7], False)])
def test_three_horizontal_thrusters_and_a_vertical_one_are_needed(lost, moves):
    assert moves_along_all_axes(VehicleConfig(), lost) == moves


def flown(tmp_path, *overrides):
    short = ["imaging.fidelity=surrogate", "plan.area_m=[1.5,0.6]", "plan.tracks=1", "seed=1", *overrides]
    metrics = run(load_scenario("reef", short), tmp_path / "run", outputs=()).metrics
    paths = [Trajectory.load(tmp_path / "run" / f"trajectory_{name}.tum").positions for name in ("truth", "reference")]
    n = min(map(len, paths))
    return metrics, np.linalg.norm(paths[0][:n] - paths[1][:n], axis=1)


@pytest.mark.parametrize("number", [pytest.param(1, marks=pytest.mark.long), 5])
def test_a_thruster_that_is_left_out_is_hardly_missed(tmp_path, number):
    """The vehicle stays within 0.03 m of its path; with the thruster in the allocation it leaves it by 0.09 m."""
    metrics, away_m = flown(tmp_path, f'faults=[{{part="thruster",number={number},start_s=3}}]')
    assert metrics["status"] == "complete" and away_m.max() < 0.03
    assert any(f"left out: {number} at 3." in text for text in metrics["warnings"])
    log = [json.loads(line) for line in (tmp_path / "run" / "log.jsonl").read_text().splitlines()]
    assert [one["number"] for one in log if one["event"] == "thruster left out"] == [number]


def test_a_survey_ends_if_the_other_thrusters_do_not_suffice(tmp_path):
    faults = ",".join(f'{{part="thruster",number={k},start_s=3}}' for k in (1, 2))
    metrics, _ = flown(tmp_path, f"faults=[{faults}]")
    assert metrics["status"] == "aborted"
    assert "thrusters 1, 2 do not push as commanded: the others cannot push along all axes" in metrics["reason"]
