"""Pose controller and thrust allocation: tracking errors in currents, saturation, unknown hull parameters."""

from types import SimpleNamespace

import numpy as np
import pytest
from physics_world import bare_model

from twin.controllers.allocation import pseudo_inverse_allocation
from twin.controllers.lawnmower import plan
from twin.controllers.segments import Reference
from twin.controllers.survey_plan import SurveyRequest
from twin.controllers.tracking import commanded_velocity, control_thrusters, rotate_lever_arm
from twin.core import geometry
from twin.scenario.model import VehicleConfig
from twin.simulate.autopilot import nominal_controller, top_speed_mps
from twin.simulate.hull import trimmed_hull
from twin.simulate.hydrodynamics import angular_first
from twin.simulate.mujoco_vehicle import MujocoVehicle
from twin.simulate.parameters import parameters_of
from twin.simulate.sea import steady_current
from twin.simulate.thrusters import steady_thrust_n

RATE_HZ = 30.0
LEVER_M = np.array([0.0, 0.075, -0.15])
ROV = parameters_of(VehicleConfig())
CONFIGURATION = angular_first(ROV.thrust_configuration)


def thrust_of(command):
    """Returns the steady thrust [N] at commands in [-1, 1]."""
    return steady_thrust_n(command, ROV.thrust_coefficients, ROV.thrust_table)


ALLOCATION = pseudo_inverse_allocation(CONFIGURATION, thrust_of)


def body_reference(camera):
    """Returns the reference of the level body for that of the camera."""
    return camera._replace(position=camera.position - rotate_lever_arm(float(camera.yaw), LEVER_M))


def command(controller, pose, twist, reference):
    """Returns the thruster commands of a pose controller for a reference of the body."""
    position, velocity, yaw, acceleration = reference
    return control_thrusters(controller, pose, twist, position, velocity, acceleration, float(yaw))


def survey(speed_mps, current_mps=(0.0, 0.0, 0.0), seed=0, hold_s=5.0, **factors):
    """Flies a small survey with noisy state estimates; returns RMS position errors [m] and greatest tilts [deg]."""
    rng = np.random.default_rng(seed)
    p = plan(SurveyRequest((5.0, 0.9), 2.2, speed_mps, 0.9, 0.8, 0, 320, 240, 277.0, RATE_HZ))
    start = body_reference(p.reference(1, 0.0)).position
    section = VehicleConfig(**factors)
    rov = MujocoVehicle(bare_model(), section, steady_current(np.array(current_mps)), geometry.pose(np.eye(3), start))
    controller = nominal_controller(VehicleConfig(), 1.2, RATE_HZ)
    rows = []
    for track in range(1, p.n_tracks + 1):
        duration = p.track_duration_s(track)
        for t in np.arange(0, duration + hold_s, 1 / RATE_HZ):
            reference = body_reference(p.reference(track, t))
            pose = rov.world_from_body
            rows.append(
                [
                    *(pose[:3, 3] - reference.position),
                    *np.rad2deg(geometry.rpy_from_rotation(pose[:3, :3])),
                    abs(reference.velocity[0]) > 0.99 * speed_mps,
                    t > duration + 3,
                    t > 5,
                ]
            )
            estimate = pose @ geometry.exp(np.concatenate([rng.normal(0, 0.002, 3), rng.normal(0, 0.003, 3)]))
            twist = rov.twist_body + np.concatenate([rng.normal(0, 0.01, 3), rng.normal(0, 0.02, 3)])
            rov.step(command(controller, estimate, twist, reference), 1 / RATE_HZ)
    table = np.array(rows)
    cruising, holding, settled = (table[:, k].astype(bool) for k in (6, 7, 8))
    return SimpleNamespace(
        cross_m=rms(table[cruising & settled, 1]),
        altitude_m=rms(table[settled, 2]),
        station_m=rms(np.linalg.norm(table[holding, :3], axis=1)),
        tilt_deg=np.abs(table[:, 3:5]).max(),
        yaw_deg=np.abs(table[:, 5]).max(),
    )


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.mark.parametrize("speed_mps", [0.3, 0.61])
def test_in_still_water_legs_and_station_keeping_are_accurate_to_one_centimetre(speed_mps):
    flown = survey(speed_mps)
    assert flown.cross_m < 0.01
    assert flown.altitude_m < 0.01
    assert flown.station_m < 0.01
    assert flown.tilt_deg < 2
    assert flown.yaw_deg < 1


@pytest.mark.parametrize("speed_mps", [0.3, 0.61])
@pytest.mark.parametrize("current_mps", [(0.1, 0.0, 0.0), (-0.06, 0.08, 0.0), (0.0, 0.08, 0.06)])
def test_in_a_current_of_ten_centimetres_per_second_legs_are_accurate_to_two_centimetres(speed_mps, current_mps):
    flown = survey(speed_mps, current_mps)
    assert flown.cross_m < 0.02
    assert flown.altitude_m < 0.02
    assert flown.tilt_deg < 5


@pytest.mark.parametrize(
    "factors", [{"drag_factor": 0.3}, {"drag_factor": 2.0}, {"added_mass_factor": 0.3}, {"buoyancy_n": 6.0}]
)
def test_legs_are_accurate_with_a_wrong_hull_model(factors):
    flown = survey(0.3, (0.05, 0.05, 0.0), **factors)
    assert flown.cross_m < 0.02
    assert flown.altitude_m < 0.02
    assert flown.tilt_deg < 5


@pytest.mark.parametrize("bearing_deg", [0, 45, 90, 200])
def test_the_current_is_estimated_within_a_few_seconds(bearing_deg):
    """Within 2 cm/s after 5 s of station keeping with noisy velocities, and the vehicle stays within 3 cm meanwhile."""
    rng, bearing = np.random.default_rng(0), np.deg2rad(bearing_deg)
    current = 0.4 * np.array([np.cos(bearing), np.sin(bearing), 0.0])
    rov = MujocoVehicle(bare_model(), VehicleConfig(), steady_current(current), np.eye(4))
    controller = nominal_controller(VehicleConfig(), 1.2, RATE_HZ)
    hold = Reference(np.zeros(3), np.zeros(3), 0.0, np.zeros(3))
    worst_m = 0.0
    for _ in range(5 * 30):
        twist = rov.twist_body + np.concatenate([np.zeros(3), rng.normal(0, 0.02, 3)])
        rov.step(command(controller, rov.world_from_body, twist, hold), 1 / RATE_HZ)
        worst_m = max(worst_m, np.linalg.norm(rov.world_from_body[:2, 3]))
    assert np.linalg.norm(controller.flow.current - current) < 0.02
    assert worst_m < 0.03


@pytest.mark.parametrize("rate_hz", [5.0, 10.0, 60.0])
def test_the_estimate_of_the_current_is_stable_at_any_rate(rate_hz):
    """At 5 Hz and 0.5 m/s the drag of the hull would stop it within less than a period."""
    controller, current = nominal_controller(VehicleConfig(), 0.6, rate_hz), np.array([0.0, 0.5, 0.0])
    rov = MujocoVehicle(bare_model(), VehicleConfig(), steady_current(current), np.eye(4))
    hold = Reference(np.zeros(3), np.zeros(3), 0.0, np.zeros(3))
    for _ in range(round(20 * rate_hz)):
        rov.step(command(controller, rov.world_from_body, rov.twist_body, hold), 1 / rate_hz)
    np.testing.assert_allclose(controller.flow.current, current, atol=0.05)


def test_the_current_is_known_after_a_turn():
    """Its estimate is in the world: a yaw of 90 deg does not change it."""
    controller, current = nominal_controller(VehicleConfig(), 1.2, RATE_HZ), np.array([0.3, 0.0, 0.0])
    rov = MujocoVehicle(bare_model(), VehicleConfig(), steady_current(current), np.eye(4))
    found = []
    for k in range(20 * 30):
        yaw = min(max(k / 30 - 5, 0.0) * 0.25, np.pi / 2)
        hold = Reference(np.zeros(3), np.zeros(3), yaw, np.zeros(3))
        rov.step(command(controller, rov.world_from_body, rov.twist_body, hold), 1 / RATE_HZ)
        found.append(controller.flow.current.copy())
    np.testing.assert_allclose(found[150:], np.tile(current, (450, 1)), atol=0.04)


def test_below_saturation_the_thrusters_produce_the_commanded_wrench():
    rng = np.random.default_rng(0)
    for wrench in rng.normal(size=(20, 6)) * [0.5, 0.5, 0.5, 10, 10, 10]:
        commands, scale = ALLOCATION.commands(wrench)
        assert scale == 1
        # the table is linear between commands 0.001 apart: an error of F''/8 * 1e-6 < 1e-4 N a thruster
        np.testing.assert_allclose(CONFIGURATION @ thrust_of(commands), wrench, atol=1e-3)


def test_in_saturation_the_wrench_keeps_its_direction_and_one_thruster_is_at_full_thrust():
    wrench = np.array([1.0, -2.0, 3.0, 300.0, 20.0, -50.0])
    commands, scale = ALLOCATION.commands(wrench)
    assert 0 < scale < 1
    np.testing.assert_allclose(CONFIGURATION @ thrust_of(commands), scale * wrench, atol=2e-3)
    strongest = thrust_of(np.linspace(-1, 1, 100_001)).max()  # the fitted curve decreases near full command
    assert np.abs(thrust_of(commands)).max() == pytest.approx(strongest, abs=1e-3)
    assert np.abs(commands).max() <= 1


def test_the_thrusts_produce_the_wrench_with_the_least_effort():
    wrench = np.array([1.0, -0.5, 0.7, 10.0, 3.0, -8.0])
    thrusts = ALLOCATION.thrusts_from_wrench @ wrench
    np.testing.assert_allclose(CONFIGURATION @ thrusts, wrench, atol=1e-12)
    null_space = np.linalg.svd(CONFIGURATION)[2][6:]  # thrusts without a wrench; none may reduce the effort
    np.testing.assert_allclose(null_space @ thrusts, 0, atol=1e-12)


def test_body_and_camera_references_differ_by_the_lever_arm_rotated_by_yaw():
    camera = Reference(np.array([1.0, 2.0, 3.0]), np.zeros(3), 0.7, np.zeros(3))
    body = body_reference(camera)
    pose = geometry.pose(geometry.rotation_from_rpy(0.0, 0.0, 0.7), body.position)
    np.testing.assert_allclose(geometry.transform(pose, LEVER_M[None])[0], camera.position, atol=1e-12)


@pytest.mark.parametrize("bearing_deg", [0.0, 30.0, 45.0, 90.0, 200.0])
def test_at_top_speed_in_any_direction_one_thruster_is_at_full_thrust(bearing_deg):
    bearing = np.deg2rad(bearing_deg)
    direction = np.array([np.cos(bearing), np.sin(bearing), 0.0])
    hull = trimmed_hull(VehicleConfig())
    velocity = top_speed_mps(VehicleConfig(), direction) * direction
    drag = (np.diag(hull.linear_drag) + np.diag(hull.quadratic_drag) * np.abs([0, 0, 0, *velocity]))[3:] * velocity
    thrusts = np.linalg.pinv(CONFIGURATION) @ [0, 0, 0, *drag]
    assert np.abs(thrusts).max() == pytest.approx(thrust_of(np.ones(1))[0])


def test_the_commanded_velocity_is_the_reference_velocity_plus_a_position_correction():
    reference = Reference(np.array([1.0, 2.0, 3.0]), np.array([0.3, 0.0, 0.0]), 0.0, np.zeros(3))
    np.testing.assert_allclose(commanded_velocity(np.array([1.0, 1.5, 3.0]), reference, 1.2), [0.3, 0.6, 0.0])


def test_the_integral_does_not_wind_up_while_thrusters_saturate():
    controller = nominal_controller(VehicleConfig(), 1.2, RATE_HZ)
    far = Reference(np.array([50.0, 0.0, 0.0]), np.zeros(3), 0.0, np.zeros(3))
    for _ in range(300):
        command(controller, np.eye(4), np.zeros(6), far)
    np.testing.assert_allclose(controller.integral, 0, atol=1e-6)
    assert np.abs(controller.flow.current).max() <= 1.0  # it does not move: as in a current


@pytest.mark.parametrize("yaw", [0.0, 1.0, np.pi / 2, -3.0])
def test_station_keeping_in_a_current_works_at_any_heading(yaw):
    reference = Reference(np.zeros(3), np.zeros(3), yaw, np.zeros(3))
    start = geometry.pose(geometry.rotation_from_rpy(0.1, 0.1, yaw + 0.4), np.array([0.2, 0.0, 0.0]))
    rov = MujocoVehicle(bare_model(), VehicleConfig(), steady_current(np.array([0.1, 0.05, 0.0])), start)
    controller = nominal_controller(VehicleConfig(), 1.2, RATE_HZ)
    for _ in range(20 * 30):
        rov.step(command(controller, rov.world_from_body, rov.twist_body, reference), 1 / RATE_HZ)
    np.testing.assert_allclose(rov.world_from_body[:3, 3], 0, atol=0.005)
    np.testing.assert_allclose(rov.world_from_body[:3, :3], geometry.rotation_from_rpy(0.0, 0.0, yaw), atol=0.005)
