"""Reader of ROS 2 bags: images of two topics, CameraInfo, sensor readings, and true poses of a topic that is named."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from twin.core.records import Trajectory
from twin.datasets.bag import Bag, BagMessage, is_bag
from twin.datasets.bag_calibration import (
    Transforms,
    add_transforms,
    pose_of_transform,
    relative_pose,
    stereo_calibration,
)
from twin.datasets.bag_images import BagImage
from twin.datasets.bag_readings import read_bag
from twin.datasets.bag_topics import StereoTopics, image_topics, stereo_topics
from twin.datasets.calibration import StereoCalibration
from twin.datasets.dataset import Dataset, ImageTime, pair_by_time, value_or_error
from twin.errors import TwinError

_CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
#: Types of messages with true poses, and where the pose is in them.
_POSES = {
    "nav_msgs/msg/Odometry": ("pose", "pose"),
    "geometry_msgs/msg/PoseStamped": ("pose",),
    "geometry_msgs/msg/PoseWithCovarianceStamped": ("pose", "pose"),
    "geometry_msgs/msg/TransformStamped": ("transform",),
}
_MOST_TRANSFORMS = 10_000


class BagTopics(NamedTuple):
    """Topics of a bag that the user names.

    Args:
        left, right: topics of the images; if one is None, the reader chooses both.
        truth: topic of the true poses; None: no truth.
    """

    left: str | None = None
    right: str | None = None
    truth: str | None = None


class BagReader:
    """Reads ROS 2 bags: MCAP or SQLite files, or folders with metadata.yaml.

    Args:
        topics: topics that the user names.
    """

    name = "ros2"
    layout = "ROS 2 bag (FILE.mcap or a folder with metadata.yaml) with two image topics and their camera_info"

    def __init__(self, topics: BagTopics | None = None):
        self._topics = topics or BagTopics()

    def recognises(self, folder: Path) -> bool:
        """Returns whether a path is an MCAP or SQLite file by its suffix, or the folder of a ROS 2 bag (`is_bag`)."""
        return is_bag(folder)

    def read(self, folder: Path) -> Dataset:
        """Returns the data set in a bag; images are decoded only when they are used.

        Raises:
            TwinError: the bag, its transforms or its true poses are damaged, the stereo pair is missing or ambiguous,
                a topic that the user names is missing or of another type, or rosbags is not installed.
        """
        bag = Bag(folder)
        topics = self._stereo_topics(bag)
        index = bag.index([topics.left, topics.right])
        notes = []
        if any(index.values()) and all(one.stamp_ns == 0 for images in index.values() for one in images):
            notes.append("The images have no times in their headers; the times of recording were used.")
            index = {topic: [one._replace(stamp_ns=one.logged_ns) for one in found] for topic, found in index.items()}
        left, right = (_image_times(bag, index[topic]) for topic in (topics.left, topics.right))
        frames, n_right_only = pair_by_time(left, right)
        transforms = _static_transforms(bag)
        calibration = value_or_error(lambda: _calibration(bag, topics, transforms))
        truth = None
        if self._topics.truth is not None:
            truth, note = _truth(bag, self._topics.truth, _frame(bag, topics.left), transforms)
            notes += [note] if note else []
        camera = _frame(bag, topics.left)
        readings = value_or_error(lambda: read_bag(bag, camera, transforms))
        return Dataset(folder, frames, calibration, truth, n_right_only, tuple(notes), readings=readings)

    def _stereo_topics(self, bag: Bag) -> StereoTopics:
        """Returns the image topics of both cameras: those that the user names, or the only pair in the bag.

        Raises:
            TwinError: a named topic is not an image topic, or, without named topics, the bag has no or several stereo
            pairs.
        """
        given = self._topics.left, self._topics.right
        images = image_topics(bag.topics)
        if given[0] is None or given[1] is None:
            return stereo_topics(images, lambda topic: bag.first(topic), bag.path)
        for topic in given:
            if topic not in images:
                allowed = ", ".join(images) or "none in this bag"
                raise TwinError("--topics", f"{str(topic)[:100]!r} is not an image topic of {bag.path}", allowed)
        return StereoTopics(given[0], given[1], images[given[0]], images[given[1]])


def _image_times(bag: Bag, positions: list[BagMessage]) -> list[ImageTime]:
    """Returns the times [s] of the images at the positions, in their order."""
    return [ImageTime(one.stamp_ns * 1e-9, BagImage(bag, one)) for one in positions]


def _calibration(bag: Bag, topics: StereoTopics, transforms: Transforms) -> StereoCalibration | None:
    """Returns the calibration in the first messages CameraInfo of both cameras; None if one of the cameras has none.

    Raises:
        TwinError: the bag is damaged, or the calibration cannot be used.
    """
    if topics.left_info is None or topics.right_info is None:
        return None
    left, right = bag.first(topics.left_info), bag.first(topics.right_info)
    if left is None or right is None:
        return None
    frames = [info.header.frame_id.lstrip("/") for info in (left, right)]
    pose = relative_pose(transforms, frames[1], frames[0]) if all(frames) and frames[0] != frames[1] else None
    file = Path(f"{bag.path}:{topics.right_info}")
    return stereo_calibration(left, right, topics.rectified, pose, file)


def _static_transforms(bag: Bag) -> Transforms:
    """Returns the transforms in /tf_static: frame -> (parent, pose of the frame in its parent).

    Raises:
        TwinError: the bag is damaged, there are more than 10,000 frames, or a transform is not a pose.
    """
    found: Transforms = {}
    if bag.topics.get("/tf_static") != "tf2_msgs/msg/TFMessage":
        return found
    for message in bag.messages("/tf_static"):
        add_transforms(found, message, Path(f"{bag.path}:/tf_static"))
        if len(found) > _MOST_TRANSFORMS:
            raise TwinError(f"{bag.path}:/tf_static", f"has more than {_MOST_TRANSFORMS} frames")
    return found


def _frame(bag: Bag, topic: str) -> str:
    """Returns the name of the coordinate frame (frame_id) of the images of a topic; "" without an image."""
    message = bag.first(topic)
    return "" if message is None else message.header.frame_id.lstrip("/")


def _truth(bag: Bag, topic: str, camera: str, transforms: Transforms) -> tuple[Trajectory, str]:
    """Returns the true poses of the left camera in the order of time, and a note on an assumption ("" for none).

    If the messages name no body or the images no frame, the recorded poses are taken as those of the left camera.

    Args:
        bag: the bag.
        topic: topic of the poses.
        camera: frame of the left camera; "" if the images name none.
        transforms: static transforms, for the pose of the camera in the body whose poses are recorded.

    Raises:
        TwinError: the bag is damaged, the topic does not exist or has no poses, a pose is damaged, or the transforms do
            not join body and camera.
    """
    kind = bag.topics.get(topic)
    if kind not in _POSES:
        poses = [name for name, one in bag.topics.items() if one in _POSES]
        raise TwinError("--truth", f"{topic[:100]!r} is not a topic of poses of {bag.path}", ", ".join(poses) or "none")
    source, times_ns, found, body = Path(f"{bag.path}:{topic}"), [], [], ""
    for message in bag.messages(topic):
        stamp = message.header.stamp
        times_ns.append(stamp.sec * 1_000_000_000 + stamp.nanosec)
        found.append(pose_of_transform(_field(message, _POSES[kind]), source))
        body = getattr(message, "child_frame_id", "").lstrip("/")
    if not found:
        raise TwinError(str(source), "has no poses", "at least one pose")
    order = np.argsort(times_ns, kind="stable")
    body_from_left = relative_pose(transforms, body, camera) if body and camera else np.eye(4)
    if body_from_left is None:
        problem = (
            f"/tf_static does not join the frame {body[:60]!r} of the poses and {camera[:60]!r} of the left camera"
        )
        raise TwinError(str(source), problem, "a truth of the left camera, or static transforms")
    unnamed = f"The poses of {topic}" if not body else "The left images" if not camera else ""
    note = f"{unnamed} name no frame; the poses were taken as those of the left camera." if unnamed else ""
    times_s = np.array(times_ns)[order] * 1e-9
    return Trajectory(times_s, np.array(found)[order] @ body_from_left), note


def _field(message: Any, path: tuple[str, ...]) -> Any:
    """Returns a nested field of a message, given the names of the fields from the outermost to the innermost."""
    for name in path:
        message = getattr(message, name)
    return message
