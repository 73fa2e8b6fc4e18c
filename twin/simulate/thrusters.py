"""Thruster model: steady thrust as a function of the command, and linear lag."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.linalg import expm

from twin.core import geometry
from twin.core.geometry import Array
from twin.kernels import kernel
from twin.scenes.bluerov2 import VehicleParameters
from twin.simulate.hydrodynamics import angular_first


@kernel
def steady_thrust_n(command: Array, coefficients: Array) -> Array:
    """Returns the steady thrust (n,) [N] of a thruster at rest in the water for commands u in [-1, 1].

    Args:
        command: (n,) commands.
        coefficients: coefficients of the odd polynomial in u, from the highest power down to u.
    """
    thrust = np.zeros_like(command)
    for coefficient in coefficients:  # Horner's scheme in u^2
        thrust = thrust * command * command + coefficient
    return thrust * command


class ThrusterState(NamedTuple):
    """State and parameters of n thrusters with a linear lag, discretised for a fixed timestep.

    Args:
        a, b, c: (m, m), (m, 1), (m,) discrete state-space model of the lag, of order m: transition, input and output.
        configuration: (6, n) wrench [moment, force] in body axes per newton of thrust of each thruster.
        coefficients: coefficients of the thrust curve, as in `steady_thrust_n`.
        lag_state: (m, n) state of the lag, modified in place.
        steady_n: (n,) steady thrust of the last command, modified in place.
    """

    a: Array
    b: Array
    c: Array
    configuration: Array
    coefficients: Array
    lag_state: Array
    steady_n: Array


class LaggedThrusters:
    """Thrusters of a vehicle; the thrust of each follows the steady thrust of its command with a linear lag.

    The lag is discretised exactly for commands that are constant over a timestep (zero-order hold).

    Args:
        vehicle: thruster positions and directions, thrust curve and lag.
        timestep_s: physics timestep.
    """

    def __init__(self, vehicle: VehicleParameters, timestep_s: float):
        numerator, denominator = vehicle.thruster_lag
        a, b = _zero_order_hold(denominator, timestep_s)
        c = np.zeros(len(a))
        c[-len(numerator) :] = numerator
        configuration = angular_first(vehicle.thrust_configuration)
        n, coefficients = configuration.shape[1], np.array(vehicle.thrust_coefficients, float)
        self.state = ThrusterState(a, b, c, configuration, coefficients, np.zeros((len(a), n)), np.zeros(n))

    def wrench(self) -> Array:
        """Returns the current total wrench of the thrusters (6,), [moment, force] in body axes [N m, N]."""
        return thruster_wrench(self.state)

    def command(self, command: Array) -> None:
        """Sets the commands (n,), clipped to [-1, 1], for the following steps."""
        set_thruster_command(self.state, command)

    def step(self) -> None:
        """Advances the thrusts by one timestep under the last commands."""
        step_thrusters(self.state)


@kernel
def set_thruster_command(thrusters, command):
    """Compiled kernel of `LaggedThrusters.command`."""
    clipped = np.minimum(np.maximum(command, -1.0), 1.0)
    geometry.copy_into(thrusters.steady_n, steady_thrust_n(clipped, thrusters.coefficients))


@kernel
def step_thrusters(thrusters):
    """Compiled kernel of `LaggedThrusters.step`."""
    previous, order = thrusters.lag_state.copy(), len(thrusters.a)
    for i in range(order):
        for n in range(thrusters.lag_state.shape[1]):
            thrusters.lag_state[i, n] = thrusters.b[i, 0] * thrusters.steady_n[n]
            for k in range(order):
                thrusters.lag_state[i, n] += thrusters.a[i, k] * previous[k, n]


@kernel
def thruster_wrench(thrusters):
    """Compiled kernel of `LaggedThrusters.wrench`."""
    wrench = np.zeros(6)
    for n in range(thrusters.lag_state.shape[1]):
        thrust = 0.0
        for k in range(len(thrusters.c)):
            thrust += thrusters.c[k] * thrusters.lag_state[k, n]
        for i in range(6):
            wrench[i] += thrusters.configuration[i, n] * thrust
    return wrench


def _zero_order_hold(denominator: Array, timestep_s: float) -> tuple[Array, Array]:
    """Returns the discrete state-space form of the transfer function 1 / denominator.

    The input is constant over a timestep dt.

    With A and B the matrices of its controllable canonical form in continuous time, the first n rows of
    exp([[A, B], [0, 0]] dt) are the discrete matrices (Van Loan 1978).
    """
    n = len(denominator) - 1
    rates = np.zeros((n + 1, n + 1))
    rates[0, :n], rates[0, n] = -denominator[1:], 1.0
    rates[1:n, : n - 1] = np.eye(n - 1)
    step = np.asarray(expm(rates * timestep_s), dtype=np.float64)
    return step[:n, :n].copy(), step[:n, n:].copy()
