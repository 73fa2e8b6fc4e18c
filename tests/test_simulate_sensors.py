"""Thruster lag against its transfer function; statistics of the navigation sensors' errors."""

import pickle

import cv2
import numpy as np
import pytest
from scipy import signal

from twin.core import geometry
from twin.core.height_field import height_field
from twin.core.records import Readings, SensorNoise, StereoRig
from twin.scenario.model import NavigationConfig, VehicleConfig
from twin.simulate.echo_sounders import BottomLock
from twin.simulate.parameters import parameters_of
from twin.simulate.reading_times import Delays
from twin.simulate.sensors import NavigationSensors
from twin.simulate.thrusters import command_thrusters, lagged_thrusters, steady_thrust_n, step_thrusters

ROV = parameters_of(VehicleConfig())
NOISE = SensorNoise(pressure_m=0.02, attitude_rad=0.003, heading_rad=0.01)
POSE = geometry.pose(geometry.rotation_from_rpy(0.05, -0.08, 3.1), np.array([1.0, 2.0, 3.0]))
CAMERA = geometry.pose(geometry.BODY_FROM_DOWN_CAMERA, np.array([0.1, 0.075, -0.15]))
RIG = StereoRig(320, 240, 277.0, 0.15, 30.0, CAMERA)
CLEAR = np.full((240, 320), 10.0, np.float32)


def sensors_of(aiding, noise, seed=0, **settings):
    streams = zip(("navigation", "dvl", "usbl", "beacons"), np.random.SeedSequence(seed).spawn(4), strict=True)
    rng = {name: np.random.default_rng(seed) for name, seed in streams}
    return NavigationSensors(NavigationConfig(aiding=tuple(aiding), **settings), noise, RIG, rng)


def readings_at(pose, aiding, n, seed=0, noise=NOISE, velocity=(0.0, 0.0, 0.0), depth_m=None):
    """Returns n readings at a pose world_from_body; with a depth image, all of them are at keyframes."""
    sensors, twist = sensors_of(aiding, noise, seed), np.array([0.0, 0.0, 0.0, *velocity])
    return [sensors.read(k / 30, pose, twist, None if depth_m is None else lambda: depth_m) for k in range(n)]


def test_a_command_step_gives_the_step_response_of_the_published_lag():
    step_s, command = 1 / 120, np.linspace(-1, 1, 8)
    thrusters = lagged_thrusters(ROV, step_s)
    command_thrusters(thrusters, command)
    history = []
    for _ in range(120):
        history.append(thrusters.c @ thrusters.lag_state)
        step_thrusters(thrusters)
    _, expected = signal.step(ROV.thruster_lag, T=np.arange(120) * step_s)
    steady = steady_thrust_n(command, ROV.thrust_coefficients, ROV.thrust_table)
    np.testing.assert_allclose(history, np.outer(expected, steady), atol=1e-9)


@pytest.mark.parametrize(("command", "thrust"), [(0.25, 4.6), (0.5, 16.6), (0.75, 26.5), (1.0, 30.4), (-0.5, -16.6)])
def test_steady_thrust_agrees_with_the_published_points(command, thrust):
    assert steady_thrust_n(np.array([command]), ROV.thrust_coefficients, ROV.thrust_table) == pytest.approx(
        thrust, abs=0.06
    )


def test_errors_of_height_and_attitude_have_the_given_standard_deviations_and_no_bias():
    n = 4000
    readings = readings_at(POSE, ("pressure", "ahrs"), n)
    height = np.array([r.pressure_z_m for r in readings]) - (POSE @ CAMERA)[2, 3]
    angles = geometry.wrap_angle(np.array([r.ahrs_rpy_rad for r in readings]) - [0.05, -0.08, 3.1])
    sigma = np.array([0.02, 0.003, 0.003, 0.01])
    errors = np.column_stack([height, angles])
    # 4 standard errors of a mean and of a standard deviation
    assert np.all(np.abs(errors.mean(axis=0)) < 4 * sigma / np.sqrt(n))
    assert np.all(np.abs(errors.std(axis=0) / sigma - 1) < 4 / np.sqrt(2 * n))
    assert np.abs(np.corrcoef(errors.T) - np.eye(4)).max() < 4 / np.sqrt(n)


def test_headings_are_wrapped_to_plus_minus_pi():
    pose = geometry.pose(geometry.rotation_from_rpy(0.0, 0.0, np.pi - 1e-3), np.zeros(3))
    yaws = [reading.ahrs_rpy_rad[2] for reading in readings_at(pose, ("ahrs",), 50)]
    assert min(yaws) >= -np.pi and max(yaws) < np.pi and min(yaws) < 0 < max(yaws)


LEVEL = geometry.pose(np.eye(3), np.array([1.0, 2.0, 3.0]))
POSE_ABOVE = LEVEL @ CAMERA
SURVEYED = ((1.2, 2.3, 0.5), (0.7, 1.6, 0.4), (9.0, 2.0, 0.4))  # the last one is outside the image
BEACONS = SensorNoise(0.02, 0.003, 0.01, beacon_px=0.3, beacons_m=SURVEYED)


def test_the_doppler_log_has_white_noise_and_one_scale_error_per_survey():
    noise, velocity, n = SensorNoise(0.02, 0.003, 0.01, dvl_mps=0.01, dvl_scale=0.05), np.array([0.4, -0.2, 0.1]), 2000
    early, late = np.array([r.dvl_mps for r in readings_at(POSE, ("dvl",), 2 * n, 0, noise, velocity)]).reshape(2, n, 3)
    # 4 standard errors of a standard deviation, and of the difference of two means
    assert np.all(np.abs(early.std(axis=0) / 0.01 - 1) < 4 / np.sqrt(2 * n))
    assert np.abs(np.corrcoef(early.T) - np.eye(3)).max() < 4 / np.sqrt(n)
    assert np.all(np.abs(early.mean(axis=0) - late.mean(axis=0)) < 4 * 0.01 * np.sqrt(2 / n))
    silent = SensorNoise(0.02, 0.003, 0.01, dvl_mps=1e-12, dvl_scale=0.05)
    ratios = np.array([readings_at(POSE, ("dvl",), 1, k, silent, velocity)[0].dvl_mps / velocity for k in range(n)])
    assert np.ptp(ratios, axis=1).max() < 1e-9  # equal on all axes
    assert abs(ratios.mean() - 1) < 4 * 0.05 / np.sqrt(n)
    assert abs(ratios[:, 0].std() / 0.05 - 1) < 4 / np.sqrt(2 * n)


def test_acoustic_fixes_are_unbiased_and_at_least_one_interval_apart():
    noise, position = SensorNoise(0.02, 0.003, 0.01, usbl_m=0.5), (POSE @ CAMERA)[:3, 3]
    sensors, times = sensors_of(("usbl",), noise, usbl_interval_s=1.0), np.arange(8000) * 0.4
    fixes = [sensors.read(time_s, POSE, np.zeros(6), lambda: CLEAR).usbl_m for time_s in times]
    taken = np.array([fix is not None for fix in fixes])
    np.testing.assert_allclose(np.diff(times[taken]), 1.2)  # the first keyframe at or after 1 s
    errors = np.array([fix for fix in fixes if fix is not None]) - position
    n = len(errors)
    assert np.all(np.abs(errors.mean(axis=0)) < 4 * 0.5 / np.sqrt(n))
    assert np.all(np.abs(errors.std(axis=0) / 0.5 - 1) < 4 / np.sqrt(2 * n))


def test_beacon_pixels_are_opencv_s_projection_plus_noise():
    n = 2000
    world_from_camera = POSE_ABOVE @ geometry.exp(np.array([0.03, -0.05, 0.4, 0.1, 0.05, 0.0]))
    camera_from_world = geometry.inverse(world_from_camera)
    rotation = cv2.Rodrigues(camera_from_world[:3, :3])[0]
    expected = cv2.projectPoints(np.array(SURVEYED), rotation, camera_from_world[:3, 3], RIG.matrix, None)[0][:2, 0]
    readings = readings_at(world_from_camera @ geometry.inverse(CAMERA), ("beacons",), n, 2, BEACONS, depth_m=CLEAR)
    sightings = [reading.beacons for reading in readings]
    assert {tuple(s.beacon for s in sighting) for sighting in sightings} == {(0, 1)}
    errors = np.array([[s.pixel for s in sighting] for sighting in sightings]) - expected
    assert np.all(np.abs(errors.mean(axis=0)) < 4 * 0.3 / np.sqrt(n))
    assert np.all(np.abs(errors.std(axis=0) / 0.3 - 1) < 4 / np.sqrt(2 * n))


def test_a_surface_in_front_of_a_beacon_hides_it():
    def seen():
        (readings,) = readings_at(LEVEL, ("beacons",), 1, 0, BEACONS, depth_m=half)
        return [s.beacon for s in readings.beacons]

    half = CLEAR.copy()
    half[:, :160] = 2.0  # the camera is at z = 2.85 m; beacon 0 is at a depth of 2.35 m in this half of the image
    assert seen() == [1]
    half[:, :160] = 2.35  # the floor on which the beacon is mounted does not hide it
    assert seen() == [0, 1]


def readings_of(aiding, n=40):
    """Returns the readings of a stationary vehicle over n frames; every fifth frame is a keyframe."""
    sensors = sensors_of(aiding, BEACONS, 5)
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


@pytest.mark.parametrize(("rate_hz", "expected"), ((None, 90), (60.0, 90), (30.0, 90), (12.0, 36), (7.0, 21), (0.5, 2)))
def test_a_sensor_of_a_rate_has_that_many_readings_with_the_numbers_of_those_frames(rate_hz, expected):
    each, rare = (
        sensors_of(("pressure", "ahrs", "dvl"), NOISE, dvl_rate_hz=rate, pressure_rate_hz=rate)
        for rate in (None, rate_hz)
    )
    pairs = [[s.read(k / 30, POSE, np.zeros(6), None) for s in (each, rare)] for k in range(90)]
    assert all(np.array_equal(one.ahrs_rpy_rad, other.ahrs_rpy_rad) for one, other in pairs)
    for name in ("dvl_mps", "pressure_z_m"):
        taken = [pair for pair in pairs if getattr(pair[1], name) is not None]
        assert len(taken) == expected and taken[0] is pairs[0]
        assert all(np.array_equal(getattr(one, name), getattr(other, name)) for one, other in taken)


def test_heights_are_multiples_of_the_resolution_and_as_noisy_as_believed():
    noise = SensorNoise(pressure_m=0.001, pressure_resolution_m=0.02)
    z = np.linspace(1.0, 3.0, 3000)
    poses = [geometry.pose(np.eye(3), np.array([0.0, 0.0, height])) for height in z]
    sensors = sensors_of(("pressure",), noise)
    read = np.array([sensors.read(k / 30, pose, np.zeros(6), None).pressure_z_m for k, pose in enumerate(poses)])
    np.testing.assert_allclose(read / 0.02, np.round(read / 0.02), atol=1e-9)
    assert (read - z - CAMERA[2, 3]).std() == pytest.approx(noise.height_sigma_m, rel=0.05)


def test_a_delayed_reading_arrives_with_the_time_of_its_measurement():
    delays, found = Delays({"usbl": 0.25, "pressure": 0.1}), []
    for k in range(10):
        fix = np.full(3, k) if k % 4 == 0 else None
        arrived = delays.deliver(k / 10, Readings(pressure_z_m=float(k), ahrs_rpy_rad=np.zeros(3), usbl_m=fix))
        assert arrived.pressure_z_m is None and arrived.usbl_m is None and arrived.ahrs_rpy_rad is not None
        found += [(k, time_s, one) for time_s, one in arrived.late]
    heights = [(k, time_s, one.pressure_z_m) for k, time_s, one in found if one.pressure_z_m is not None]
    assert heights == [(k + 1, k / 10, float(k)) for k in range(9)]
    fixes = [(k, time_s, one.usbl_m[0]) for k, time_s, one in found if one.usbl_m is not None]
    assert fixes == [(3, 0.0, 0.0), (7, 0.4, 4.0)]


def floor_with_slope(degrees):
    x = np.arange(-20, 20.5, 0.5)
    return height_field(np.tile(np.tan(np.deg2rad(degrees)) * x, (len(x), 1)), 0.5, -20.0, -20.0)


def at_height(z):
    return geometry.pose(np.eye(3), np.array([0.0, 0.0, z]))


def test_bottom_lock_needs_three_beams_within_range():
    level = BottomLock((0.5, 6.0), 30.0, floor_with_slope(0.0))
    longest = 6.0 * np.cos(np.deg2rad(30.0))
    heights = (0.4, 0.44, longest - 0.01, longest + 0.01)
    assert [level.holds(at_height(z)) for z in heights] == [False, True, True, False]
    # a slope g in x makes the beams h / (cos a -+ g sin a / sqrt 2): two of them too long
    steep = BottomLock((0.5, 6.0), 30.0, floor_with_slope(45.0))
    too_long = 6.0 * (np.cos(np.deg2rad(30.0)) - 0.5 / np.sqrt(2))
    assert [steep.holds(at_height(z)) for z in (too_long - 0.01, too_long + 0.01)] == [True, False]
    assert not level.holds(at_height(3.0) @ geometry.pose(geometry.rotation_from_rpy(np.pi, 0.0, 0.0), np.zeros(3)))
