"""Thrusters: from commands to thrust, with their lag."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.linalg import expm

from scenes.bluerov2 import Vehicle as Vessel
from twin.core import geometry
from twin.simulate.hydrodynamics import angular_first

Array = NDArray[np.float64]


@njit(cache=True, nogil=True)
def steady_thrust_n(command: Array, coefficients: Array) -> Array:
    """Thrust [N] at rest of commands in [-1, 1]: an odd polynomial, coefficients from the highest power down to u."""
    thrust = np.zeros_like(command)
    for coefficient in coefficients:  # Horner's scheme in the square
        thrust = thrust * command * command + coefficient
    return thrust * command


class Thrusters(NamedTuple):
    """Thrusters that follow their commands with a linear lag, for a fixed step.

    Args:
        a, b, c: (m, m), (m, 1), (m,) step of the lag, its input and its output.
        effects: (6, n) wrench [moment, force] in the body per newton of each.
        coefficients: of the thrust curve.
        state: (m, n) of the lag, changed in place.
        steady_n: (n,) thrust that the last command leads to, changed in place.
    """

    a: Array
    b: Array
    c: Array
    effects: Array
    coefficients: Array
    state: Array
    steady_n: Array


class LaggedThrusters:
    """The thrusters of a vessel: each follows its commanded steady thrust with the vessel's linear lag.

    The lag is discretised exactly for commands that are held over a step.

    Args:
        vessel: positions, directions, thrust curve and lag.
        timestep_s: step.
    """

    def __init__(self, vessel: Vessel, timestep_s: float):
        numerator, denominator = vessel.thruster_lag
        a, b = _held(denominator, timestep_s)
        c = np.zeros(len(a))
        c[-len(numerator) :] = numerator
        effects = angular_first(vessel.allocation)
        n = effects.shape[1]
        self.parts = Thrusters(
            a, b, c, effects, np.array(vessel.thrust_coefficients, float), np.zeros((len(a), n)), np.zeros(n)
        )

    def thrust_n(self) -> Array:
        """Thrust of each at this instant (n,)."""
        return self.parts.c @ self.parts.state

    def wrench(self) -> Array:
        """Their wrench on the body at this instant, [moment, force] in the body (6,) [N m, N]."""
        return wrench_of(self.parts)

    def command(self, command: Array) -> None:
        """Sets commands (n,), cut to [-1, 1], for the steps that follow."""
        set_command(self.parts, command)

    def step(self) -> None:
        """One step under the last commands."""
        pass_step(self.parts)


@njit(cache=True, nogil=True)
def set_command(thrusters, command):
    """As `LaggedThrusters.command`."""
    cut = np.minimum(np.maximum(command, -1.0), 1.0)
    geometry.put(thrusters.steady_n, steady_thrust_n(cut, thrusters.coefficients))


@njit(cache=True, nogil=True)
def pass_step(thrusters):
    """As `LaggedThrusters.step`."""
    before, order = thrusters.state.copy(), len(thrusters.a)
    for i in range(order):
        for n in range(thrusters.state.shape[1]):
            thrusters.state[i, n] = thrusters.b[i, 0] * thrusters.steady_n[n]
            for k in range(order):
                thrusters.state[i, n] += thrusters.a[i, k] * before[k, n]


@njit(cache=True, nogil=True)
def wrench_of(thrusters):
    """As `LaggedThrusters.wrench`."""
    wrench = np.zeros(6)
    for n in range(thrusters.state.shape[1]):
        thrust = 0.0
        for k in range(len(thrusters.c)):
            thrust += thrusters.c[k] * thrusters.state[k, n]
        for i in range(6):
            wrench[i] += thrusters.effects[i, n] * thrust
    return wrench


def _held(denominator: Array, timestep_s: float) -> tuple[Array, Array]:
    """Controllable canonical form of 1 / denominator (leading coefficient 1), exact for inputs held over a step.

    exp([[A, B], [0, 0]] dt) holds both matrices of the step (Van Loan 1978). (n + 1,) -> (n, n), (n, 1).
    """
    n = len(denominator) - 1
    rates = np.zeros((n + 1, n + 1))
    rates[0, :n], rates[0, n] = -denominator[1:], 1.0
    rates[1:n, : n - 1] = np.eye(n - 1)
    step = np.asarray(expm(rates * timestep_s), dtype=np.float64)
    return step[:n, :n].copy(), step[:n, n:].copy()
