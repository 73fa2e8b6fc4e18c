"""Images in the messages of a ROS 2 bag: sensor_msgs/Image and sensor_msgs/CompressedImage, decoded when needed."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from twin.datasets.image_files import UnreadableImage, decoded, encoded_size
from twin.datasets.ros2.bag import Bag, BagMessage

IMAGE, COMPRESSED_IMAGE = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
#: Encodings by the names of sensor_msgs/image_encodings.hpp: bytes per value, channels, and OpenCV's code of the
#: conversion to BGR (None for grey and BGR). In a Bayer name, the letters are the first two rows.
_ENCODINGS: dict[str, tuple[int, int, int | None]] = {
    "mono8": (1, 1, None),
    "8UC1": (1, 1, None),
    "mono16": (2, 1, None),
    "16UC1": (2, 1, None),
    "bgr8": (1, 3, None),
    "8UC3": (1, 3, None),
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
        """Returns the topic and the time [s] of the image, for messages."""
        return f"{self._position.topic} at {self._position.stamp_ns * 1e-9:.3f} s"

    def size_px(self) -> tuple[int, int]:
        """Returns (width, height); raises UnreadableImage if the message is damaged or of an unknown encoding."""
        message = self._message()
        if hasattr(message, "format"):
            return encoded_size(message.data.tobytes())
        _encoding(message.encoding)
        return int(message.width), int(message.height)

    def pixels(self, size_px: tuple[int, int]) -> NDArray[Any]:
        """Returns the values of the image (`StoredImage.pixels`)."""
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
    """Returns the values of a message sensor_msgs/Image, (H, W) or (H, W, 3) in the order BGR, uint8 or uint16.

    Raises:
        UnreadableImage: the encoding is unknown, or the image has too few bytes or another size than `size_px`.
    """
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
