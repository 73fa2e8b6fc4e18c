"""Thrusters lag as their transfer function says; sensors err as their data sheet says."""

import numpy as np
import pytest
from scipy import signal

from scenes.bluerov2 import BLUEROV2_HEAVY as ROV
from twin import geometry
from twin.records import SensorNoise
from twin.simulate.sensors import read_sensors
from twin.simulate.thrusters import LaggedThrusters, steady_thrust_n

NOISE = SensorNoise(pressure_m=0.02, attitude_rad=0.003, heading_rad=0.01)
POSE = geometry.pose(geometry.rotation_from_rpy(0.05, -0.08, 3.1), np.array([1.0, 2.0, 3.0]))
CAMERA = geometry.pose(geometry.BODY_FROM_DOWN_CAMERA, np.array([0.1, 0.075, -0.15]))


def test_a_step_of_command_gives_the_step_response_of_the_published_lag():
    step_s, command = 1 / 120, np.linspace(-1, 1, 8)
    thrusters = LaggedThrusters(ROV, step_s)
    thrusters.command(command)
    history = []
    for _ in range(120):
        history.append(thrusters.thrust_n())
        thrusters.step()
    _, expected = signal.step(ROV.thruster_lag, T=np.arange(120) * step_s)
    steady = steady_thrust_n(command, ROV.thrust_coefficients)
    np.testing.assert_allclose(history, np.outer(expected, steady), atol=1e-9)


@pytest.mark.parametrize(("command", "thrust"), [(0.25, 4.6), (0.5, 16.6), (0.75, 26.5), (1.0, 30.4), (-0.5, -16.6)])
def test_steady_thrust_meets_the_published_points(command, thrust):
    assert steady_thrust_n(np.array(command), ROV.thrust_coefficients) == pytest.approx(thrust, abs=0.06)


def test_readings_scatter_about_the_truth_as_the_data_sheet_says():
    rng, n = np.random.default_rng(3), 4000
    readings = [read_sensors(POSE, CAMERA, NOISE, ("pressure", "ahrs"), rng) for _ in range(n)]
    height = np.array([r.pressure_z_m for r in readings]) - (POSE @ CAMERA)[2, 3]
    angles = geometry.wrap_angle(np.array([r.ahrs_rpy_rad for r in readings]) - [0.05, -0.08, 3.1])
    sigma = np.array([0.02, 0.003, 0.003, 0.01])
    errors = np.column_stack([height, angles])
    # 4 standard errors of a mean and of a standard deviation
    assert np.all(np.abs(errors.mean(axis=0)) < 4 * sigma / np.sqrt(n))
    assert np.all(np.abs(errors.std(axis=0) / sigma - 1) < 4 / np.sqrt(2 * n))
    assert np.abs(np.corrcoef(errors.T) - np.eye(4)).max() < 4 / np.sqrt(n)


def test_headings_stay_wrapped():
    rng = np.random.default_rng(0)
    pose = geometry.pose(geometry.rotation_from_rpy(0.0, 0.0, np.pi - 1e-3), np.zeros(3))
    yaws = [read_sensors(pose, CAMERA, NOISE, ("ahrs",), rng).ahrs_rpy_rad[2] for _ in range(50)]
    assert min(yaws) >= -np.pi and max(yaws) < np.pi and min(yaws) < 0 < max(yaws)


def test_a_draw_does_not_depend_on_what_is_listed():
    def third(aiding):
        rng = np.random.default_rng(7)
        return [read_sensors(POSE, CAMERA, NOISE, aiding, rng) for _ in range(3)][-1]

    both, pressure, ahrs, none = (third(a) for a in (("pressure", "ahrs"), ("pressure",), ("ahrs",), ()))
    assert both.pressure_z_m == pressure.pressure_z_m
    np.testing.assert_array_equal(both.ahrs_rpy_rad, ahrs.ahrs_rpy_rad)
    assert pressure.ahrs_rpy_rad is None and ahrs.pressure_z_m is None
    assert none.pressure_z_m is None and none.ahrs_rpy_rad is None
