"""Small ROS 2 bags for tests, written by rosbags."""

from pathlib import Path

import numpy as np
from recorded_datasets import RIG
from rosbags.rosbag2 import StoragePlugin, Writer

from twin.datasets.calibration import RecordedCamera
from twin.datasets.ros2.messages import MessageFactory

ROS = MessageFactory()
START_NS = 1_700_000_000_000_000_000
LEFT, RIGHT = "left_camera_optical_frame", "right_camera_optical_frame"


def write(path: Path, messages, storage=StoragePlugin.MCAP) -> Path:
    """Writes messages (topic, recording time [ns], message) in their order and returns the folder of the bag."""
    with Writer(path, version=8, storage_plugin=storage) as writer:
        connections = {}
        for topic, time_ns, message in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, message.__msgtype__, typestore=ROS.typestore)
            data = message if isinstance(message, bytes) else ROS.serialised(message)
            writer.write(connections[topic], time_ns, data)
    return path


def make(kind, *fields):
    """Returns a message of a type."""
    return ROS.typestore.types[kind](*fields)


def header(time_ns, frame="camera"):
    return make("std_msgs/msg/Header", make("builtin_interfaces/msg/Time", *divmod(time_ns, 10**9)), frame)


def image(pixels, encoding, time_ns=START_NS, padding=0, big_endian=False, frame=LEFT):
    """Returns sensor_msgs/Image of an array (H, W) or (H, W, channels); rows end with `padding` bytes of 7."""
    values = pixels.astype(pixels.dtype.newbyteorder(">" if big_endian else "<"))
    rows = np.ascontiguousarray(values).view(np.uint8).reshape(len(pixels), -1)
    rows = np.pad(rows, ((0, 0), (0, padding)), constant_values=7)
    return make("sensor_msgs/msg/Image", header(time_ns, frame), pixels.shape[0], pixels.shape[1], encoding,
                int(big_endian), rows.shape[1], rows.ravel())  # fmt: skip


def info(side, time_ns=START_NS, rig=RIG, **changed):
    """Returns sensor_msgs/CameraInfo of a rectified camera; `changed` replaces fields."""
    camera = RecordedCamera((rig.width_px, rig.height_px), rig.matrix, np.zeros(5))
    frame, baseline_m = (LEFT, 0.0) if side == "left" else (RIGHT, rig.baseline_m)
    message = ROS.camera_info(time_ns, frame, camera, baseline_m)
    for key, value in changed.items():
        setattr(message, key, value)
    return message


def stereo(frames, prefix="", encoding="rgb8", **changed):
    """Returns the messages of stereo frames as uncompressed images, with CameraInfo of the first pair."""
    messages = [(f"{prefix}/{side}/camera_info", START_NS, info(side, **changed)) for side in ("left", "right")]
    for frame in frames:
        time_ns = START_NS + round(frame.time_s * 1e9)
        for side, pixels, name in (("left", frame.left, LEFT), ("right", frame.right, RIGHT)):
            if pixels is not None:
                messages.append((f"{prefix}/{side}/image_rect", time_ns, image(pixels, encoding, time_ns, frame=name)))
    return messages
