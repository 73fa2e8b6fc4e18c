"""Transition of the path to other heights or another offset."""

from typing import NamedTuple

import numpy as np

from twin.controllers.segments import Reference
from twin.core.geometry import Array

_RATE_RADPS = 1.5  #: rate at which the difference of the paths decays, about the bandwidth of the controller


class PathChange(NamedTuple):
    """Transition from the last path to a new one, without a step of position or velocity; arrays are (3,)."""

    left_m: Array  #: last minus new position at its start
    rate_mps: Array  #: last minus new velocity there
    start: int  #: frame at which it starts
    offset_m: Array = np.zeros(3)  #: offset of the new path from the planned one

    def at(self, first: int, n: int, rate_hz: float) -> tuple[Array, Array, Array]:
        """Returns what is left (n, 3) of the difference and its two derivatives at n frames from number `first` on."""
        w, t = _RATE_RADPS, ((first - self.start + np.arange(n)) / rate_hz)[:, None]
        slope, decay = self.rate_mps + w * self.left_m, np.exp(-w * t)
        left = (self.left_m + slope * t) * decay
        rate = slope * decay - w * left
        return left, rate, -w * (slope * decay + rate)

    def added_to(self, reference: Reference, first: int, rate_hz: float) -> Reference:
        """Returns the references of consecutive frames, of which the first has the number `first`."""
        left, rate, acceleration = self.at(first, len(reference.position), rate_hz)
        return reference._replace(
            position=reference.position + left + self.offset_m,
            velocity=reference.velocity + rate,
            acceleration=reference.acceleration + acceleration,
        )
