"""Reader of ROS 2 bags: images of two topics, CameraInfo, sensor readings, and true poses of a topic that is named."""

from operator import attrgetter
from pathlib import Path
from typing import NamedTuple

import numpy as np

from twin.core.records import Trajectory
from twin.datasets.calibration import StereoCalibration
from twin.datasets.dataset import Dataset, ImageTime, pair_by_time, value_or_error
from twin.datasets.ros2.bag import Bag, is_bag
from twin.datasets.ros2.bag_images import BagImage, StereoTopics, image_topics, stereo_topics
from twin.datasets.ros2.bag_readings import read_bag
from twin.datasets.ros2.camera_info import stereo_calibration
from twin.datasets.ros2.frame_transforms import Transforms, pose_of_transform, relative_pose, static_transforms
from twin.errors import TwinError

#: Types of messages with true poses, and where the pose is in them.
_POSES = {
    "nav_msgs/msg/Odometry": "pose.pose",
    "geometry_msgs/msg/PoseStamped": "pose",
    "geometry_msgs/msg/PoseWithCovarianceStamped": "pose.pose",
    "geometry_msgs/msg/TransformStamped": "transform",
}


class BagTopics(NamedTuple):
    """Topics of a bag that the user names."""

    images: tuple[str, str] | None = None  #: topics of the left and the right images; None: the only stereo pair
    truth: str | None = None  #: topic of the true poses; None: no truth


class BagReader:
    name = "ros2"
    layout = "ROS 2 bag (FILE.mcap or a folder with metadata.yaml) with two image topics and their camera_info"

    def __init__(self, topics: BagTopics | None = None):
        self._topics = topics or BagTopics()

    def recognises(self, folder: Path) -> bool:
        return is_bag(folder)

    def read(self, folder: Path) -> Dataset:
        """Returns the data set in a bag; images are decoded only when they are used.

        Raises TwinError if the bag, its transforms or its true poses are damaged, the stereo pair is missing or
        ambiguous, a topic that the user names is missing or of another type, or rosbags is not installed.
        """
        bag = Bag(folder)
        topics = self._stereo_topics(bag)
        index = bag.index([topics.left, topics.right])
        notes = []
        if any(index.values()) and all(one.stamp_ns == 0 for images in index.values() for one in images):
            notes.append("The images have no times in their headers; the times of recording were used.")
            index = {topic: [one._replace(stamp_ns=one.logged_ns) for one in found] for topic, found in index.items()}
        left, right = (
            [ImageTime(one.stamp_ns * 1e-9, BagImage(bag, one)) for one in index[topic]]
            for topic in (topics.left, topics.right)
        )
        frames, n_right_only = pair_by_time(left, right)
        transforms, camera, truth = static_transforms(bag), _frame(bag, topics.left), None
        if self._topics.truth is not None:
            truth = _truth(bag, self._topics.truth, camera, transforms, notes)
        return Dataset(
            folder, frames, value_or_error(lambda: _calibration(bag, topics, transforms)), truth, n_right_only,
            tuple(notes), readings=value_or_error(lambda: read_bag(bag, camera, transforms)),
        )  # fmt: skip

    def _stereo_topics(self, bag: Bag) -> StereoTopics:
        images = image_topics(bag.topics)
        if self._topics.images is None:
            return stereo_topics(images, bag.first, bag.path)
        left, right = self._topics.images
        for topic in (left, right):
            if topic not in images:
                allowed = ", ".join(images) or "none in this bag"
                raise TwinError("--topics", f"{topic[:100]!r} is not an image topic of {bag.path}", allowed)
        return StereoTopics(left, right, images[left], images[right])


def _frame(bag: Bag, topic: str) -> str:
    """Returns the name of the coordinate frame (frame_id) of the images of a topic; "" without an image."""
    message = bag.first(topic)
    return "" if message is None else message.header.frame_id.lstrip("/")


def _calibration(bag: Bag, topics: StereoTopics, transforms: Transforms) -> StereoCalibration | None:
    if topics.left_info is None or topics.right_info is None:
        return None
    left, right = bag.first(topics.left_info), bag.first(topics.right_info)
    if left is None or right is None:
        return None
    frames = [info.header.frame_id.lstrip("/") for info in (left, right)]
    pose = relative_pose(transforms, frames[1], frames[0]) if all(frames) and frames[0] != frames[1] else None
    return stereo_calibration(left, right, topics.rectified, pose, Path(f"{bag.path}:{topics.right_info}"))


def _truth(bag: Bag, topic: str, camera: str, transforms: Transforms, notes: list[str]) -> Trajectory:
    """Returns the true poses of the left camera, whose frame is `camera` ("": not named), in the order of time.

    If the messages name no body or the images no frame, the recorded poses are taken as those of the left camera, and a
    note says so. Raises TwinError if the topic does not exist or has no poses, a pose is damaged, or the transforms do
    not join body and camera.
    """
    kind = bag.topics.get(topic)
    if kind not in _POSES:
        poses = [name for name, one in bag.topics.items() if one in _POSES]
        raise TwinError("--truth", f"{topic[:100]!r} is not a topic of poses of {bag.path}", ", ".join(poses) or "none")
    source, times_ns, found, body = Path(f"{bag.path}:{topic}"), [], [], ""
    for _, message in bag.messages(topic):
        stamp = message.header.stamp
        times_ns.append(stamp.sec * 1_000_000_000 + stamp.nanosec)
        found.append(pose_of_transform(attrgetter(_POSES[kind])(message), source))
        body = getattr(message, "child_frame_id", "").lstrip("/")
    if not found:
        raise TwinError(str(source), "has no poses", "at least one pose")
    body_from_left = relative_pose(transforms, body, camera) if body and camera else np.eye(4)
    if body_from_left is None:
        frames = f"the frame {body[:60]!r} of the poses and {camera[:60]!r} of the left camera"
        allowed = "a truth of the left camera, or static transforms"
        raise TwinError(str(source), f"/tf_static does not join {frames}", allowed)
    if not body or not camera:
        unnamed = "The left images" if body else f"The poses of {topic}"
        notes.append(f"{unnamed} name no frame; the poses were taken as those of the left camera.")
    order = np.argsort(times_ns, kind="stable")
    return Trajectory(np.array(times_ns)[order] * 1e-9, np.array(found)[order] @ body_from_left)
