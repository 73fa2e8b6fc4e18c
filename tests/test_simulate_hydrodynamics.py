"""Vehicle dynamics against Fossen's equations: closed forms, conservation laws and a dense reference solution."""

import numpy as np
import pytest
from physics_world import IDLE, bare_model, vehicle

from twin.core import geometry
from twin.errors import SurveyAborted
from twin.scenario.model import VehicleConfig
from twin.simulate.compiled_vehicle import CompiledVehicle
from twin.simulate.fins import WATER_KG_M3
from twin.simulate.hull import physics_timestep_s, trimmed_hull
from twin.simulate.hydrodynamics import acceleration
from twin.simulate.mujoco_vehicle import MujocoVehicle
from twin.simulate.parameters import parameters_of
from twin.simulate.sea import steady_current

STEP_S, AHEAD = 1 / 120, np.array([1.0, 0.0, 0.0])
ROV, HULL = parameters_of(VehicleConfig()), trimmed_hull(VehicleConfig(buoyancy_n=0.0))


def energy(v, hull=HULL):
    """Returns the mechanical energy of a vehicle in still water [J], kinetic energy including added mass."""
    pose = v.world_from_body
    buoyancy_z = pose[2, 3] + pose[2, :3] @ hull.centre_of_buoyancy_m
    kinetic = 0.5 * v.twist_body @ (np.diag(hull.inertia) + hull.added_inertia) @ v.twist_body
    return kinetic + hull.weight_n * pose[2, 3] - hull.buoyancy_n * buoyancy_z


def linear_first(matrix):
    return np.roll(matrix, 3, axis=(0, 1))


def dense_acceleration(hull, rotation, twist, flow, wrench):
    """Solves Fossen's equation with full matrices, linear velocity first as in the book."""
    mass, added = linear_first(np.diag(hull.inertia)), linear_first(hull.added_inertia)
    current, rate, gradient = flow[0], flow[1], flow[2:]
    nu, flow = np.roll(twist, 3), np.concatenate([rotation.T @ current, np.zeros(3)])
    relative = nu - flow

    def coriolis(m, v):
        s1, s2 = (geometry.skew(rows[:, :3] @ v[:3] + rows[:, 3:] @ v[3:]) for rows in (m[:3], m[3:]))
        return np.block([[np.zeros((3, 3)), -s1], [-s1, -s2]])

    shift = np.block([[np.eye(3), -geometry.skew(hull.drag_centre_m)], [np.zeros((3, 3)), np.eye(3)]])
    there = shift @ relative  # velocity of the centre of drag through the water
    drag = shift.T @ (linear_first(hull.linear_drag) + linear_first(hull.quadratic_drag) * np.abs(there)) @ there
    up = rotation.T @ [0.0, 0.0, 1.0]
    lift = (hull.buoyancy_n - hull.weight_n) * up
    righting = np.cross(hull.centre_of_buoyancy_m, hull.buoyancy_n * up)
    along, water = (rotation.T @ (rate + gradient @ velocity) for velocity in (rotation @ nu[:3], current))
    flow_rate = np.concatenate([along - np.cross(nu[3:], flow[:3]), np.zeros(3)])
    displaced = hull.buoyancy_n / 9.81 * water
    total = np.roll(wrench, 3) + np.concatenate([lift, righting]) + added @ flow_rate
    total += np.concatenate([displaced, np.cross(hull.centre_of_buoyancy_m, displaced)])
    total -= coriolis(mass, nu) @ nu + coriolis(added, relative) @ relative + drag
    return np.roll(np.linalg.solve(mass + added, total), 3)


def dense_fins(vehicle, angles_rad, relative):
    """Returns the wrench (6,) of the fins by vectors, each force resolved into lift and drag in the flow."""
    total, w, v = np.zeros(6), relative[:3], relative[3:]
    for fin, angle in zip(vehicle.fins, angles_rad, strict=True):
        at, cant = np.array(fin.position_m), np.radians(fin.lift_direction_deg)
        normal = np.array([0.0, np.cos(cant), np.sin(cant)])
        there = v + np.cross(w, at)
        there = there @ AHEAD * AHEAD + there @ normal * normal  # without the part along the span
        chord, across = np.cos(angle) * AHEAD + np.sin(angle) * normal, np.cos(angle) * normal - np.sin(angle) * AHEAD
        speed, attack = np.linalg.norm(there), -np.arctan2(there @ across, abs(there @ chord))
        if speed == 0:
            continue
        coefficient = fin.lift_slope_per_rad * np.clip(attack, *np.radians([-fin.stall_deg, fin.stall_deg]))
        flow = there / speed
        lift = across - across @ flow * flow
        force = coefficient * (lift + across @ flow * flow) * WATER_KG_M3 / 2 * fin.area_m2 * speed**2
        total += np.concatenate([np.cross(at, force), force])
    return total


def coupled(rng, **factors):
    """Returns a vehicle with full matrices and a centre of drag of its own."""
    parts = rng.normal(size=(6, 6))
    return VehicleConfig(
        added_mass_matrix=tuple(map(tuple, (parts @ parts.T).tolist())),
        linear_drag_matrix=tuple(map(tuple, (rng.normal(size=(6, 6)) + 8 * np.eye(6)).tolist())),
        quadratic_drag_matrix=tuple(map(tuple, (rng.normal(size=(6, 6)) + 40 * np.eye(6)).tolist())),
        drag_centre_m=(0.02, -0.01, 0.05),
        **factors,
    )


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("full", [False, True])
def test_acceleration_agrees_with_the_full_matrix_equation(seed, full):
    rng = np.random.default_rng(seed)
    factors = {"buoyancy_n": 3.0, "drag_factor": 1.7, "added_mass_factor": 0.6}
    hull = trimmed_hull(coupled(rng, **factors) if full else VehicleConfig(**factors))
    rotation = geometry.so3_exp(rng.normal(size=3))
    arguments = rotation, rng.normal(size=6), rng.normal(size=(5, 3)), rng.normal(size=6)
    np.testing.assert_allclose(acceleration(hull, *arguments), dense_acceleration(hull, *arguments), rtol=1e-9)


def test_energy_does_not_increase_in_still_water_without_thrust():
    # Leapfrog can add (rate * step)^3 / 4 of the oscillation energy per step: (1.7/s / 120)^3 / 4 * 0.6 J < 1e-6 J.
    v = vehicle(geometry.pose(geometry.rotation_from_rpy(1.0, 0.5, 2.0), np.zeros(3)))
    v._velocity[:] = [0.8, -0.3, 0.4, 1.0, 0.5, 2.0]
    v.step(IDLE, STEP_S)
    energies = []
    for _ in range(120 * 20):
        v.step(IDLE, STEP_S)
        energies.append(energy(v))
    assert energies[0] - energies[-1] > 1.0
    assert np.diff(energies).max() < 1e-6


def test_energy_is_conserved_without_drag():
    none = np.zeros((6, 6))
    hull = trimmed_hull(VehicleConfig(buoyancy_n=0.0))._replace(linear_drag=none, quadratic_drag=none)
    v = vehicle(geometry.pose(geometry.rotation_from_rpy(0.6, -0.3, 0.0), np.zeros(3)))
    v._hull = hull
    start = energy(v, hull)
    energies = [energy(v, hull) for _ in range(120 * 30) if v.step(IDLE, STEP_S) is None]
    amplitude = start + hull.buoyancy_n * hull.centre_of_buoyancy_m[2]  # energy above the minimum of the pendulum
    assert np.abs(np.array(energies) - start).max() < 1e-3 * amplitude  # (1.7/s * step)^2 / 4 = 5e-5, and a margin


@pytest.mark.parametrize(("axis", "command"), [("surge", 0.3), ("surge", 0.6), ("heave", 0.3)])
def test_terminal_speed_balances_thrust_and_drag(axis, command):
    # The horizontal thrusters are below the centre of gravity; a large moment of inertia suppresses the pitching.
    k = {"surge": 0, "heave": 2}[axis]
    v = vehicle()
    v._hull = v._hull._replace(inertia=v._hull.inertia * np.array([1e9, 1e9, 1e9, 1, 1, 1]))
    active = np.array([1, 1, 1, 1, 0, 0, 0, 0] if axis == "surge" else [0, 0, 0, 0, 1, 1, 1, 1])
    for _ in range(60):
        v.step(command * active, 0.5)
    thrust = np.polyval(ROV.thrust_coefficients, command**2) * command * 4 * (np.sqrt(0.5) if axis == "surge" else 1)
    linear, quadratic = ROV.linear_drag[k, k], ROV.quadratic_drag[k, k]
    expected = (-linear + np.sqrt(linear**2 + 4 * quadratic * thrust)) / (2 * quadratic)
    assert v.twist_body[3 + k] == pytest.approx(expected, rel=0.01)


def test_a_neutral_vehicle_stays_at_depth_and_a_buoyant_one_rises_at_terminal_speed():
    v = vehicle(buoyancy_n=0.0)
    v.step(IDLE, 30.0)
    np.testing.assert_allclose(v.world_from_body, np.eye(4), atol=1e-12)
    v = vehicle(buoyancy_n=2.0)
    v.step(IDLE, 30.0)
    linear, quadratic = ROV.linear_drag[2, 2], ROV.quadratic_drag[2, 2]
    expected = (-linear + np.sqrt(linear**2 + 8 * quadratic)) / (2 * quadratic)
    assert v.twist_body[5] == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize(("axis", "sign"), [(0, 1), (1, -1)])
def test_free_decay_of_a_small_tilt_has_the_period_and_damping_of_the_linearised_equation(axis, sign):
    """I a'' + d a' + B h a = 0; roll needs a linear damping because its published value is zero."""
    damping, stiffness = 0.15, HULL.buoyancy_n * HULL.centre_of_buoyancy_m[2]
    inertia = HULL.inertia[axis] + HULL.added_inertia[axis, axis]
    v = vehicle(geometry.pose(geometry.so3_exp(0.02 * sign * np.eye(3)[axis]), np.zeros(3)))
    v._hull = v._hull._replace(linear_drag=np.diag([damping] * 3 + [0.0] * 3), quadratic_drag=np.zeros((6, 6)))
    rate, decay = np.sqrt(stiffness / inertia - (damping / 2 / inertia) ** 2), damping / 2 / inertia
    times, angles = [], []
    for _ in range(120 * 12):
        v.step(IDLE, STEP_S)
        times.append(v.time_s)
        angles.append(geometry.so3_log(v.world_from_body[:3, :3])[axis])
    t = np.array(times)
    expected = 0.02 * sign * np.exp(-decay * t) * (np.cos(rate * t) + decay / rate * np.sin(rate * t))
    # Relative errors: stiffness 0.02^2 / 6 = 7e-5 (sin a against a), rate (rate step)^2 / 24 = 1e-5 (leapfrog). Over
    # 20 rad of phase this is less than 1e-3 of the amplitude, 2e-5 rad; the tolerance has a margin of 2.
    np.testing.assert_allclose(angles, expected, atol=4e-5)


def test_one_step_of_thrust_accelerates_mass_and_added_mass():
    v = vehicle()
    force = np.array([0.0, 0.0, 0.0, 10.0, -4.0, 7.0])
    v._advance(force)
    np.testing.assert_allclose(v.twist_body[3:], force[3:] / (13.5 + np.diag(ROV.added_mass)[:3]) * STEP_S, rtol=1e-12)


def test_motion_relative_to_the_water_is_the_same_in_a_steady_current_as_in_still_water():
    """Galilean invariance, for a start at the velocity of the current, with rotation and thrust."""
    current = np.array([0.4, -0.3, 0.1])
    pose = geometry.pose(geometry.rotation_from_rpy(0.3, -0.2, 0.5), np.zeros(3))
    drifting, still = vehicle(pose, current), vehicle(pose)
    drifting._velocity[:3] = current
    for _ in range(90):
        for v in (drifting, still):
            v.step(np.array([0.5, 0.1, 0.3, 0.4, 0.2, 0.1, 0.3, 0.2]), 1 / 30)
    expected = still.world_from_body
    expected[:3, 3] += 3.0 * current
    assert np.linalg.norm(still.twist_body[:3]) > 0.2
    np.testing.assert_allclose(drifting.world_from_body, expected, atol=1e-9)


def test_a_drifting_neutral_vehicle_reaches_the_velocity_of_a_steady_current():
    # Drag in sway is purely quadratic, so the velocity difference decays as (m + m_A) / (quadratic * t).
    current = np.array([0.2, 0.1, -0.1])
    v = vehicle(current_mps=current)
    v.step(IDLE, 120.0)
    velocity = v.world_from_body[:3, :3] @ v.twist_body[3:]
    np.testing.assert_allclose(velocity, current, atol=2 * (13.5 + 7.12) / 217 / 120)


def test_added_mass_and_drag_factors_scale_added_mass_and_drag():
    hull = trimmed_hull(VehicleConfig(drag_factor=2.0, added_mass_factor=3.0))
    np.testing.assert_allclose(linear_first(hull.added_inertia), 3 * ROV.added_mass)
    np.testing.assert_allclose(linear_first(hull.linear_drag), 2 * ROV.linear_drag)
    np.testing.assert_allclose(linear_first(hull.quadratic_drag), 2 * ROV.quadratic_drag)


def test_divergence_aborts_the_survey_and_reports_time_and_last_states():
    v = vehicle()
    v.step(IDLE, 0.5)
    with pytest.raises(SurveyAborted, match=r"diverged at 0\.[56].* s; last states: 0\.500 s: at \[0\.0"):
        v.step(np.full(8, np.nan), 0.5)
    fast = vehicle()
    fast._velocity[0] = 1e3
    with pytest.raises(SurveyAborted, match="diverged at 0.000 s"):
        fast.step(IDLE, STEP_S)


@pytest.mark.parametrize("rate_hz", [1, 7.5, 24, 25, 29.97, 30, 60, 100, 119, 120])
def test_a_frame_is_a_whole_number_of_physics_steps(rate_hz):
    step = physics_timestep_s(rate_hz)
    assert step <= STEP_S * (1 + 1e-9)
    assert 1 / rate_hz / step == pytest.approx(round(1 / rate_hz / step), abs=1e-9)
    v = MujocoVehicle(bare_model(step), VehicleConfig(), steady_current(np.zeros(3)), np.eye(4))
    v.step(IDLE, 1 / rate_hz)
    assert v.time_s == pytest.approx(1 / rate_hz)


@pytest.mark.parametrize("steps", [0.3, 1.5])
def test_a_fraction_of_a_physics_step_is_rejected(steps):
    for body in (vehicle(), CompiledVehicle(VehicleConfig(), steady_current(np.zeros(3)), np.eye(4), STEP_S)):
        start = body.world_from_body
        with pytest.raises(ValueError, match="not a whole number of timesteps"):
            body.step(IDLE, steps * STEP_S)
        np.testing.assert_array_equal(body.world_from_body, start)


def test_the_compiled_vehicle_moves_as_mujoco_does():
    """One minute of random commands in a current; the difference is rounding, amplified by rotation."""
    rng = np.random.default_rng(5)
    start = geometry.exp(np.array([0.1, -0.05, 0.8, 1.0, 2.0, -3.0]))
    current = np.array([0.1, -0.05, 0.02])
    compiled = CompiledVehicle(VehicleConfig(drag_factor=1.3), steady_current(current), start, 1 / 120)
    reference = vehicle(start, current, buoyancy_n=1.0, drag_factor=1.3)
    for _ in range(600):
        command = rng.uniform(-0.4, 0.4, 8)
        for body in (compiled, reference):
            body.step(command, 0.1)
    assert np.linalg.norm(reference.world_from_body[:3, 3] - start[:3, 3]) > 1.0
    np.testing.assert_allclose(compiled.world_from_body, reference.world_from_body, atol=1e-8)
    np.testing.assert_allclose(compiled.twist_body, reference.twist_body, atol=1e-8)
