"""Illumination pattern of the lamps in colour, and the gain that removes it from the colours of a map."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from twin.core.records import Image, StereoRig

Map = NDArray[np.float32]


class MeanIllumination:
    """Illumination pattern of the lamps, estimated as the mean of all images added so far.

    The lamps are fixed to the camera, so their pattern remains in the mean, and the texture of the floor averages out.

    Args:
        rig: calibration of the images, of which only the image size is used.
    """

    def __init__(self, rig: StereoRig) -> None:
        self._size = (rig.width_px, rig.height_px)
        self._sum = np.zeros((-(-rig.height_px // 4), -(-rig.width_px // 4), 3), np.float32)
        self._count = 0

    def add(self, rgb: Image) -> None:
        """Adds an image (H, W, 3), reduced to a quarter of its width and height and blurred, to the mean."""
        small = cv2.resize(rgb, self._sum.shape[1::-1], interpolation=cv2.INTER_AREA).astype(np.float32)
        self._sum += cv2.blur(small, (9, 9))
        self._count += 1

    def gain(self) -> Map:
        """Returns the factor (H, W, 3) by which to multiply an image to make its illumination uniform.

        At least one image must have been added.
        """
        mean = self._sum / self._count + 1
        return np.asarray(cv2.resize(mean.mean(axis=(0, 1)) / mean, self._size), np.float32)
