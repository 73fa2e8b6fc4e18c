"""Copies of recorded images into exported data sets."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from twin.core.records import Array
from twin.core.user_files import MOST_IMAGE_BYTES, read_bytes
from twin.datasets.run_contents import RecordedFrame, RunContents
from twin.errors import TwinError

_PNG_START = b"\x89PNG"
_PNG_END = b"IEND\xaeB`\x82"  # last bytes of a complete PNG file


class CopiedImage(NamedTuple):
    """An image in an exported data set."""

    name: str  #: name of the file
    frame: RecordedFrame
    camera: str  #: "left" or "right"
    left_from_camera: Array  #: (4, 4) pose of the camera in the axes of the left camera [m]


def copy_images(contents: RunContents, folder: Path, left_from_right: Array) -> Iterator[CopiedImage]:
    """Copies all recorded images to a folder as CAMERA_FRAME, for example left_000012.png, and yields each copy.

    Frames without a right image have only the left one. `left_from_right` (4, 4) is the pose of the right camera.
    """
    folder.mkdir(exist_ok=True)
    for k, frame in enumerate(contents.frames):
        for camera, file, pose in (("left", frame.left, np.eye(4)), ("right", frame.right, left_from_right)):
            if file is not None:
                copied = copy_image(file, folder / f"{camera}_{frame.index:06d}", contents.jpeg_quality)
                yield CopiedImage(copied.name, frame, camera, pose)
        contents.progress((k + 1) / len(contents.frames))


def copy_image(source: Path, stem: Path, jpeg_quality: int | None = None) -> Path:
    """Copies a PNG file to `stem` with a suffix, as it is or as JPEG (`encoded_image`); returns the new file."""
    kind, data = encoded_image(source, jpeg_quality)
    file = stem.with_name(f"{stem.name}.{'jpg' if kind == 'jpeg' else kind}")
    file.write_bytes(data)
    return file


def encoded_image(source: Path, jpeg_quality: int | None = None) -> tuple[str, bytes]:
    """Returns the format ("png" or "jpeg") and the bytes of a PNG file, as they are or, with a quality, as JPEG.

    Raises:
        TwinError: the file is truncated or not a PNG image.
        OSError: the file cannot be read.
    """
    data = read_bytes(source, most_bytes=MOST_IMAGE_BYTES)
    image = None if jpeg_quality is None else cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    if not data.startswith(_PNG_START) or not data.endswith(_PNG_END) or (image is None and jpeg_quality is not None):
        raise TwinError(str(source), "is truncated or not a PNG image", "an undamaged image of the run")
    if image is None:
        return "png", data
    return "jpeg", cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality or 0])[1].tobytes()
