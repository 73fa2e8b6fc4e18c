"""Reads image files and encodes images as downscaled JPEG data."""

from pathlib import Path

import cv2
import numpy as np

from twin.core.records import Image
from twin.core.user_files import MOST_IMAGE_BYTES, read_bytes
from twin.errors import TwinError

JPEG_QUALITY = 78
_SIGNATURES = (b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff")


def jpeg_bytes(image: Image, longest_px: int) -> bytes:
    """Returns an RGB image as JPEG data, downscaled to a longer side of `longest_px` if it is larger."""
    image = reduced(image, longest_px)
    _, data = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return data.tobytes()


def reduced(image: Image, longest_px: int) -> Image:
    """Returns an image downscaled to a longer side of `longest_px` if it is larger."""
    scale = longest_px / max(image.shape[:2])
    if scale >= 1:
        return image
    return np.asarray(cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8)


def png_bytes(image: Image) -> bytes:
    _, data = cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_PNG_COMPRESSION, 6])
    return data.tobytes()


def read_rgb(file: Path) -> Image | None:
    """Returns a PNG or JPEG file as RGB; None if it is missing or not such an image."""
    try:
        data = read_bytes(file, most_bytes=MOST_IMAGE_BYTES)
    except TwinError:
        return None
    if not data.startswith(_SIGNATURES):
        return None
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR_RGB)
    return None if image is None else np.asarray(image, np.uint8)
