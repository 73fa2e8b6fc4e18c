"""Transition of the path from the heights of one surface to those of another."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from twin.controllers.segments import Reference

_RATE_RADPS = 1.5  #: rate at which the difference of the heights decays, about the bandwidth of the controller


class HeightChange(NamedTuple):
    """Transition from the last heights of a path to new ones, without a step of height or vertical velocity."""

    offset_m: float  #: last minus new height at its start
    rate_mps: float  #: last minus new vertical velocity there
    start: int  #: frame at which it starts

    def added_to(self, reference: Reference, first: int, rate_hz: float) -> Reference:
        """Returns the references of consecutive frames, of which the first has the number `first`."""
        w, t = _RATE_RADPS, (first - self.start + np.arange(len(reference.position))) / rate_hz
        slope, decay = self.rate_mps + w * self.offset_m, np.exp(-w * t)
        height = (self.offset_m + slope * t) * decay
        velocity = slope * decay - w * height
        acceleration = -w * (slope * decay + velocity)
        up = np.array([0.0, 0.0, 1.0])
        return reference._replace(
            position=reference.position + np.outer(height, up),
            velocity=reference.velocity + np.outer(velocity, up),
            acceleration=reference.acceleration + np.outer(acceleration, up),
        )
