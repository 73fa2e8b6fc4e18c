"""Copies of recorded images into exported data sets."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from twin.core.user_files import MOST_IMAGE_BYTES, read_bytes
from twin.datasets.run_contents import RecordedFrame, RunContents
from twin.errors import TwinError

_PNG_START = b"\x89PNG"
_PNG_END = b"IEND\xaeB`\x82"  # last bytes of a complete PNG file


class CopiedImage(NamedTuple):
    """An image in an exported data set."""

    file: Path
    frame: RecordedFrame
    camera: str  #: "left" or "right"


def copy_images(
    contents: RunContents, stem: Callable[[str, RecordedFrame], Path], frames: Sequence[RecordedFrame] | None = None
) -> list[CopiedImage]:
    """Copies images of recorded frames (default: all) to `stem(camera, frame)` plus suffix; reports the progress."""
    frames, copied = contents.frames if frames is None else frames, list[CopiedImage]()
    for k, frame in enumerate(frames):
        for camera, file in (("left", frame.left), ("right", frame.right)):
            if file is not None:
                target = stem(camera, frame)
                target.parent.mkdir(parents=True, exist_ok=True)
                copied.append(CopiedImage(copy_image(file, target, contents.jpeg_quality), frame, camera))
        contents.progress((k + 1) / len(frames))
    return copied


def copy_all(contents: RunContents, folder: Path) -> list[CopiedImage]:
    """Copies all recorded images to a folder as CAMERA_FRAME, for example left_000012.png; returns the copies."""
    folder.mkdir(exist_ok=True)
    return copy_images(contents, lambda camera, frame: folder / f"{camera}_{frame.index:06d}")


def copy_image(source: Path, stem: Path, jpeg_quality: int | None = None) -> Path:
    """Copies a PNG file to `stem` with a suffix, as it is or as JPEG (`encoded_image`); returns the new file."""
    kind, data = encoded_image(source, jpeg_quality)
    file = stem.with_name(f"{stem.name}.{'jpg' if kind == 'jpeg' else kind}")
    file.write_bytes(data)
    return file


def encoded_image(source: Path, jpeg_quality: int | None = None) -> tuple[str, bytes]:
    """Returns the format ("png" or "jpeg") and the bytes of a PNG file, as they are or, with a quality, as JPEG.

    Raises TwinError if the file is truncated or not a PNG image, OSError if it cannot be read.
    """
    data = read_bytes(source, most_bytes=MOST_IMAGE_BYTES)
    image = None if jpeg_quality is None else cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    if not data.startswith(_PNG_START) or not data.endswith(_PNG_END) or (image is None and jpeg_quality is not None):
        raise TwinError(str(source), "is truncated or not a PNG image", "an undamaged image of the run")
    if image is None:
        return "png", data
    return "jpeg", cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality or 0])[1].tobytes()
