"""Thrust allocation: converts a wrench on the body to thruster commands."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from twin.core.geometry import Array
from twin.kernels import kernel


class ThrustAllocation(NamedTuple):
    thrusts_from_wrench: Array  # (n, 6) weighted pseudo-inverse of the thrust configuration matrix
    command_table: Array  # (k,) increasing commands, over the range in which thrust increases with the command
    thrust_table_n: Array  # (k,) steady thrust at the commands of `command_table` [N]

    def commands(self, wrench: Array) -> tuple[Array, float]:
        """Returns the commands (n,) in [-1, 1] for a wrench (6,) [moment, force] in the body [N m, N], and its factor.

        A wrench that would saturate a thruster is scaled down by a factor in (0, 1]; its direction is kept.
        """
        return allocate_wrench(self, wrench)


@kernel
def allocate_wrench(allocation, wrench):
    thrusts, table = allocation.thrusts_from_wrench @ wrench, allocation.thrust_table_n
    load = 1.0
    for thrust in thrusts:
        load = max(load, thrust / (table[-1] if thrust > 0 else table[0]))
    return np.interp(thrusts / load, table, allocation.command_table), 1 / load


def pseudo_inverse_allocation(configuration: Array, thrust_of_command: Callable[[Array], Array]) -> ThrustAllocation:
    """Returns the allocation by the pseudo-inverse of the thrust configuration matrix.

    The thrusts f = B' (B B')^-1 tau minimise f' f subject to B f = tau (Fossen 2011, section 12.3). Where the thrusters
    cannot produce all wrenches, they produce the part of tau that they can (generalised inverse). B (6, n) is the
    wrench [moment, force] in the body per newton of thrust; `thrust_of_command` returns the steady thrust [N] at
    commands in [-1, 1], increasing around 0.
    """
    square = configuration @ configuration.T
    is_full = np.linalg.matrix_rank(configuration) == 6
    inverse = configuration.T @ (np.linalg.inv(square) if is_full else np.linalg.pinv(square))
    command = np.linspace(-1, 1, 2001)
    thrust = thrust_of_command(command)
    # The fitted thrust curve decreases near full command: only its increasing part can be inverted.
    low, high = int(np.argmin(thrust)), int(np.argmax(thrust))
    return ThrustAllocation(inverse, command[low : high + 1], thrust[low : high + 1])
