"""Thruster model: steady thrust as a function of the command, and linear lag."""

from typing import NamedTuple

import numpy as np
from scipy.linalg import expm

from twin.core import geometry
from twin.core.geometry import Array
from twin.kernels import kernel
from twin.simulate.hydrodynamics import angular_first
from twin.simulate.parameters import VehicleParameters


@kernel
def steady_thrust_n(command: Array, coefficients: Array, table: Array) -> Array:
    """Returns the thrust (n,) [N] at rest for commands u (n,) in [-1, 1].

    It is interpolated in `table` (2, m), commands and thrusts, or, if m = 0, an odd polynomial (highest power first).
    """
    if table.shape[1]:
        return np.interp(command, table[0], table[1])
    thrust = np.zeros_like(command)
    for coefficient in coefficients:  # Horner's scheme in u^2
        thrust = thrust * command * command + coefficient
    return thrust * command


class ThrusterState(NamedTuple):
    """State and parameters of n thrusters with a linear lag, discretised for a fixed timestep."""

    #: a, b, c: (m, m), (m, 1), (m,) discrete state-space model of the lag, of order m: transition, input and output.
    a: Array
    b: Array
    c: Array
    configuration: Array  #: (6, n) wrench [moment, force] in body axes per newton of thrust of each thruster
    coefficients: Array  #: coefficients of the thrust curve, as in `steady_thrust_n`
    table: Array  #: (2, m) table of the thrust curve, as in `steady_thrust_n`
    lag_state: Array  #: (m, n) state of the lag, modified in place
    steady_n: Array  #: (n,) steady thrust of the last command, modified in place
    factors: Array  #: (n,) on the steady thrusts, modified in place; 1 without faults


def lagged_thrusters(vehicle: VehicleParameters, timestep_s: float) -> ThrusterState:
    """Returns thrusters at rest that follow their steady thrust with a linear lag, exact for a zero-order hold."""
    numerator, denominator = vehicle.thruster_lag
    a, b = _zero_order_hold(denominator, timestep_s)
    c = np.zeros(len(a))
    c[-len(numerator) :] = numerator
    configuration = angular_first(vehicle.thrust_configuration)
    n, curve = configuration.shape[1], (vehicle.thrust_coefficients, vehicle.thrust_table)
    return ThrusterState(a, b, c, configuration, *curve, np.zeros((len(a), n)), np.zeros(n), np.ones(n))


@kernel
def command_thrusters(thrusters, command):
    """Sets the commands (n,), clipped to [-1, 1], for the following steps."""
    clipped = np.minimum(np.maximum(command, -1.0), 1.0)
    steady_n = thrusters.factors * steady_thrust_n(clipped, thrusters.coefficients, thrusters.table)
    geometry.copy_into(thrusters.steady_n, steady_n)


@kernel
def step_thrusters(thrusters):
    previous, order = thrusters.lag_state.copy(), len(thrusters.a)
    for i in range(order):
        for n in range(thrusters.lag_state.shape[1]):
            thrusters.lag_state[i, n] = thrusters.b[i, 0] * thrusters.steady_n[n]
            for k in range(order):
                thrusters.lag_state[i, n] += thrusters.a[i, k] * previous[k, n]


@kernel
def thruster_wrench(thrusters):
    """Returns the current total wrench of the thrusters (6,), [moment, force] in body axes [N m, N]."""
    wrench = np.zeros(6)
    for n in range(thrusters.lag_state.shape[1]):
        thrust = 0.0
        for k in range(len(thrusters.c)):
            thrust += thrusters.c[k] * thrusters.lag_state[k, n]
        for i in range(6):
            wrench[i] += thrusters.configuration[i, n] * thrust
    return wrench


def _zero_order_hold(denominator: Array, timestep_s: float) -> tuple[Array, Array]:
    """Returns the discrete matrices of 1 / denominator for an input that is constant over a timestep dt."""
    # the first n rows of exp([[A, B], [0, 0]] dt), in controllable canonical form (Van Loan 1978)
    n = len(denominator) - 1
    rates = np.zeros((n + 1, n + 1))
    rates[0, :n], rates[0, n] = -denominator[1:], 1.0
    rates[1:n, : n - 1] = np.eye(n - 1)
    step = np.asarray(expm(rates * timestep_s), dtype=np.float64)
    return step[:n, :n].copy(), step[:n, n:].copy()
