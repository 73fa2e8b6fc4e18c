"""Readings of navigation sensors in a ROS 2 bag: Imu (attitude), FluidPressure and TwistWithCovarianceStamped (DVL)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.pressure import PASCAL_PER_METRE
from twin.datasets.bag import Bag
from twin.datasets.bag_calibration import Transforms, relative_pose
from twin.datasets.readings import (
    ATTITUDE,
    HEIGHT,
    VELOCITY,
    RecordedReadings,
    SensorQuantity,
    SensorSeries,
    checked_series,
)
from twin.errors import TwinError

_TYPES = {
    "sensor_msgs/msg/FluidPressure": HEIGHT,
    "sensor_msgs/msg/Imu": ATTITUDE,
    "geometry_msgs/msg/TwistWithCovarianceStamped": VELOCITY,
}
_UNIT_QUATERNION = 0.01  # largest deviation of the norm of a quaternion from 1
_SAME_PLACE_M = 0.01  # largest distance of two frames that count as one place


class _Recorded(NamedTuple):
    """Readings of a topic and the frame in which they are given."""

    topic: str
    frame: str
    series: SensorSeries


def read_bag(bag: Bag, camera: str, transforms: Transforms) -> RecordedReadings | None:
    """Returns the readings in a bag; None without any.

    The body is the frame of the attitude or, if there is none, that of the velocity. If /tf_static does not join this
    frame to the left camera, neither attitude nor velocity is used. A sensor is also not used if there are several
    topics of its type, if its messages state no covariance, or if it is not where it must be: the pressure sensor at
    the left camera, the DVL at the origin of the body (within 1 cm). The notes of the result say what is not used.

    Args:
        bag: the bag.
        camera: frame of the left camera; "" if the images name none.
        transforms: static transforms.

    Raises:
        TwinError: the bag is damaged, or a reading is impossible.
    """
    notes: list[str] = []
    height, attitude, velocity = (_topic(bag, kind, quantity, notes) for kind, quantity in _TYPES.items())
    if height is velocity is attitude is None and not notes:
        return None
    body = attitude or velocity
    body_from_left = relative_pose(transforms, body.frame, camera) if body and body.frame and camera else None
    if body is not None and body_from_left is None:
        notes.append(
            f"The readings of {body.topic} are not used: /tf_static does not join its frame and the left camera."
        )
        attitude = velocity = None
    if height is not None and not _same_place(relative_pose(transforms, camera, height.frame)):
        notes.append(f"The readings of {height.topic} are not used: the pressure sensor is not at the left camera.")
        height = None
    if velocity is not None and body is not None and velocity is not body:
        velocity = _in_body(velocity, relative_pose(transforms, body.frame, velocity.frame), notes)
    heights, attitudes, velocities = (None if one is None else one.series for one in (height, attitude, velocity))
    pose = np.eye(4) if body_from_left is None else body_from_left
    return RecordedReadings(pose, heights, attitudes, velocities, tuple(notes))


def _same_place(pose: Array | None) -> bool:
    """Returns whether a relative pose (4, 4) is known and its translation is at most 1 cm."""
    return pose is not None and float(np.linalg.norm(pose[:3, 3])) <= _SAME_PLACE_M


def _in_body(velocity: _Recorded, body_from_sensor: Array | None, notes: list[str]) -> _Recorded | None:
    """Returns the velocities in the axes of the body; None, with a note, if the sensor is at another place."""
    if body_from_sensor is None or not _same_place(body_from_sensor):
        notes.append(
            f"The readings of {velocity.topic} are not used: the DVL is not at the origin of the attitude's frame."
        )
        return None
    series = velocity.series
    sigmas = np.full(3, float(series.sigmas.max()))
    return velocity._replace(series=SensorSeries(series.times_s, series.values @ body_from_sensor[:3, :3].T, sigmas))


def _topic(bag: Bag, kind: str, quantity: SensorQuantity, notes: list[str]) -> _Recorded | None:
    """Returns the readings of the only topic of a type.

    The result is None if there is no such topic or if it has no messages; also, with an entry in `notes`, if several
    topics have this type or if a message has no covariance.

    Raises:
        TwinError: a reading is impossible.
    """
    topics = [name for name, one in bag.topics.items() if one == kind]
    if len(topics) > 1:
        notes.append(f"The {quantity.name} is not used: several topics have it ({', '.join(sorted(topics))[:200]}).")
    if len(topics) != 1:
        return None
    topic, convert = topics[0], _CONVERT[kind]
    times_ns, values, variances, places, frame = [], [], [], [], ""
    for number, message in enumerate(bag.messages(topic), 1):
        place = f"{bag.path}:{topic}: message {number}"
        value, variance = convert(message, place)
        if not np.any(variance > 0):
            notes.append(f"The readings of {topic} are not used: they state no covariance.")
            return None
        times_ns.append(message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec)
        values.append(value)
        variances.append(variance)
        places.append(place)
        frame = message.header.frame_id.lstrip("/")
    if not values:
        return None
    sigmas = np.sqrt(np.max(variances, axis=0))
    series = checked_series(quantity, np.array(times_ns) * 1e-9, np.array(values), sigmas, places)
    return _Recorded(topic, frame, series)


def _height(message: Any, _: str) -> tuple[Array, Array]:
    """Returns the height (1,) above the level of zero pressure [m] and its variance (1,) of a message FluidPressure."""
    variance = np.array([message.variance]) / PASCAL_PER_METRE**2
    return -np.array([message.fluid_pressure]) / PASCAL_PER_METRE, variance


def _attitude(message: Any, place: str) -> tuple[Array, Array]:
    """Returns roll, pitch, yaw (3,) [rad] and their variances (3,) of a message Imu; zeros without an orientation.

    Raises:
        TwinError: the orientation is not a unit quaternion.
    """
    variances = np.array(message.orientation_covariance).reshape(3, 3).diagonal()
    if variances[0] < 0 or not variances.any():
        return np.zeros(3), np.zeros(3)
    q = message.orientation
    quaternion = np.array([q.w, q.x, q.y, q.z])
    if not abs(np.linalg.norm(quaternion) - 1) < _UNIT_QUATERNION:  # also for NaN
        shown = ", ".join(f"{value:g}" for value in quaternion)
        raise TwinError(place, f"the orientation is {shown} (w, x, y, z)", "a unit quaternion")
    return geometry.rpy_from_rotation(geometry.rotation_from_wxyz(quaternion)), variances


def _velocity(message: Any, _: str) -> tuple[Array, Array]:
    """Returns the velocity (3,) [m/s] and its variances (3,) of a message TwistWithCovarianceStamped."""
    linear = message.twist.twist.linear
    variances = np.array(message.twist.covariance).reshape(6, 6).diagonal()[:3]
    return np.array([linear.x, linear.y, linear.z]), variances.copy()


_CONVERT: dict[str, Callable[[Any, str], tuple[Array, Array]]] = {
    "sensor_msgs/msg/FluidPressure": _height,
    "sensor_msgs/msg/Imu": _attitude,
    "geometry_msgs/msg/TwistWithCovarianceStamped": _velocity,
}
