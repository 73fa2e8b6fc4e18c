"""Choice of the two image topics of a ROS 2 bag: those with a camera_info, left and right by name or by baseline."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from twin.datasets.ros2.bag_images import COMPRESSED_IMAGE, IMAGE
from twin.errors import TwinError

_CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
#: Words in the names of topics that state the side of a camera: left, right.
_SIDES = (
    re.compile(r"(^|[/_])(left|cam0|cam_0|camera0|camera_0|infra1|image_0)([/_]|$)", re.IGNORECASE),
    re.compile(r"(^|[/_])(right|cam1|cam_1|camera1|camera_1|infra2|image_1)([/_]|$)", re.IGNORECASE),
)
_RECTIFIED = re.compile(r"[/_]rect(_|$|/|ified)", re.IGNORECASE)


class StereoTopics(NamedTuple):
    """Image topics of both cameras, and the topics of their calibrations; None for one that was not recorded."""

    left: str
    right: str
    left_info: str | None
    right_info: str | None

    @property
    def rectified(self) -> bool:
        """Returns whether both topics are named as image_proc names rectified images, for example `image_rect`."""
        return all(_RECTIFIED.search(topic) is not None for topic in (self.left, self.right))


def image_topics(topics: Mapping[str, str]) -> dict[str, str | None]:
    """Returns the image topics of a bag, each with the topic of its calibration, or None if this was not recorded.

    The topic of the calibration of an image topic NAMESPACE/NAME or NAMESPACE/NAME/compressed is NAMESPACE/camera_info.
    `topics` has the type of the messages of each topic of the bag.
    """
    found = {}
    for topic, kind in topics.items():
        if kind in (IMAGE, COMPRESSED_IMAGE) and not topic.endswith("/compressedDepth"):
            image = topic.removesuffix("/compressed") if kind == COMPRESSED_IMAGE else topic
            info = f"{image.rpartition('/')[0]}/camera_info"
            found[topic] = info if topics.get(info) == _CAMERA_INFO else None
    return found


def stereo_topics(images: Mapping[str, str | None], first: Callable[[str], Any], path: Path) -> StereoTopics:
    """Returns the only stereo pair among the image topics (`image_topics`) that have a calibration.

    A topic of uncompressed images takes precedence over the topic of the same images in compressed form. Left and
    right are recognised by words in the topics, such as "left" or "cam0". If these do not decide and there are two
    topics, the right camera is the one whose projection matrix P has a baseline (P[0, 3] < 0); `first` returns the
    first message of a topic, or None.

    Raises:
        TwinError: the bag `path` has no pair with calibrations, or several.
    """
    calibrated = {topic: info for topic, info in images.items() if info and not _has_uncompressed(topic, images)}
    sides = [[topic for topic in calibrated if word.search(topic)] for word in _SIDES]
    if [len(side) for side in sides] != [1, 1] and len(calibrated) == 2:
        infos = {topic: first(info) for topic, info in calibrated.items()}
        is_right = {topic: float(info.p[3]) < 0 for topic, info in infos.items() if info is not None}
        sides = [[topic for topic in is_right if is_right[topic] == right] for right in (False, True)]
    if [len(side) for side in sides] == [1, 1] and sides[0] != sides[1]:
        (left,), (right,) = sides
        return StereoTopics(left, right, images[left], images[right])
    found = ", ".join(images)
    problem = "which two image topics are a stereo pair is ambiguous" if calibrated else "has no stereo pair"
    allowed = f"--topics LEFT,RIGHT of: {found}" if found else "a bag with sensor_msgs/Image or CompressedImage"
    raise TwinError(str(path), problem, allowed)


def _has_uncompressed(topic: str, images: Mapping[str, str | None]) -> bool:
    """Returns whether the images of a compressed topic are also recorded uncompressed."""
    return topic.endswith("/compressed") and topic.removesuffix("/compressed") in images
