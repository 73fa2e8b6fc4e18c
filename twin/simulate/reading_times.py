"""When readings are taken, and when they arrive."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twin.core.records import Readings

_FIELDS = {"pressure": "pressure_z_m", "ahrs": "ahrs_rpy_rad", "usbl": "usbl_m"}
_ROUNDING = 1e-9  # of times, relative to an interval


def is_due(rate_hz: float, frames: NDArray[np.int64], frame_rate_hz: float) -> NDArray[np.bool_]:
    """Returns for frames (n,), numbered from 0, whether a reading is due since the previous frame."""
    n_readings = np.floor(np.stack([frames - 1, frames]) * (rate_hz / frame_rate_hz) + _ROUNDING)
    return (n_readings[1] > n_readings[0]) | (frames == 0)


class Delays:
    """Readings on their way from the sensors to the estimators; `delays_s` has the sensors with a delay."""

    def __init__(self, delays_s: Mapping[str, float]):
        self._delays = [(_FIELDS[name], delay_s) for name, delay_s in delays_s.items()]
        self._waiting: list[tuple[float, float, str, Any]] = []  # time of arrival, time of measurement, field, value

    def deliver(self, time_s: float, readings: Readings) -> Readings:
        """Takes the readings measured at a time, later than the last one, and returns those that have arrived by it."""
        for field, delay_s in self._delays:
            if (value := getattr(readings, field)) is not None:
                self._waiting.append((time_s + delay_s, time_s, field, value))
                readings = replace(readings, **{field: None})
        arrived = [one for one in self._waiting if one[0] <= time_s + _ROUNDING]
        self._waiting = [one for one in self._waiting if one[0] > time_s + _ROUNDING]
        return replace(readings, late=tuple((at_s, Readings(**{field: value})) for _, at_s, field, value in arrived))
