"""Thrust allocation: from a wrench on the body to the commands of its thrusters."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Allocation(NamedTuple):
    """Shares a wrench [moment, force] among n thrusters.

    Args:
        thrusts_from_wrench: (n, 6) weighted pseudo-inverse of the thrusters' effect on the body.
        command_table: (k,) commands, rising, over the part of the curve where the thrust rises with them.
        thrust_table_n: (k,) their steady thrusts [N].
    """

    thrusts_from_wrench: Array
    command_table: Array
    thrust_table_n: Array

    @property
    def range_n(self) -> tuple[float, float]:
        """Most thrust astern (negative) and ahead of one thruster [N]."""
        return float(self.thrust_table_n[0]), float(self.thrust_table_n[-1])

    def commands(self, wrench: Array) -> tuple[Array, float]:
        """Commands in [-1, 1] (n,) and the share (0, 1] of the wrench [N m, N] that the thrusters can give.

        A wrench beyond reach is scaled down as a whole: its direction is kept.
        """
        return share_out(self, wrench)


@njit(cache=True, nogil=True)
def share_out(allocation, wrench):
    """As `Allocation.commands`."""
    thrusts, table = allocation.thrusts_from_wrench @ wrench, allocation.thrust_table_n
    load = 1.0
    for thrust in thrusts:
        load = max(load, thrust / (table[-1] if thrust > 0 else table[0]))
    return np.interp(thrusts / load, table, allocation.command_table), 1 / load


def allocation(effects: Array, thrust_of_command: Callable[[Array], Array], weights: Array | None = None) -> Allocation:
    """The allocation of least weighted effort: f = W^-1 B' (B W^-1 B')^-1 tau minimises f' W f subject to B f = tau.

    Args:
        effects: B (6, n), wrench [moment, force] in the body per newton of each thruster.
        thrust_of_command: steady thrust [N] of commands in [-1, 1], rising around 0.
        weights: diagonal of W (n,): a thruster of great weight is spared; all equal where None.
    """
    eased = effects / (np.ones(effects.shape[1]) if weights is None else weights)
    inverse = eased.T @ np.linalg.inv(effects @ eased.T)
    command = np.linspace(-1, 1, 2001)
    thrust = thrust_of_command(command)
    # Fitted curves bend back just below full command: the inverse lives where the thrust still rises.
    low, high = int(np.argmin(thrust)), int(np.argmax(thrust))
    return Allocation(inverse, command[low : high + 1], thrust[low : high + 1])
