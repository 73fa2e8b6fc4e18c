"""Pace of the vehicle along its planned path: full, or slowed down to a stop, as a time scaling of the reference."""

from typing import NamedTuple

import numpy as np

from twin.controllers.segments import Reference
from twin.core.geometry import Array

SAME_TIME_S = 1e-9  #: times that differ by less are treated as equal


class Pace(NamedTuple):
    """Pace along the path. The path time s, at which the plan is evaluated, advances by ds/dt = rate."""

    rate: float = 1.0  #: derivative ds/dt of the path time, 0 to 1; 1 is the planned speed
    change_per_s: float = 0.0  #: derivative of the rate
    keyframe: bool = False  #: whether the next frame is a keyframe in addition to the planned ones

    def path_times(self, last_s: float, end_s: float, interval_s: float) -> Array:
        """Returns the path times (n,) of the next frames [s]: one or, at the planned speed, all to the last, `end_s`.

        Empty if the frame at `last_s`, the last one flown, is the last of the track.
        """
        n_full = int(np.ceil((end_s - last_s - SAME_TIME_S) / interval_s))
        n = n_full if self.rate == 1 and not self.change_per_s else min(n_full, 1)
        return np.minimum(last_s + self.rate * interval_s * np.arange(1, n + 1), end_s)

    def scaled(self, reference: Reference) -> Reference:
        """Returns a reference x(s) with time derivatives: dx/dt = r x', d2x/dt2 = r^2 x'' + (dr/dt) x', r = rate."""
        return reference._replace(
            velocity=self.rate * reference.velocity,
            acceleration=self.rate**2 * reference.acceleration + self.change_per_s * reference.velocity,
        )


FULL = Pace()
