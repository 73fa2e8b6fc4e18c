"""Distribution of the texture over the windows of dense matching.

The Cramér-Rao bound of an image contains the RMS gradient of the whole image (`matchability`). Dense matching fits a
plane of disparities in a small Gaussian window, so the bound of a pixel contains the RMS gradient g in that window:
it is the bound of the image times G / g, with the RMS gradient G of the image. Over even texture, such as sand, g is
nearly the same in all windows. Over reefs, g is several times larger at bright edges than in dark areas without
texture. Gradients also vary with the light over the image; that part is removed here, because it belongs to the
position in the image (`matchability.PositionDependence`).
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from twin.core.geometry import Array

WINDOW_PX = 5  #: side of the windows, with about the area of the Gaussian window of `estimate.vision.epipolar`
_WEAKEST = 0.05  # smallest RMS gradient of a window that is counted, relative to that of the image


class WindowTexture(NamedTuple):
    """Distribution over windows of the Cramér-Rao bound of matching in one window."""

    median_ratio: float  #: bound of the median window, divided by that of the RMS gradient of the image
    scatter: float  #: standard deviation over windows of the logarithm of the bound


_EVEN = np.ones((1, 1))  # relative gradients of an evenly lit image
EVEN_TEXTURE = WindowTexture(1.0, 0.0)


def window_texture(signal: NDArray[np.floating], relative_gradients: Array = _EVEN) -> WindowTexture:
    """Returns the distribution of the bound over the windows of an image.

    It is `EVEN_TEXTURE` for an image that has no texture or is smaller than a window.

    Args:
        signal: (rows, cols) grey levels of the part of the image that the texture causes, without noise.
        relative_gradients: (r, c) RMS gradients of an even texture in blocks of the image, relative to the whole image.
    """
    squares = np.diff(signal.astype(np.float64), axis=1) ** 2
    squares /= cv2.resize(np.square(relative_gradients), squares.shape[::-1], interpolation=cv2.INTER_LINEAR)
    whole = float(np.sqrt(squares.mean()))
    inner = WINDOW_PX // 2
    # the running sums of the blur end just below zero in windows without texture
    means = np.maximum(cv2.blur(squares, (WINDOW_PX, WINDOW_PX))[inner:-inner, inner:-inner], 0)
    if whole == 0 or not means.size:
        return EVEN_TEXTURE
    relative = np.maximum(np.sqrt(means) / whole, _WEAKEST)
    return WindowTexture(1 / float(np.median(relative)), float(np.std(np.log(relative))))
