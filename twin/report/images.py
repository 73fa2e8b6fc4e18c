"""Reads image files and encodes images as downscaled JPEG data."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from twin.core.records import Image

JPEG_QUALITY = 78


def jpeg_bytes(image: Image, longest_px: int) -> bytes:
    """Returns an RGB image as JPEG data, downscaled to a longer side of `longest_px` if it is larger."""
    if (scale := longest_px / max(image.shape[:2])) < 1:
        image = np.asarray(cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8)
    _, data = cv2.imencode(".jpg", np.ascontiguousarray(image[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return data.tobytes()


def read_rgb(file: Path) -> Image | None:
    """Returns an image file as RGB; None if it is missing or not an image."""
    image = cv2.imread(str(file), cv2.IMREAD_COLOR_RGB)
    return None if image is None else np.asarray(image, np.uint8)
