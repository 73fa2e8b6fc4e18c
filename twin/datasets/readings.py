"""Recorded readings of navigation sensors (pressure, attitude, DVL, IMU): their checks, and the vertical by an IMU."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from twin.core.geometry import Array
from twin.core.records import GRAVITY_MPS2, ImuErrorModel, ImuReadings
from twin.errors import TwinError
from twin.estimate.navigation.vertical import verticals

#: Smallest and largest allowed standard deviation of a reading, as fractions of the largest allowed value.
_SIGMA_SHARES = 1e-12, 1e6

#: Standard deviation of the bias of an accelerometer that states none [m/s2]: 20 mg, as of small MEMS sensors.
USUAL_BIAS_MPS2 = 0.2
#: The same of a gyroscope [rad/s] (EuRoC's: up to 0.08), and random walk of the bias of an accelerometer that states
#: none [m/s3/sqrt(Hz)]: that of EuRoC.
USUAL_RATE_BIAS_RADPS, USUAL_FORCE_WALK = 0.1, 3e-3
_SAME_PLACE_M = 0.01  # an IMU at most this far from the origin of the body measures its motion
_MOST_OFF = 0.15  # largest relative difference of the mean specific force from gravity


class SensorQuantity(NamedTuple):
    """A measured quantity."""

    name: str  #: name for messages
    folder: str  #: folder of its readings in an EuRoC-like data set
    unit: str  #: unit of its values and standard deviations
    n: int  #: number of its values
    largest: float  #: largest allowed absolute value


HEIGHT = SensorQuantity("height from pressure", "pressure0", "m", 1, 12_000.0)
ATTITUDE = SensorQuantity("attitude", "ahrs0", "rad", 3, 2 * np.pi)
VELOCITY = SensorQuantity("velocity of the DVL", "dvl0", "m/s", 3, 20.0)
INERTIAL = SensorQuantity("angular rate or specific force", "imu0", "rad/s or m/s2", 6, 1000.0)


class SensorSeries(NamedTuple):
    """Readings of one sensor."""

    times_s: Array  #: (n,) increasing times, in the clock of the data set
    values: Array  #: (n, k) readings
    sigmas: Array  #: (k,) standard deviations of a reading


class RecordedInertial(NamedTuple):
    """Readings of an IMU at the origin of the body, in its axes, and their errors."""

    readings: ImuReadings
    errors: ImuErrorModel


class RecordedReadings(NamedTuple):
    """Readings of the navigation sensors of a data set; None where a sensor was not recorded or cannot be used."""

    body_from_left: Array  #: (4, 4) pose of the left camera, before rectification, in the body of the sensors
    height: SensorSeries | None = None  #: heights of the left camera above a plane whose level may be unknown [m]
    attitude: SensorSeries | None = None  #: roll, pitch and yaw of the body in a world whose z axis points up [rad]
    velocity: SensorSeries | None = None  #: velocities of the origin of the body over ground, in body axes [m/s]
    #: unit vectors that point upwards, in body axes, with one standard deviation [rad] (`vertical_series`);
    #: None if there is an attitude.
    vertical: SensorSeries | None = None
    notes: tuple[str, ...] = ()  #: sentences on readings that are not used, and on assumptions about their times
    inertial: RecordedInertial | None = None  #: readings of the IMU, to predict the motion between frames


def checked_series(
    quantity: SensorQuantity, recorded: SensorSeries, source: str, place: Callable[[int], str], notes: list[str]
) -> SensorSeries | None:
    """Returns the finite readings of a sensor, after checks of them; None without any.

    Values that are not finite stand for no measurement, such as a DVL without bottom lock. `source` is the topic or the
    folder of the readings, for notes; `place` returns the place of a reading by its number, for errors. A note states
    the number of readings that are not finite. Raises TwinError if a time is not after the previous one, or a value or
    a standard deviation is outside its limits.
    """
    if not len(recorded.values):
        notes.append(f"There are no readings in {source}.")
        return None
    kept = np.flatnonzero(np.isfinite(recorded.values).all(axis=1))
    if not len(kept):
        notes.append(f"The readings of {source} are not used: none of them is finite.")
        return None
    if lost := len(recorded.values) - len(kept):
        notes.append(f"{lost} of {len(recorded.values)} readings of {source} are not used: not finite.")
    series = SensorSeries(recorded.times_s[kept], recorded.values[kept], recorded.sigmas)
    if fault := _fault(quantity, series):
        row, problem, allowed = fault
        raise TwinError(place(0 if row is None else int(kept[row])), problem, allowed)
    return series


def _fault(quantity: SensorQuantity, series: SensorSeries) -> tuple[int | None, str, str] | None:
    """Returns row (None: all), problem and allowed values of the first impossible reading; None if all are possible."""
    times_s, values, sigmas = series
    late = np.flatnonzero(np.diff(times_s) <= 0)
    if len(late):
        k = int(late[0]) + 1
        problem = f"the time {times_s[k]:.9g} s is not after that of the reading before, {times_s[k - 1]:.9g} s"
        return k, problem, "increasing times"
    large = np.argwhere(np.abs(values) > quantity.largest)
    if len(large):
        k, column = (int(index) for index in large[0])
        problem = f"the {quantity.name} is {values[k, column]:g} {quantity.unit}"
        return k, problem, f"-{quantity.largest:g} to {quantity.largest:g} {quantity.unit}"
    low, high = (share * quantity.largest for share in _SIGMA_SHARES)
    if not ((sigmas >= low) & (sigmas <= high)).all():
        shown = ", ".join(f"{sigma:g}" for sigma in sigmas)
        problem = f"the standard deviations of the {quantity.name} are {shown}"
        return None, problem, f"positive numbers, {low:g} to {high:g} {quantity.unit}"
    return None


def in_body(inertial: SensorSeries, body_from_sensor: Array, errors: ImuErrorModel) -> RecordedInertial | None:
    """Returns the readings (n, 6) of an IMU at a pose (4, 4) in the body, in its axes; None if not at its origin."""
    if np.linalg.norm(body_from_sensor[:3, 3]) > _SAME_PLACE_M:
        return None
    turned = inertial.values.reshape(-1, 2, 3) @ body_from_sensor[:3, :3].T
    return RecordedInertial(ImuReadings(inertial.times_s, turned[:, 0], turned[:, 1]), errors)


def vertical_series(
    source: str, inertial: SensorSeries, body_from_sensor: Array, errors: ImuErrorModel, notes: list[str]
) -> SensorSeries | None:
    """Returns the direction of the vertical in body axes (unit vectors that point upwards) and its standard deviation.

    The standard deviation [rad] is that about each perpendicular axis: the RMS of that of `verticals` and, on top of
    it, the error due to the bias of the accelerometer. `inertial` has angular rates [rad/s] and specific forces [m/s2]
    (n, 6) in the axes of the IMU, `body_from_sensor` is their rotation (3, 3) in the body. If the mean specific force
    differs from gravity by more than 15 %, the result is None, and a note on `source` says so.
    """
    rates, forces = inertial.values[:, :3], inertial.values[:, 3:]
    mean_mps2 = float(np.linalg.norm(forces, axis=1).mean())
    if abs(mean_mps2 / GRAVITY_MPS2 - 1) > _MOST_OFF:
        notes.append(
            f"The readings of {source} are not used: their mean specific force is {mean_mps2:.3g} m/s2, that of "
            f"gravity is {GRAVITY_MPS2} m/s2."
        )
        return None
    up, sigma_rad = verticals(ImuReadings(inertial.times_s, rates, forces), errors)
    sigma = float(np.hypot(np.sqrt(np.mean(sigma_rad**2)), errors.force_bias / GRAVITY_MPS2))
    return SensorSeries(inertial.times_s, up @ body_from_sensor.T, np.array([sigma]))
