"""Parameters of a vehicle as arrays, from the section [vehicle] of a scenario."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from twin.core.geometry import Array
from twin.scenario.model import VehicleConfig


class VehicleParameters(NamedTuple):
    """Rigid body, hydrodynamics and thrusters of a vehicle, see `VehicleConfig`; linear parts are first."""

    mass_kg: float
    inertia_kgm2: Array  #: (3,)
    centre_of_buoyancy_m: Array  #: (3,)
    added_mass: Array  #: (6, 6)
    linear_drag: Array  #: (6, 6)
    quadratic_drag: Array  #: (6, 6)
    drag_centre_m: Array  #: (3,)
    #: (6, n) wrench [force, moment] about the centre of gravity per newton of thrust of each thruster
    thrust_configuration: Array
    thrust_coefficients: Array  #: (k,) of the odd polynomial, see `thrusters.steady_thrust_n`
    thrust_table: Array  #: (2, m) commands and thrusts [N]; (2, 0): the polynomial holds
    #: numerator and denominator of the transfer function from steady to actual thrust
    thruster_lag: tuple[Array, Array]
    half_size_m: Array  #: (3,) half the sides of the hull's box
    hull_centre_m: Array  #: (3,)


def parameters_of(vehicle: VehicleConfig) -> VehicleParameters:
    positions = np.array([thruster.position_m for thruster in vehicle.thrusters], float)
    along = np.array([thruster.direction for thruster in vehicle.thrusters], float)
    directions = along * np.sqrt(1 / (along**2).sum(axis=1, keepdims=True))
    numerator, denominator = (np.array(part, float) for part in vehicle.thruster_lag)
    table = np.array(vehicle.thrust_table, float).reshape(-1, 2).T
    if vehicle.voltage_v is not None:
        table = thrust_and_power(vehicle, vehicle.voltage_v)[:2]
    return VehicleParameters(
        mass_kg=vehicle.mass_kg, inertia_kgm2=np.array(vehicle.inertia_kgm2),
        centre_of_buoyancy_m=np.array(vehicle.centre_of_buoyancy_m, float),
        added_mass=_matrix(vehicle.added_mass, vehicle.added_mass_matrix),
        linear_drag=_matrix(vehicle.linear_drag, vehicle.linear_drag_matrix),
        quadratic_drag=_matrix(vehicle.quadratic_drag, vehicle.quadratic_drag_matrix),
        drag_centre_m=np.array(vehicle.drag_centre_m, float),
        thrust_configuration=np.vstack([directions.T, np.cross(positions, directions).T]),
        thrust_coefficients=np.array(vehicle.thrust_coefficients, float), thrust_table=table.copy(),
        thruster_lag=(numerator / denominator[0], denominator / denominator[0]),
        half_size_m=np.array(vehicle.size_m) / 2, hull_centre_m=np.array(vehicle.hull_centre_m, float),
    )  # fmt: skip


def thrust_and_power(vehicle: VehicleConfig, voltage_v: float) -> Array:
    """Returns commands, thrusts [N] and powers [W] (3, m) of a thruster: linear between the voltages of its curves."""
    tables = [np.array(curve.table).T for curve in vehicle.thrust_curves]
    voltages = [curve.voltage_v for curve in vehicle.thrust_curves]
    command = np.unique(np.concatenate([table[0] for table in tables]))
    weights = [np.interp(voltage_v, voltages, unit) for unit in np.eye(len(tables))]
    at_commands = [[np.interp(command, table[0], row) for row in table[1:]] for table in tables]
    return np.vstack([command, np.tensordot(weights, at_commands, axes=1)])


def _matrix(diagonal: Sequence[float], full: Sequence[Sequence[float]] | None) -> Array:
    return np.diag(diagonal) if full is None else np.array(full, float)


def moves_along_all_axes(vehicle: VehicleConfig, lost: Sequence[int] = ()) -> bool:
    """Returns whether thrusters, without those `lost` (indices), push along each axis and turn about the vertical."""
    surge, sway, heave, _, _, yaw = range(6)
    left = np.delete(parameters_of(vehicle).thrust_configuration, lost, axis=1)
    return np.linalg.matrix_rank(left[[surge, sway, heave, yaw]]) == 4
