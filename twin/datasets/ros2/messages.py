"""ROS 2 messages of an exported run. Frames and axes follow REP 103, REP 104 and REP 105.

`world` has x east, y north, z up; `base_link`, the body, has x forward, y left, z up; the camera frames have x to the
right and y down in the image, and z along the optical axis.
"""

from typing import Any

import numpy as np

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.optional_packages import optional
from twin.datasets.calibration import RecordedCamera

WORLD, BODY = "world", "base_link"
LEFT, RIGHT = "left_camera_optical_frame", "right_camera_optical_frame"
_PURPOSE = "--to mcap"
_NOT_MEASURED = -1.0  # first element of a covariance of sensor_msgs/Imu whose quantity is not measured
_UNKNOWN = np.array([_NOT_MEASURED, *[0.0] * 8])  # such a covariance


class MessageFactory:
    """Makes and serialises messages of ROS 2 Humble, given the time [ns] of a reading and the values in it."""

    def __init__(self) -> None:
        typesys = optional("rosbags.typesys", "exchange", _PURPOSE)
        self.typestore: Any = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)

    def serialised(self, message: Any) -> Any:
        return self.typestore.serialize_cdr(message, message.__msgtype__)

    def compressed_image(self, time_ns: int, frame: str, kind: str, data: bytes) -> Any:
        """Returns sensor_msgs/CompressedImage with the bytes of an image file; `kind` is "png" or "jpeg"."""
        # As in compressed_image_transport, "rgb8; png compressed bgr8" is a file of bgr8 that becomes rgb8 for
        # subscribers.
        values = np.frombuffer(data, np.uint8)
        header = self._header(time_ns, frame)
        return self._make("sensor_msgs/CompressedImage", header, f"rgb8; {kind} compressed bgr8", values)

    def camera_info(self, time_ns: int, frame: str, camera: RecordedCamera, baseline_m: float) -> Any:
        """Returns sensor_msgs/CameraInfo of a rectified image; P[0, 3] = -fx baseline, 0 for the left camera."""
        assert camera.size_px is not None
        projection = np.column_stack([camera.matrix, [-camera.matrix[0, 0] * baseline_m, 0.0, 0.0]])
        return self._make(
            "sensor_msgs/CameraInfo", self._header(time_ns, frame), camera.size_px[1], camera.size_px[0],
            "plumb_bob", np.array(camera.distortion, np.float64), camera.matrix.ravel(), np.eye(3).ravel(),
            projection.ravel(), 0, 0, self._make("sensor_msgs/RegionOfInterest", 0, 0, 0, 0, False),
        )  # fmt: skip

    def odometry(self, time_ns: int, world_from_body: Array, twist_body: Array) -> Any:
        """Returns nav_msgs/Odometry of the body in the world; its covariances are zero, that is, not stated."""
        pose = self._make("geometry_msgs/Pose", *self._place(world_from_body, "geometry_msgs/Point"))
        with_cov = self._make("geometry_msgs/PoseWithCovariance", pose, np.zeros(36))
        twist = self._twist(twist_body, np.zeros(36))
        return self._make("nav_msgs/Odometry", self._header(time_ns, WORLD), BODY, with_cov, twist)

    def transforms(self, time_ns: int, poses: dict[tuple[str, str], Array]) -> Any:
        """Returns tf2_msgs/TFMessage with poses (4, 4) by the names of the parent frame and of the frame."""
        found = []
        for (parent, child), pose in poses.items():
            transform = self._make("geometry_msgs/Transform", *self._place(pose, "geometry_msgs/Vector3"))
            header = self._header(time_ns, parent)
            found.append(self._make("geometry_msgs/TransformStamped", header, child, transform))
        return self._make("tf2_msgs/TFMessage", found)

    def attitude(self, time_ns: int, rpy_rad: Array, sigmas_rad: Array) -> Any:
        """Returns sensor_msgs/Imu with the attitude of the body (3,) in the world, without rates and accelerations."""
        attitude = geometry.rotation_from_rpy(*(float(angle) for angle in rpy_rad))
        cov, zero = np.diag(np.square(sigmas_rad)).ravel(), np.zeros(3)
        return self._imu(time_ns, (attitude, cov), (zero, _UNKNOWN), (zero, _UNKNOWN))

    def inertial(self, time_ns: int, rates_radps: Array, forces_mps2: Array, sigmas: tuple[float, float]) -> Any:
        """Returns sensor_msgs/Imu: rates (3,), specific forces (3,) in body axes, their noise; no orientation."""
        rate_cov, force_cov = (np.diag([sigma**2] * 3).ravel() for sigma in sigmas)
        return self._imu(time_ns, (np.eye(3), _UNKNOWN), (rates_radps, rate_cov), (forces_mps2, force_cov))

    def _imu(self, time_ns: int, attitude: tuple[Array, Array], *vectors: tuple[Array, Array]) -> Any:
        fields = [self._quaternion(attitude[0]), attitude[1].copy()]
        for vector, cov in vectors:
            fields += [self._vector(vector), cov.copy()]
        return self._make("sensor_msgs/Imu", self._header(time_ns, BODY), *fields)

    def pressure(self, time_ns: int, pressure_pa: float, sigma_pa: float) -> Any:
        """Returns sensor_msgs/FluidPressure of the sensor, which is at the left camera."""
        return self._make("sensor_msgs/FluidPressure", self._header(time_ns, LEFT), pressure_pa, sigma_pa**2)

    def velocity(self, time_ns: int, velocity_mps: Array, sigma_mps: float) -> Any:
        """Returns geometry_msgs/TwistWithCovarianceStamped with a velocity (3,) over ground in body axes, no rates."""
        covariance = np.diag([sigma_mps**2] * 3 + [_NOT_MEASURED] * 3).ravel()
        twist = self._twist(np.concatenate([np.zeros(3), velocity_mps]), covariance)
        return self._make("geometry_msgs/TwistWithCovarianceStamped", self._header(time_ns, BODY), twist)

    def fix(self, time_ns: int, position_m: Array, sigma_m: float) -> Any:
        """Returns PoseWithCovarianceStamped with the position (3,) of the left camera in the world, no orientation."""
        covariance = np.diag([sigma_m**2] * 3 + [_NOT_MEASURED] * 3).ravel()
        pose = self._make(
            "geometry_msgs/Pose", *self._place(geometry.pose(np.eye(3), position_m), "geometry_msgs/Point")
        )
        with_cov = self._make("geometry_msgs/PoseWithCovariance", pose, covariance)
        return self._make("geometry_msgs/PoseWithCovarianceStamped", self._header(time_ns, WORLD), with_cov)

    def _make(self, kind: str, *fields: Any) -> Any:
        return self.typestore.types[kind.replace("/", "/msg/")](*fields)

    def _header(self, time_ns: int, frame: str) -> Any:
        stamp = self._make("builtin_interfaces/Time", *divmod(time_ns, 1_000_000_000))
        return self._make("std_msgs/Header", stamp, frame)

    def _vector(self, vector: Array, kind: str = "geometry_msgs/Vector3") -> Any:
        return self._make(kind, *(float(value) for value in vector))

    def _quaternion(self, rotation: Array) -> Any:
        return self._vector(geometry.quaternion_xyzw(rotation), "geometry_msgs/Quaternion")

    def _place(self, pose: Array, kind: str) -> tuple[Any, Any]:
        return self._vector(pose[:3, 3], kind), self._quaternion(pose[:3, :3])

    def _twist(self, twist_body: Array, covariance: Array) -> Any:
        """Returns geometry_msgs/TwistWithCovariance of [rotation, translation] (6,); covariance (36,) as in ROS."""
        twist = self._make("geometry_msgs/Twist", self._vector(twist_body[3:]), self._vector(twist_body[:3]))
        return self._make("geometry_msgs/TwistWithCovariance", twist, covariance)
