"""ROS 2 messages of an exported run. Frames and axes follow REP 103, REP 104 and REP 105.

`world` has x east, y north, z up; `base_link`, the body, has x forward, y left, z up; the camera frames have x to the
right and y down in the image, and z along the optical axis.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.optional_packages import optional
from twin.exchange.run_contents import CameraIntrinsics

WORLD, BODY = "world", "base_link"
LEFT, RIGHT = "left_camera_optical_frame", "right_camera_optical_frame"
_PURPOSE = "--to mcap"
_NOT_MEASURED = -1.0  # first element of a covariance of sensor_msgs/Imu whose quantity is not measured


class MessageFactory:
    """Makes and serialises messages of ROS 2 Humble. All times are in nanoseconds.

    Raises:
        TwinError: the package rosbags is not installed.
    """

    def __init__(self) -> None:
        typesys = optional("rosbags.typesys", "exchange", _PURPOSE)
        self.typestore: Any = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)

    def serialised(self, message: Any) -> Any:
        """Returns a message serialised in CDR (Common Data Representation of the OMG)."""
        return self.typestore.serialize_cdr(message, message.__msgtype__)

    def compressed_image(self, time_ns: int, frame: str, kind: str, data: bytes) -> Any:
        """Returns sensor_msgs/CompressedImage with the bytes of an image file; `kind` is "png" or "jpeg".

        The field `format` follows compressed_image_transport, for example "rgb8; png compressed bgr8": decoding of the
        file gives bgr8, which is converted to rgb8 for the subscribers.
        """
        values = np.frombuffer(data, np.uint8)
        header = self._header(time_ns, frame)
        return self._make("sensor_msgs/msg/CompressedImage", header, f"rgb8; {kind} compressed bgr8", values)

    def camera_info(self, time_ns: int, frame: str, camera: CameraIntrinsics, baseline_m: float) -> Any:
        """Returns sensor_msgs/CameraInfo of a rectified image.

        Args:
            time_ns: time of the image.
            frame: name of the coordinate frame of the camera.
            camera: camera model.
            baseline_m: distance to the left camera [m]; 0 for the left camera itself. P[0, 3] = -fx baseline.
        """
        projection = np.column_stack([camera.matrix, [-camera.matrix[0, 0] * baseline_m, 0.0, 0.0]])
        region = self._make("sensor_msgs/msg/RegionOfInterest", 0, 0, 0, 0, False)
        return self._make(
            "sensor_msgs/msg/CameraInfo", self._header(time_ns, frame), camera.size_px[1], camera.size_px[0],
            "plumb_bob", np.array(camera.distortion, np.float64), camera.matrix.ravel(), np.eye(3).ravel(),
            projection.ravel(), 0, 0, region,
        )  # fmt: skip

    def odometry(self, time_ns: int, world_from_body: Array, twist_body: Array) -> Any:
        """Returns nav_msgs/Odometry of the body in the world; its covariances are zero, that is, not stated.

        Args:
            time_ns: time of the pose.
            world_from_body: (4, 4) pose.
            twist_body: (6,) angular velocity [rad/s] and velocity [m/s] in the axes of the body.
        """
        p = world_from_body[:3, 3]
        pose = self._make("geometry_msgs/msg/Pose", self._point(p), self._quaternion(world_from_body))
        return self._make(
            "nav_msgs/msg/Odometry", self._header(time_ns, WORLD), BODY,
            self._make("geometry_msgs/msg/PoseWithCovariance", pose, np.zeros(36)),
            self._twist(twist_body, np.zeros(36)),
        )  # fmt: skip

    def transforms(self, time_ns: int, poses: dict[tuple[str, str], Array]) -> Any:
        """Returns tf2_msgs/TFMessage with the poses of frames in their parent frames.

        Args:
            time_ns: time of the poses.
            poses: for each (name of the parent, name of the frame), the pose (4, 4) of the frame in its parent.
        """
        found = [
            self._make(
                "geometry_msgs/msg/TransformStamped", self._header(time_ns, parent), child,
                self._make("geometry_msgs/msg/Transform", self._vector(pose[:3, 3]), self._quaternion(pose)),
            )
            for (parent, child), pose in poses.items()
        ]  # fmt: skip
        return self._make("tf2_msgs/msg/TFMessage", found)

    def attitude(self, time_ns: int, rpy_rad: Array, sigmas_rad: Array) -> Any:
        """Returns sensor_msgs/Imu with the attitude; angular rates and accelerations are marked as not measured.

        Args:
            time_ns: time of the reading.
            rpy_rad: (3,) roll, pitch and yaw of the body in the world [rad].
            sigmas_rad: (3,) their standard deviations [rad].
        """
        unknown, zero = _unknown_covariance(), self._vector(np.zeros(3))
        attitude = geometry.pose(geometry.rotation_from_rpy(*(float(angle) for angle in rpy_rad)), np.zeros(3))
        return self._make(
            "sensor_msgs/msg/Imu", self._header(time_ns, BODY), self._quaternion(attitude),
            np.diag(np.square(sigmas_rad)).ravel(), zero, unknown, zero, unknown.copy(),
        )  # fmt: skip

    def inertial(self, time_ns: int, rates_radps: Array, forces_mps2: Array, sigmas: tuple[float, float]) -> Any:
        """Returns sensor_msgs/Imu with angular rates and specific forces; the orientation is marked as not measured.

        Args:
            time_ns: time of the reading.
            rates_radps: (3,) angular rates of the body in its own axes [rad/s].
            forces_mps2: (3,) specific forces in the axes of the body [m/s2], "linear acceleration" in ROS.
            sigmas: standard deviations of the white noise of each rate [rad/s] and of each specific force [m/s2].
        """
        rate_cov, force_cov = (np.diag([sigma**2] * 3).ravel() for sigma in sigmas)
        return self._make(
            "sensor_msgs/msg/Imu", self._header(time_ns, BODY), self._quaternion(np.eye(4)), _unknown_covariance(),
            self._vector(rates_radps), rate_cov, self._vector(forces_mps2), force_cov,
        )  # fmt: skip

    def pressure(self, time_ns: int, pressure_pa: float, sigma_pa: float) -> Any:
        """Returns sensor_msgs/FluidPressure; the pressure sensor is at the left camera.

        Args:
            time_ns: time of the reading.
            pressure_pa: pressure [Pa].
            sigma_pa: its standard deviation [Pa].
        """
        return self._make("sensor_msgs/msg/FluidPressure", self._header(time_ns, LEFT), pressure_pa, sigma_pa**2)

    def velocity(self, time_ns: int, velocity_mps: Array, sigma_mps: float) -> Any:
        """Returns geometry_msgs/TwistWithCovarianceStamped with a velocity over ground.

        The angular velocity is not measured; its variances are -1.

        Args:
            time_ns: time of the reading.
            velocity_mps: (3,) velocity in the axes of the body [m/s].
            sigma_mps: standard deviation of each of its components [m/s].
        """
        covariance = np.diag([sigma_mps**2] * 3 + [_NOT_MEASURED] * 3).ravel()
        twist = self._twist(np.concatenate([np.zeros(3), velocity_mps]), covariance)
        return self._make("geometry_msgs/msg/TwistWithCovarianceStamped", self._header(time_ns, BODY), twist)

    def _make(self, kind: str, *fields: Any) -> Any:
        """Returns a message of the type `kind` with the given values of its fields, in the order of the fields."""
        return self.typestore.types[kind](*fields)

    def _header(self, time_ns: int, frame: str) -> Any:
        """Returns std_msgs/Header with a time and the name of a coordinate frame."""
        stamp = self._make("builtin_interfaces/msg/Time", time_ns // 1_000_000_000, time_ns % 1_000_000_000)
        return self._make("std_msgs/msg/Header", stamp, frame)

    def _point(self, p: Array) -> Any:
        """Returns geometry_msgs/Point of a position (3,)."""
        return self._make("geometry_msgs/msg/Point", *(float(value) for value in p))

    def _vector(self, v: Array) -> Any:
        """Returns geometry_msgs/Vector3 of a vector (3,)."""
        return self._make("geometry_msgs/msg/Vector3", *(float(value) for value in v))

    def _quaternion(self, pose: Array) -> Any:
        """Returns geometry_msgs/Quaternion of the rotation of a pose (4, 4)."""
        return self._make(
            "geometry_msgs/msg/Quaternion", *(float(value) for value in geometry.quaternion_xyzw(pose[:3, :3]))
        )

    def _twist(self, twist_body: Array, covariance: Array) -> Any:
        """Returns geometry_msgs/TwistWithCovariance of a twist (6,) [rotation, translation].

        `covariance` (36,) is the row-major 6 x 6 matrix in the order of ROS: linear before angular velocity.
        """
        twist = self._make("geometry_msgs/msg/Twist", self._vector(twist_body[3:]), self._vector(twist_body[:3]))
        return self._make("geometry_msgs/msg/TwistWithCovariance", twist, covariance)


def _unknown_covariance() -> Array:
    """Returns the covariance (9,) that marks a quantity of sensor_msgs/Imu as not measured."""
    return np.array([_NOT_MEASURED, *[0.0] * 8])
