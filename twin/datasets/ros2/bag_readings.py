"""Readings of navigation sensors in a ROS 2 bag: Imu, FluidPressure and TwistWithCovarianceStamped (DVL)."""

from array import array
from collections.abc import Callable, Iterable
from itertools import islice
from typing import Any, NamedTuple

import numpy as np

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.records import PASCAL_PER_METRE, ImuErrorModel
from twin.datasets import readings
from twin.datasets.dataset import are_rotations
from twin.datasets.readings import RecordedInertial, RecordedReadings, SensorQuantity, SensorSeries
from twin.datasets.ros2.bag import Bag
from twin.datasets.ros2.frame_transforms import Transforms, relative_pose
from twin.errors import TwinError

_PRESSURE, _IMU = "sensor_msgs/msg/FluidPressure", "sensor_msgs/msg/Imu"
_DVL = "geometry_msgs/msg/TwistWithCovarianceStamped"
_NO_ORIENTATION = "states an orientation."  # end of the note on topics without attitude
_USUAL_WALK = 1e-4  # random walk of the bias of a gyroscope, which messages do not state [rad/s2/sqrt(Hz)]
_N_FIRST = 100  # number of messages of a topic that are searched for an orientation
_Converter = Callable[[Any, str], tuple[Array, Array]]  # from a message and its place to values and variances
_SAME_PLACE_M = 0.01  # largest distance between the origins of two frames that count as one place


class _Recorded(NamedTuple):
    topic: str
    frame: str
    series: SensorSeries


def read_bag(bag: Bag, camera: str, transforms: Transforms) -> RecordedReadings | None:
    """Returns the readings in a bag; None if no topic has the type Imu, FluidPressure or TwistWithCovarianceStamped.

    The body is the frame of the attitude or, if there is none, that of the velocity or of the IMU. If /tf_static does
    not join this frame to the left camera, whose frame is `camera` ("": not named), none of them is used. The attitude
    is that of the only topic of type Imu whose messages state an orientation; without one, the only topic with angular
    rates and specific forces gives the vertical. A sensor is also not used if there are several topics of its type, if
    a finite reading of it has no covariance, or if it is not where it must be: the pressure sensor within 1 cm of the
    left camera, the DVL within 1 cm of the origin of the body. If all headers of a topic have the time 0, the times of
    recording are taken. Notes state which readings are not used and which times are those of recording.

    Raises TwinError if the bag is damaged, or a reading is impossible.
    """
    notes: list[str] = []
    topics = {kind: [name for name, one in bag.topics.items() if one == kind] for kind in (_PRESSURE, _IMU, _DVL)}
    height = _read(bag, topics[_PRESSURE], readings.HEIGHT, _height, notes)
    attitude = _read(bag, _with_orientation(bag, topics[_IMU], notes), readings.ATTITUDE, _attitude, notes)
    velocity = _read(bag, topics[_DVL], readings.VELOCITY, _velocity, notes)
    inertial = None
    if attitude is None:
        moving = [name for name in topics[_IMU] if any(map(_states_motion, _first(bag, name)))]
        inertial = _read(bag, moving, readings.INERTIAL, _motion, notes)
    if inertial is not None:
        notes = [note for note in notes if not note.endswith(_NO_ORIENTATION)]
    if height is velocity is attitude is inertial is None and not notes:
        return None
    body = attitude or velocity or inertial
    body_from_left = relative_pose(transforms, body.frame, camera) if body and body.frame and camera else None
    if body is not None and body_from_left is None:
        notes.append(_unused(body, "/tf_static does not join its frame and the left camera"))
        attitude = velocity = inertial = None
    if height is not None and not _same_place(relative_pose(transforms, camera, height.frame)):
        notes.append(_unused(height, "the pressure sensor is not at the left camera"))
        height = None
    vertical = imu = None
    if body is not None and velocity is not None and velocity is not body:
        velocity = _in_body(velocity, relative_pose(transforms, body.frame, velocity.frame), notes)
    if body is not None and inertial is not None:
        vertical, imu = _inertial(inertial, relative_pose(transforms, body.frame, inertial.frame), notes)
    heights, attitudes, velocities = (None if one is None else one.series for one in (height, attitude, velocity))
    pose = np.eye(4) if body_from_left is None else body_from_left
    return RecordedReadings(pose, heights, attitudes, velocities, vertical, tuple(notes), imu)


def _unused(recorded: _Recorded, reason: str) -> str:
    return f"The readings of {recorded.topic} are not used: {reason}."


def _same_place(pose: Array | None) -> bool:
    return pose is not None and float(np.linalg.norm(pose[:3, 3])) <= _SAME_PLACE_M


def _in_body(velocity: _Recorded, body_from_sensor: Array | None, notes: list[str]) -> _Recorded | None:
    """Returns the velocities in body axes, with the largest sigma; None, with a note, if the DVL is elsewhere."""
    if body_from_sensor is None or not _same_place(body_from_sensor):
        notes.append(_unused(velocity, "the DVL is not at the origin of the attitude's frame"))
        return None
    series = velocity.series
    sigmas = np.full(3, float(series.sigmas.max()))
    return velocity._replace(series=SensorSeries(series.times_s, series.values @ body_from_sensor[:3, :3].T, sigmas))


def _inertial(
    inertial: _Recorded, body_from_sensor: Array | None, notes: list[str]
) -> tuple[SensorSeries | None, RecordedInertial | None]:
    """Returns the direction of the vertical, and the readings of the IMU in body axes."""
    if body_from_sensor is None:
        notes.append(_unused(inertial, "/tf_static does not join its frame and the body"))
        return None, None
    times_s, _, sigmas = inertial.series
    root_s = float(np.sqrt(np.median(np.diff(times_s)))) if len(times_s) > 1 else 0.0  # a density is sigma / sqrt(rate)
    errors = ImuErrorModel(
        float(sigmas[:3].max()) * root_s, _USUAL_WALK, float(sigmas[3:].max()) * root_s, readings.USUAL_FORCE_WALK,
        readings.USUAL_RATE_BIAS_RADPS, readings.USUAL_BIAS_MPS2,
    )  # fmt: skip
    vertical = readings.vertical_series(inertial.topic, inertial.series, body_from_sensor[:3, :3], errors, notes)
    return vertical, readings.in_body(inertial.series, body_from_sensor, errors)


def _first(bag: Bag, topic: str) -> Iterable[Any]:
    return (message for _, message in islice(bag.messages(topic), _N_FIRST))


def _states_motion(message: Any) -> bool:
    """Returns whether a message Imu has rates and specific forces, which their covariances mark by -1 if it has not."""
    given = message.angular_velocity_covariance[0] >= 0 and message.linear_acceleration_covariance[0] >= 0
    force = message.linear_acceleration
    return bool(given and (force.x or force.y or force.z))


def _with_orientation(bag: Bag, topics: list[str], notes: list[str]) -> list[str]:
    """Returns the topics of type Imu that state an orientation, or those with a covariance if there are any."""
    # If none does: all or, if all messages mark their orientation as not measured, none, with a note.
    first = {name: list(_first(bag, name)) for name in topics}
    stated = [name for name in topics if any(_states_orientation(message) for message in first[name])]
    known = [name for name in stated if any(np.any(message.orientation_covariance) for message in first[name])]
    if topics and not any(message.orientation_covariance[0] >= 0 for name in topics for message in first[name]):
        notes.append(f"The attitude is not used: no message of {_listed(topics)} {_NO_ORIENTATION}")
        return []
    return known or stated or topics


def _states_orientation(message: Any) -> bool:
    """Returns whether a message Imu has a unit quaternion whose covariance does not mark it as not measured (-1)."""
    return bool(message.orientation_covariance[0] >= 0 and are_rotations(_quaternion(message)))


def _quaternion(message: Any) -> Array:
    q = message.orientation
    return np.array([q.w, q.x, q.y, q.z])


def _listed(topics: list[str]) -> str:
    return ", ".join(sorted(topics))[:200]


def _read(
    bag: Bag, topics: list[str], quantity: SensorQuantity, convert: _Converter, notes: list[str]
) -> _Recorded | None:
    """Returns the readings of the only one of some topics, with the largest standard deviations of the finite readings.

    The result is None if there is no topic; also, with a note, if there are several, if a finite reading has no
    covariance, or if no reading is finite.
    """
    if len(topics) > 1:
        notes.append(f"The {quantity.name} is not used: several topics have it ({_listed(topics)}).")
    if len(topics) != 1:
        return None
    (topic,) = topics
    stamps_ns, logged_ns, values = array("q"), array("q"), array("d")  # compact, as a bag may have millions of messages
    largest, frame = np.zeros(quantity.n), ""
    for recorded_ns, message in bag.messages(topic):
        value, variance = convert(message, _place(bag, topic, len(stamps_ns)))
        finite = bool(np.isfinite(value).all() and np.isfinite(variance).all())
        if finite and not np.any(variance > 0):
            notes.append(f"The readings of {topic} are not used: they state no covariance.")
            return None
        largest = np.maximum(largest, variance) if finite else largest
        stamps_ns.append(message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec)
        logged_ns.append(recorded_ns)
        values.extend(value if finite else np.full(quantity.n, np.nan))
        frame = message.header.frame_id.lstrip("/")
    stamped = any(stamps_ns)
    times_s = np.array(stamps_ns if stamped else logged_ns, np.float64) * 1e-9
    table = np.array(values, np.float64).reshape(-1, quantity.n)
    recorded = SensorSeries(times_s, table, np.sqrt(largest))
    series = readings.checked_series(quantity, recorded, topic, lambda k: _place(bag, topic, k), notes)
    if series is None:
        return None
    if not stamped:
        notes.append(f"The readings of {topic} have no times in their headers; the times of recording were used.")
    return _Recorded(topic, frame, series)


def _place(bag: Bag, topic: str, k: int) -> str:
    return f"{bag.path}:{topic}: message {k + 1}"


def _height(message: Any, _: str) -> tuple[Array, Array]:
    """Returns the height above the level of zero pressure [m] and its variance [m2], each (1,), of a FluidPressure."""
    variance = np.array([message.variance]) / PASCAL_PER_METRE**2
    return -np.array([message.fluid_pressure]) / PASCAL_PER_METRE, variance


def _attitude(message: Any, place: str) -> tuple[Array, Array]:
    """Returns roll, pitch, yaw (3,) [rad], variances (3,) [rad2] of an Imu; 0: not measured, NaN: not finite."""
    # TwinError if it is no rotation
    variances = np.array(message.orientation_covariance).reshape(3, 3).diagonal()
    if variances[0] < 0 or not variances.any():
        return np.zeros(3), np.zeros(3)
    quaternion = _quaternion(message)
    if not np.isfinite(quaternion).all():
        return np.full(3, np.nan), variances
    if not are_rotations(quaternion):
        shown = ", ".join(f"{value:g}" for value in quaternion)
        raise TwinError(place, f"the orientation is {shown} (w, x, y, z)", "a unit quaternion")
    return geometry.rpy_from_rotation(geometry.rotation_from_wxyz(quaternion)), variances


def _velocity(message: Any, _: str) -> tuple[Array, Array]:
    """Returns the velocity (3,) [m/s] and its variances (3,) [m2/s2] of a message TwistWithCovarianceStamped."""
    linear = message.twist.twist.linear
    variances = np.array(message.twist.covariance).reshape(6, 6).diagonal()[:3]
    return np.array([linear.x, linear.y, linear.z]), variances.copy()


def _motion(message: Any, _: str) -> tuple[Array, Array]:
    """Returns angular rate and specific force (6,) [rad/s, m/s2] of a message Imu and their variances (6,)."""
    rate, force = message.angular_velocity, message.linear_acceleration
    covariances = message.angular_velocity_covariance, message.linear_acceleration_covariance
    variances = np.concatenate([np.array(cov).reshape(3, 3).diagonal() for cov in covariances])
    return np.array([rate.x, rate.y, rate.z, force.x, force.y, force.z]), variances
