"""The trapezoidal speed profile of a straight segment, from rest to rest."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property


@dataclass(frozen=True)
class SpeedProfile:
    """Speeds up at a constant rate, cruises, slows down at the same rate; a triangle where the segment is too short.

    Args:
        length_m: length of the segment.
        cruise_mps: speed limit.
        acceleration_mps2: rate of speeding up and slowing down.
    """

    length_m: float
    cruise_mps: float
    acceleration_mps2: float

    @cached_property
    def peak_mps(self) -> float:
        """The speed that is reached."""
        return min(self.cruise_mps, math.sqrt(self.length_m * self.acceleration_mps2))

    @cached_property
    def duration_s(self) -> float:
        return self.length_m / self.peak_mps + self.peak_mps / self.acceleration_mps2

    def at(self, time_s: float) -> tuple[float, float, float]:
        """Distance [m], speed [m/s] and acceleration [m/s2] at a time since the start; at rest before and after."""
        duration, peak, rate = self.duration_s, self.peak_mps, self.acceleration_mps2
        if not 0 <= time_s < duration:
            return (0.0 if time_s < 0 else self.length_m), 0.0, 0.0
        ramp = peak / rate
        if time_s < ramp:
            return 0.5 * rate * time_s**2, rate * time_s, rate
        if time_s < duration - ramp:
            return peak * (time_s - 0.5 * ramp), peak, 0.0
        left = duration - time_s
        return self.length_m - 0.5 * rate * left**2, rate * left, -rate
