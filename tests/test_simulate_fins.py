"""Fins: force, stall and energy against vectors and closed forms; trim, circles and trajectories of the AUV."""

import numpy as np
import pytest
from physics_world import bare_model
from scipy.optimize import root
from test_simulate_hydrodynamics import AHEAD, dense_acceleration, dense_fins, energy
from test_simulate_sea import sea_of

from twin.core import geometry
from twin.scenario.file import load_scenario
from twin.scenario.model import FinConfig, VehicleConfig
from twin.simulate.autopilot import top_speed_mps
from twin.simulate.compiled_vehicle import CompiledVehicle
from twin.simulate.fins import WATER_KG_M3, add_fins, fins_of
from twin.simulate.hull import trimmed_hull
from twin.simulate.mujoco_vehicle import MujocoVehicle
from twin.simulate.parameters import parameters_of
from twin.simulate.sea import steady_current
from twin.simulate.steady_flight import minimum_speed_mps, trim, turning_radius_m

AUV = load_scenario("auv").vehicle
STILL, STEP_S = steady_current(np.zeros(3)), 1 / 120


def flown(command, seconds, speed_mps=1.2, vehicle=AUV, pose=None, step_s=STEP_S):
    body = CompiledVehicle(
        vehicle, STILL, np.eye(4) if pose is None else pose, step_s, start_velocity_mps=speed_mps * AHEAD
    )
    body.step(np.asarray(command), seconds)
    return body


def commands_of(found):
    """Returns the commands of a trim: thrust by the table, then angles of the four movable fins."""
    command = np.interp(found.thrust_n, *np.array(AUV.thrust_table).T[::-1])
    return np.concatenate([[command], found.angles_rad[:4] / np.radians(13.6)])


@pytest.mark.parametrize("seed", range(6))
def test_the_wrench_of_the_fins_is_that_of_their_forces_as_vectors(seed):
    rng = np.random.default_rng(seed)
    fins, relative, wrench = fins_of(AUV, STEP_S), rng.normal(size=6), np.zeros(6)
    fins.angle_rad[:4] = rng.uniform(-0.3, 0.3, 4)
    add_fins(wrench, fins, relative)
    np.testing.assert_allclose(wrench, dense_fins(AUV, fins.angle_rad, relative), rtol=1e-12, atol=1e-12)


def test_lift_is_linear_up_to_stall_and_falls_as_that_of_a_flat_plate_beyond():
    """Lift rho/2 S V^2 a alpha cos alpha; beyond stall, a alpha_stall cos alpha; drag is lift times tan alpha."""
    fin = FinConfig(position_m=(0, 0, 0), lift_direction_deg=90, area_m2=0.01, lift_slope_per_rad=3.0, stall_deg=15)
    fins = fins_of(VehicleConfig(fins=(fin,)), STEP_S)
    for attack_deg in (-80, -20, -15, -5, 0, 5, 14.9, 15, 30, 90):
        attack, wrench = np.radians(attack_deg), np.zeros(6)
        add_fins(wrench, fins, np.array([0, 0, 0, 2 * np.cos(attack), 0.0, -2 * np.sin(attack)]))
        normal = WATER_KG_M3 / 2 * 0.01 * 4 * 3.0 * np.clip(attack, -np.radians(15), np.radians(15))
        flow = np.array([np.cos(attack), -np.sin(attack)])  # of the fin through the water
        lift, drag = wrench[[3, 5]] @ [-flow[1], flow[0]], -(wrench[[3, 5]] @ flow)
        assert lift == pytest.approx(normal * np.cos(attack), abs=1e-12)
        assert drag == pytest.approx(normal * np.sin(attack), abs=1e-12) and drag >= 0


def test_the_angle_of_a_fin_follows_its_command_with_its_lag_and_is_limited():
    body = flown([0, 2.0, 0, 0, 0], 0.25)
    assert np.degrees(body.state.fins.angle_rad[0]) == pytest.approx(13.6 * (1 - np.exp(-0.25 / 0.1)), rel=1e-9)
    assert not body.state.fins.angle_rad[1:].any()


def test_a_fin_fixed_or_moved_adds_no_energy_in_still_water():
    rng, fins = np.random.default_rng(0), fins_of(AUV, STEP_S)
    for _ in range(1000):
        relative, wrench = rng.normal(size=6), np.zeros(6)
        fins.angle_rad[:4] = rng.uniform(-0.3, 0.3, 4)
        add_fins(wrench, fins, relative)
        assert wrench @ relative <= 0


def test_the_energy_balance_closes_within_half_a_percent():
    """Change of mechanical energy = work of thrusters, fins and drag, each from its own formula, over 10 s."""
    body, hull = flown([0, 0, 0, 0, 0], STEP_S), trimmed_hull(AUV)
    rng, power, energies = np.random.default_rng(4), [], [energy(body, hull)]
    configuration = np.roll(parameters_of(AUV).thrust_configuration, 3, axis=0)
    for k in range(10 * 120):
        if k % 120 == 0:
            command = np.concatenate([rng.uniform(0.1, 0.5, 1), rng.uniform(-1, 1, 4)])
        twist, there = body.twist_body, body.twist_body.copy()
        there[3:] += np.cross(twist[:3], hull.drag_centre_m)
        drag = -(hull.quadratic_drag * np.abs(there)) @ there @ there
        thrust_n = body.state.thrusters.lag_state[0]
        fins = dense_fins(AUV, body.state.fins.angle_rad, twist) @ twist
        power.append((configuration @ thrust_n @ twist, fins, drag))
        body.step(command, STEP_S)
        energies.append(energy(body, hull))
    work = np.sum(power[1:], axis=0) * STEP_S
    assert work[0] > 50 and work[1] < -1 and work[2] < -10  # [J]
    assert energies[-1] - energies[1] == pytest.approx(work.sum(), abs=0.005 * work[0])


@pytest.mark.parametrize("curvature", [0.0, 0.1, -0.28, 0.4])
def test_the_trim_solves_the_equation_with_full_matrices_and_the_simulated_circle_has_its_radius(curvature):
    found = trim(AUV, 1.2, curvature)
    rotation = geometry.rotation_from_rpy(found.roll, found.pitch, 0.0)
    wrench = np.roll(parameters_of(AUV).thrust_configuration, 3, axis=0)[:, 0] * found.thrust_n
    wrench = wrench + dense_fins(AUV, found.angles_rad, found.twist)
    rate = dense_acceleration(trimmed_hull(AUV), rotation, found.twist, np.zeros((5, 3)), wrench)
    np.testing.assert_allclose(rate, 0.0, atol=1e-8)
    body = flown(commands_of(found), 60.0)
    speed = np.linalg.norm(body.twist_body[3:])
    turning = (body.world_from_body[:3, :3] @ body.twist_body[:3])[2]
    assert speed == pytest.approx(1.2, rel=2e-3)
    assert turning / speed == pytest.approx(curvature, rel=5e-3, abs=1e-6)


def test_the_circle_of_a_free_root_of_the_dense_equations_is_that_of_the_trim():
    """Rudders at 5 deg: scipy's root for the motion, with other unknowns and the dense equations."""
    rudder, hull = np.radians(5.0), trimmed_hull(AUV)
    ahead = np.roll(parameters_of(AUV).thrust_configuration, 3, axis=0)[:, 0]

    def residual(unknown):
        roll, pitch, u, v, w, turning, elevator = unknown
        rotation = geometry.rotation_from_rpy(roll, pitch, 0.0)
        twist = np.concatenate([rotation.T @ [0, 0, turning], [u, v, w]])
        angles = [rudder, rudder, elevator, elevator, 0, 0]
        wrench = 10.0 * ahead + dense_fins(AUV, angles, twist)
        rate = dense_acceleration(hull, rotation, twist, np.zeros((5, 3)), wrench)
        return np.append(rate, rotation[2] @ [u, v, w])

    solved = root(residual, [0, 0, 1.2, 0, 0, -0.3, 0], tol=1e-11)
    assert solved.success
    speed = np.linalg.norm(solved.x[2:5])
    found = trim(AUV, speed, solved.x[5] / speed)
    np.testing.assert_allclose(found.angles_rad[:2], rudder, rtol=1e-5)
    assert found.thrust_n == pytest.approx(10.0, rel=1e-6)


def test_the_terminal_speed_balances_thrust_and_drag():
    """T = X_uu V^2; the hull at its small angle of trim adds less than a percent."""
    for command in (0.2, 0.6, 1.0):
        body = flown([command, 0, 0, 0, 0], 60.0, vehicle=AUV.model_copy(update={"buoyancy_n": 0.0}))
        assert body.twist_body[3] == pytest.approx(np.sqrt(38.3 * command / 6.13), rel=0.01)


def test_published_figures_of_the_vehicle():
    """Top speed 2.5 m/s at 1525 rpm (Fossen); drag of Allen et al. 2000 with Cd 0.42; Yuv and Nuv of Prestero 2001.

    Without his fins (9.64 u v and 6.15 u v), Yuv = -28.6 is the lift of the hull, and Nuv = -24 its moment and Munk's.
    """
    assert top_speed_mps(AUV, AHEAD) == pytest.approx(2.5, rel=0.005)
    assert AUV.quadratic_drag_matrix[0][0] == pytest.approx(0.5 * 1025 * 0.42 * 0.0285, rel=0.01)
    hull = [fin for fin in AUV.fins if fin.max_deg == 0]
    slopes = [WATER_KG_M3 / 2 * fin.area_m2 * fin.lift_slope_per_rad for fin in hull]
    np.testing.assert_allclose(slopes, 28.6 - 9.64, rtol=1e-3)
    munk = 35.5 - 0.93
    np.testing.assert_allclose([munk + slopes[0] * hull[0].position_m[0] - 6.15], 24.0, rtol=3e-3)


def test_the_minimum_speed_follows_the_buoyancy_and_the_turning_radius_does_not_depend_on_the_speed():
    """Fins keep the height in proportion to V^2; a turn without gravity scales with the size of the vehicle only."""
    heavy = AUV.model_copy(update={"buoyancy_n": 7.0})  # as Prestero's
    assert minimum_speed_mps(AUV) == 0.55 and minimum_speed_mps(heavy) == 0.9
    assert trim(AUV, 0.3) is None or np.abs(trim(AUV, 0.3).angles_rad).max() > np.radians(13.6)
    radii = [turning_radius_m(AUV, speed) for speed in (1.0, 2.0)]
    assert radii[0] == pytest.approx(radii[1], rel=0.05) and 2 < radii[0] < 6
    assert turning_radius_m(AUV, 1.2, share=1.0) < radii[0]


def test_the_vehicle_is_stable_at_twice_the_default_step():
    command = np.array([0.3, 0.5, 0.5, -0.4, -0.4])
    one, two = (flown(command, 30.0, step_s=step_s) for step_s in (STEP_S, 2 * STEP_S))
    np.testing.assert_allclose(two.twist_body, one.twist_body, atol=2e-3)


def test_mujoco_and_the_compiled_loop_fly_alike_with_fins():
    sea, rng = sea_of(), np.random.default_rng(2)
    compiled = CompiledVehicle(AUV, sea, np.eye(4), STEP_S, start_velocity_mps=AHEAD)
    mujoco = MujocoVehicle(bare_model(), AUV, sea, np.eye(4), start_velocity_mps=AHEAD)
    for command in rng.uniform(-0.5, 0.8, (20, 5)):
        for body in (compiled, mujoco):
            body.step(command, 0.5)
    assert np.linalg.norm(compiled.world_from_body[:3, 3]) > 3
    np.testing.assert_allclose(compiled.world_from_body, mujoco.world_from_body, atol=1e-8)
