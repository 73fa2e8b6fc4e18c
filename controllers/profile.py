"""Trapezoidal speed profile along a segment, from rest to rest."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property


@dataclass(frozen=True)
class SpeedProfile:
    """Trapezoidal speed profile: constant acceleration, cruise, deceleration; triangular on a short segment."""

    length_m: float  # length of the segment
    cruise_mps: float  # speed limit
    acceleration_mps2: float  # acceleration, and deceleration at the end

    @cached_property
    def peak_mps(self) -> float:
        """Returns the greatest speed on the segment [m/s]."""
        return min(self.cruise_mps, math.sqrt(self.length_m * self.acceleration_mps2))

    @cached_property
    def duration_s(self) -> float:
        """Returns the time from start to end [s]."""
        return self.length_m / self.peak_mps + self.peak_mps / self.acceleration_mps2

    def at(self, time_s: float) -> tuple[float, float, float]:
        """Returns distance [m], speed [m/s] and acceleration [m/s2] at a time since the start [s].

        The speed is 0 before the start and after the end.
        """
        duration, peak, rate = self.duration_s, self.peak_mps, self.acceleration_mps2
        if not 0 <= time_s < duration:
            return (0.0 if time_s < 0 else self.length_m), 0.0, 0.0
        ramp = peak / rate
        if time_s < ramp:
            return 0.5 * rate * time_s**2, rate * time_s, rate
        if time_s < duration - ramp:
            return peak * (time_s - 0.5 * ramp), peak, 0.0
        remaining = duration - time_s
        return self.length_m - 0.5 * rate * remaining**2, rate * remaining, -rate
