"""Watch over the navigation sensors: readings that repeat are removed, and long gaps between readings are reported."""

from array import array
from dataclasses import replace

import numpy as np

from twin.core.records import Readings

_NAMES = {"pressure": "pressure_z_m", "ahrs": "ahrs_rpy_rad", "dvl": "dvl_mps", "usbl": "usbl_m"}
#: A sensor counts as frozen if more than _MOST_EQUAL readings in succession are equal over _FROZEN_S: a slow sensor
#: repeats its reading from frame to frame, and a coarse one at rest.
_MOST_EQUAL, _FROZEN_S = 2, 2.0
_LONG_S, _LONG = 5.0, 20.0  # a gap is reported if it is longer than this time, and than this multiple of the median gap


class ReadingWatch:
    """Watch over the readings of all frames, in the order of time."""

    def __init__(self) -> None:
        self._last: dict[str, np.ndarray] = {}
        self._n_equal, self._since_s = dict.fromkeys(_NAMES, 0), dict.fromkeys(_NAMES, 0.0)
        self._n_removed = dict.fromkeys(_NAMES, 0)
        self._times_s = {name: array("d") for name in _NAMES}
        self._now_s = 0.0

    def fresh(self, readings: Readings, time_s: float) -> Readings:
        """Returns the readings without those of frozen sensors: the same numbers again and again are no information."""
        self._now_s = time_s
        for sensor, name in _NAMES.items():
            value = getattr(readings, name)
            if value is None:
                continue
            array, last = np.atleast_1d(np.asarray(value, float)), self._last.get(sensor)
            is_equal = last is not None and np.array_equal(array, last)
            if not is_equal:
                self._n_equal[sensor], self._since_s[sensor], self._last[sensor] = 0, time_s, array
            self._n_equal[sensor] += 1
            if self._n_equal[sensor] > _MOST_EQUAL and time_s - self._since_s[sensor] > _FROZEN_S:
                self._n_removed[sensor] += 1
                readings = replace(readings, **{name: None})
            else:
                self._times_s[sensor].append(time_s)
        return readings

    @property
    def notes(self) -> tuple[str, ...]:
        """Returns a sentence for each sensor that was frozen, or gave no readings for long."""
        found = []
        for sensor, times in self._times_s.items():
            if n := self._n_removed[sensor]:
                found.append(f"The {sensor} sensor repeated its reading; {n} of the repetitions were not used.")
            gaps = np.diff([*times, self._now_s])
            if len(times) > 2 and not n and (longest := gaps.max()) > max(_LONG_S, _LONG * np.median(gaps[:-1])):
                start_s = times[int(gaps.argmax())]
                found.append(f"The {sensor} sensor gave no readings for {longest:.0f} s from {start_s:.0f} s on.")
        return tuple(found)
