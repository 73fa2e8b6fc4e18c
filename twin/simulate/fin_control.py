"""Design of the autopilot of a vehicle that is steered by fins: linear-quadratic regulator about its trim."""

from __future__ import annotations

import numpy as np
from scipy.linalg import solve_continuous_are

from twin.controllers.fin_autopilot import FinAutopilot, TrimTable
from twin.core import geometry
from twin.core.geometry import Array
from twin.scenario.model import VehicleConfig
from twin.simulate.autopilot import full_force_n
from twin.simulate.fins import add_fins, fins_of
from twin.simulate.hull import trimmed_hull
from twin.simulate.hydrodynamics import acceleration, angular_first
from twin.simulate.parameters import parameters_of
from twin.simulate.steady_flight import Trim, trim, turning_radius_m

#: Deviations that cost the same (Bryson's rule): position along, across, up [m], roll, pitch, yaw [rad], twist (of
#: which only the yaw rate costs [rad/s]), integrals of the position [m s]; inputs as shares of their greatest values.
_DEVIATIONS = np.array([1.0, 0.2, 0.2, np.inf, 0.3, 0.15, *[np.inf] * 2, 0.3, *[np.inf] * 3, 5.0, 2.0, 1.5])
_INPUT_SHARE = 0.5
_N_CURVATURES = 9  # of the table of trims
_BEYOND = 1.5  # greatest curvature of the table, in curvatures of the planned turns
_STEP = 1e-5  # of the numerical derivatives


def fin_autopilot(vehicle: VehicleConfig, speed_mps: float, frame_rate_hz: float) -> FinAutopilot:
    """Returns the autopilot for a cruise speed, designed without the factors on drag and added mass."""
    nominal = vehicle.model_copy(update={"drag_factor": 1.0, "added_mass_factor": 1.0})
    straight = trim(nominal, speed_mps)
    assert straight is not None  # `check_speed`
    most = np.array([full_force_n(nominal, np.array([1.0, 0.0, 0.0]))] * len(vehicle.thrusters))
    fins = fins_of(nominal, 1.0)
    most = np.concatenate([most, fins.max_rad[fins.max_rad > 0]])
    gains = _regulator(nominal, straight, speed_mps, most)
    return FinAutopilot(_table(nominal, speed_mps), gains, most, speed_mps, 1 / frame_rate_hz)


def _table(vehicle: VehicleConfig, speed_mps: float) -> TrimTable:
    most = _BEYOND / turning_radius_m(vehicle, speed_mps)
    tried = [(k, trim(vehicle, speed_mps, k)) for k in np.linspace(-most, most, _N_CURVATURES)]
    found = [(k, motion) for k, motion in tried if motion is not None]
    attitudes = [[motion.roll, motion.pitch, motion.yaw_from_course] for _, motion in found]
    twists, inputs = [motion.twist for _, motion in found], [_inputs(vehicle, motion) for _, motion in found]
    return TrimTable(np.array([k for k, _ in found]), np.array(attitudes), np.array(twists), np.array(inputs))


def _inputs(vehicle: VehicleConfig, motion: Trim) -> Array:
    movable = [fin.max_deg > 0 for fin in vehicle.fins]
    return np.concatenate([[motion.thrust_n] * len(vehicle.thrusters), motion.angles_rad[movable]])


def _regulator(vehicle: VehicleConfig, straight: Trim, speed_mps: float, most: Array) -> Array:
    """Returns the gains (n, 15) that minimise the integral of the squared deviations from straight flight."""
    state = np.concatenate([np.zeros(3), [straight.roll, straight.pitch, straight.yaw_from_course], straight.twist])
    inputs = _inputs(vehicle, straight)
    rates = lambda x, u: _rates(vehicle, speed_mps, x, u)  # noqa: E731
    a, b = np.zeros((15, 15)), np.zeros((15, len(inputs)))
    for k, step in enumerate(_STEP * np.eye(12)):
        a[:12, k] = (rates(state + step, inputs) - rates(state - step, inputs)) / (2 * _STEP)
    for k, step in enumerate(_STEP * np.eye(len(inputs))):
        b[:12, k] = (rates(state, inputs + step) - rates(state, inputs - step)) / (2 * _STEP)
    a[12:, :3] = np.eye(3)
    cost, effort = np.diag(1 / _DEVIATIONS**2), np.diag(1 / (_INPUT_SHARE * most) ** 2)
    solution = solve_continuous_are(a, b, cost, effort)
    return np.asarray(np.linalg.solve(effort, b.T @ solution), np.float64)


def _rates(vehicle: VehicleConfig, speed_mps: float, state: Array, inputs: Array) -> Array:
    """Returns the rates (12,) of position along, left of and above the course, roll, pitch, yaw and twist."""
    hull, fins, n = trimmed_hull(vehicle), fins_of(vehicle, 1.0), len(vehicle.thrusters)
    angles = np.zeros(len(fins.max_rad))
    angles[fins.max_rad > 0] = inputs[n:]
    rotation, twist = geometry.rotation_from_rpy(*state[3:6]), state[6:]
    wrench = angular_first(parameters_of(vehicle).thrust_configuration) @ inputs[:n]
    add_fins(wrench, fins._replace(angle_rad=angles), twist)
    s, c, t = np.sin(state[3]), np.cos(state[3]), np.tan(state[4])
    euler = np.array([[1, s * t, c * t], [0, c, -s], [0, s / np.cos(state[4]), c / np.cos(state[4])]])
    moved = rotation @ twist[3:] - [speed_mps, 0.0, 0.0]
    return np.concatenate([moved, euler @ twist[:3], acceleration(hull, rotation, twist, np.zeros((5, 3)), wrench)])
