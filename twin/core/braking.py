"""How a vehicle without vision stops: an agreement between the estimators, which predict it, and the mission."""

from __future__ import annotations

import math

#: A vehicle that has measured no motion for BLIND_S brakes; its speed decays with the time constant BRAKING_S [s].
BLIND_S, BRAKING_S = 0.5, 1.0


def braking_factor(blind_s: float, interval_s: float) -> float:
    """Returns the factor by which the speed decreases in an interval [s], after a time without a measurement [s]."""
    return 1.0 if blind_s <= BLIND_S else math.exp(-interval_s / BRAKING_S)
