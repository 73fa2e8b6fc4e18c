"""Images in the messages of a ROS 2 bag, decoded when needed, and the choice of the topics of a stereo pair."""

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from twin.datasets.image_files import UnreadableImage, decoded, image_header
from twin.datasets.ros2.bag import Bag, BagMessage
from twin.errors import TwinError

IMAGE, COMPRESSED_IMAGE = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
_CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
#: Words in the names of topics that state the side of a camera: left, right.
_SIDES = (
    re.compile(r"(^|[/_])(left|cam0|cam_0|camera0|camera_0|infra1|image_0)([/_]|$)", re.IGNORECASE),
    re.compile(r"(^|[/_])(right|cam1|cam_1|camera1|camera_1|infra2|image_1)([/_]|$)", re.IGNORECASE),
)
_RECTIFIED = re.compile(r"[/_]rect(_|$|/|ified)", re.IGNORECASE)
#: Encodings by the names of sensor_msgs/image_encodings.hpp: bytes per value, channels, and OpenCV's code of the
#: conversion to BGR (None for grey and BGR). In a Bayer name, the letters are the first two rows.
_ENCODINGS: dict[str, tuple[int, int, int | None]] = {
    **dict.fromkeys(("mono8", "8UC1"), (1, 1, None)),
    **dict.fromkeys(("mono16", "16UC1"), (2, 1, None)),
    **dict.fromkeys(("bgr8", "8UC3"), (1, 3, None)),
    "rgb8": (1, 3, cv2.COLOR_RGB2BGR),
    "bgra8": (1, 4, cv2.COLOR_BGRA2BGR),
    "rgba8": (1, 4, cv2.COLOR_RGBA2BGR),
    "bgr16": (2, 3, None),
    "rgb16": (2, 3, cv2.COLOR_RGB2BGR),
    **{
        f"bayer_{name.lower()}{bits}": (bits // 8, 1, getattr(cv2, f"COLOR_Bayer{name}2BGR"))
        for name in ("RGGB", "BGGR", "GBRG", "GRBG")
        for bits in (8, 16)
    },
}


class BagImage:
    """An image in an open bag (`image_files.StoredImage`); its message is read at each call of a method."""

    def __init__(self, bag: Bag, position: BagMessage):
        self._bag, self._position = bag, position

    @property
    def name(self) -> str:
        return f"{self._position.topic} at {self._position.stamp_ns * 1e-9:.3f} s"

    def size_px(self) -> tuple[int, int]:
        message = self._message()
        if hasattr(message, "format"):
            return image_header(message.data.tobytes())[:2]
        _encoding(message.encoding)
        return int(message.width), int(message.height)

    def pixels(self, size_px: tuple[int, int]) -> NDArray[Any]:
        message = self._message()
        if hasattr(message, "format"):
            return decoded(message.data.tobytes(), size_px)
        return raw_pixels(message, size_px)

    def _message(self) -> Any:
        try:
            return self._bag.message(self._position)
        except ValueError:
            raise UnreadableImage("damaged message") from None


def raw_pixels(message: Any, size_px: tuple[int, int]) -> NDArray[Any]:
    """Returns the values of a sensor_msgs/Image, (H, W) or BGR (H, W, 3), uint8, uint16; may raise UnreadableImage."""
    value_bytes, channels, code = _encoding(message.encoding)
    width, height, step = int(message.width), int(message.height), int(message.step)
    if (width, height) != size_px:
        raise UnreadableImage("another size")
    row_bytes = width * channels * value_bytes
    if step < row_bytes or len(message.data) < step * height:
        raise UnreadableImage("truncated")
    values = np.ascontiguousarray(message.data[: step * height].reshape(height, step)[:, :row_bytes])
    if value_bytes == 2:
        values = values.view(">u2" if message.is_bigendian else "<u2").astype(np.uint16)
    if channels > 1:
        values = values.reshape(height, width, channels)
    return values if code is None else np.asarray(cv2.cvtColor(values, code))


def _encoding(name: str) -> tuple[int, int, int | None]:
    if name not in _ENCODINGS:
        raise UnreadableImage(f"encoding {name[:30]!r} is not supported")
    return _ENCODINGS[name]


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
    """Returns the image topics among topics and their types, with NAMESPACE/camera_info, or None if not recorded."""
    found = {}
    for topic, kind in topics.items():
        if kind in (IMAGE, COMPRESSED_IMAGE) and not topic.endswith("/compressedDepth"):
            image = topic.removesuffix("/compressed") if kind == COMPRESSED_IMAGE else topic
            info = f"{image.rpartition('/')[0]}/camera_info"
            found[topic] = info if topics.get(info) == _CAMERA_INFO else None
    return found


def stereo_topics(images: Mapping[str, str | None], first: Callable[[str], Any], path: Path) -> StereoTopics:
    """Returns the only stereo pair among the image topics (`image_topics`) that have a calibration.

    A topic of uncompressed images takes precedence over that of the same images in compressed form. Left and right are
    recognised by words such as "left" or "cam0". If these do not decide and there are two topics, the right camera is
    the one whose projection matrix has a baseline (P[0, 3] < 0); `first` returns the first message of a topic, or None.
    Raises TwinError if the bag `path` has no pair with calibrations, or several.
    """
    compressed = {f"{topic}/compressed" for topic in images}  # of topics that are also recorded uncompressed
    calibrated = {topic: info for topic, info in images.items() if info and topic not in compressed}
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
