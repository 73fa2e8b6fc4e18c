"""Thruster lag against its transfer function; statistics of the navigation sensors' errors."""

import pickle

import cv2
import numpy as np
import pytest
from scipy import signal

from twin.core import geometry
from twin.core.records import SensorNoise, StereoRig
from twin.scenario.model import NavigationConfig
from twin.scenes.bluerov2 import BLUEROV2_HEAVY as ROV
from twin.simulate.sensors import (
    AcousticPositioning,
    DopplerVelocityLog,
    NavigationSensors,
    detect_beacons,
    read_pressure_and_attitude,
)
from twin.simulate.thrusters import LaggedThrusters, steady_thrust_n

NOISE = SensorNoise(pressure_m=0.02, attitude_rad=0.003, heading_rad=0.01)
POSE = geometry.pose(geometry.rotation_from_rpy(0.05, -0.08, 3.1), np.array([1.0, 2.0, 3.0]))
CAMERA = geometry.pose(geometry.BODY_FROM_DOWN_CAMERA, np.array([0.1, 0.075, -0.15]))


def test_a_command_step_gives_the_step_response_of_the_published_lag():
    step_s, command = 1 / 120, np.linspace(-1, 1, 8)
    thrusters = LaggedThrusters(ROV, step_s)
    thrusters.command(command)
    history = []
    for _ in range(120):
        history.append(thrusters.state.c @ thrusters.state.lag_state)
        thrusters.step()
    _, expected = signal.step(ROV.thruster_lag, T=np.arange(120) * step_s)
    steady = steady_thrust_n(command, ROV.thrust_coefficients)
    np.testing.assert_allclose(history, np.outer(expected, steady), atol=1e-9)


@pytest.mark.parametrize(("command", "thrust"), [(0.25, 4.6), (0.5, 16.6), (0.75, 26.5), (1.0, 30.4), (-0.5, -16.6)])
def test_steady_thrust_agrees_with_the_published_points(command, thrust):
    assert steady_thrust_n(np.array([command]), ROV.thrust_coefficients) == pytest.approx(thrust, abs=0.06)


def test_errors_of_height_and_attitude_have_the_given_standard_deviations_and_no_bias():
    rng, n = np.random.default_rng(3), 4000
    readings = [read_pressure_and_attitude(POSE, CAMERA, NOISE, ("pressure", "ahrs"), rng) for _ in range(n)]
    height = np.array([r.pressure_z_m for r in readings]) - (POSE @ CAMERA)[2, 3]
    angles = geometry.wrap_angle(np.array([r.ahrs_rpy_rad for r in readings]) - [0.05, -0.08, 3.1])
    sigma = np.array([0.02, 0.003, 0.003, 0.01])
    errors = np.column_stack([height, angles])
    # 4 standard errors of a mean and of a standard deviation
    assert np.all(np.abs(errors.mean(axis=0)) < 4 * sigma / np.sqrt(n))
    assert np.all(np.abs(errors.std(axis=0) / sigma - 1) < 4 / np.sqrt(2 * n))
    assert np.abs(np.corrcoef(errors.T) - np.eye(4)).max() < 4 / np.sqrt(n)


def test_headings_are_wrapped_to_plus_minus_pi():
    rng = np.random.default_rng(0)
    pose = geometry.pose(geometry.rotation_from_rpy(0.0, 0.0, np.pi - 1e-3), np.zeros(3))
    yaws = [read_pressure_and_attitude(pose, CAMERA, NOISE, ("ahrs",), rng).ahrs_rpy_rad[2] for _ in range(50)]
    assert min(yaws) >= -np.pi and max(yaws) < np.pi and min(yaws) < 0 < max(yaws)


def test_random_numbers_do_not_depend_on_the_aiding_sensors():
    def third_reading(aiding):
        rng = np.random.default_rng(7)
        return [read_pressure_and_attitude(POSE, CAMERA, NOISE, aiding, rng) for _ in range(3)][-1]

    both, pressure, ahrs, none = (third_reading(a) for a in (("pressure", "ahrs"), ("pressure",), ("ahrs",), ()))
    assert both.pressure_z_m == pressure.pressure_z_m
    np.testing.assert_array_equal(both.ahrs_rpy_rad, ahrs.ahrs_rpy_rad)
    assert pressure.ahrs_rpy_rad is None and ahrs.pressure_z_m is None
    assert none.pressure_z_m is None and none.ahrs_rpy_rad is None


RIG = StereoRig(320, 240, 277.0, 0.15, 30.0, CAMERA)
LEVEL = geometry.pose(np.eye(3), np.array([1.0, 2.0, 3.0]))
POSE_ABOVE = LEVEL @ CAMERA
SURVEYED = ((1.2, 2.3, 0.5), (0.7, 1.6, 0.4), (9.0, 2.0, 0.4))  # the last one is outside the image
BEACONS = SensorNoise(0.02, 0.003, 0.01, beacon_px=0.3, beacons_m=SURVEYED)
CLEAR = np.full((240, 320), 10.0, np.float32)


def test_the_doppler_log_has_white_noise_and_one_scale_error_per_survey():
    noise, velocity, n = SensorNoise(0.02, 0.003, 0.01, dvl_mps=0.01, dvl_scale=0.05), np.array([0.4, -0.2, 0.1]), 2000
    log = DopplerVelocityLog(noise, np.random.default_rng(0))
    early, late = (np.array([log.read(velocity) for _ in range(n)]) for _ in range(2))
    # 4 standard errors of a standard deviation, and of the difference of two means
    assert np.all(np.abs(early.std(axis=0) / 0.01 - 1) < 4 / np.sqrt(2 * n))
    assert np.abs(np.corrcoef(early.T) - np.eye(3)).max() < 4 / np.sqrt(n)
    assert np.all(np.abs(early.mean(axis=0) - late.mean(axis=0)) < 4 * 0.01 * np.sqrt(2 / n))
    silent = SensorNoise(0.02, 0.003, 0.01, dvl_mps=1e-12, dvl_scale=0.05)
    ratios = np.array(
        [DopplerVelocityLog(silent, np.random.default_rng(k)).read(velocity) / velocity for k in range(n)]
    )
    assert np.ptp(ratios, axis=1).max() < 1e-9  # equal on all axes
    assert abs(ratios.mean() - 1) < 4 * 0.05 / np.sqrt(n)
    assert abs(ratios[:, 0].std() / 0.05 - 1) < 4 / np.sqrt(2 * n)


def test_acoustic_fixes_are_unbiased_and_at_least_one_interval_apart():
    noise, position = SensorNoise(0.02, 0.003, 0.01, usbl_m=0.5), np.array([3.0, -4.0, 2.0])
    usbl, times = AcousticPositioning(noise, 1.0, np.random.default_rng(1)), np.arange(8000) * 0.4
    fixes = [usbl.read(time_s, position) for time_s in times]
    taken = np.array([fix is not None for fix in fixes])
    np.testing.assert_allclose(np.diff(times[taken]), 1.2)  # the first keyframe at or after 1 s
    errors = np.array([fix for fix in fixes if fix is not None]) - position
    n = len(errors)
    assert np.all(np.abs(errors.mean(axis=0)) < 4 * 0.5 / np.sqrt(n))
    assert np.all(np.abs(errors.std(axis=0) / 0.5 - 1) < 4 / np.sqrt(2 * n))


def test_beacon_pixels_are_opencv_s_projection_plus_noise():
    rng, n = np.random.default_rng(2), 2000
    world_from_camera = POSE_ABOVE @ geometry.exp(np.array([0.03, -0.05, 0.4, 0.1, 0.05, 0.0]))
    camera_from_world = geometry.inverse(world_from_camera)
    rotation = cv2.Rodrigues(camera_from_world[:3, :3])[0]
    expected = cv2.projectPoints(np.array(SURVEYED), rotation, camera_from_world[:3, 3], RIG.matrix, None)[0][:2, 0]
    sightings = [detect_beacons(world_from_camera, CLEAR, RIG.project, BEACONS, rng) for _ in range(n)]
    assert {tuple(s.beacon for s in sighting) for sighting in sightings} == {(0, 1)}
    errors = np.array([[s.pixel for s in sighting] for sighting in sightings]) - expected
    assert np.all(np.abs(errors.mean(axis=0)) < 4 * 0.3 / np.sqrt(n))
    assert np.all(np.abs(errors.std(axis=0) / 0.3 - 1) < 4 / np.sqrt(2 * n))


def test_a_surface_in_front_of_a_beacon_hides_it():
    rng = np.random.default_rng(0)
    half = CLEAR.copy()
    half[:, :160] = 2.0  # the camera is at z = 2.85 m; beacon 0 is at a depth of 2.35 m in this half of the image
    assert [s.beacon for s in detect_beacons(POSE_ABOVE, half, RIG.project, BEACONS, rng)] == [1]
    half[:, :160] = 2.35  # the floor on which the beacon is mounted does not hide it
    assert [s.beacon for s in detect_beacons(POSE_ABOVE, half, RIG.project, BEACONS, rng)] == [0, 1]


def readings_of(aiding, n=40):
    """Returns the readings of a stationary vehicle over n frames; every fifth frame is a keyframe."""
    streams = zip(("navigation", "dvl", "usbl", "beacons"), np.random.SeedSequence(5).spawn(4), strict=True)
    rng = {name: np.random.default_rng(seed) for name, seed in streams}
    sensors = NavigationSensors(NavigationConfig(aiding=tuple(aiding)), BEACONS, RIG, rng)
    twist = np.array([0, 0, 0, 0.3, 0.0, 0.0])
    return [sensors.read(k / 30, LEVEL, twist, (lambda: CLEAR) if k % 5 == 0 else None) for k in range(n)]


SENSORS = {
    "pressure": "pressure_z_m", "ahrs": "ahrs_rpy_rad", "dvl": "dvl_mps", "usbl": "usbl_m", "beacons": "beacons",
}  # fmt: skip


@pytest.mark.parametrize("name", SENSORS)
def test_a_sensor_reads_the_same_with_any_other_sensors_and_none_if_it_is_not_listed(name):
    everything, alone, others = readings_of(SENSORS), readings_of((name,)), readings_of(set(SENSORS) - {name})
    readings = [getattr(r, SENSORS[name]) for r in everything]
    assert any(value is not None for value in readings)
    for one, value, other in zip(alone, readings, others, strict=True):
        # pickles compare numbers, arrays and sightings bit by bit
        assert pickle.dumps(getattr(one, SENSORS[name])) == pickle.dumps(value)
        assert getattr(other, SENSORS[name]) is None
        assert all(getattr(one, field) is None for other_name, field in SENSORS.items() if other_name != name)


def test_acoustic_fixes_and_sightings_come_only_with_keyframes():
    readings = readings_of(SENSORS)
    assert [k for k, r in enumerate(readings) if r.usbl_m is not None] == [0, 30]
    assert [k for k, r in enumerate(readings) if r.beacons is not None] == list(range(0, 40, 5))
