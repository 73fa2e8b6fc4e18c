"""Pose controller, top speed and thruster loads of a vehicle.

The controller is designed with the parameters of the vehicle and ignores the drag and added-mass factors of the
scenario, which therefore act as model errors. The top speed includes the drag factor, the loads include both factors.
"""

from collections.abc import Sequence

import numpy as np

from twin.controllers.allocation import ThrustAllocation, pseudo_inverse_allocation
from twin.controllers.current_estimate import unknown_current
from twin.controllers.tracking import ControllerState, HullModel, feedforward_wrench, pole_placement_gains
from twin.core.geometry import Array
from twin.scenario.model import VehicleConfig
from twin.simulate.hull import trimmed_hull
from twin.simulate.hydrodynamics import Hull, angular_first
from twin.simulate.parameters import VehicleParameters, parameters_of
from twin.simulate.thrusters import steady_thrust_n


def nominal_controller(
    vehicle: VehicleConfig, natural_frequency_radps: float, frame_rate_hz: float, velocity_lag_s: float = 0.0
) -> ControllerState:
    """Returns a controller of this frequency in position, with a command per frame and a lag of the velocity [s]."""
    rov, lag_s = parameters_of(vehicle), velocity_lag_s + thruster_lag_s(vehicle)
    model = _controller_model(trimmed_hull(vehicle.model_copy(update={"drag_factor": 1.0, "added_mass_factor": 1.0})))
    gains = pole_placement_gains(natural_frequency_radps)
    return ControllerState(model, _allocation(rov), gains, 1 / frame_rate_hz, lag_s, np.zeros(6), unknown_current())


def thruster_lag_s(vehicle: VehicleConfig) -> float:
    """Returns the mean time by which the thrust lags behind its steady value."""
    numerator, denominator = parameters_of(vehicle).thruster_lag
    lead_s = numerator[-2] / numerator[-1] if len(numerator) > 1 else 0.0
    return float(denominator[-2] / denominator[-1] - lead_s)


def top_speed_mps(vehicle: VehicleConfig, direction: Array) -> float:
    """Returns the speed in still water along a direction (3,) in the body at which the first thruster saturates [m/s].

    Drag along each axis is a u + b u |u|, so that each thruster needs the thrust p v + q v^2 at the speed v; p and q
    follow from the thrust allocation. The Munk moment and the net buoyancy are neglected.
    """
    hull, rov = trimmed_hull(vehicle), parameters_of(vehicle)
    thrusts_from_force, full_n = _allocation(rov).thrusts_from_wrench[:, 3:], full_thrust_n(vehicle)
    linear = hull.linear_drag[3:, 3:] @ direction
    quadratic = hull.quadratic_drag[3:, 3:] @ (np.abs(direction) * direction)
    coefficients = zip(thrusts_from_force @ quadratic, thrusts_from_force @ linear, strict=True)
    roots = np.concatenate([np.roots([q, p, sign * full_n]) for q, p in coefficients for sign in (-1, 1)])
    real = roots[np.isreal(roots)].real
    return float(real[real > 0].min(initial=np.inf))


def thrust_loads(vehicle: VehicleConfig, velocities: Array, pulls: Array | float = 0.0) -> Array:
    """Returns the largest thrust (n,) / full thrust at steady velocities (n, 3) [m/s]; see `steady_thrusts_n`."""
    thrusts = steady_thrusts_n(vehicle, velocities, pulls)
    return np.abs(thrusts).max(axis=1, initial=0.0) / full_thrust_n(vehicle)


def full_force_n(vehicle: VehicleConfig, direction: Array) -> float:
    """Returns the force along a direction (3,) in the body at which the first thruster saturates [N]."""
    rov = parameters_of(vehicle)
    per_newton = _allocation(rov).thrusts_from_wrench[:, 3:] @ direction
    return full_thrust_n(vehicle) / float(np.abs(per_newton).max())


def steady_thrusts_n(vehicle: VehicleConfig, velocities: Array, pulls: Array | float = 0.0) -> Array:
    """Returns the thrusts (n, k) [N] of a level vehicle at steady velocities (n, 3) through the water, in the body.

    The thrusters balance drag, the Munk moment in yaw, the net buoyancy, and the wrenches `pulls` (n, 6) of a tether;
    the righting moment balances roll and pitch.
    """
    hull, rov = trimmed_hull(vehicle), parameters_of(vehicle)
    model = _controller_model(hull)
    wrenches = np.array([feedforward_wrench(model, np.asarray(v, np.float64)) for v in velocities]).reshape(-1, 6)
    wrenches -= pulls
    wrenches[:, :2] = 0.0
    wrenches[:, 5] += hull.weight_n - hull.buoyancy_n
    return np.asarray(wrenches @ _allocation(rov).thrusts_from_wrench.T, np.float64)


def _controller_model(hull: Hull) -> HullModel:
    matrices = hull.added_inertia, hull.linear_drag, hull.quadratic_drag
    added, linear, quadratic = (np.diagonal(matrix).copy() for matrix in matrices)
    return HullModel(hull.inertia + added, added[3:], linear, quadratic, hull.drag_centre_m)


def allocation_without(vehicle: VehicleConfig, lost: Sequence[int]) -> ThrustAllocation:
    """Returns the allocation that leaves out the thrusters with these indices, whose commands are then 0."""
    rov = parameters_of(vehicle)
    configuration = rov.thrust_configuration.copy()
    configuration[:, lost] = 0.0
    return _allocation(rov._replace(thrust_configuration=configuration))


def commanded_thrusts_n(vehicle: VehicleConfig, command: Array) -> Array:
    """Returns the steady thrusts (n,) of commands (n,), which the thrusters limit to [-1, 1] [N]."""
    return _thrust_n(parameters_of(vehicle), np.clip(command, -1.0, 1.0))


def _allocation(rov: VehicleParameters) -> ThrustAllocation:
    return pseudo_inverse_allocation(angular_first(rov.thrust_configuration), lambda command: _thrust_n(rov, command))


def full_thrust_n(vehicle: VehicleConfig) -> float:
    """Returns the full thrust of a thruster: the smaller of the greatest thrusts forwards and backwards [N]."""
    return float(np.abs(_thrust_n(parameters_of(vehicle), np.array([-1.0, 1.0]))).min())


def _thrust_n(rov: VehicleParameters, command: Array) -> Array:
    return steady_thrust_n(command, rov.thrust_coefficients, rov.thrust_table)
