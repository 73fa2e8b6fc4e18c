"""Watch over the navigation sensors: readings that repeat are removed, and long gaps between readings are reported."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from twin.core.records import Readings

_NAMES = {"pressure": "pressure_z_m", "ahrs": "ahrs_rpy_rad", "dvl": "dvl_mps", "usbl": "usbl_m"}
#: Equal readings in succession after which a sensor counts as frozen; coarse resolution makes fewer equal.
_EQUAL = {"pressure": 10, "ahrs": 3, "dvl": 3, "usbl": 2}
_LONG_S, _LONG = 5.0, 20.0  # a gap is reported if it is longer than this time, and than this multiple of the median gap


class ReadingWatch:
    """Watch over the readings of all frames, in the order of time."""

    def __init__(self) -> None:
        self._last: dict[str, np.ndarray] = {}
        self._n_equal = dict.fromkeys(_NAMES, 0)
        self._n_removed = dict.fromkeys(_NAMES, 0)
        self._times_s: dict[str, list[float]] = {name: [] for name in _NAMES}
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
            self._n_equal[sensor] = self._n_equal[sensor] + 1 if is_equal else 0
            self._last[sensor] = array
            if self._n_equal[sensor] >= _EQUAL[sensor]:
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
