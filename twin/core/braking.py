"""Deceleration of a vehicle that has lost vision, commanded by the mission and predicted by the estimators."""

from __future__ import annotations

import math

#: If no motion has been measured for more than BLIND_S, the vehicle stops: its speed decays with the time constant
#: BRAKING_S [s].
BLIND_S, BRAKING_S = 0.5, 1.0


def braking_factor(blind_s: float, interval_s: float) -> float:
    """Returns the factor, at most 1, by which the speed is multiplied over an interval.

    Args:
        blind_s: time without a measured motion, up to the start of the interval.
        interval_s: length of the interval.
    """
    return 1.0 if blind_s <= BLIND_S else math.exp(-interval_s / BRAKING_S)
