"""Thrusters: from commands to thrust, with their lag."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.linalg import expm

from scenes.bluerov2 import Vehicle as Vessel
from twin.simulate.hydrodynamics import angular_first

Array = NDArray[np.float64]


@njit(cache=True, nogil=True)
def steady_thrust_n(command: Array, coefficients: Array) -> Array:
    """Thrust [N] at rest of commands in [-1, 1]: an odd polynomial, coefficients from the highest power down to u."""
    thrust = np.zeros_like(command)
    for coefficient in coefficients:  # Horner's scheme in the square
        thrust = thrust * command * command + coefficient
    return thrust * command


class LaggedThrusters:
    """The thrusters of a vessel: each follows its commanded steady thrust with the vessel's linear lag.

    The lag is discretised exactly for commands that are held over a step.

    Args:
        vessel: positions, directions, thrust curve and lag.
        timestep_s: step.
    """

    def __init__(self, vessel: Vessel, timestep_s: float):
        numerator, denominator = vessel.thruster_lag
        self._a, self._b = _held(denominator, timestep_s)
        self._c = np.zeros(len(self._a))
        self._c[-len(numerator) :] = numerator
        self._effects = angular_first(vessel.allocation)
        self._coefficients = vessel.thrust_coefficients
        self._state = np.zeros((len(self._a), self._effects.shape[1]))
        self._steady_n = np.zeros(self._effects.shape[1])

    def thrust_n(self) -> Array:
        """Thrust of each at this instant (n,)."""
        return self._c @ self._state

    def wrench(self) -> Array:
        """Their wrench on the body at this instant, [moment, force] in the body (6,) [N m, N]."""
        return self._effects @ self.thrust_n()

    def command(self, command: Array) -> None:
        """Sets commands (n,), cut to [-1, 1], for the steps that follow."""
        self._steady_n = steady_thrust_n(np.minimum(np.maximum(command, -1.0), 1.0), self._coefficients)

    def wrenches(self, n_steps: int) -> Array:
        """Their wrench at the beginning of each of the next steps (n_steps, 6), which are then over."""
        thrusts, self._state = _thrusts(self._a, self._b, self._c, self._state, self._steady_n, n_steps)
        return thrusts @ self._effects.T

    def step(self) -> None:
        """One step under the last commands."""
        self._state = self._a @ self._state + self._b * self._steady_n


@njit(cache=True, nogil=True)
def _thrusts(a, b, c, state, steady, n_steps):
    """Thrusts (n_steps, n) at the beginning of each step, and the state after them."""
    thrusts = np.empty((n_steps, state.shape[1]))
    for k in range(n_steps):
        thrusts[k] = c @ state
        state = a @ state + b * steady
    return thrusts, state


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
