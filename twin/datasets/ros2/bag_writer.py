"""Writer of ROS 2 bags in MCAP: images, calibration, transforms, odometry, readings of the navigation sensors."""

import heapq
from collections.abc import Iterator
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.optional_packages import optional
from twin.core.records import PASCAL_PER_METRE, Trajectory
from twin.datasets.image_copy import encoded_image
from twin.datasets.ros2.messages import BODY, LEFT, RIGHT, WORLD, MessageFactory
from twin.datasets.run_contents import RecordedImu, RunContents
from twin.datasets.sensor_folders import timestamp_ns
from twin.errors import TwinError

BAG = "ros2_bag"  # folder of the bag, and the name of its MCAP file
_AIR_PA = 101_325.0  # standard air pressure
Messages = Iterator[tuple[int, str, Any]]  #: time [ns], topic and message


def export(contents: RunContents, folder: Path) -> list[Path]:
    """Writes the bag `folder`/ros2_bag (MCAP and metadata.yaml); returns its path, as a list of one.

    Topics, all in the order of time (`timestamp_ns`): /left/image_rect/compressed, /left/camera_info and the same for
    right; /tf_static; /odometry and /tf of the final trajectory; /ground_truth/odometry if the truth is known; and, if
    recorded, /imu/data (attitude), /imu/data_raw (rates and specific forces), /pressure, /dvl and /usbl. TwinError if
    rosbags is not installed, the bag exists already, or an image is damaged.
    """
    rosbag2 = optional("rosbags.rosbag2", "exchange", "--to mcap")
    path, factory = folder / BAG, MessageFactory()
    if path.exists():
        raise TwinError(str(path), "exists already", "a new folder")
    with rosbag2.Writer(path, version=8, storage_plugin=rosbag2.StoragePlugin.MCAP) as writer:
        connections: dict[str, Any] = {}
        for time_ns, topic, message in _messages(contents, factory):
            if topic not in connections:
                qos = _static_qos() if topic == "/tf_static" else []
                connections[topic] = writer.add_connection(
                    topic, message.__msgtype__, typestore=factory.typestore, offered_qos_profiles=qos
                )
            writer.write(connections[topic], time_ns, factory.serialised(message))
    return [path]


def pressure_pa(height_m: float, surface_m: float) -> float:
    """Returns the pressure [Pa] at a height in the water, both above the plane z = 0, if the surface is known (> 0).

    This is the absolute pressure p = p_air + rho g (surface - height), with the standard air pressure p_air and rho g =
    `PASCAL_PER_METRE`. If the height of the surface is 0 (not known), the pressure is relative to that at z = 0.
    """
    air_pa = _AIR_PA if surface_m > 0 else 0.0
    return air_pa + PASCAL_PER_METRE * (surface_m - height_m)


def _messages(contents: RunContents, factory: MessageFactory) -> Messages:
    rig, start_ns = contents.rig, timestamp_ns(0.0)
    poses = {(BODY, LEFT): rig.body_from_camera, (BODY, RIGHT): rig.body_from_camera @ rig.left_from_right}
    static: Messages = iter([(start_ns, "/tf_static", factory.transforms(start_ns, poses))])
    streams = [static, _images(contents, factory), _readings(contents, factory)]
    if contents.imu is not None:
        streams.append(_inertial(contents.imu, factory))
    for topic, name in (("/odometry", "final"), ("/ground_truth/odometry", "truth")):
        if name in contents.trajectories and len(contents.trajectories[name]):
            streams.append(_odometry(factory, topic, contents.trajectories[name], contents.rig.body_from_camera))
    return heapq.merge(*streams, key=itemgetter(0))


def _images(contents: RunContents, factory: MessageFactory) -> Messages:
    left, right = contents.believed.left, contents.believed.right
    for k, frame in enumerate(contents.frames):
        time_ns = timestamp_ns(frame.time_s)
        for side, name, file, camera, distance_m in (
            ("left", LEFT, frame.left, left, 0.0),
            ("right", RIGHT, frame.right, right, contents.rig.baseline_m),
        ):
            if file is not None:
                image = factory.compressed_image(time_ns, name, *encoded_image(file, contents.jpeg_quality))
                yield time_ns, f"/{side}/image_rect/compressed", image
                yield time_ns, f"/{side}/camera_info", factory.camera_info(time_ns, name, camera, distance_m)
        contents.progress((k + 1) / len(contents.frames))


def _odometry(factory: MessageFactory, topic: str, trajectory: Trajectory, body_from_left: Array) -> Messages:
    """Yields pose and twist of the body at each frame; with the topic /odometry, also the pose as a message of /tf."""
    poses = trajectory.world_from_camera @ geometry.inverse(body_from_left)
    twists = body_twists(trajectory.times_s, poses)
    for time_s, pose, twist in zip(trajectory.times_s, poses, twists, strict=True):
        time_ns = timestamp_ns(time_s)
        yield time_ns, topic, factory.odometry(time_ns, pose, twist)
        if topic == "/odometry":
            yield time_ns, "/tf", factory.transforms(time_ns, {(WORLD, BODY): pose})


def body_twists(times_s: Array, poses: Array) -> Array:
    """Returns twists (n, 6) [rad/s, m/s] in body axes from the motions between poses (n, 4, 4) world_from_body."""
    # the last pose has the twist of the one before, a single pose zero
    found = np.zeros((len(poses), 6))
    for k in range(len(poses) - 1):
        motion = geometry.inverse(np.ascontiguousarray(poses[k])) @ poses[k + 1]
        found[k] = geometry.log(np.ascontiguousarray(motion)) / (times_s[k + 1] - times_s[k])
    if len(poses) > 1:
        found[-1] = found[-2]
    return found


def _readings(contents: RunContents, factory: MessageFactory) -> Messages:
    surface_m = float(contents.scenario.get("sun", {}).get("depth_m", 0.0))
    level_rad, heading_rad, height_m, sigma_mps, fix_m = contents.sigmas(
        "attitude_sigma_deg", "heading_sigma_deg", "pressure_sigma_m", "dvl_sigma_mps", "usbl_sigma_m"
    )
    sigmas_rad, sigma_pa = np.array([level_rad, level_rad, heading_rad]), PASCAL_PER_METRE * height_m
    for frame in contents.frames:
        time_ns, readings = timestamp_ns(frame.time_s), frame.readings
        if readings.ahrs_rpy_rad is not None:
            yield time_ns, "/imu/data", factory.attitude(time_ns, readings.ahrs_rpy_rad, sigmas_rad)
        if readings.pressure_z_m is not None:
            value_pa = pressure_pa(readings.pressure_z_m, surface_m)
            yield time_ns, "/pressure", factory.pressure(time_ns, value_pa, sigma_pa)
        if readings.dvl_mps is not None:
            yield time_ns, "/dvl", factory.velocity(time_ns, readings.dvl_mps, sigma_mps)
        if readings.usbl_m is not None:
            yield time_ns, "/usbl", factory.fix(time_ns, readings.usbl_m, fix_m)


def _inertial(imu: RecordedImu, factory: MessageFactory) -> Messages:
    """Yields the readings of the IMU; the variances are s^2 f of white noise of density s, sampled at the rate f."""
    root = np.sqrt(imu.rate_hz)
    sigmas = imu.noise.gyroscope_noise_density * root, imu.noise.accelerometer_noise_density * root
    for time_s, rates, forces in zip(*imu.readings, strict=True):
        time_ns = timestamp_ns(time_s)
        yield time_ns, "/imu/data_raw", factory.inertial(time_ns, rates, forces, sigmas)


def _static_qos() -> list[Any]:
    """Returns the quality of service of /tf_static: late subscribers also get the last message (transient local)."""
    interfaces = optional("rosbags.interfaces", "exchange", "--to mcap")
    forever = interfaces.QosTime(9223372036, 854775807)  # as rosbag2 writes an unlimited duration
    return [
        interfaces.Qos(
            interfaces.QosHistory.KEEP_LAST, 1, interfaces.QosReliability.RELIABLE,
            interfaces.QosDurability.TRANSIENT_LOCAL, forever, forever, interfaces.QosLiveliness.AUTOMATIC, forever,
            False,
        )
    ]  # fmt: skip
