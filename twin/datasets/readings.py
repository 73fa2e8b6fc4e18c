"""Recorded readings of navigation sensors: pressure, attitude and Doppler velocity log, and their EuRoC-like files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from twin.core.geometry import Array
from twin.datasets.text_files import read_numbered_table, read_yaml
from twin.errors import TwinError

#: Smallest and largest allowed standard deviation of a reading, as fractions of the largest allowed value.
_SIGMA_SHARES = 1e-12, 1e6


class SensorQuantity(NamedTuple):
    """A measured quantity.

    Args:
        name: name for messages.
        folder: folder of its readings in an EuRoC-like data set.
        unit: unit of its values and standard deviations.
        n: number of its values.
        largest: largest allowed absolute value.
    """

    name: str
    folder: str
    unit: str
    n: int
    largest: float


HEIGHT = SensorQuantity("height from pressure", "pressure0", "m", 1, 12_000.0)
ATTITUDE = SensorQuantity("attitude", "ahrs0", "rad", 3, 2 * np.pi)
VELOCITY = SensorQuantity("velocity of the DVL", "dvl0", "m/s", 3, 20.0)


class SensorSeries(NamedTuple):
    """Readings of one sensor.

    Args:
        times_s: (n,) increasing times, in the clock of the data set [s].
        values: (n, k) readings.
        sigmas: (k,) standard deviations of a reading.
    """

    times_s: Array
    values: Array
    sigmas: Array


class RecordedReadings(NamedTuple):
    """Readings of the navigation sensors of a data set; None where a sensor was not recorded or cannot be used.

    Args:
        body_from_left: (4, 4) pose of the left camera, before rectification, in the body that the sensors refer to.
        height: heights [m] of the left camera above a horizontal plane, whose level may be unknown.
        attitude: roll, pitch and yaw [rad] of the body in a world whose z axis points up.
        velocity: velocities [m/s] of the origin of the body over ground, in body axes.
        vertical: unit vectors that point upwards, in body axes, with one standard deviation [rad]
            (`inertial.vertical_series`); None if there is an attitude.
        notes: sentences on readings that are not used, and on assumptions about their times.
    """

    body_from_left: Array
    height: SensorSeries | None = None
    attitude: SensorSeries | None = None
    velocity: SensorSeries | None = None
    vertical: SensorSeries | None = None
    notes: tuple[str, ...] = ()


class UncheckedReadings(NamedTuple):
    """Readings of one sensor as recorded.

    Args:
        source: topic or folder of the readings, for notes.
        times_s: (n,) times [s].
        values: (n, k) readings; NaN or infinite where the sensor measured nothing, such as a DVL without bottom lock.
        place: function that returns the place of a reading (file and line, or topic and message), given its number,
            from 0.
    """

    source: str
    times_s: Array
    values: Array
    place: Callable[[int], str]


def checked_series(
    quantity: SensorQuantity, recorded: UncheckedReadings, sigmas: Array, notes: list[str]
) -> SensorSeries | None:
    """Returns the finite readings of a sensor after checks of them; None if there are none.

    Readings that are not finite are left out; an entry in `notes` states their number.

    Args:
        quantity: the measured quantity.
        recorded: the readings.
        sigmas: (k,) standard deviations.
        notes: sentences on readings that are not used, to which a sentence may be appended.

    Raises:
        TwinError: a time is not after the previous one, or a value or a standard deviation is outside its limits.
    """
    if not len(recorded.values):
        notes.append(f"There are no readings in {recorded.source}.")
        return None
    kept = np.flatnonzero(np.isfinite(recorded.values).all(axis=1))
    if not len(kept):
        notes.append(f"The readings of {recorded.source} are not used: none of them is finite.")
        return None
    if lost := len(recorded.values) - len(kept):
        notes.append(f"{lost} of {len(recorded.values)} readings of {recorded.source} are not used: not finite.")
    times_s, values = recorded.times_s[kept], recorded.values[kept]
    late = np.flatnonzero(np.diff(times_s) <= 0)
    if len(late):
        k = int(late[0]) + 1
        problem = f"the time {times_s[k]:.9g} s is not after that of the reading before, {times_s[k - 1]:.9g} s"
        raise TwinError(recorded.place(int(kept[k])), problem, "increasing times")
    large = np.argwhere(np.abs(values) > quantity.largest)
    if len(large):
        k, column = (int(index) for index in large[0])
        problem = f"the {quantity.name} is {values[k, column]:g} {quantity.unit}"
        allowed = f"-{quantity.largest:g} to {quantity.largest:g} {quantity.unit}"
        raise TwinError(recorded.place(int(kept[k])), problem, allowed)
    low, high = (share * quantity.largest for share in _SIGMA_SHARES)
    if not ((sigmas >= low) & (sigmas <= high)).all():
        shown = ", ".join(f"{sigma:g}" for sigma in sigmas)
        problem = f"the standard deviations of the {quantity.name} are {shown}"
        raise TwinError(recorded.place(0), problem, f"positive numbers, {low:g} to {high:g} {quantity.unit}")
    return SensorSeries(times_s, values, sigmas)


def read_folder(root: Path, body_from_left: Array) -> RecordedReadings | None:
    """Returns the readings in the folders pressure0, ahrs0 and dvl0 of an EuRoC-like data set; None if none is there.

    In each folder, `data.csv` has the time [ns] and the values, and `sensor.yaml` their standard deviations as `sigma`
    (one number, or one per value). A sensor without standard deviations is not used, nor are readings with a value that
    is empty or not finite.

    Args:
        root: folder of the sensors.
        body_from_left: (4, 4) pose of the left camera in the body.

    Raises:
        TwinError: a file is damaged, or a value is impossible.
    """
    found: list[SensorSeries | None] = []
    notes: list[str] = []
    for quantity in (HEIGHT, ATTITUDE, VELOCITY):
        file = root / quantity.folder / "data.csv"
        sigmas = _sigmas(root / quantity.folder / "sensor.yaml", quantity.n) if file.exists() else None
        if file.exists() and sigmas is None:
            notes.append(f"The readings in {quantity.folder} are not used: sensor.yaml states no `sigma`.")
        found.append(None if sigmas is None else read_csv(file, quantity, sigmas, notes))
    height, attitude, velocity = found
    if not notes and height is attitude is velocity is None:
        return None
    return RecordedReadings(body_from_left, height, attitude, velocity, notes=tuple(notes))


def read_csv(file: Path, quantity: SensorQuantity, sigmas: Array, notes: list[str]) -> SensorSeries | None:
    """Returns the finite readings in a file data.csv; None if there are none.

    A sentence on the readings that are left out is appended to `notes`.

    Raises:
        TwinError: a line is not a time and numbers, or a value is impossible.
    """
    columns = 1 + quantity.n
    table = read_numbered_table(file, columns, 1, lambda parts: [_number(part) for part in parts[:columns]])
    times_s, values = table.values[:, 0] * 1e-9, table.values[:, 1:]
    recorded = UncheckedReadings(quantity.folder, times_s, values, lambda k: f"{file}:{table.lines[k]}")
    return checked_series(quantity, recorded, sigmas, notes)


def _number(text: str) -> float:
    """Returns the number that a text states; NaN for an empty text. Raises ValueError if it is not a number."""
    return float(text) if text.strip() else np.nan


def _sigmas(file: Path, n: int) -> Array | None:
    """Returns the standard deviations (n,) in a file sensor.yaml (`sigma`); None if the file or `sigma` is missing.

    Raises:
        TwinError: the file is damaged, or `sigma` is neither a number nor n numbers.
    """
    value = read_yaml(file).get("sigma") if file.is_file() else None
    if value is None:
        return None
    try:
        given = np.array(value, dtype=np.float64).ravel()
    except (TypeError, ValueError):
        given = np.zeros(0)
    if len(given) not in (1, n):
        raise TwinError(f"{file}: sigma", f"{str(value)[:60]!r} is not allowed", f"a number or {n} numbers")
    return np.broadcast_to(given, (n,)).copy()
