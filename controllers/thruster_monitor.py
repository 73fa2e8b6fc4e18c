"""Thruster monitor: finds thrusters whose reported thrust is not that of their commands."""

from typing import NamedTuple

import numpy as np

from twin.core.geometry import Array

_WINDOW_S = 1.0  # time constant of the means of commanded and missing thrust
_MOST_MISSING = 0.5  # greatest ratio of missing to commanded thrust (RMS) of a thruster that is used
_LEAST = 0.01  # least missing thrust (RMS) that is noticed, a share of full thrust


class LostThruster(NamedTuple):
    time_s: float  # when it was noticed
    number: int  # from 1
    missing: float  # missing / commanded thrust (RMS)


class ThrusterMonitor:
    """Compares the thrust that speed controllers (ESCs) report with that of the commands, frame by frame.

    A thruster that misses too much of its thrust is lost for the rest of the survey: without commands, nothing shows
    that it works again. The RMS are exponentially weighted over the last second; `full_n` is the full thrust of one.
    """

    def __init__(self, full_n: float, rate_hz: float):
        self._least_n2 = (_LEAST * full_n) ** 2
        self._share = 1 - np.exp(-1 / (_WINDOW_S * rate_hz))
        self._commanded_n2: Array | float = 0.0
        self._missing_n2: Array | float = 0.0
        self.lost: list[LostThruster] = []

    def add(self, time_s: float, commanded_n: Array, reported_n: Array) -> None:
        """Adds commanded and reported thrusts (n,) of a frame [N]; a thruster that is found lost joins `lost`."""
        commanded_n2 = self._commanded_n2 + self._share * (commanded_n**2 - self._commanded_n2)
        missing_n2 = self._missing_n2 + self._share * ((commanded_n - reported_n) ** 2 - self._missing_n2)
        self._commanded_n2, self._missing_n2 = commanded_n2, missing_n2
        missing = np.sqrt(missing_n2 / np.maximum(commanded_n2, self._least_n2))
        noticed = (missing > _MOST_MISSING) & (missing_n2 > self._least_n2)
        for k in np.flatnonzero(noticed).tolist():
            if all(k + 1 != one.number for one in self.lost):
                self.lost.append(LostThruster(time_s, k + 1, float(missing[k])))

    @property
    def sentences(self) -> list[str]:
        """Returns a sentence on the thrusters that were left out."""
        lost = [f"{number} at {time_s:.1f} s" for time_s, number, _ in self.lost]
        return [f"Thrusters that did not push as commanded were left out: {', '.join(lost)}."] if lost else []
