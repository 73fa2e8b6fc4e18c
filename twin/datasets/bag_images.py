"""Images in the messages of a ROS 2 bag: sensor_msgs/Image and sensor_msgs/CompressedImage, decoded when needed."""

from __future__ import annotations

from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from twin.datasets.bag import Bag, BagMessage
from twin.datasets.image_files import UnreadableImage, decoded, encoded_size

IMAGE, COMPRESSED_IMAGE = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"


class _Encoding(NamedTuple):
    """Encoding of sensor_msgs/Image: bytes per value, number of channels, and OpenCV's code for the conversion to BGR.

    The code is None for grey and BGR images, which are not converted.
    """

    value_bytes: int
    channels: int
    code: int | None = None


#: Encodings by the names of sensor_msgs/image_encodings.hpp. In a Bayer name, the letters are the first two rows.
_ENCODINGS = {
    "mono8": _Encoding(1, 1),
    "8UC1": _Encoding(1, 1),
    "mono16": _Encoding(2, 1),
    "16UC1": _Encoding(2, 1),
    "bgr8": _Encoding(1, 3),
    "8UC3": _Encoding(1, 3),
    "rgb8": _Encoding(1, 3, cv2.COLOR_RGB2BGR),
    "bgra8": _Encoding(1, 4, cv2.COLOR_BGRA2BGR),
    "rgba8": _Encoding(1, 4, cv2.COLOR_RGBA2BGR),
    "bgr16": _Encoding(2, 3),
    "rgb16": _Encoding(2, 3, cv2.COLOR_RGB2BGR),
    **{
        f"bayer_{name.lower()}{bits}": _Encoding(bits // 8, 1, getattr(cv2, f"COLOR_Bayer{name}2BGR"))
        for name in ("RGGB", "BGGR", "GBRG", "GRBG")
        for bits in (8, 16)
    },
}


class BagImage:
    """An image in a bag; its message is read from the bag at each call of a method.

    Args:
        bag: the open bag.
        position: position of the message in the bag.
    """

    def __init__(self, bag: Bag, position: BagMessage):
        self._bag, self._position = bag, position

    @property
    def name(self) -> str:
        """Returns the topic and the time [s] of the image, for messages."""
        return f"{self._position.topic} at {self._position.stamp_ns * 1e-9:.3f} s"

    def size_px(self) -> tuple[int, int]:
        """Returns (width, height) [px].

        Raises:
            UnreadableImage: the message is damaged or of an unknown encoding.
        """
        message = self._message()
        if hasattr(message, "format"):
            return encoded_size(message.data.tobytes())
        _encoding(message.encoding)
        return int(message.width), int(message.height)

    def pixels(self, size_px: tuple[int, int]) -> NDArray[Any]:
        """Returns the values of the image, (H, W) or (H, W, channels) in the order BGR(A), uint8 or uint16.

        Args:
            size_px: (width, height) that the image must have.

        Raises:
            UnreadableImage: the message is damaged, of an unknown encoding or of another size.
        """
        message = self._message()
        if hasattr(message, "format"):
            return decoded(message.data.tobytes(), size_px)
        return raw_pixels(message, size_px)

    def _message(self) -> Any:
        """Returns the message; raises UnreadableImage if it is damaged."""
        try:
            return self._bag.message(self._position)
        except ValueError:
            raise UnreadableImage("damaged message") from None


def raw_pixels(message: Any, size_px: tuple[int, int]) -> NDArray[Any]:
    """Returns the values of a message sensor_msgs/Image, (H, W) or (H, W, 3) in the order BGR, uint8 or uint16.

    Args:
        message: the message: `width`, `height`, `encoding`, `is_bigendian`, `step` (bytes per row) and `data`.
        size_px: (width, height) that the image must have.

    Raises:
        UnreadableImage: the encoding is unknown, or the image has another size or too few bytes.
    """
    encoding = _encoding(message.encoding)
    width, height, step = int(message.width), int(message.height), int(message.step)
    if (width, height) != size_px:
        raise UnreadableImage("another size")
    row_bytes = width * encoding.channels * encoding.value_bytes
    if step < row_bytes or len(message.data) < step * height:
        raise UnreadableImage("truncated")
    rows = np.ascontiguousarray(message.data[: step * height].reshape(height, step)[:, :row_bytes])
    values = rows
    if encoding.value_bytes == 2:
        values = rows.view(">u2" if message.is_bigendian else "<u2").astype(np.uint16)
    if encoding.channels > 1:
        values = values.reshape(height, width, encoding.channels)
    return values if encoding.code is None else np.asarray(cv2.cvtColor(values, encoding.code))


def _encoding(name: str) -> _Encoding:
    """Returns the encoding of this name; raises UnreadableImage if it is not supported."""
    if name not in _ENCODINGS:
        raise UnreadableImage(f"encoding {name[:30]!r} is not supported")
    return _ENCODINGS[name]
